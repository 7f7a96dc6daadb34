"""Frames that are unlike the others of their run: empty, copies of another, or at another level."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

KINDS = ("empty", "copied", "far")
#: Frames whose level is farther than this many robust standard deviations from those around them are odd, if
#: they are no more than this share of the run: what more frames do is a property of the sensor.
_FAR, _MOST = 6.5, 0.05
FAR_CHANCE = math.erfc(_FAR / math.sqrt(2.0))  # of one frame to be as far, by a normal law
_AROUND, _FEWEST_FRAMES, _FEWEST_PIXELS = 101, 32, 64


def odd_frames(
    level: FloatArray, variance: FloatArray, digest: NDArray[np.int64], pixels: int
) -> dict[str, IntArray]:
    """Return frames that are empty (all pixels at one DN), copies of an earlier one, or far from the others.

    Args:
        level: of each frame over its pixels, DN, (n,).
        variance: likewise, DN^2; it bounds what independent pixels do to the level.
        digest: of the content of each frame, (n,).
        pixels: of a frame; of few pixels chance makes all of these.
    """
    if level.size < _FEWEST_FRAMES or pixels < _FEWEST_PIXELS:
        return {kind: np.zeros(0, np.int64) for kind in KINDS}
    away, size = levels_apart(level), _around(level)
    # around a frame the levels spread by a drift, too, which the median at an end of the run does not follow
    low, high = (ndimage.percentile_filter(level, share, size) for share in (25, 75))
    floor = max(1.4826 * float(np.median(np.abs(away))), float(np.sqrt(np.median(variance) / pixels)))
    empty = (variance == 0.0) & (np.abs(level - np.median(level)) > _FAR * floor)
    far = (np.abs(away) > _FAR * np.maximum((high - low) / 1.349, floor)) & ~empty
    _, first, kind = np.unique(digest, return_index=True, return_inverse=True)
    copied = (first[kind] != np.arange(level.size)) & ~empty
    far &= ~copied
    if far.sum() > _MOST * level.size:
        far[:] = False
    return {"empty": np.flatnonzero(empty), "copied": np.flatnonzero(copied), "far": np.flatnonzero(far)}


def levels_apart(level: FloatArray) -> FloatArray:
    """Return the levels of frames less the median of those around them in time, DN."""
    return np.asarray(level - ndimage.median_filter(level, _around(level)))


def _around(level: FloatArray) -> int:
    return min(_AROUND, max(level.size // 2, 1))


def left_out(odd: dict[str, IntArray], n_frames: int) -> IntArray:
    """Return the frames that are left out of sums, increasing: of copies only a few."""
    few = odd["copied"].size <= _MOST * n_frames
    return np.unique(np.concatenate([frames for kind, frames in odd.items() if kind != "copied" or few]))


def frame_words(frames: IntArray, most: int = 4) -> str:
    """Return the numbers of frames in words, those that follow each other as a range: frames 0 to 4, 17."""
    if not frames.size:
        return ""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    if len(runs) > most:
        return f"{frames.size:,} frames from {frames[0]} to {frames[-1]}"
    words = [f"{run[0]} to {run[-1]}" if run.size > 1 else f"{run[0]}" for run in runs]
    return f"frame{'s' if frames.size > 1 else ''} {', '.join(words)}"


def odd_words(odd: dict[str, IntArray], mean: FloatArray) -> str:
    """Return which frames are odd and why; ``mean`` of all frames, DN."""
    away, words = levels_apart(mean), []
    nothing = np.zeros(0, np.int64)
    far = odd.get("far", nothing)
    above = away[far] > 0
    for frames, says in (
        (odd.get("empty", nothing), "empty"),
        (odd.get("copied", nothing), "equal to an earlier frame"),
        (far[above], "DN above the others"),
        (far[~above], "DN below the others"),
    ):
        if frames.size:
            size = f"{float(np.median(np.abs(away[frames]))):.2g} " if says.startswith("DN") else ""
            words.append(f"{frame_words(frames)} {'is' if frames.size == 1 else 'are'} {size}{says}")
    return "; ".join(words)
