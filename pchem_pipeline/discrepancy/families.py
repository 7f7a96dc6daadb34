"""Families of places on a sensor or in a series, and the place of each that stands out most.

The statistic of a place is a sum over it: of the values of a map, of events, or of products of all pairs of
its pixels. A :class:`Contrast` compares the sum with the share of the whole that its count asks for (pixels,
events by chance, pairs). Sums over bands and rectangles come from cumulative tables, in which pairs have an
axis twice; these boxes are of cells, and around the ends of the best one the scan goes on with finer cells,
down to single lines. The p-value of a place is the union bound over its family.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.model.arithmetic.significance import PRICE

#: First indices of ranges, and their ends.
Ranges = tuple[IntArray, IntArray] | IntArray
#: Of the cells of rows, and of columns.
Edges = tuple[IntArray, IntArray]
Null = Callable[[FloatArray, FloatArray], FloatArray]

#: Cells along an edge of a map of which rectangles are made, and ranges of lines or frames.
_CELLS, _RANGE_CELLS = 32, 400
#: Cells to either side of an end of a box that are made finer, how often, and those in their place: so few
#: that those of both ends are summed one by one in a table of pairs.
_BESIDE, _ROUNDS, _FINER = 2, 4, 14
_AT_ONCE = 1 << 20  # indices of boxes
_RADII = (1.5, 2.5, 4.0, 6.0, 9.0, 13.0, 19.0, 28.0)
_FINER_RADII = (0.72, 0.8, 0.9, 1.12, 1.25, 1.4)
_PERIODS = (2, 4, 8, 16, 32)
#: Pixels, frames or events of a place, at least.
FEWEST = 3
#: Probability of a chance among all single pixels of a place.
SURE = 0.05
#: Whether the rows and the columns of a box have ends.
BOXES = {"rows": (True, False), "columns": (False, True), "rectangle": (True, True)}


@dataclass(frozen=True)
class Place:
    """The best place of a family."""

    family: str
    mask: BoolArray  # its pixels, (y, x)
    z: float  # deviation of the mean inside from that outside, standard errors
    log_places: float  # logarithm of the number of places that were looked at
    edges: Edges | None = None  # of the cells with which a box ends, of rows and of columns

    @property
    def log_p(self) -> float:
        """Logarithm of the probability of such a deviation by chance in any of the places."""
        return min(0.0, float(special.log_ndtr(-abs(self.z))) + self.log_places)

    def means(self, values: FloatArray, some: BoolArray) -> dict[str, Any]:
        """Return the fields of a cluster, with the means of values (y, x) over pixels that count."""
        inside, outside = (float(values[each].mean()) for each in (some & self.mask, some & ~self.mask))
        return {
            "family": self.family, "z": self.z, "log_p": self.log_p, "inside": inside, "outside": outside,
        }  # fmt: skip


def successive(
    best: Callable[[BoolArray], Place | None], some: BoolArray, most: int
) -> Iterator[tuple[Place, BoolArray]]:
    """Yield the most significant place of some pixels, with these, then that of the rest, and so on."""
    for _ in range(most):
        if some.sum() <= 2 * FEWEST or (place := best(some)) is None:
            return
        yield place, some
        some = some & ~place.mask


def best_place(families: Sequence[Place | None], better: float = PRICE) -> Place | None:
    """Return the place of the smallest probability of all families, corrected for their number.

    Simpler families come first; the place of a later one must be less probable by ``better``, nats.
    """
    best: Place | None = None
    for each in families:
        if each is not None and (best is None or each.log_p < best.log_p - better):
            best = each
    return best and replace(best, log_places=best.log_places + math.log(len(families)))


# -- sums and what they are by chance -------------------------------------------------------------


def cell_edges(n: int, most: int) -> IntArray:
    """Return the edges of cells of about equal size of n lines, ``most`` of them or one for each line."""
    return np.unique(np.linspace(0, n, min(n, most) + 1).astype(np.int64))


def cumulative(table: FloatArray) -> FloatArray:
    """Return the sums before each index of all axes."""
    for axis in range(table.ndim):
        table = np.cumsum(table, axis=axis)
    return np.pad(table, [(1, 0)] * table.ndim)


def box_sums(table: FloatArray, axes: tuple[int, int], rows: Ranges, columns: Ranges) -> FloatArray:
    """Return sums over all boxes of some ranges of rows and of columns, (ranges of rows, of columns).

    The table is cumulative, of pixels (y, x), of pairs of a row (y, x, x), of a column (y, y, x), or of a
    frame (y, y, x, x); ``axes``: how many of its axes are rows, and columns.
    """
    if axes[0] > axes[1]:  # less is left of an axis that is there twice
        turned = np.moveaxis(table, (0, 1), (-2, -1))
        return box_sums(turned, (axes[1], axes[0]), columns, rows).T
    of_columns = _between(np.moveaxis(table, range(axes[0]), range(-axes[0], 0)), axes[1], columns)
    return _between(np.moveaxis(of_columns, 0, -1), axes[0], rows)


def _between(table: FloatArray, axes: int, ranges: Ranges) -> FloatArray:
    """Return sums over ranges of the first axis, or of the first two alike, in its place."""
    first, last = ranges
    if axes == 1:
        return np.asarray(table[last] - table[first])
    return np.asarray(table[last, last] - table[first, last] - table[last, first] + table[first, first])


@dataclass(frozen=True)
class Contrast:
    """Sums over places, and how far they are from their share of the whole."""

    edges: Edges  # of the cells of the tables
    sums: FloatArray  # cumulative tables, see :func:`box_sums`
    counts: FloatArray  # the same of what counts
    null: Null  # returns the deviations of sums with such counts, standard errors; 0 where one is no place
    axes: tuple[int, int] = (1, 1)  # of the tables that are rows, and columns
    frames: IntArray | None = None  # numbers of the columns where these are frames

    @classmethod
    def of_pixels(
        cls, values: FloatArray, weight: FloatArray, null: Null, frames: IntArray | None = None
    ) -> Self:
        """Take what is seen in each pixel and what it counts, (y, x)."""
        rows, columns = (np.arange(n + 1) for n in values.shape)
        return cls((rows, columns), cumulative(values), cumulative(weight), null, frames=frames)

    def at(self, edges: Edges) -> Self:
        """Return it with larger cells than pixels."""
        sums, counts = (each[np.ix_(*edges)] for each in (self.sums, self.counts))
        return replace(self, edges=edges, sums=sums, counts=counts)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return int(self.edges[0][-1]), int(self.edges[1][-1])

    def boxes(self, rows: Ranges, columns: Ranges) -> FloatArray:
        """Return the deviations of all boxes of some ranges of cells."""
        return self.null(*(box_sums(table, self.axes, rows, columns) for table in (self.sums, self.counts)))

    def numbers(self, axis: int) -> IntArray:
        """Return the numbers of the rows or columns."""
        return np.arange(self.shape[axis]) if self.frames is None else self.frames

    def phases(self, axis: int, period: int) -> FloatArray:
        """Return the deviations of every n-th row or column, by their numbers modulo the period."""
        phase = self.numbers(axis) % period
        lines = (np.diff(np.take(each, -1, axis=1 - axis)) for each in (self.sums, self.counts))
        return self.null(*(np.bincount(phase, each, period).astype(np.float64) for each in lines))


def normal(total: float, number: float, variance: float, fewest: float, one_sided: bool = False) -> Null:
    """Return the null of normal sums with a mean and a variance in proportion to their count.

    ``total`` and ``number`` are sum and count of all, ``variance`` is by count, ``fewest`` the smallest count
    inside and outside of a place; if ``one_sided``, only sums that are too large count.
    """

    def deviations(sums: FloatArray, counts: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            z = sums - counts * (total / number)
            z /= np.sqrt(variance * counts * (1.0 - counts / number))
        # sums over discs are whole numbers but for rounding
        z = np.where((counts > fewest - 0.5) & (counts < number - fewest + 0.5), z, 0.0)
        return np.maximum(z, 0.0) if one_sided else z

    return deviations


def events(total: float) -> Null:
    """Return the null of events, each in a place by chance with its share; only more than chance counts.

    The deviation is the root of twice the logarithm of the likelihood ratio.
    """

    def deviations(sums: FloatArray, counts: FloatArray) -> FloatArray:
        share, seen = np.clip(counts, 1e-12, 1.0 - 1e-12), np.clip(sums, 0.0, total)
        information = special.rel_entr(seen, total * share)
        information += special.rel_entr(total - seen, total * (1.0 - share))
        more = (seen > total * share) & (seen > FEWEST - 0.5)
        return np.where(more, np.sqrt(2.0 * np.maximum(information, 0.0)), 0.0)

    return deviations


def contrast_of_map(
    values: FloatArray, some: BoolArray, fewest: int = FEWEST, frames: IntArray | None = None
) -> Contrast:
    """Return the contrast of values that are N(0, 1) by chance, of a map (y, x) or a series (1, n) of frames.

    ``some`` of them count, ``fewest`` of these inside and outside of a place. Far ones are clipped.
    """
    values = np.clip(np.where(some, values, 0.0), -FAR, FAR)
    # what stands out widens the spread of the whole: take it from the middle
    spread = max(1.0, float(np.subtract(*np.quantile(values[some], [0.75, 0.25]))) / 1.349)
    null = normal(float(values.sum()), float(some.sum()), spread**2, fewest)
    return Contrast.of_pixels(values, some.astype(np.float64), null, frames)


def log_binomial_tails(k: Any, n: float, share: Any) -> FloatArray:
    """Return the logarithms of the probabilities of at least k (one or more) of n events in a share."""
    tail = special.betainc(k, n - k + 1.0, np.minimum(share, 1.0))
    return np.asarray(np.log(np.maximum(tail, 1e-300)))


def _log_p_range(z: float, n: int, shortest: float) -> float:
    """Return the logarithm of the probability of such a range among n frames, both signs.

    Ranges overlap: of those of ``shortest`` frames or more far fewer are independent than there are. Siegmund
    (1992, eq. 1.3; Olshen et al. 2004) for the largest contrast of a range against the rest:
    ``b^3 phi(b) / 2 int nu(b / sqrt(n t (1 - t)))^2 / (t^2 (1 - t)) dt`` over t from ``shortest / n``.
    """
    union = float(special.log_ndtr(-abs(z))) + 2.0 * math.log(n)
    b, least = abs(z), shortest / n
    if b < 2.0 or least >= 0.5:
        return union
    t = np.geomspace(least, 1.0 - least, 500)
    x = b / np.sqrt(n * t * (1.0 - t))
    phi = np.exp(-(x**2) / 8.0) / np.sqrt(2.0 * np.pi)
    nu = (2.0 / x) * (special.ndtr(x / 2.0) - 0.5) / ((x / 2.0) * special.ndtr(x / 2.0) + phi)
    total = float(np.trapezoid(nu**2 / (t**2 * (1.0 - t)), t))
    return min(union, 3.0 * math.log(b) - b**2 / 2.0 - 0.5 * math.log(8.0 * math.pi) + math.log(total))


# -- families -------------------------------------------------------------------------------------


def box(contrast: Contrast, family: str) -> Place | None:
    """Return the best band of rows or columns, or rectangle, that ends with cells; None without any."""
    edges, free = contrast.edges, BOXES[family]
    rows, columns = (_ranges(each.size, ends) for each, ends in zip(edges, free, strict=True))
    z, mask = 0.0, np.zeros(contrast.shape, np.bool_)
    if not (rows.size and columns.size):
        return None
    for some in np.array_split(rows, 1 + rows.size * columns.size // _AT_ONCE, axis=1):
        found = contrast.boxes(some, columns)
        row, column = _largest(found)
        if abs(found[row, column]) > abs(z):
            z, mask[:] = float(found[row, column]), False
            within = edges[0][some[:, row]], edges[1][columns[:, column]]
            mask[slice(*within[0]), slice(*within[1])] = True
    places = _number_of_boxes((each.size - 1 for each in edges), family)
    return Place(family, mask, z, math.log(2.0 * places), edges) if z else None


def _number_of_boxes(lines: Iterable[int], family: str) -> float:
    """Return how many boxes of a family some rows and columns have, about."""
    return math.prod(n**2 / 2 for n, free in zip(lines, BOXES[family], strict=True) if free)


def _largest(z: FloatArray) -> tuple[Any, ...]:
    """Return where a deviation is largest."""
    return np.unravel_index(int(np.argmax(np.abs(z))), z.shape)


def _ranges(edges: int, free: bool) -> IntArray:
    """Return all ranges between edges but the whole, (2, n); without ends the whole."""
    ranges = np.stack(np.triu_indices(edges, 1))
    return ranges[:, (ranges[1] - ranges[0] < edges - 1) == free]


def with_sharp_ends(place: Place, at: Callable[[Edges], Contrast]) -> Place:
    """Return a box with ends searched among finer and finer cells, all boxes counted; other places as is.

    ``at`` returns the contrast by cells of other edges.
    """
    for _ in range(_ROUNDS):
        if place.edges is None:
            break
        inside = (np.flatnonzero(place.mask.any(axis=axis)) for axis in (1, 0))
        rows, columns = (
            _finer(each, lines) if free else each
            for each, lines, free in zip(place.edges, inside, BOXES[place.family], strict=True)
        )
        if all(np.isin(finer, each).all() for finer, each in zip((rows, columns), place.edges, strict=True)):
            break
        sharper = box(at((rows, columns)), place.family) or place
        place = replace(sharper, log_places=float(np.logaddexp(place.log_places, sharper.log_places)))
    return place


def _finer(edges: IntArray, inside: IntArray) -> IntArray:
    """Return the edges of finer cells around the ends of a range, and one cell for what is between."""
    kept = [edges[[0, -1]]]
    for end in (inside[0], inside[-1] + 1):
        at = int(np.searchsorted(edges, end))
        low, high = edges[max(at - _BESIDE, 0)], edges[min(at + _BESIDE, edges.size - 1)]
        kept += [np.array([end]), np.linspace(low, high, min(high - low, _FINER) + 1)]
    return np.unique(np.concatenate(kept).astype(np.int64))


def box_of_map(contrast: Contrast, family: str, shortest: int | None = None) -> Place | None:
    """Return the best box of a family of :data:`BOXES` to a line; all of them are counted.

    ``shortest``: the columns are frames, of which a range has so many at least.
    """
    most = _CELLS if family == "rectangle" else _RANGE_CELLS
    rows, columns = (
        cell_edges(n, most if free else 1) for n, free in zip(contrast.shape, BOXES[family], strict=True)
    )
    place = box(contrast.at((rows, columns)), family)
    if place is None:
        return None
    place = with_sharp_ends(place, contrast.at)
    if shortest is None:
        return replace(place, log_places=math.log(2.0 * _number_of_boxes(contrast.shape, family)))
    log_p = _log_p_range(place.z, contrast.shape[1], shortest)
    return replace(place, log_places=log_p - float(special.log_ndtr(-abs(place.z))))


def every_nth(
    contrast: Contrast, axis: int, periods: Sequence[int] = _PERIODS, cycles: int = 2, better: float = 1.0
) -> Place | None:
    """Return the best set of every n-th row (axis 0) or column (axis 1).

    Periods with fewer cycles are not tried; a longer one must deviate more by the factor ``better``.
    """
    number, z, lines = contrast.numbers(axis), 0.0, np.zeros(0, np.bool_)
    periods = [each for each in periods if cycles * each <= number.size]
    for period in periods:
        found = contrast.phases(axis, period)
        phase = int(np.argmax(np.abs(found)))
        if abs(found[phase]) > abs(z) * better:
            z, lines = float(found[phase]), number % period == phase
    mask = np.broadcast_to(lines if axis else lines[:, None], contrast.shape) if z else None
    return None if mask is None else Place("period", mask, z, math.log(2.0 * sum(periods)))


def disc(contrast: Contrast) -> Place | None:
    """Return the best disc, its middle anywhere; one that an edge of the sensor cuts counts as well."""
    ny, nx = contrast.shape
    tried = [_disc_of(contrast, radius) for radius in _RADII if radius <= max(ny, nx) / 2]
    if not tried:
        return None
    best = max(tried, key=lambda each: abs(each[0]))
    tried += [_disc_of(contrast, best[2] * factor) for factor in _FINER_RADII]
    z, (row, column), radius = max(tried, key=lambda each: abs(each[0]))
    y, x = np.ogrid[:ny, :nx]
    mask = np.asarray((y - row) ** 2 + (x - column) ** 2 <= radius**2)
    return Place("disc", mask, z, math.log(2.0 * ny * nx * len(tried))) if z else None


def _disc_of(contrast: Contrast, radius: float) -> tuple[float, tuple[int, ...], float]:
    """Return deviation and middle of the best disc of a radius."""
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = (y * y + x * x <= radius * radius).astype(np.float64)
    pixels = (np.diff(np.diff(table, axis=0), axis=1) for table in (contrast.sums, contrast.counts))
    z = contrast.null(*(_around(each, inside) for each in pixels))
    middle = _largest(z)
    return float(z[middle]), middle, radius


def _around(values: FloatArray, disc: FloatArray) -> FloatArray:
    """Return the sums over a disc around each pixel; scipy.signal, which has this, takes 0.5 s to import."""
    shape = tuple(a + b - 1 for a, b in zip(values.shape, disc.shape, strict=True))
    product = np.fft.rfft2(values, shape) * np.fft.rfft2(disc, shape)
    reach, (ny, nx) = disc.shape[0] // 2, values.shape
    return np.asarray(np.fft.irfft2(product, shape)[reach : reach + ny, reach : reach + nx])


def single(values: FloatArray, some: BoolArray) -> Place | None:
    """Return the pixels that stand out each by itself (with the sign of the largest)."""
    magnitude = np.where(some, np.abs(values), 0.0)
    at = np.unravel_index(int(np.argmax(magnitude)), values.shape)
    n = int(some.sum())
    limit = float(-special.ndtri_exp(math.log(SURE / n)))
    mask = some & (np.sign(values[at]) * values > limit)
    # many next to each other are a place, and found as such
    if mask.sum() > 0.02 * n:
        return None
    mask[at] = True
    return Place("pixels", mask, float(values[at]), math.log(2.0 * n))
