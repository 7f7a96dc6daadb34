"""Frames that are unlike the others of their run: empty, copied, moved, or of another level or spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import ndimage, special, stats

from pchem_pipeline.base.arrays import BoolArray, CodeArray, FloatArray, IntArray
from pchem_pipeline.base.wording import short
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.histogram.spectrum import MOST_SAMPLES
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
#: Standard deviations beyond which a difference or a deviation of a single pixel does not count any more.
_CLIP = 3.0
#: Rows and columns by which a frame may have moved, and the kinds of two of them each.
_STEPS, _KINDS = ((0, 1), (0, -1), (1, 0), (-1, 0)), ("moved_x", "moved_y")


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
    # normal quantiles of ranks, equal values at their mean rank
    ranks = (stats.rankdata(each, axis=0) for each in (away, squares - sums * (sums / columns)))
    level, spread = (np.asarray(special.ndtri(each / (len(each) + 1))) for each in ranks)
    n_parts, found = min(_PARTS, sums.shape[1] // _PART_ROWS), [spread]
    if n_parts > 1:
        found += [part for each in (level, spread) for part in np.array_split(each, n_parts, axis=1)]
    return np.stack([each.sum(axis=1) / np.sqrt(each.shape[1]) for each in found])


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


class MovedFrames:
    """Finds frames whose pixels look moved by one column or row, by the fixed pattern of the sensor.

    The pattern is the mean of the first frames. Let ``d`` be the difference of a pixel's neighbour from the
    pixel, and ``u`` the deviation of a sample from the mean of its pixel, both over its standard deviation
    along time. In a frame that has not moved ``sum(u d)`` is N(0, sum d^2), in one that has moved by that
    much its mean is ``sum d^2``.

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

    def add(self, frames: CodeArray) -> None:
        """Compare the next frames, (frame, y, x), of the same rows each."""
        step = max(FEWEST_FRAMES, MOST_SAMPLES // max(frames[0].size, 1))
        for part in (frames[t : t + step] for t in range(0, len(frames), step)):
            if not self._known:
                self.learn(part.mean(axis=0), part.std(axis=0), len(part))
            if self._known:
                self._compare(part.reshape(len(part), -1))
            self._n += len(part)

    def _compare(self, frames: CodeArray) -> None:
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
