"""Scan statistics: the place on a map, or the stretch of a series, whose values stand out most.

Each value is about N(0, 1) and independent of the others where nothing is wrong. Of every place of some
family (bands of rows or columns, rectangles, discs, lines at a period, single pixels; ranges of frames, a
period, single frames) the mean inside is compared with the mean outside, so that something everywhere alike
has no place. The probability is that of the largest deviation among all places of the family (the union
bound), of all families: it counts every place that was looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.effects.framework.region import Region, When

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Values count as no more than this many standard deviations, so that a few pixels are no band of columns.
_CLIP = 6.0
#: Cells along an edge of the map (or the series) on which all rectangles (ranges) are tried.
_CELLS, _STRETCHES = 32, 400
_RADII = (1.5, 2.5, 4.0, 6.0, 9.0, 13.0, 19.0, 28.0)
_FINER = (0.72, 0.8, 0.9, 1.12, 1.25, 1.4)
_PERIODS = (2, 4, 8, 16, 32)
_FRAME_PERIODS = tuple(range(2, 33))
#: Sweeps of the edges of a rectangle over the pixels, and of a range over the frames.
_SWEEPS = 3
_RIDGE = 1e-3  # of a covariance of series that may all but coincide
_FEWEST = 3  # pixels of a place
_LEAST = -690.0  # logarithm of the smallest probability that is written
_SURE = 0.05
_LITTLE = 0.25  # of the mean inside a place, that outside
#: Nats by which a place of a further family must be less probable than a simpler one.
_BETTER = 3.0


@dataclass(frozen=True)
class Suspect:
    """A place on the sensor where a map stands out.

    Attributes:
        region: the place.
        family: rows, columns, rectangle, disc, period or pixels.
        z: deviation of its mean from that of the rest, standard errors.
        log_p: logarithm of the probability of such a deviation by chance in any place.
        inside, outside: mean of the map there and elsewhere.
        share: of its pixels that deviate, at least (at 95 %, for all places at once).
    """

    region: Region
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


@dataclass(frozen=True)
class Stretch:
    """Frames in which a series stands out; as :class:`Suspect`, of a series."""

    when: When
    family: str
    z: float
    log_p: float
    inside: float
    outside: float

    @property
    def p(self) -> float:
        """Probability of such a deviation by chance, at least 1e-300."""
        return math.exp(max(self.log_p, _LEAST))

    @property
    def only_there(self) -> bool:
        """Whether little of it is elsewhere."""
        return abs(self.outside) < _LITTLE * abs(self.inside)


@dataclass(frozen=True)
class Found:
    """The best place of a family, its deviation, and the logarithm of its probability."""

    family: str
    mask: BoolArray
    z: float
    log_p: float


# -- maps ---------------------------------------------------------------------------------------


def scan_map(
    values: FloatArray,
    usable: BoolArray,
    *,
    significance: float = 1e-3,
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
    found: list[Suspect] = []
    left = some.copy()
    while len(found) < most and left.sum() > 2 * _FEWEST:
        best = _best(values, left, single)
        if best is not None:
            best = _checked(_odd_side(best, values, left), values, left)
        if best is None or best.log_p > math.log(significance):
            break
        mask = best.mask & left
        inside, outside = float(values[mask].mean()), float(values[left & ~mask].mean())
        share = affected_share(np.where(some, math.copysign(1.0, best.z) * values, -np.inf)[some], mask[some])
        region = Region.of_mask(_reaching(best.mask, next_along))
        found.append(Suspect(region, best.family, best.z, best.log_p, inside, outside, share))
        left &= ~best.mask
    return found


def _reaching(mask: BoolArray, axis: int | None) -> BoolArray:
    """Return a mask of pixels whose pairs with the next pixel along an axis are in the place."""
    if axis is None:
        return mask
    grown = mask.copy()
    after, before = (np.s_[1:], np.s_[:-1]) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
    grown[after] |= mask[before]
    return grown


def _checked(found: Found, values: FloatArray, some: BoolArray) -> Found:
    """Return a place with its deviation in terms of the scatter inside and outside (Welch).

    Where values scatter more, a mean that is off says less.
    """
    if found.family == "pixels":
        return found
    inside, outside = values[some & found.mask], values[some & ~found.mask]
    variance = max(inside.var(), 1.0) / inside.size + max(outside.var(), 1.0) / outside.size
    z = float((inside.mean() - outside.mean()) / np.sqrt(variance))
    if abs(z) >= abs(found.z):
        return found
    places = found.log_p - float(special.log_ndtr(-abs(found.z)))
    return Found(found.family, found.mask, z, min(0.0, float(special.log_ndtr(-abs(z))) + places))


def _best(values: FloatArray, some: BoolArray, single: bool) -> Found | None:
    """Return the place of the smallest probability, a simpler one where that is nearly as small."""
    kept = np.clip(np.where(some, values, 0.0), -_CLIP, _CLIP)
    contrast = Contrast.of(kept, some)
    return None if contrast is None else best_place(contrast, some, _single(values, some) if single else None)


def best_place(contrast: Contrast, some: BoolArray, *others: Found | None) -> Found | None:
    """Return the place of the smallest probability of all families; None where none divides the pixels.

    Args:
        contrast: of a map, (y, x).
        some: pixels that count, (y, x).
        others: the best places of further families.
    """
    families = [
        _bands(contrast, 0),
        _bands(contrast, 1),
        _periodic(contrast, 0),
        _periodic(contrast, 1),
        _rectangle(contrast),
        _disc(contrast),
        *others,
    ]
    there = [each for each in families if each is not None and _parts(each.mask, some)]
    if not there:
        return None
    best = there[0]
    for each in there[1:]:
        if each.log_p < best.log_p - _BETTER:
            best = each
    return Found(best.family, best.mask, best.z, best.log_p + math.log(len(families)))


def _parts(mask: BoolArray, some: BoolArray) -> bool:
    """Return whether a place divides the pixels: a sensor of one row has no band of rows."""
    return bool((some & mask).any() and (some & ~mask).any())


def _odd_side(found: Found, values: FloatArray, some: BoolArray) -> Found:
    """Return the place, or all outside of it where that is what deviates from 0."""
    inside, outside = values[some & found.mask].mean(), values[some & ~found.mask].mean()
    if abs(inside) >= abs(outside):
        return found
    return Found(found.family, ~found.mask, -found.z, found.log_p)


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
    fewest: int = _FEWEST

    @classmethod
    def of(cls, values: FloatArray, some: BoolArray, fewest: int = _FEWEST) -> Contrast | None:
        """Centre a map, to look for places of so many values or more; None where it has too few."""
        inside = values[some]
        if inside.size <= 2 * _FEWEST:
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


def _intervals(contrast: Contrast, sums: FloatArray, counts: FloatArray) -> tuple[float, int, int]:
    """Return the deviation and the ends of the best range of lines."""
    total, number = (np.concatenate([[0.0], np.cumsum(values)]) for values in (sums, counts))
    z = contrast.z(total[None, :] - total[:, None], number[None, :] - number[:, None])
    z = np.where(np.arange(total.size)[None, :] > np.arange(total.size)[:, None], z, 0.0)
    a, b = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
    return float(z[a, b]), int(a), int(b)


def _bands(contrast: Contrast, axis: int) -> Found:
    """Return the best band of rows (axis 0) or columns (axis 1)."""
    across = 1 - axis
    sums, counts = contrast.values.sum(axis=across), contrast.some.sum(axis=across)
    z, a, b = _intervals(contrast, sums, counts)
    lines = np.zeros(sums.size, np.bool_)
    lines[a:b] = True
    return Found("columns" if axis else "rows", _lines(lines, axis, contrast), z, _log_p(z, sums.size**2 / 2))


def _lines(lines: BoolArray, axis: int, contrast: Contrast) -> BoolArray:
    return np.broadcast_to(lines if axis else lines[:, None], contrast.values.shape).copy()


def _periodic(contrast: Contrast, axis: int) -> Found:
    """Return the best set of every n-th row or column."""
    across = 1 - axis
    sums, counts = contrast.values.sum(axis=across), contrast.some.sum(axis=across)
    best, lines, tried = 0.0, np.zeros(sums.size, np.bool_), 0
    number = np.arange(sums.size)
    for period in (p for p in _PERIODS if 2 * p <= sums.size):
        phase = number % period
        z = contrast.z(np.bincount(phase, sums), np.bincount(phase, counts))
        tried += period
        at = int(np.argmax(np.abs(z)))
        if abs(z[at]) > abs(best):
            best, lines = float(z[at]), phase == at
    return Found("period", _lines(lines, axis, contrast), best, _log_p(best, max(tried, 1)))


def _rectangle(contrast: Contrast) -> Found:
    """Return the best rectangle: of all made of coarse cells, its edges moved to where they fit best."""
    ny, nx = contrast.values.shape
    tops, lefts = (np.unique(np.linspace(0, size, min(_CELLS, size) + 1).astype(int)) for size in (ny, nx))
    sums, counts = (_integral(values)[np.ix_(tops, lefts)] for values in (contrast.values, contrast.some))
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


def _integral(values: FloatArray) -> FloatArray:
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


def affected_share(z: FloatArray, inside: BoolArray, level: float = 0.05) -> float:
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


# -- series -------------------------------------------------------------------------------------


def scan_series(
    values: FloatArray,
    numbers: NDArray[np.int64],
    *,
    significance: float = 1e-3,
    most: int = 2,
    shortest: int = _FEWEST,
) -> list[Stretch]:
    """Return the frames that stand out of a series, the most significant first.

    Args:
        values: N(0, 1) and independent where nothing is wrong, (n,).
        numbers: frame numbers, increasing, (n,).
        significance: largest probability of a chance.
        most: stretches at most.
        shortest: frames that a range or a phase of a period must have.
    """
    left = np.isfinite(values)
    found: list[Stretch] = []
    while len(found) < most and left.sum() > 2 * _FEWEST:
        best = _best_frames(values, numbers, left, shortest)
        if best is None:
            break
        when, place = best[0], _checked(best[1], values, left)
        if place.log_p > math.log(significance):
            break
        mask = place.mask & left
        inside, outside = float(values[mask].mean()), float(values[left & ~mask].mean())
        family = "frames" if place.family == "pixels" else place.family
        found.append(Stretch(when, family, place.z, place.log_p, inside, outside))
        left &= ~place.mask
    return found


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

    def nats(a: NDArray[np.int64], b: NDArray[np.int64]) -> FloatArray:
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


def _normal(count: NDArray[np.int64], sums: FloatArray, squares: FloatArray) -> FloatArray:
    """Return the largest log likelihood of normal vectors, given their number, sums and sums of squares."""
    m = np.maximum(count, 1)[:, None]
    mean = sums / m
    covariance = squares / m[:, :, None] - mean[:, :, None] * mean[:, None, :]
    ridge = _RIDGE * np.eye(sums.shape[-1])
    return np.asarray(-0.5 * m[:, 0] * np.linalg.slogdet(covariance + ridge)[1])


def _best_frames(
    values: FloatArray, numbers: NDArray[np.int64], some: BoolArray, shortest: int
) -> tuple[When, Found] | None:
    kept = np.clip(np.where(some, values, 0.0), -_CLIP, _CLIP)
    contrast = Contrast.of(kept, some, shortest)
    if contrast is None:
        return None
    families = [_frame_range(contrast), _frame_period(contrast, numbers), _single(values, some)]
    there = [each for each in families if each is not None and each.mask.any()]
    if not there:
        return None
    best = min(there, key=lambda each: each.log_p)
    log_p = best.log_p + math.log(len(families))
    at = np.flatnonzero(best.mask)
    if best.family == "range":
        when = When(range=((int(numbers[at[0]]), int(numbers[at[-1]]) + 1),))
    elif best.family == "period":
        period = int(np.gcd.reduce(np.diff(numbers[at])))
        when = When(every=period, phase=int(numbers[at[0]]) % period)
    else:
        when = When(single=tuple(int(i) for i in numbers[at][:1000]))
    return when, Found(best.family, best.mask, best.z, log_p)


def _frame_range(contrast: Contrast) -> Found | None:
    """Return the best range of frames: of whole cells, then its ends moved by frames; None: all too short."""
    n = contrast.values.size
    total, number = (np.concatenate([[0.0], np.cumsum(v)]) for v in (contrast.values, contrast.some))
    edges = np.unique(np.linspace(0, n, min(_STRETCHES, n) + 1).astype(int))
    z, a, b = _intervals(contrast, np.diff(total[edges]), np.diff(number[edges]))
    first, last = int(edges[a]), int(edges[b])
    if last <= first:
        return None
    near = int(np.ceil(n / _STRETCHES)) + 1
    for _ in range(2):
        starts = np.arange(max(first - near, 0), min(first + near, last - 1) + 1)
        scores = contrast.z(total[last] - total[starts], number[last] - number[starts])
        first = int(starts[np.argmax(np.abs(scores))])
        ends = np.arange(max(last - near, first + 1), min(last + near, n) + 1)
        scores = contrast.z(total[ends] - total[first], number[ends] - number[first])
        last = int(ends[np.argmax(np.abs(scores))])
        z = float(scores[np.argmax(np.abs(scores))])
    mask = np.zeros(n, np.bool_)
    mask[first:last] = True
    return Found("range", mask, z, _log_p_range(z, n, contrast.fewest))


def _frame_period(contrast: Contrast, numbers: NDArray[np.int64]) -> Found | None:
    """Return the best phase of a period of frames."""
    best, mask, tried = 0.0, np.zeros(numbers.size, np.bool_), 0
    for period in (p for p in _FRAME_PERIODS if 4 * p <= numbers.size):
        phase = numbers % period
        sums, counts = (np.bincount(phase, v, period) for v in (contrast.values, contrast.some))
        z = contrast.z(sums, counts)
        tried += period
        at = int(np.argmax(np.abs(z)))
        if abs(z[at]) > abs(best) * 1.02:  # a multiple of a period is no better than it
            best, mask = float(z[at]), np.asarray(phase == at)
    return Found("period", mask, best, _log_p(best, max(tried, 1))) if tried else None
