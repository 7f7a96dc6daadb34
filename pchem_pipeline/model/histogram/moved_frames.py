"""Frames whose pixels look moved by one column or row, by the fixed pattern of the sensor.

The pattern is the mean of the first frames. Let ``d`` be the difference of a pixel's neighbour from the
pixel, and ``u`` the deviation of a sample from the mean of its pixel, both over its standard deviation along
time. In a frame that has not moved ``sum(u d)`` is N(0, sum d^2), in one that has moved by that much its mean
is ``sum d^2``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.histogram.odd_frames import FAR, FEWEST_FRAMES
from pchem_pipeline.model.histogram.spectrum import MOST_SAMPLES

#: Standard deviations beyond which a difference or a deviation of a single pixel does not count any more.
_CLIP = 3.0
#: Rows and columns by which a frame may have moved, and the kinds of two of them each.
_STEPS, _KINDS = ((0, 1), (0, -1), (1, 0), (-1, 0)), ("moved_x", "moved_y")


class MovedFrames:
    """Compares the frames that come in with the pattern of the first of them.

    Attributes:
        found: numbers of the frames that look moved, by kind.
    """

    def __init__(self, found: Mapping[str, Sequence[int]] | None = None, n_frames: int = 0) -> None:
        """Begin with no frames, or behind so many of which some were found."""
        self._n, self._known = n_frames, False
        self.found = {kind: list((found or {}).get(kind, ())) for kind in _KINDS}

    def learn(self, mean: FloatArray, sd: FloatArray, n_frames: int) -> None:
        """Take mean and standard deviation of each pixel over some frames, (y, x), DN, as the pattern."""
        if n_frames < FEWEST_FRAMES:
            return
        (ny, nx), weight = mean.shape, np.divide(1.0, sd, where=sd > 0, out=np.zeros(sd.shape))
        shown = np.pad(mean, 1, constant_values=np.nan)
        neighbours = np.stack([shown[1 - dy :, 1 - dx :][:ny, :nx] for dy, dx in _STEPS], axis=-1)
        scaled = ((neighbours - mean[..., None]) * weight[..., None]).reshape(-1, len(_STEPS))
        clipped = np.nan_to_num(np.clip(scaled, -_CLIP, _CLIP))
        # what an offset of the frame, other light (as the variances are) or another gain do is no movement
        modes = np.stack([weight, sd, mean * weight], axis=-1).reshape(-1, 3)
        differences = clipped - modes @ np.linalg.lstsq(modes, clipped, rcond=None)[0]
        self._squares = (differences**2).sum(axis=0)
        self._bias = np.count_nonzero(clipped, axis=0) / n_frames  # the error of the mean is in u and in d
        self._mean, self._weight, self._differences = (
            each.astype(np.float32) for each in (mean.ravel(), weight.ravel(), differences)
        )
        self._known = True

    def add(self, frames: NDArray[np.unsignedinteger[Any]]) -> None:
        """Compare the next frames, (frame, y, x), of the same rows each."""
        step = max(FEWEST_FRAMES, MOST_SAMPLES // max(frames[0].size, 1))
        for part in (frames[t : t + step] for t in range(0, len(frames), step)):
            if not self._known:
                self.learn(part.mean(axis=0), part.std(axis=0), len(part))
            if self._known:
                self._compare(part.reshape(len(part), -1))
            self._n += len(part)

    def _compare(self, frames: NDArray[np.unsignedinteger[Any]]) -> None:
        """Add the frames, (frame, pixel), that fit better if they have moved."""
        u = frames.astype(np.float32)
        u -= self._mean
        u *= self._weight
        np.clip(u, -_CLIP, _CLIP, out=u)
        products = u @ self._differences - self._bias
        noise = np.maximum(np.einsum("tp,tp->t", u, u) / max(np.count_nonzero(self._weight), 1), 1.0)
        better = products - 0.5 * self._squares
        better[products <= FAR * np.sqrt(noise[:, None] * self._squares)] = 0.0
        for t in np.flatnonzero((better > 0).any(axis=1)).tolist():
            self.found[_KINDS[int(better[t].argmax()) // 2]].append(self._n + t)
