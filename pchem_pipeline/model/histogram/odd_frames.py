"""Frames that are unlike the others of their run: empty, copies of another, or at another level."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Means of frames farther than this many robust standard deviations from those around them in time are odd,
#: if they are no more than this share of the run: what more frames do is a property of the sensor.
_FAR, _MOST = 8.0, 0.05
FAR_CHANCE = 1.3e-15  # of one frame to be as far, by a normal law
_AROUND, _FEWEST_FRAMES, _FEWEST_PIXELS = 101, 32, 64


def far_frames(mean: FloatArray, variance: FloatArray, pixels: int) -> IntArray:
    """Return the frames whose mean is far from those around them in time, at most 5 % of all.

    Args:
        mean: of each frame over its pixels, DN, (n,).
        variance: likewise, DN^2; it bounds what independent pixels do to the mean.
        pixels: of a frame.
    """
    if mean.size < _FEWEST_FRAMES or pixels < _FEWEST_PIXELS:
        return np.zeros(0, np.int64)
    away, size = levels_apart(mean), _around(mean)
    # around a frame the means spread by a drift, too, which the median at an end of the run does not follow
    low, high = (ndimage.percentile_filter(mean, share, size) for share in (25, 75))
    floor = max(1.4826 * float(np.median(np.abs(away))), float(np.sqrt(np.median(variance) / pixels)))
    return _few(np.flatnonzero(np.abs(away) > _FAR * np.maximum((high - low) / 1.349, floor)), mean.size)


def levels_apart(mean: FloatArray) -> FloatArray:
    """Return the means of frames less the median of those around them in time, DN."""
    return np.asarray(mean - ndimage.median_filter(mean, _around(mean)))


def _around(mean: FloatArray) -> int:
    return min(_AROUND, max(mean.size // 2, 1))


def copied_frames(
    mean: FloatArray, variance: FloatArray, digests: Callable[[IntArray], list[bytes]]
) -> IntArray:
    """Return the frames that equal an earlier one.

    Args:
        mean: of each frame over its pixels, DN, (n,).
        variance: likewise, DN^2.
        digests: of the sums along the rows of some frames.
    """
    _, kind, number = np.unique(mean + 1j * variance, return_inverse=True, return_counts=True)
    alike = np.flatnonzero(number[kind] > 1)
    seen: set[bytes] = set()
    copies = []
    for t, digest in zip(alike.tolist(), digests(alike), strict=True):
        if digest in seen:
            copies.append(t)
        seen.add(digest)
    return np.array(copies, np.int64)


def left_out(odd: dict[str, IntArray], n_frames: int) -> IntArray:
    """Return the frames that are left out of sums, increasing: all empty ones, and of others a few."""
    some = [odd["empty"], _few(odd["copied"], n_frames), odd["far"]]
    return np.unique(np.concatenate(some)).astype(np.int64)


def frame_words(frames: IntArray, most: int = 4) -> str:
    """Return the numbers of frames in words, those that follow each other as a range: frames 0 to 4, 17."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    if len(runs) > most:
        return f"{frames.size:,} frames from {frames[0]} to {frames[-1]}"
    words = [f"{run[0]} to {run[-1]}" if run.size > 1 else f"{run[0]}" for run in runs]
    return f"frame{'s' if frames.size > 1 else ''} {', '.join(words)}"


def odd_words(odd: dict[str, IntArray], mean: FloatArray) -> str:
    """Return which frames are odd and why; ``mean`` of all frames, DN."""
    away = levels_apart(mean)
    words = []
    for kind, says in (("empty", "empty"), ("copied", "equal to an earlier one")):
        if odd[kind].size:
            words.append(f"{frame_words(odd[kind])} {'is' if odd[kind].size == 1 else 'are'} {says}")
    for sign, side in ((1.0, "above"), (-1.0, "below")):
        far = odd["far"][sign * away[odd["far"]] > 0]
        if far.size:
            dn = f"{float(np.median(np.abs(away[far]))):.2g} DN {side} the others"
            words.append(f"{frame_words(far)} {'is' if far.size == 1 else 'are'} {dn}")
    return "; ".join(words)


def _few(frames: IntArray, n_frames: int) -> IntArray:
    return frames if frames.size <= _MOST * n_frames else frames[:0]
