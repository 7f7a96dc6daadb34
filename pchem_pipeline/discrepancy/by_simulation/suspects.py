"""Parts of the sensor and of the run that differ from the rest: guesses of the place of an effect.

What the scans of :mod:`pchem_pipeline.discrepancy.where` find in maps of pixels and series of frames, and the
rows and columns whose means move together from frame to frame, unlike the others: a common mode of a part is
far larger in those than in any map. A guess only adds hypotheses, which are compared with all others; so it
must stand out far beyond what chance does anywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.places import FEWEST_FRAMES, FEWEST_PIXELS, Part
from pchem_pipeline.discrepancy.scan import scan_series
from pchem_pipeline.discrepancy.where import frame_series, suspected_regions
from pchem_pipeline.effects.framework.evidence import Evidence, TimeSeries
from pchem_pipeline.effects.framework.region import Region, Taps, When

__all__ = ["suspected_parts"]

FloatArray = NDArray[np.float64]

_SIGNIFICANCE = 1e-6  # of a place among all places of all maps and series
_FAR = 7.0  # standard deviations of a common mode, and of frames
_LARGEST = 0.6  # of sensor or run
_CONTRAST = 0.4  # of the mean inside, the most that the mean outside may have
_PERIODS = (2, 4, 8, 16)
_TREND = 0.7  # of the deviation of a range, what a trend from end to end may explain


class _Found(NamedTuple):
    """A part, and by how many standard deviations it differs from the rest."""

    z: float
    part: Part


def suspected_parts(evidence: Evidence) -> tuple[Part, ...]:
    """Return the parts that stand out most from the rest: at most a region and a range, and both together."""
    time = evidence.time
    if time is None:
        return ()
    usable = evidence.maps.usable
    shape = usable.shape[0], usable.shape[1]
    modes = (each for each in _common_modes(time, shape) if each.z > _FAR)
    regions = [*_regions(evidence, usable), *modes]
    places = [each for each in (regions, _stretches(evidence, time)) if each]
    best = [max(each, key=lambda one: one.z).part for each in places]
    if len(best) > 1:
        best.append(Part(best[0].region, best[1].when))
    return tuple(best)


def _regions(evidence: Evidence, usable: NDArray[np.bool_]) -> Iterator[_Found]:
    """Yield the places of maps that stand out while little of it is elsewhere."""
    for suspects in suspected_regions(evidence, _SIGNIFICANCE).values():
        for one in suspects:
            mask = one.region.mask((usable.shape[0], usable.shape[1]))
            inside = int((usable & mask).sum())
            if one.only_there and FEWEST_PIXELS <= inside <= _LARGEST * usable.sum():
                yield _Found(abs(one.z), Part(one.region))


def _stretches(evidence: Evidence, time: TimeSeries) -> list[_Found]:
    """Return the frames of series that stand out, but for what goes on rising from end to end of the run."""
    found = []
    series = frame_series(evidence)
    for channel in ("charge", "readout"):
        # noise of the frames in some of them only
        series[f"scatter.{channel}"] = (series[f"frame.{channel}"] ** 2 - 1.0) / np.sqrt(2.0)
    for name, values in series.items():
        for one in scan_series(values, time.frames, significance=_SIGNIFICANCE / len(series)):
            inside = int(one.when.frames(time.frames).sum())
            some = FEWEST_FRAMES <= inside <= _LARGEST * time.frames.size
            # a scatter that is less is that of the frames beside it which is more
            some = some and (one.inside > one.outside or name.startswith("frame."))
            # levels that alternate or beat are effects in all frames, which have names
            some = some and not (one.when.every and name.startswith("frame."))
            if some and abs(one.z) > max(_FAR, _slope(values) / _TREND):
                found.append(_Found(abs(one.z), Part(None, _with_unseen(one.when, time.frames))))
    return found


def _with_unseen(when: When, seen: NDArray[np.int64]) -> When:
    """Return a range with half of the frames at its ends that were not looked at."""
    if len(when.range) != 1:
        return when
    first, last = when.range[0]
    before, after = seen[seen < first], seen[seen >= last]
    first -= int(first - before[-1] - 1) // 2 if before.size else 0
    last += int(after[0] - last) // 2 if after.size else 0
    return when.model_copy(update={"range": ((first, last),)})


def _slope(values: FloatArray) -> float:
    """Return by how many standard deviations a series rises or falls along the run."""
    return float(abs(np.corrcoef(np.arange(values.size), values)[0, 1]) * np.sqrt(values.size))


def _common_modes(time: TimeSeries, shape: tuple[int, int]) -> Iterator[_Found]:
    """Yield the bands of columns and rows whose means move together from frame to frame, unlike the others.

    Where both a band of rows and one of columns do, it is the box in which they cross.
    """
    for rows, columns in ((time.row_readout, time.column_readout), (time.row_charge, time.column_charge)):
        found = [_band_of_lines(values) for values in (rows, columns)]
        z, taps = _taps_of_lines(columns)
        if taps is not None and z > max(each[0] for each in found):
            yield _Found(z, Part(Region(taps=taps)))
        spans = [span if z > _FAR else (0, size) for (z, span), size in zip(found, shape, strict=True)]
        mask = np.zeros(shape, np.bool_)
        mask[spans[0][0] : spans[0][1], spans[1][0] : spans[1][1]] = True
        if not mask.all():
            yield _Found(max(z for z, _ in found), Part(Region.of_mask(mask)))


def _correlations(means: NDArray[np.floating]) -> FloatArray:
    """Return the correlations of the lines' means over the frames, about N(0, 1) each, 0 on the diagonal."""
    with np.errstate(invalid="ignore", divide="ignore"):
        series = (means - means.mean(axis=0)) / means.std(axis=0)
    series = np.where(np.isfinite(series), series, 0.0).astype(np.float64)
    found = series.T @ series / np.sqrt(series.shape[0])
    np.fill_diagonal(found, 0.0)
    return np.asarray(np.clip(found, -_FAR, _FAR))


