"""Scan statistics: the place on a map, or the stretch of a series, whose values stand out most.

Each value is about N(0, 1) and independent of the others where nothing is wrong. Of every place of some
family (bands of rows or columns, rectangles, discs, lines at a period, single pixels) the mean inside is
compared with the mean outside, so that something everywhere alike has no place. A series is a map of one row:
its bands are ranges of frames, its pixels single frames. The probability is that of the largest deviation
among all places of the family (the union bound), of all families: it counts every place that was looked at.

Samples beyond all that the PCD allows are few, and maps of their numbers nothing like normal: they are
events. Given how many there are in all, each lies by chance in a place with the share of it that the laws of
the pixels give, and in a range of frames with the share of its frames. Probabilities are those of binomial
laws, and only more than chance makes has a place. How many are expected in all does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.discrepancy.observe.rare import SEED
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.arithmetic.significance import PRICE, SIGNIFICANCE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Cells along an edge of a map on which all rectangles are tried, and of a series on which all ranges are.
_CELLS, _STRETCHES = 32, 400
_RADII = (1.5, 2.5, 4.0, 6.0, 9.0, 13.0, 19.0, 28.0)
_FINER = (0.72, 0.8, 0.9, 1.12, 1.25, 1.4)
#: Periods of lines, and of frames.
PERIODS, _FRAME_PERIODS = (2, 4, 8, 16, 32), range(2, 33)
#: Sweeps of the edges of a rectangle over the pixels, and of a range over the frames.
_SWEEPS = 3
_RIDGE = 1e-3  # of a covariance of series that may all but coincide
#: Pixels, frames or events of a place, at least.
FEWEST = 3
_LEAST = math.log(SMALLEST_MASS)  # of the smallest probability that is written
_SURE = 0.05  # probability of a chance among all single pixels of a place
_LITTLE = 0.25  # of the mean inside a place, that outside
_MOST_SINGLE = 1000  # frames that are listed
_MOST_EVENTS = 500  # frames with an event that are looked at: so many drawn of them tell a range as well


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A part of a map or of a series that stands out.

    Attributes:
        family: rows, columns, rectangle, disc, period or pixels; of frames range, period or frames.
        z: deviation of its mean from that of the rest, standard errors.
        log_p: logarithm of the probability of such a deviation by chance in any place.
        inside, outside: mean there and elsewhere.
        share: of its pixels that deviate, at least (at 95 %, for all places at once).
    """

    family: str
    z: float
    log_p: float
    inside: float
    outside: float
    share: float = 0.0

    @property
    def p(self) -> float:
        """Probability of such a deviation by chance, at least 1e-300."""
        return math.exp(max(self.log_p, _LEAST))

    @property
    def log_places(self) -> float:
        """Logarithm of the number of places that were looked at."""
        return max(self.log_p - float(special.log_ndtr(-abs(self.z))), 0.0)

    @property
    def only_there(self) -> bool:
        """Whether little of it is elsewhere."""
        return abs(self.outside) < _LITTLE * abs(self.inside)


@dataclass(frozen=True, kw_only=True)
class Suspect(Cluster):
    """A place on the sensor where a map stands out."""

    region: Region


@dataclass(frozen=True, kw_only=True)
class Stretch(Cluster):
    """Frames in which a series stands out."""

    when: When


@dataclass(frozen=True)
class Found:
    """The best place of a family, its deviation, and the logarithm of its probability."""

    family: str
    mask: BoolArray
    z: float
    log_p: float

    def means(self, values: FloatArray, some: BoolArray) -> dict[str, Any]:
        """Return what a :class:`Cluster` says of the place, with the means of values over pixels that count.

        Args:
            values: of the map, (y, x).
            some: pixels that count, (y, x).
        """
        inside, outside = (float(values[each].mean()) for each in (some & self.mask, some & ~self.mask))
        return {
            "family": self.family, "z": self.z, "log_p": self.log_p, "inside": inside, "outside": outside,
        }  # fmt: skip


_C = TypeVar("_C", bound=Cluster)


def successive(
    best: Callable[[BoolArray], tuple[BoolArray, _C] | None], some: BoolArray, most: int
) -> list[_C]:
    """Return what stands out most, then what does so without it, and so on.

    Args:
        best: returns the most significant place among pixels that count, and all its pixels; None without.
        some: pixels that count.
        most: places at most.
    """
    found: list[_C] = []
    while len(found) < most and (one := best(some)) is not None:
        some = some & ~one[0]
        found.append(one[1])
    return found


