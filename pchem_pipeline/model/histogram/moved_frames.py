"""Frames whose pixels look moved by one column or row, by the fixed pattern of the sensor.

The pattern is the mean of the first frames. Let ``d`` be the difference of a pixel's neighbour from the
pixel, and ``u`` the deviation of a sample from the mean of its pixel, both over its standard deviation along
time. In a frame that has not moved ``sum(u d)`` is N(0, sum d^2), in one that has moved by that much its mean
is ``sum d^2``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.histogram.odd_frames import FAR, FEWEST_FRAMES

_FloatArray = NDArray[np.float32]

#: Standard deviations beyond which a difference or a deviation of a single pixel does not count any more.
_CLIP = 3.0
#: Rows and columns by which a frame may have moved, and the kinds of two of them each.
_STEPS, _KINDS = ((0, 1), (0, -1), (1, 0), (-1, 0)), ("moved_x", "moved_y")


class MovedFrames:
    """Compares the frames that come in with the pattern of the first of them."""

    def __init__(self, found: Mapping[str, Sequence[int]] | None = None, n_frames: int = 0) -> None:
        """Begin with no frames, or behind so many of which some were found."""
        self._pattern: _Pattern | None = None
        self._n = n_frames
        self.found = {kind: list((found or {}).get(kind, ())) for kind in _KINDS}

    def learn(self, mean: NDArray[np.float64], sd: NDArray[np.float64], n_frames: int) -> None:
        """Take mean and standard deviation of each pixel over some frames, (y, x), DN, as the pattern."""
        if n_frames < FEWEST_FRAMES:
            return
        weight = np.divide(1.0, sd, where=sd > 0, out=np.zeros(sd.shape))
        shown = np.pad(mean, 1, constant_values=np.nan)
        ny, nx = mean.shape
        neighbours = np.stack([shown[1 - dy :, 1 - dx :][:ny, :nx] for dy, dx in _STEPS], axis=-1)
        scaled = ((neighbours - mean[..., None]) * weight[..., None]).reshape(-1, len(_STEPS))
        clipped = np.nan_to_num(np.clip(scaled, -_CLIP, _CLIP))
        # what an offset of the frame, other light (as the variances are) or another gain do is no movement
        modes = np.stack([weight, sd, mean * weight], axis=-1).reshape(-1, 3)
        differences = clipped - modes @ np.linalg.lstsq(modes, clipped, rcond=None)[0]
        self._pattern = _Pattern(
            mean.ravel().astype(np.float32),
            weight.ravel().astype(np.float32),
            differences.astype(np.float32),
            (differences**2).sum(axis=0),
            np.count_nonzero(clipped, axis=0) / n_frames,
        )

    def add(self, frames: NDArray[np.unsignedinteger[Any]]) -> None:
        """Compare the next frames, (frame, y, x), of the same rows each."""
        if self._pattern is None:
            self.learn(frames.mean(axis=0), frames.std(axis=0), len(frames))
        if self._pattern is not None:
            for t, kind in self._pattern.moved(frames.reshape(len(frames), -1)):
                self.found[kind].append(self._n + t)
        self._n += len(frames)


@dataclass(frozen=True)
class _Pattern:
    """The pattern of the sensor.

    Attributes:
        mean: of each pixel, DN, (p,).
        weight: one over its standard deviation along time, 1/DN; 0 of a pixel that never changes.
        differences: ``d`` of each pixel and step, (p, step).
        squares: their sums of squares, (step,).
        bias: by which ``sum(u d)`` is too large, as the error of the mean is in both, (step,).
    """

    mean: _FloatArray
    weight: _FloatArray
    differences: _FloatArray
    squares: NDArray[np.float64]
    bias: NDArray[np.float64]

    def moved(self, frames: NDArray[np.unsignedinteger[Any]]) -> Iterator[tuple[int, str]]:
        """Yield the number and kind of each frame, (frame, p), that fits better if it has moved."""
        u = frames.astype(np.float32)
        u -= self.mean
        u *= self.weight
        np.clip(u, -_CLIP, _CLIP, out=u)
        products = u @ self.differences - self.bias
        noise = np.maximum(np.einsum("tp,tp->t", u, u) / max(np.count_nonzero(self.weight), 1), 1.0)
        better = products - 0.5 * self.squares
        certain = products > FAR * np.sqrt(noise[:, None] * self.squares)
        for t in np.flatnonzero((certain & (better > 0)).any(axis=1)).tolist():
            yield t, _KINDS[int(np.where(certain[t], better[t], 0.0).argmax()) // 2]