def _pairs_contrast(
    inside: FloatArray, one: FloatArray, n: FloatArray, total: float, lines: int
) -> FloatArray:
    """Return the contrast of sums over pairs of lines, both inside, against those with both outside.

    Args:
        inside: sums over pairs of lines in the set.
        one: sums over pairs of which one is.
        n: lines in the set.
        total: sum over all pairs.
        lines: number of all lines.
    """
    pairs, others = n * (n - 1.0), (lines - n) * (lines - n - 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        within, beyond = inside / pairs, (total - 2.0 * one + inside) / others
        z = (within - beyond) / np.sqrt(2.0 / pairs + 2.0 / others)
    allowed = (n <= _LARGEST * lines) & (np.abs(beyond) < _CONTRAST * within)
    return np.where(allowed & np.isfinite(z), z, 0.0)


def _band_of_lines(means: NDArray[np.floating]) -> tuple[float, tuple[int, int]]:
    """Return the band of lines that move together most, and by how many standard deviations they do."""
    matrix = _correlations(means)
    lines = matrix.shape[0]
    if lines < 4:
        return 0.0, (0, lines)
    sums = np.pad(matrix, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    a, b = np.triu_indices(lines + 1, 2)
    inside = sums[b, b] - sums[a, b] - sums[b, a] + sums[a, a]
    one = sums[b, -1] - sums[a, -1]
    z = _pairs_contrast(inside, one, (b - a).astype(np.float64), float(sums[-1, -1]), lines)
    best = int(z.argmax())
    return float(z[best]), (int(a[best]), int(b[best]))


def _taps_of_lines(means: NDArray[np.floating]) -> tuple[float, Taps | None]:
    """Return the same for every so many lines."""
    matrix = _correlations(means)
    lines = matrix.shape[0]
    found: tuple[float, Taps | None] = (0.0, None)
    for every in (each for each in _PERIODS if 2 * each <= lines):
        for phase in range(every):
            some = np.arange(lines) % every == phase
            inside = np.asarray(matrix[np.ix_(some, some)].sum())
            n = np.asarray(float(some.sum()))
            z = float(_pairs_contrast(inside, np.asarray(matrix[some].sum()), n, float(matrix.sum()), lines))
            if z > found[0]:
                found = z, Taps(every=every, which=(phase,))
    return found
