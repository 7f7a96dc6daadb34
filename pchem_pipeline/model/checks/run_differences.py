"""How two runs differ: value by value, and map by map in units of the standard errors.

Whether a difference of two measurements is chance is judged by order statistics, which a few odd pixels do
not move, with limits of five standard errors (false alarm 6e-7 each), and pixel by pixel at a false-discovery
rate over all maps. Single pixels that stand out are confirmed by the likelihood ratio of a common fit: where
the likelihood is not quadratic, a few estimates in 10,000 are many of their own standard errors off.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, erfc, ndtri

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.statistics import false_discovery
from pchem_pipeline.model.checks.settings import allowed
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.maps.maps import summarise

#: Standard errors beyond which a single pixel, or a statistic of all pixels, counts as changed.
LIMIT = 5.0
#: Bias of the estimates times the number of frames, in standard errors of one frame: up to 4.5, measured.
_BIAS = 5.0
#: By how much the standard errors of the fits themselves may be wrong.
_TRUST = 0.1
#: Pixels of a row or column from which its median says something.
_LEAST_LINE = 8
#: Share of the pixels that non-quadratic likelihoods can make stand out; more need no confirmation.
_FEW = 0.01


@dataclass(frozen=True)
class BlockDifference:
    """What differs between two blocks of values."""

    n_values: int  # values compared
    n_different: int  # values that are not equal; NaN equals NaN
    n_beyond: int  # values that differ by more than rounding, NaN against a number included
    largest: float  # largest absolute difference of two numbers, in their unit

    def __add__(self, other: BlockDifference) -> BlockDifference:
        """Return both blocks together."""
        return BlockDifference(
            self.n_values + other.n_values,
            self.n_different + other.n_different,
            self.n_beyond + other.n_beyond,
            max(self.largest, other.largest),
        )


def compare_blocks(
    one: NDArray[np.generic], other: NDArray[np.generic], *, scale: float, tolerance: float
) -> BlockDifference:
    """Compare two blocks of integers or floats, of one shape, value by value.

    A difference of ``tolerance`` counts as rounding, relative to the largest absolute value of the whole
    array, ``scale``, since many values are differences of large ones; between integers none does.
    """
    if one.dtype.kind not in "fc" and other.dtype.kind not in "fc":
        tolerance = -1.0
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        apart = np.abs(a - b)
    same = (one == other) | (np.isnan(a) & np.isnan(b))
    close = same | (apart <= tolerance * scale)
    known = ~same & np.isfinite(apart)
    largest = float(np.max(apart, initial=0.0, where=known))
    return BlockDifference(a.size, int((~same).sum()), int((~close).sum()), largest)


@dataclass(frozen=True)
class MapDifference:
    """Two maps of one quantity, pixel by pixel.

    Attributes:
        difference: other minus one, in the unit of the map, shape (ny, nx); NaN where either has no value.
        z: the same in standard errors.
        median: median of the difference over the pixels that count.
        median_stderr: its standard error.
        median_z: median of ``z`` over them.
        limit: change that is allowed, in the unit of the map; 0: none.
        margin: the same in standard errors, (ny, nx).
        beyond_z: median of ``z`` less the margin, towards where the values moved.
        lines: of each row, then column: by how much the median of its ``z`` less `median_z` is beyond the
            margin, the same of the differences with its standard error, and the pixels that count,
            (4, ny + nx).
        spread_z: robust standard deviation of ``z`` over them; 1 where chance alone acts.
        n_counted: pixels that count: good fits in both.
        largest_z: largest absolute value of ``z`` among them.
        changed: those among them whose value changed, (ny, nx); see :func:`compare_maps`.
        n_changed: their number.
        p_value: probability that chance alone makes a map with a pixel like them, all maps and pixels that
            were looked at allowed for.
    """

    difference: FloatArray
    z: FloatArray
    median: float
    median_stderr: float
    median_z: float
    limit: float
    margin: FloatArray
    beyond_z: float
    lines: FloatArray
    spread_z: float
    n_counted: int
    largest_z: float
    changed: BoolArray = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    n_changed: int = 0
    p_value: float = 1.0


ValuesAndErrors = tuple[FloatArray, FloatArray]
#: The p-values of :func:`common_fit_p` of pixels (y, x).
CommonFit = Callable[[IntArray, IntArray], FloatArray]


def compare_maps(
    maps: Iterable[tuple[str, ValuesAndErrors, ValuesAndErrors]],
    good: BoolArray,
    *,
    same_data: bool,
    rate: float = 0.01,
    confirm: CommonFit | None = None,
    limits: Mapping[str, float | str | None] | None = None,
) -> dict[str, MapDifference]:
    """Compare the maps of two runs.

    A pixel changed where its ``z`` is significantly beyond the limit, at a false-discovery rate (Benjamini
    and Hochberg 1995) among the pixels of its map, with Bonferroni's factor for the number of maps. Where
    nothing changed, a pixel is found with at most that probability: standard errors a tenth too small, and
    the tails of fits, are allowed for.

    Args:
        maps: name of each, and its values and standard errors in either run, (ny, nx); NaN: no value.
        good: pixels with a good fit in both, (ny, nx).
        same_data: both are fits of the same frames: the errors are then not independent, and the unit is the
            standard error of one fit, ``sqrt((s1^2 + s2^2) / 2)``; else it is ``sqrt(s1^2 + s2^2)``.
        rate: share of the changed pixels that may be due to chance.
        confirm: p-values of pixels for a common fit of both runs, which those that stand out must pass, too;
            None: not known.
        limits: change of a map that is allowed, absolute or in per cent of the median of one.
    """
    found = {
        name: _difference(one, other, good, (limits or {}).get(name), same_data=same_data)
        for name, one, other in maps
    }
    tested = sum(each.n_counted for each in found.values())
    places, likely = [], []
    for each in found.values():
        beyond = np.maximum(np.abs(each.z) - each.margin, 0.0)
        probability = np.where(good, erfc(beyond / ((1.0 + _TRUST) * np.sqrt(2.0))), np.nan)
        places.append(np.nonzero(probability <= rate))  # the others are not significant in any company
        likely.append(probability[places[-1]])
    q = _q_values(likely, tested)
    odd = np.zeros(good.shape, np.bool_)
    for place, each_q in zip(places, q, strict=True):
        odd[place] |= each_q <= rate
    if confirm is not None and 0 < odd.sum() <= max(1.0, _FEW * good.sum()):
        p = np.zeros(good.shape)
        p[odd] = confirm(*np.nonzero(odd))
        q = _q_values([np.fmax(a, p[place]) for a, place in zip(likely, places, strict=True)], tested)
    for name, place, each_q in zip(found, places, q, strict=True):
        changed = np.zeros(good.shape, np.bool_)
        changed[place] = each_q <= rate
        smallest = float(np.min(each_q, initial=1.0))
        found[name] = replace(found[name], changed=changed, n_changed=int(changed.sum()), p_value=smallest)
    return found


def _q_values(likely: Sequence[FloatArray], tested: int) -> list[FloatArray]:
    """Return the q-values of the smallest p-values of each map, out of all that were tested."""
    # map by map: where one has changed throughout, no pixel of another is let through in its company
    return [false_discovery(few * (tested / max(few.size, 1))) for few in likely]


def common_fit_p(
    limits: tuple[int, int] | None, counts: Sequence[NDArray[Any]], origins: Sequence[NDArray[Any]]
) -> FloatArray:
    """Return the p-values of one (H, g, mu, sigma) for both histograms of each pixel, against one for each.

    Twice the gain in log-likelihood by separate fits is chi-square with 4 degrees of freedom (Wilks 1938),
    also where the likelihood is not quadratic. The histograms of either run are of shape (n, B), with the DN
    of bin 0 (n,), between the limits of the ADC, DN, if known. NaN where a fit failed.
    """
    origin = np.minimum(*origins)
    places = [(own - origin)[:, None] + np.arange(n.shape[1]) for n, own in zip(counts, origins, strict=True)]
    both = np.zeros((origin.size, 1 + max(int(each.max(initial=0)) for each in places)), np.uint32)
    for n, place in zip(counts, places, strict=True):
        both[np.arange(origin.size)[:, None], place] += n
    # every sample counts in all three, or the likelihoods would not be of the same data
    settings = FitSettings(likelihood="exact", tail_guard=0.0)
    one, other, together = (
        fit_histograms(n, first, adc_limits=limits, settings=settings).log_likelihood
        for n, first in zip((*counts, both), (*origins, origin), strict=True)
    )
    return np.asarray(chdtrc(4.0, np.maximum(2.0 * (one + other - together), 0.0)))


def _difference(
    one: ValuesAndErrors,
    other: ValuesAndErrors,
    good: BoolArray,
    limit: float | str | None,
    *,
    same_data: bool,
) -> MapDifference:
    difference = other[0] - one[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = np.sqrt((one[1] ** 2 + other[1] ** 2) / (2.0 if same_data else 1.0))
        z = np.where(unit > 0, difference / unit, np.nan)
        counts = good & np.isfinite(z)
        most = allowed(limit, summarise(one[0][counts]).median)
        margin = np.where(unit > 0, most / unit, np.nan)
    counted, core = z[counts], summarise(z[counts])
    whole = summarise(difference[counts])
    moved, most_z, change, error = (
        _line_medians(values, counts) for values in (z - core.median, margin, difference - whole.median, unit)
    )
    in_line = np.concatenate([counts.sum(1), counts.sum(0)])
    error *= np.sqrt(np.pi / (2.0 * np.maximum(in_line, 1)))
    beyond = summarise(np.sign(core.median) * counted - margin[counts]).median
    return MapDifference(
        difference=difference,
        z=z,
        median=whole.median,
        median_stderr=whole.median_stderr,
        median_z=core.median,
        limit=most,
        margin=margin,
        beyond_z=beyond,
        lines=np.stack([np.abs(moved) - most_z, change, error, in_line]),
        spread_z=core.robust_sd,
        n_counted=counted.size,
        largest_z=float(np.max(np.abs(counted), initial=0.0)),
    )


def _line_medians(values: FloatArray, counts: BoolArray) -> FloatArray:
    """Return the median of the pixels that count in each row, then column; NaN where none does."""
    known = np.where(counts, values, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of a line without any
        return np.concatenate([np.nanmedian(known, axis=axis) for axis in (1, 0)])


@dataclass(frozen=True)
class Reasons:
    """Why two measurements of a map differ by more than chance; all False where they do not."""

    shifted: bool  # the median is beyond the limit
    spread: bool  # ``z`` scatters more than its standard errors allow
    pixels: bool  # single pixels changed
    #: rows and columns that moved against the others by more than the limit: by how much, with its error
    lines: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Return whether there is any."""
        return self.shifted or self.spread or self.pixels or bool(self.lines)