def scan_map(
    values: FloatArray,
    usable: BoolArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 3,
    single: bool = True,
    next_along: int | None = None,
) -> list[Suspect]:
    """Return the places that stand out of a map, the most significant first, each without those before it.

    Args:
        values: N(0, 1) where nothing is wrong, (y, x).
        usable: pixels that count, (y, x).
        significance: largest probability of a chance.
        most: places at most.
        single: look for single pixels, too; not where far tails are heavier than normal.
        next_along: axis along which each value is of a pixel and the next one: places reach one further.
    """
    some = usable & np.isfinite(values)

    def best(left: BoolArray) -> tuple[BoolArray, Suspect] | None:
        contrast = Contrast.of(values, left)
        if contrast is None:
            return None
        families = [*regions(contrast), _single(values, left) if single else None]
        found = _significant(best_place(contrast, families), values, left, significance, either_side=True)
        if found is None:
            return None
        deviations = np.where(some, math.copysign(1.0, found.z) * values, -np.inf)[some]
        share = affected_share(deviations, (found.mask & left)[some])
        region = Region.of_mask(_reaching(found.mask, next_along))
        return found.mask, Suspect(**found.means(values, left), region=region, share=share)

    return successive(best, some, most)


def scan_series(
    values: FloatArray,
    numbers: IntArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 2,
    shortest: int = FEWEST,
) -> list[Stretch]:
    """Return the frames that stand out of a series, the most significant first.

    Args:
        values: N(0, 1) and independent where nothing is wrong, (n,).
        numbers: frame numbers, increasing, (n,).
        significance: largest probability of a chance.
        most: stretches at most.
        shortest: frames that a range or a phase of a period must have.
    """
    row = values[None]

    def best(left: BoolArray) -> tuple[BoolArray, Stretch] | None:
        contrast = Contrast.of(row, left, shortest)
        if contrast is None:
            return None
        families = [
            _bands(contrast, 1, in_time=True),
            # a multiple of a period is no better than it
            _periodic(contrast, 1, numbers, _FRAME_PERIODS, cycles=4, better=1.02),
            _single(row, left),
        ]
        found = _significant(best_place(contrast, families, better=0.0), row, left, significance)
        if found is None:
            return None
        family, when = _frames(found, numbers)
        return found.mask, Stretch(**{**found.means(row, left), "family": family}, when=when)

    return successive(best, np.isfinite(row), most)


def _frames(found: Found, numbers: IntArray) -> tuple[str, When]:
    """Return the frames of a place in a series, and what they are."""
    at = numbers[found.mask[0]]
    if found.family == "columns":
        return "range", When(range=((int(at[0]), int(at[-1]) + 1),))
    if found.family == "period":
        period = int(np.gcd.reduce(np.diff(at)))
        return "period", When(every=period, phase=int(at[0]) % period)
    return "frames", When(single=tuple(int(number) for number in at[:_MOST_SINGLE]))


def _reaching(mask: BoolArray, axis: int | None) -> BoolArray:
    """Return a mask of pixels whose pairs with the next pixel along an axis are in the place."""
    if axis is None:
        return mask
    grown = mask.copy()
    after, before = (np.s_[1:], np.s_[:-1]) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
    grown[after] |= mask[before]
    return grown


def _significant(
    found: Found | None,
    values: FloatArray,
    some: BoolArray,
    significance: float,
    *,
    either_side: bool = False,
) -> Found | None:
    """Return a place with its deviation in terms of the scatter inside and outside (Welch), if significant.

    Where values scatter more, a mean that is off says less. ``either_side``: the place, or all outside of it
    where that is what deviates from 0.
    """
    if found is None:
        return None
    inside, outside = values[some & found.mask], values[some & ~found.mask]
    if either_side and abs(inside.mean()) < abs(outside.mean()):
        found = replace(found, mask=~found.mask, z=-found.z)
        inside, outside = outside, inside
    if found.family != "pixels":
        variance = max(inside.var(), 1.0) / inside.size + max(outside.var(), 1.0) / outside.size
        z = float((inside.mean() - outside.mean()) / np.sqrt(variance))
        if abs(z) < abs(found.z):
            places = found.log_p - float(special.log_ndtr(-abs(found.z)))
            found = replace(found, z=z, log_p=min(0.0, float(special.log_ndtr(-abs(z))) + places))
    return found if found.log_p <= math.log(significance) else None


