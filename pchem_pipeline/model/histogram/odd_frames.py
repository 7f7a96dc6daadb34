"""Frames that are unlike the others of their run: empty, copied, moved, or of another level or spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import ndimage, special, stats

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.wording import short
from pchem_pipeline.model.arithmetic.robust import robust_sd
from pchem_pipeline.model.histogram.summaries import ROW_GROUP

KINDS = ("empty", "copied", "far", "moved_x", "moved_y")
#: Frames whose level, or spread, is farther than this many robust standard deviations from those around them
#: are odd, if they are no more than this share of the run: what more frames do is a property of the sensor.
FAR, _MOST = 7.0, 0.05
_AROUND, FEWEST_FRAMES, _FEWEST_PIXELS = 101, 32, 64
#: Parts of a frame that are looked at alone, and the fewest rows of a part: a particle's track is in a few.
_PARTS, _PART_ROWS = 4, 16
#: Chance of a frame to be as far, by a normal law, in its level or spread, of all rows or of one part.
FAR_CHANCE = (2 + 2 * _PARTS) * 2.0 * float(special.ndtr(-FAR))


def odd_frames(
    level: FloatArray,
    variance: FloatArray,
    digest: IntArray,
    pixels: int,
    *,
    scores: FloatArray | None = None,
    copies: bool = True,
    moved: Mapping[str, Sequence[int]] | None = None,
) -> dict[str, IntArray]:
    """Return frames that are empty (all pixels at one DN), copies of an earlier one, far or moved, by kind.

    Args:
        level: of each frame over its pixels, DN, (n,).
        variance: likewise, DN^2; it bounds what independent pixels do to the level.
        digest: of the content of each frame, (n,).
        pixels: of a frame; of few pixels chance makes all of these.
        scores: of :func:`frame_scores`, (k, n).
        copies: whether equal frames are copies; see :func:`chance_of_copies`.
        moved: those that look moved, see `MovedFrames`.
    """
    found = {kind: np.zeros(0, np.int64) for kind in KINDS}
    if level.size < FEWEST_FRAMES or pixels < _FEWEST_PIXELS:
        return found
    least = float(np.sqrt(np.median(variance) / pixels))
    far, floor = _far(level, least)
    empty = (variance == 0.0) & (np.abs(level - np.median(level)) > FAR * floor)
    for series in () if scores is None else scores:
        far |= _far(series, 1.0)[0]
    _, first, of = np.unique(digest, return_index=True, return_inverse=True)
    copied = (first[of] != np.arange(level.size)) & ~empty & copies
    far &= ~copied & ~empty
    if far.sum() > _MOST * level.size:
        far[:] = False
    for kind, frames in (moved or {}).items():
        found[kind] = np.setdiff1d(np.array(frames, np.int64), np.flatnonzero(empty | copied | far))
    some = {"empty": empty, "copied": copied, "far": far}
    return found | {kind: np.flatnonzero(frames) for kind, frames in some.items()}


def _far(level: FloatArray, least: float) -> tuple[BoolArray, float]:
    """Return which frames are far from those around them, and how much frames scatter at least."""
    away, size = levels_apart(level), _around(level)
    # around a frame the levels spread by a drift, too, which the median at an end of the run does not follow
    low, high = (ndimage.percentile_filter(level, share, size) for share in (25, 75))
    floor = max(robust_sd(away, 0.0), least)
    return np.abs(away) > FAR * np.maximum((high - low) / 1.349, floor), floor


def levels_apart(level: FloatArray) -> FloatArray:
    """Return the levels of frames less the median of those around them in time, DN."""
    return np.asarray(level - ndimage.median_filter(level, _around(level)))


def _around(level: FloatArray) -> int:
    return min(_AROUND, max(level.size // 2, 1))


def frame_scores(row_sum: IntArray, row_sum_square: IntArray, columns: int) -> FloatArray:
    """Return normal scores, (k, frame): the spread of all rows, then level and spread of parts of a frame.

    The level and the variance of a row, of so many columns, are ranked among the frames (van der Waerden
    1952) by the sums along rows, (frame, y). Of independent rows the sum of m scores over root m is N(0, 1),
    whatever the distribution of the samples.
    """
    some = np.s_[:, :: -(-row_sum.shape[1] // (_PARTS * ROW_GROUP))]
    sums, squares = row_sum[some], row_sum_square[some]
    away = sums - np.median(sums, axis=0)
    away -= np.median(away, axis=1)[:, None]
    level, spread = (_normal_scores(each) for each in (away, squares - sums * (sums / columns)))
    n_parts, found = min(_PARTS, sums.shape[1] // _PART_ROWS), [spread]
    if n_parts > 1:
        found += [part for each in (level, spread) for part in np.array_split(each, n_parts, axis=1)]
    return np.stack([each.sum(axis=1) / np.sqrt(each.shape[1]) for each in found])


def _normal_scores(values: FloatArray) -> FloatArray:
    """Return the normal quantiles of ranks along the first axis, equal values at their mean rank."""
    return np.asarray(special.ndtri(stats.rankdata(values, axis=0) / (len(values) + 1)))


def chance_of_copies(row_variance: FloatArray, n_frames: int) -> float:
    """Return how many pairs of frames have equal rows by chance.

    Of each row the sum of the variances of its pixels along time is given, DN^2, (y,).
    """
    alike = float(np.log(np.minimum(1.0, 0.5 / np.sqrt(np.pi * np.maximum(row_variance, 0.1)))).sum())
    return float(np.exp(max(alike + 2.0 * np.log(n_frames), -700.0)))


def left_out(odd: dict[str, IntArray], n_frames: int) -> IntArray:
    """Return the frames that are left out of sums, increasing: of moved ones only a few."""
    moved = [frames for kind, frames in odd.items() if kind.startswith("moved")]
    few = sum(frames.size for frames in moved) <= _MOST * n_frames
    rest = [frames for kind, frames in odd.items() if not kind.startswith("moved")]
    return np.unique(np.concatenate([*rest, *moved] if few else rest))


def frame_words(frames: IntArray, most: int = 4) -> str:
    """Return the numbers of frames in words, those that follow each other as a range: frames 0 to 4, 17."""
    if not frames.size:
        return ""
    runs = _runs(frames)
    if len(runs) > most:
        return f"{frames.size:,} frames from {frames[0]} to {frames[-1]}"
    return f"frame{'s' if frames.size > 1 else ''} {', '.join(runs)}"


def _runs(frames: IntArray) -> list[str]:
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    return [f"{run[0]} to {run[-1]}" if run.size > 1 else f"{run[0]}" for run in runs]


def odd_words(odd: dict[str, IntArray], mean: FloatArray, variance: FloatArray) -> str:
    """Return which frames are odd, by kind, and why, with mean and variance of all frames, (n,)."""
    away, excess = levels_apart(mean), levels_apart(variance)
    added, nothing = np.sqrt(np.abs(excess)), np.zeros(0, np.int64)
    far = odd.get("far", nothing)
    # a level that differs in a part of the frame scatters as much as it moves the mean, or more
    level = np.abs(away[far]) > 0.25 * added[far]
    above, noisier = away[far] > 0, excess[far] > 0
    words = []
    for frames, verbs, values, says in (
        (odd.get("empty", nothing), ("is", "are"), None, "empty"),
        (odd.get("copied", nothing), ("is", "are"), None, "equal to an earlier frame"),
        (far[level & above], ("is", "are"), away, "DN above the others"),
        (far[level & ~above], ("is", "are"), away, "DN below the others"),
        (far[~level & noisier], ("has", "have"), added, "DN rms more noise than the others"),
        (far[~level & ~noisier], ("has", "have"), added, "DN rms less noise than the others"),
        (odd.get("moved_x", nothing), ("looks", "look"), None, "moved by one column"),
        (odd.get("moved_y", nothing), ("looks", "look"), None, "moved by one row"),
    ):
        if frames.size:
            size = "" if values is None else f"{short(float(np.median(np.abs(values[frames]))), 2)} "
            runs = _runs(frames)
            listed = f": {', '.join(runs[:4])}, ..." if len(runs) > 4 else ""
            words.append(f"{frame_words(frames)} {verbs[frames.size > 1]} {size}{says}{listed}")
    return "; ".join(words)