def reasons_of_change(
    found: MapDifference, n_frames: Sequence[int] = (1, 1), kept: Sequence[float] = (1.0, 1.0)
) -> Reasons:
    """Judge two independent measurements of a map, from so many frames.

    Where all values moved by just the limit, ``z`` less the limit is N(0, 1): its median has standard error
    ``sqrt(pi / 2 n)``, its robust standard deviation ``1.166 / sqrt(n)`` (Maronna et al., *Robust
    Statistics*, 2019, Sec. 2.5), to which a tenth is added since the standard errors are estimates. The
    bias of the estimates falls as 1/N, and is not the same in runs of unlike numbers N of frames. Where a
    share f of N(0, 1) is kept, from one end on, its mean is ``phi(Phi^-1(f)) / f``: at most so far off are
    the estimates where of the good fits in the other run a share ``kept`` is good in this one, too.
    """
    n = found.n_counted
    if n < 2:
        return Reasons(False, False, False)
    share, f = 1.0 / np.asarray(n_frames), np.asarray(kept)
    bias = _BIAS * np.ptp(share) / np.sqrt(share.sum())
    mean = np.exp(-0.5 * ndtri(f) ** 2) / np.sqrt(2.0 * np.pi) / f
    bias += np.ptp(mean * np.sqrt(share / share.sum()))
    beyond, change, change_error, in_line = found.lines
    error = max(1.0 + _TRUST, found.spread_z) * np.sqrt(np.pi / (2.0 * np.maximum(in_line, 1)))
    rows = len(found.z)
    lines = np.flatnonzero((in_line >= _LEAST_LINE) & (beyond > bias + LIMIT * error))
    return Reasons(
        shifted=bool(found.beyond_z > bias + LIMIT * np.sqrt(np.pi / (2.0 * n))),
        spread=bool(found.spread_z > 1.0 + _TRUST + LIMIT * 1.166 / np.sqrt(n)),
        pixels=found.n_changed > 0,
        lines={
            f"row {i}" if i < rows else f"column {i - rows}": (float(change[i]), float(change_error[i]))
            for i in lines.tolist()
        },
    )