def regions(contrast: Contrast) -> list[Found | None]:
    """Return the best place of a map of every family but single pixels, the simpler ones first."""
    return [
        _bands(contrast, 0),
        _bands(contrast, 1),
        _periodic(contrast, 0),
        _periodic(contrast, 1),
        _rectangle(contrast),
        _disc(contrast),
    ]


def best_place(contrast: Contrast, families: Sequence[Found | None], better: float = PRICE) -> Found | None:
    """Return the place of the smallest probability of all families; None where none divides the pixels.

    Args:
        contrast: of a map, (y, x).
        families: the best place of each.
        better: nats by which one of a later family must be less probable.
    """
    some = contrast.some > 0
    # a sensor of one row has no band of rows
    there = [
        each for each in families
        if each is not None and (some & each.mask).any() and (some & ~each.mask).any()
    ]  # fmt: skip
    if not there:
        return None
    best = there[0]
    for each in there[1:]:
        if each.log_p < best.log_p - better:
            best = each
    return replace(best, log_p=best.log_p + math.log(len(families)))


@dataclass(frozen=True)
class Contrast:
    """Values about the mean of all, 0 where they do not count, with what a mean over places needs.

    Attributes:
        values: of the map or series.
        some: 1 where they count, else 0.
        spread: standard deviation of a value.
        fewest: values of a place.
    """

    values: FloatArray
    some: FloatArray
    spread: float
    fewest: int = FEWEST

    @classmethod
    def of(cls, values: FloatArray, some: BoolArray, fewest: int = FEWEST) -> Contrast | None:
        """Clip and centre a map, to look for places of so many values or more; None where it has too few."""
        values = np.clip(np.where(some, values, 0.0), -FAR, FAR)
        inside = values[some]
        if inside.size <= 2 * FEWEST:
            return None
        # what stands out widens the spread of the whole: take it from the middle
        spread = max(1.0, float(np.subtract(*np.quantile(inside, [0.75, 0.25]))) / 1.349)
        return cls(np.where(some, values - inside.mean(), 0.0), some.astype(np.float64), spread, fewest)

    @property
    def n(self) -> float:
        """Pixels in all."""
        return float(self.some.sum())

    def z(self, sums: NDArray[Any], counts: NDArray[Any]) -> FloatArray:
        """Return the deviation of mean inside from mean outside, for places of such sums and counts."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z = sums / (self.spread * np.sqrt(counts * (1.0 - counts / self.n)))
        # sums over discs are whole numbers but for rounding
        return np.where((counts > self.fewest - 0.5) & (counts < self.n - self.fewest + 0.5), z, 0.0)


def _log_p(z: float, places: float) -> float:
    """Return the logarithm of the union bound over places, both signs, at most 0."""
    return min(0.0, float(special.log_ndtr(-abs(z))) + math.log(2.0 * places))


def _log_p_range(z: float, n: int, shortest: int) -> float:
    """Return the logarithm of the probability of such a range among n frames, both signs.

    Ranges overlap: of those of ``shortest`` frames or more far fewer are independent than there are. Siegmund
    (1992, eq. 1.3; Olshen et al. 2004) for the largest contrast of a range against the rest:
    ``b^3 phi(b) / 2 int nu(b / sqrt(n t (1 - t)))^2 / (t^2 (1 - t)) dt`` over t from ``shortest / n``.
    """
    union = _log_p(z, n**2 / 2)
    b, least = abs(z), shortest / n
    if b < 2.0 or least >= 0.5:
        return union
    t = np.geomspace(least, 1.0 - least, 500)
    x = b / np.sqrt(n * t * (1.0 - t))
    phi = np.exp(-(x**2) / 8.0) / np.sqrt(2.0 * np.pi)
    nu = (2.0 / x) * (special.ndtr(x / 2.0) - 0.5) / ((x / 2.0) * special.ndtr(x / 2.0) + phi)
    total = float(np.trapezoid(nu**2 / (t**2 * (1.0 - t)), t))
    return min(union, 3.0 * math.log(b) - b**2 / 2.0 - 0.5 * math.log(8.0 * math.pi) + math.log(total))


def _intervals(
    contrast: Contrast, sums: FloatArray, counts: FloatArray, cells: int | None = None
) -> tuple[float, int, int]:
    """Return the deviation and the ends of the best range of lines.

    Of all ranges, or of those of so many cells of lines, whose ends are then moved by lines.
    """
    n = sums.size
    cells = n if cells is None else min(cells, n)
    total, number = (np.concatenate([[0.0], np.cumsum(values)]) for values in (sums, counts))
    edges = np.unique(np.linspace(0, n, cells + 1).astype(int))
    some, many = total[edges], number[edges]
    z = np.triu(np.abs(contrast.z(some[None, :] - some[:, None], many[None, :] - many[:, None])), 1)
    first, last = (int(edges[i]) for i in np.unravel_index(int(np.argmax(z)), z.shape))
    near = math.ceil(n / cells) + 1
    for _ in range(2 if first < last and cells < n else 0):
        starts = np.arange(max(first - near, 0), min(first + near, last - 1) + 1)
        tried = contrast.z(total[last] - total[starts], number[last] - number[starts])
        first = int(starts[np.argmax(np.abs(tried))])
        ends = np.arange(max(last - near, first + 1), min(last + near, n) + 1)
        tried = contrast.z(total[ends] - total[first], number[ends] - number[first])
        last = int(ends[np.argmax(np.abs(tried))])
    return float(contrast.z(total[last] - total[first], number[last] - number[first])), first, last


def _bands(contrast: Contrast, axis: int, *, in_time: bool = False) -> Found:
    """Return the best band of rows (axis 0) or columns (axis 1), or range of frames."""
    sums, counts = (values.sum(axis=1 - axis) for values in (contrast.values, contrast.some))
    n = sums.size
    z, a, b = _intervals(contrast, sums, counts, _STRETCHES if in_time else None)
    lines = np.zeros(n, np.bool_)
    lines[a:b] = True
    log_p = _log_p_range(z, n, contrast.fewest) if in_time else _log_p(z, n**2 / 2)
    return Found("columns" if axis else "rows", _lines(lines, axis, contrast), z, log_p)


def _lines(lines: BoolArray, axis: int, contrast: Contrast) -> BoolArray:
    return np.broadcast_to(lines if axis else lines[:, None], contrast.values.shape).copy()


def _periodic(
    contrast: Contrast,
    axis: int,
    numbers: IntArray | None = None,
    periods: Sequence[int] = PERIODS,
    cycles: int = 2,
    better: float = 1.0,
) -> Found:
    """Return the best set of every n-th row or column.

    Args:
        contrast: of a map.
        axis: 0 for rows, 1 for columns.
        numbers: of the lines; None: from 0 on.
        periods: that are tried, increasing.
        cycles: of a period, at least, among the lines.
        better: factor by which a longer period must deviate more.
    """
    sums, counts = (values.sum(axis=1 - axis) for values in (contrast.values, contrast.some))
    best, lines, tried = 0.0, np.zeros(sums.size, np.bool_), 0
    number = np.arange(sums.size) if numbers is None else numbers
    for period in (p for p in periods if cycles * p <= sums.size):
        phase = number % period
        z = contrast.z(np.bincount(phase, sums, period), np.bincount(phase, counts, period))
        tried += period
        at = int(np.argmax(np.abs(z)))
        if abs(z[at]) > abs(best) * better:
            best, lines = float(z[at]), phase == at
    return Found("period", _lines(lines, axis, contrast), best, _log_p(best, max(tried, 1)))


def _rectangle(contrast: Contrast) -> Found:
    """Return the best rectangle: of all made of coarse cells, its edges moved to where they fit best."""
    ny, nx = contrast.values.shape
    tops, lefts = (np.unique(np.linspace(0, size, min(_CELLS, size) + 1).astype(int)) for size in (ny, nx))
    sums, counts = (integral(values)[np.ix_(tops, lefts)] for values in (contrast.values, contrast.some))
    best, rows, columns = 0.0, (0, ny), (0, nx)
    for height in range(1, tops.size):
        band, number = sums[height:] - sums[:-height], counts[height:] - counts[:-height]
        z = contrast.z(band[:, None, :] - band[:, :, None], number[:, None, :] - number[:, :, None])
        z = np.triu(np.abs(z), 1)
        at, a, b = np.unravel_index(int(np.argmax(z)), z.shape)
        if z[at, a, b] > best:
            best, rows = float(z[at, a, b]), (int(tops[at]), int(tops[at + height]))
            columns = (int(lefts[a]), int(lefts[b]))
    z_best = best
    for _ in range(_SWEEPS):
        inside = slice(*rows)
        z_best, *ends = _intervals(contrast, contrast.values[inside].sum(0), contrast.some[inside].sum(0))
        columns = (ends[0], ends[1])
        within = np.s_[:, slice(*columns)]
        z_best, *ends = _intervals(contrast, contrast.values[within].sum(1), contrast.some[within].sum(1))
        rows = (ends[0], ends[1])
    mask = np.zeros((ny, nx), np.bool_)
    mask[slice(*rows), slice(*columns)] = True
    return Found("rectangle", mask, z_best, _log_p(z_best, (ny * nx) ** 2 / 4.0))


def integral(values: NDArray[Any]) -> NDArray[Any]:
    """Return the sums of a map before each row and column, (y + 1, x + 1)."""
    return np.pad(np.cumsum(np.cumsum(values, axis=0), axis=1), ((1, 0), (1, 0)))


def _disc(contrast: Contrast) -> Found | None:
    """Return the best disc, its middle anywhere; one that an edge of the sensor cuts counts as well."""
    ny, nx = contrast.values.shape
    radii = [radius for radius in _RADII if radius <= max(ny, nx) / 2]
    tried = [_disc_of(contrast, radius) for radius in radii]
    if not tried:
        return None
    best = max(tried, key=lambda each: abs(each[0]))
    tried += [_disc_of(contrast, best[2] * factor) for factor in _FINER]
    z, (row, column), radius = max(tried, key=lambda each: abs(each[0]))
    y, x = np.ogrid[:ny, :nx]
    mask = np.asarray((y - row) ** 2 + (x - column) ** 2 <= radius**2)
    return Found("disc", mask, z, _log_p(z, float(ny * nx * len(tried))))


def _disc_of(contrast: Contrast, radius: float) -> tuple[float, tuple[int, int], float]:
    """Return deviation and middle of the best disc of a radius."""
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (y * y + x * x <= radius * radius).astype(np.float64)
    sums, counts = (_around(values, disc) for values in (contrast.values, contrast.some))
    z = contrast.z(sums, counts)
    row, column = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
    return float(z[row, column]), (int(row), int(column)), radius


def _around(values: NDArray[Any], disc: FloatArray) -> FloatArray:
    """Return the sums over a disc around each pixel; scipy.signal, which has this, takes 0.5 s to import."""
    shape = tuple(a + b - 1 for a, b in zip(values.shape, disc.shape, strict=True))
    product = np.fft.rfft2(values, shape) * np.fft.rfft2(disc, shape)
    reach, (ny, nx) = disc.shape[0] // 2, values.shape
    return np.asarray(np.fft.irfft2(product, shape)[reach : reach + ny, reach : reach + nx])


def _single(values: FloatArray, some: BoolArray) -> Found | None:
    """Return the pixels that stand out each by itself (with the sign of the largest)."""
    magnitude = np.where(some, np.abs(values), 0.0)
    at = np.unravel_index(int(np.argmax(magnitude)), values.shape)
    n = float(some.sum())
    log_p = _log_p(float(magnitude[at]), n)
    limit = float(-special.ndtri_exp(math.log(_SURE / n)))
    mask = some & (np.sign(values[at]) * values > limit)
    # many next to each other are a place, and found as such
    if mask.sum() > 0.02 * n:
        return None
    mask[at] = True
    return Found("pixels", mask, float(values[at]), log_p)


def affected_share(z: FloatArray, inside: BoolArray, level: float = _SURE) -> float:
    """Return a lower bound of the share of the values inside a place that are larger than by chance.

    All-resolutions inference (Rosenblatt et al. 2018; Goeman and Solari 2011): closed testing with Simes'
    test bounds the number of true deviations of all sets at once, so that the place may have been chosen
    after looking: ``max_u (1 - u + #{i inside: m p_i <= u level})`` with all m values (Hommel's smaller
    number would do, and give a little more).

    Args:
        z: one-sided deviations of all values, N(0, 1) by chance, (m,).
        inside: the place, (m,).
        level: probability that any of these bounds is too large.
    """
    n = int(inside.sum())
    if n == 0:
        return 0.0
    p = np.sort(special.ndtr(-z[inside]))
    # the smallest u for which the i-th value counts
    u = np.maximum(np.ceil(z.size * p / level), 1.0)
    bound = 1.0 - u + np.arange(1, n + 1)
    return float(max(bound.max(), 0.0) / n)


def sharpest_range(series: FloatArray, first: int, last: int, shortest: int) -> tuple[int, int]:
    """Return the range of frames, its end excluded, with which all series together are most probable.

    Inside and outside, all series are normal with a mean and a covariance of their own (a change point of
    either, Hinkley 1970; its error goes as the inverse of what a frame tells, and not with the root of their
    number); of each only the inverse hyperbolic sine counts, so that single frames far off decide nothing.
    Where the series are not more probable with a range than without by as many nats as it has parameters
    (Akaike 1974) and as choosing one of all ranges gains, they do not tell its ends: those that are given
    stay.

    Args:
        series: N(0, 1) where nothing is wrong, (s, n), finite.
        first: of a range near it.
        last: its end, excluded.
        shortest: frames inside, and outside, at least.
    """
    x = np.arcsinh(series - np.median(series, axis=1, keepdims=True)).T
    total, square = (
        np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        for values in (x, x[:, :, None] * x[:, None, :])
    )
    n = len(x)

    def nats(a: IntArray, b: IntArray) -> FloatArray:
        inside, whole = (total[b] - total[a], square[b] - square[a]), (total[-1], square[-1])
        outside = whole[0] - inside[0], whole[1] - inside[1]
        likely = _normal(b - a, *inside) + _normal(n - b + a, *outside)
        return np.where(np.minimum(b - a, n - b + a) >= shortest, likely, -np.inf)

    every, given = np.arange(n + 1), (first, last)
    for _ in range(_SWEEPS):
        first = int(np.argmax(nats(every[:last], np.full(last, last))))
        last = first + 1 + int(np.argmax(nats(np.full(n - first, first), every[first + 1 :])))
    with_range = nats(np.array([first]), np.array([last]))
    gain = float((with_range - _normal(np.array([n]), total[-1:], square[-1:]))[0])
    price = len(series) * (len(series) + 3) / 2 + math.log(n**2 / 2)
    return (first, last) if gain > price else given


def _normal(count: IntArray, sums: FloatArray, squares: FloatArray) -> FloatArray:
    """Return the largest log likelihood of normal vectors, given their number, sums and sums of squares."""
    m = np.maximum(count, 1)[:, None]
    mean = sums / m
    covariance = squares / m[:, :, None] - mean[:, :, None] * mean[:, None, :]
    ridge = _RIDGE * np.eye(sums.shape[-1])
    return np.asarray(-0.5 * m[:, 0] * np.linalg.slogdet(covariance + ridge)[1])


def scan_event_map(
    seen: BoolArray,
    expected: FloatArray,
    usable: BoolArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 3,
) -> list[Suspect]:
    """Return the places with more events than their share, the most significant first.

    Args:
        seen: pixels with an event, (y, x).
        expected: number of events in each, in proportion, (y, x).
        usable: pixels that count, (y, x).
        significance: largest probability of a chance.
        most: places at most.

    Returns:
        Places; ``inside`` and ``outside`` are events beyond those expected per pixel.
    """

    def best(left: BoolArray) -> tuple[BoolArray, Suspect] | None:
        events, chance = np.where(left, seen, 0.0), np.where(left, expected, 0.0)
        if events.sum() < FEWEST:
            return None
        contrast = _Events(events, chance / chance.sum(), 1.0)
        found = best_place(contrast, regions(contrast))
        if found is None or (log_p := contrast.exact(found)) > math.log(significance):
            return None
        means = replace(found, log_p=log_p).means(events - chance, left)
        share = max(means["inside"], 0.0)
        return found.mask, Suspect(**means, region=Region.of_mask(found.mask), share=share)

    return successive(best, usable & (expected > 0.0), most)


@dataclass(frozen=True)
class _Events(Contrast):
    """Events by pixel, and in ``some`` the share of all that chance puts there."""

    def z(self, sums: NDArray[np.floating], counts: NDArray[np.floating]) -> FloatArray:
        """Return the signed root of the likelihood ratio of events beyond their share, 0 where they are less.

        Args:
            sums: events of places.
            counts: their shares.
        """
        total = float(self.values.sum())
        share = np.clip(counts, 1e-12, 1.0 - 1e-12)
        events = np.clip(sums, 0.0, total)
        information = special.rel_entr(events, total * share) + special.rel_entr(
            total - events, total * (1.0 - share)
        )
        more = (events > total * share) & (events > self.fewest - 0.5)
        return np.where(more, np.sqrt(2.0 * np.maximum(information, 0.0)), 0.0)

    def exact(self, found: Found) -> float:
        """Return the logarithm of the probability of a place by the binomial law itself."""
        places = found.log_p - float(special.log_ndtr(-abs(found.z)))
        seen, share = (float(values[found.mask].sum()) for values in (self.values, self.some))
        return min(0.0, places + log_binomial_tail(seen, float(self.values.sum()), share))


def scan_event_frames(
    positions: IntArray,
    numbers: IntArray,
    *,
    expected: float = 0.0,
    significance: float = SIGNIFICANCE,
    shortest: int = 1,
) -> Stretch | None:
    """Return the range of frames in which events come together most; None where chance explains it.

    Of n events in random order, those that follow the i-th by k in a share w of the frames are at least k of
    the others with the probability of a binomial law, which is uniform whatever i and k: the union bound has
    as many terms as there are pairs of events.

    Args:
        positions: of the frames with an event, increasing, none twice, (m,).
        numbers: of all frames in the run, increasing, (n,).
        expected: number of events in all frames.
        significance: largest probability of a chance.
        shortest: frames that a range must have.

    Returns:
        The range; ``inside`` and ``outside`` are events beyond those expected per frame.
    """
    if positions.size > _MOST_EVENTS:
        expected *= _MOST_EVENTS / positions.size
        positions = np.sort(np.random.default_rng(SEED).choice(positions, _MOST_EVENTS, replace=False))
    m, n = positions.size, numbers.size
    if m < FEWEST or n < 2 * shortest:
        return None
    first, last = np.triu_indices(m, FEWEST - 1)
    length = positions[last] - positions[first] + 1
    log_p = _log_tails(last - first, m - 1, np.maximum(length, shortest) / n)
    at = int(np.argmin(log_p))
    value = min(0.0, float(log_p[at]) + math.log(m * (m - 1) / 2))
    if value > math.log(significance):
        return None
    begin, end = _ends(int(positions[first[at]]), int(positions[last[at]]), int(last[at] - first[at]), n)
    inside = (positions >= begin) & (positions < end)
    seen = (float(inside.sum()), end - begin), (float((~inside).sum()), max(n - end + begin, 1))
    rates = [events / frames - expected / n for events, frames in seen]
    when = When(range=((int(numbers[begin]), int(numbers[end - 1]) + 1),))
    z = float(-special.ndtri_exp(float(log_p[at])))
    return Stretch(family="range", z=z, log_p=value, inside=rates[0], outside=rates[1], when=when)


def _ends(first: int, last: int, gaps: int, n: int) -> tuple[int, int]:
    """Return a range of frames about its first and last event, as wide as a constant rate asks for."""
    beyond = round((last - first) / max(gaps, 1) / 2)
    return max(first - beyond, 0), min(last + beyond + 1, n)


def _log_tails(k: IntArray, n: int, share: FloatArray) -> FloatArray:
    """Return the logarithms of the probabilities of at least k (one or more) of n events in a share, (m,)."""
    tail = special.betainc(k, n - k + 1.0, np.minimum(share, 1.0))
    return np.asarray(np.log(np.maximum(tail, 1e-300)))


def log_binomial_tail(k: float, n: float, share: float) -> float:
    """Return the logarithm of the probability of at least k (one or more) of n events in a share."""
    return float(_log_tails(np.array([round(k)]), round(n), np.array([share]))[0])
