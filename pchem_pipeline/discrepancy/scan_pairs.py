"""Places whose pixels share noise of their rows, columns or frames: a scan over all pairs of pixels.

Of every band of lines, every band across them, every rectangle, every n-th line, and the lines that stand out
each by itself the mean covariance of the pairs inside is compared with that of all other pairs, so that noise
which all pixels share has no place. The standard error is ``1 / sqrt(N)`` of N pairs (:mod:`.observe.pairs`),
or what the frames' scatter gives where that is more; the sum of squares behind it is skewed, which Wilson and
Hilferty's root takes away. The probability is the union bound over the places of the family, the families,
modes and channels.

Boxes are of cells, each of several rows or columns of a large sensor. How much a single line shares with the
inside of a box is told by far more samples than where a box of many is best: a line near an edge belongs to
it where it shares half as much as those inside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.pairs import MODES, PERIOD, Pairs, Samples, energies, pairs_of
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.scan import PERIODS, Suspect, successive
from pchem_pipeline.effects.framework.region import Region, Taps
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_FEWEST_LINES = 2  # of a period
#: Pixels of a place, its share of the sensor at most, and the mean outside over that inside at most.
FEWEST_PIXELS, LARGEST = 16, 0.6
_CONTRAST = 0.4
#: Guesses that are held against the scatter of the frames, the most significant first.
_MEASURED = 8
#: Families of places: bands of lines, bands across them, rectangles, periods, scattered lines.
_FAMILIES = 5
_LINE_BY_CHANCE = 1e-4  # probability of a line that stands out by itself, among all
#: Standard errors of a line's share that the share of the lines inside must exceed; where pairs count twice,
#: so much over the square root of two.
_CERTAIN = 6.0
_HALF = 0.5


@dataclass(frozen=True, kw_only=True)
class Shared(Suspect):
    """A place whose pixels move together, unlike the rest; inside and outside are mean correlations of pairs.

    Attributes:
        channel: 0 for electron numbers, 1 for residuals.
        mode: row, column or frame: what the pixels share.
    """

    channel: int
    mode: str


@dataclass(frozen=True)
class _Best:
    """The best place of a family: z, number of places, pixels (None: all), and cells of lines and across."""

    family: str
    z: float
    places: float
    region: Region | None = None
    box: tuple[tuple[int, int], tuple[int, int]] | None = None


def _boxes_of(mode: str, shape: tuple[int, ...], boxes: Sequence[tuple[slice, slice]]) -> Region | None:
    """Return the pixels of boxes, of lines and across them; None for all of the sensor."""
    mask = np.zeros(shape, np.bool_)
    turned = mask.T if mode == "column" else mask
    for box in boxes:
        turned[box] = True
    return None if mask.all() else Region.of_mask(mask)


def scan_pairs(samples: Samples, *, significance: float = SIGNIFICANCE, most: int = 2) -> list[Shared]:
    """Return the places whose pixels share noise, the most significant first, each without those before it.

    Args:
        samples: standardised frames.
        significance: largest probability of a chance in any place, mode and channel.
        most: places at most.
    """

    def best(left: BoolArray) -> tuple[BoolArray, Shared] | None:
        if left.sum() <= 2 * FEWEST_PIXELS:
            return None
        found = _most_significant(replace(samples, usable=left), math.log(significance))
        return None if found is None else (found.region.mask((left.shape[0], left.shape[1])), found)

    return successive(best, samples.usable, most)


def shared_elsewhere(samples: Samples, place: Shared, *, significance: float = SIGNIFICANCE) -> Region | None:
    """Return all pixels outside a place if they share noise among themselves as those inside do; else None.

    Args:
        samples: standardised frames.
        place: found among them.
        significance: largest probability of a chance.
    """
    left = samples.usable & ~place.region.mask((samples.usable.shape[0], samples.usable.shape[1]))
    if left.sum() <= 2 * FEWEST_PIXELS:
        return None
    pairs = pairs_of(replace(samples, usable=left))[place.channel][place.mode]
    every = np.array([0]), np.array([pairs.across.size - 1])
    total, number = (
        float(pairs.from_line(pairs.boxes(table, *every), 0)[-1, 0]) for table in (pairs.sums, pairs.counts)
    )
    z = total / math.sqrt(max(2.0 * number, 1.0))
    return Region.of_mask(left) if special.log_ndtr(-z) <= math.log(significance) else None


def _most_significant(samples: Samples, log_limit: float) -> Shared | None:
    """Return the place of the smallest probability that holds against the scatter of the frames, too."""
    guesses = sorted(
        (
            (_log_p(best.z, best.places), channel, pairs, best)
            for channel, modes in enumerate(pairs_of(samples))
            for pairs in modes.values()
            for best in (
                *_boxes(pairs, samples.usable),
                *_periods(pairs),
                *_scattered(pairs, samples.usable),
            )
        ),
        key=lambda guess: guess[0],
    )
    for log_p, channel, pairs, best in guesses[:_MEASURED]:
        if log_p > log_limit:
            break
        if best.region is None:
            continue
        place = _measured(samples, channel, pairs.mode, best.region, best)
        if _holds(place, log_limit):
            sharper = _with_ends(samples, channel, pairs, best)
            return sharper if sharper is not None and _holds(sharper, log_limit) else place
    return None


def _holds(place: Shared, log_limit: float) -> bool:
    """Tell whether a place is significant, and little of it is elsewhere."""
    return place.log_p <= log_limit and abs(place.outside) < _CONTRAST * place.inside


def _log_p(z: float, places: float) -> float:
    """Return the logarithm of the union bound over the places of a family, all families and modes."""
    looks = places * _FAMILIES * len(MODES) * len(CHANNELS)
    return min(0.0, float(special.log_ndtr(-z)) + math.log(max(looks, 1.0)))


def _measured(samples: Samples, channel: int, mode: str, region: Region, best: _Best) -> Shared:
    """Return a place with its significance by theory or by the scatter of the frames, whichever is less."""
    inside = region.mask((samples.usable.shape[0], samples.usable.shape[1]))
    usable = samples.usable
    energy, total = (samples.energies(channel, mode, part) for part in (usable & inside, usable))
    n = energy.size
    # the products of ones are the number of pairs
    ones = (part[None].astype(np.float32) for part in (usable & inside, usable))
    own, every = (float(energies(each, mode)[0]) for each in ones)
    share = own / every
    apart = energy - share * total
    by_theory = math.sqrt(n * own * (1.0 - share))
    by_scatter = float(np.std(apart) * math.sqrt(n))
    z = float(apart.sum()) / max(by_theory, by_scatter)
    # partners of each pixel: squares of sums over w of them have this many degrees of freedom
    partners = 2.0 * own / max(int((usable & inside).sum()), 1)
    freedom = 2.0 * n * own / max(partners - 1.0, 1e-9) ** 2
    z = float(chi_square(max(freedom + z * math.sqrt(2.0 * freedom), 0.0), freedom))
    rest = (float(total.sum()) - float(energy.sum())) / max(n * (every - own), 1.0)
    return Shared(
        family=best.family,
        z=z,
        log_p=_log_p(z, best.places),
        inside=float(energy.sum()) / (n * own),
        outside=rest,
        region=region,
        channel=channel,
        mode=mode,
    )


def _with_ends(samples: Samples, channel: int, pairs: Pairs, best: _Best) -> Shared | None:
    """Return the place of a box with its ends told line by line; None where the scan knows as much."""
    if best.box is None:
        return None
    lines, across = Side.of(pairs.lines, best.box[0]), Side.of(pairs.across, best.box[1])
    if lines.exact and across.exact:
        return None
    first, second = (slice(*each) for each in sharpened(samples, channel, pairs.mode, lines, across))
    shape = samples.usable.shape[0], samples.usable.shape[1]
    region = _boxes_of(pairs.mode, shape, [(first, second)])
    return None if region is None else _measured(samples, channel, pairs.mode, region, best)


# -- families -----------------------------------------------------------------------------------


def _boxes(pairs: Pairs, usable: BoolArray) -> list[_Best]:
    """Return the best band of lines, band across them, and rectangle."""
    lines, across = pairs.lines.size - 1, pairs.across.size - 1
    c, d = np.triu_indices(across + 1, 1)
    sums, counts = (pairs.boxes(table, c, d) for table in (pairs.sums, pairs.counts))
    whole = int(np.flatnonzero((c == 0) & (d == across))[0])
    total, number = (float(pairs.from_line(table, 0)[-1, whole]) for table in (sums, counts))
    if number <= 0:
        return []
    area = _areas(usable if pairs.mode != "column" else usable.T, pairs.lines, pairs.across)
    best = {name: _Best(name, 0.0, 0.0) for name in ("lines", "across", "rectangle")}
    for a in range(lines):
        counted = pairs.from_line(counts, a)
        size = area[a + 1 :, d] - area[a, d] - area[a + 1 :, c] + area[a, c]
        some = (size >= FEWEST_PIXELS) & (size <= LARGEST * usable.sum()) & (counted > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = pairs.from_line(sums, a) - counted * total / number
            z /= np.sqrt(2.0 * counted * (1.0 - counted / number))
        for family, which in _families(some, a, whole).items():
            best[family] = _better(best[family], np.where(which, z, 0.0), int(which.sum()), a, (c, d))
    found = []
    for each in best.values():
        if each.z > 0 and each.box is not None:
            sides = zip((pairs.lines, pairs.across), each.box, strict=True)
            first, second = (slice(int(edges[a]), int(edges[b])) for edges, (a, b) in sides)
            found.append(replace(each, region=_boxes_of(pairs.mode, usable.shape, [(first, second)])))
    return found


def _families(some: BoolArray, first: int, whole: int) -> dict[str, BoolArray]:
    """Return which boxes (last line, band) from a first line on belong to which family."""
    every, full = np.zeros_like(some), np.zeros_like(some)
    full[:, whole] = True
    every[-1] = first == 0
    return {
        "lines": some & full & ~every,
        "across": some & every & ~full,
        "rectangle": some & ~every & ~full,
    }


def _better(best: _Best, z: FloatArray, tried: int, first: int, bands: tuple[IntArray, IntArray]) -> _Best:
    """Return the best box so far of a family, with the number of those tried."""
    last, band = np.unravel_index(int(np.argmax(z)), z.shape)
    if z[last, band] > best.z:
        box = (first, first + 1 + int(last)), (int(bands[0][band]), int(bands[1][band]))
        best = replace(best, z=float(z[last, band]), box=box)
    return replace(best, places=best.places + tried)


def _areas(usable: BoolArray, lines: IntArray, across: IntArray) -> FloatArray:
    """Return the usable pixels before each edge, (lines + 1, across + 1)."""
    total = np.pad(np.cumsum(np.cumsum(usable, axis=0, dtype=np.int64), axis=1), ((1, 0), (1, 0)))
    return np.asarray(total[np.ix_(lines, across)], np.float64)


def _periods(pairs: Pairs) -> list[_Best]:
    """Return the best set of every n-th column, and of every n-th row where they share the line."""
    ways: tuple[Literal["rows", "columns"], ...] = ("columns", "rows")
    ways = {"row": ways[:1], "column": ways[1:], "frame": ways}[pairs.mode]
    best, tried = _Best("period", 0.0, 1.0), 0
    for along, sums, counts in zip(ways, pairs.phases, pairs.phase_counts, strict=True):
        total, number = float(sums.sum()), float(counts.sum())
        length = int((pairs.columns if along == "columns" else pairs.rows)[-1])
        for period in (p for p in PERIODS if _FEWEST_LINES * p <= length and number > 0):
            for phase in range(period):
                some = np.ix_(*2 * (np.arange(PERIOD) % period == phase,))
                inside, counted = float(sums[some].sum()), float(counts[some].sum())
                tried += 1
                if not 0 < counted < number:
                    continue
                z = (inside - counted * total / number) / math.sqrt(2.0 * counted * (1.0 - counted / number))
                if z > best.z:
                    taps = Taps(every=period, which=(phase,), along=along)
                    best = _Best("period", z, 1.0, Region(taps=taps))
    return [replace(best, places=float(tried))] if best.z > 0 else []


def _scattered(pairs: Pairs, usable: BoolArray) -> list[_Best]:
    """Return the rows (columns) that stand out each by itself, where they are more than one band."""
    if pairs.mode == "frame":
        return []
    n, every = pairs.lines.size - 1, (np.array([0]), np.array([pairs.across.size - 1]))
    sums, counts = (
        np.diff(np.append(0.0, pairs.from_line(pairs.boxes(table, *every), 0)[:, 0]))
        for table in (pairs.sums, pairs.counts)
    )
    some = counts > 0
    if some.sum() < 3:
        return []
    usual = float(np.median(sums[some] / counts[some]))
    z = np.zeros(n)
    z[some] = (sums[some] - usual * counts[some]) / np.sqrt(2.0 * counts[some])
    chosen = np.flatnonzero(z > -special.ndtri(_LINE_BY_CHANCE / n))
    area = np.add.reduceat((usable.T if pairs.mode == "column" else usable).sum(axis=1), pairs.lines[:-1])
    size = int(area[chosen].sum())
    if not (np.diff(chosen) > 1).any() or not FEWEST_PIXELS <= size <= LARGEST * usable.sum():
        return []
    together = float(z[chosen] @ np.sqrt(counts[chosen]) / np.sqrt(counts[chosen].sum()))
    # of all sets of as many lines
    log_places = (
        special.gammaln(n + 1) - special.gammaln(chosen.size + 1) - special.gammaln(n - chosen.size + 1)
    )
    spans = [(slice(int(pairs.lines[i]), int(pairs.lines[i + 1])), slice(None)) for i in chosen]
    region = _boxes_of(pairs.mode, usable.shape, spans)
    return [_Best("scattered", together, float(np.exp(log_places)), region)]


class Side(NamedTuple):
    """A box of cells along one axis.

    Attributes:
        first, last: line that it begins with, and behind its last one.
        low, high: the same with the cells beside it.
        inner: the same without the cells at its ends, where it has others.
        sure: whether it has, so that all of these lines are inside.
    """

    first: int
    last: int
    low: int
    high: int
    inner: tuple[int, int]
    sure: bool

    @classmethod
    def of(cls, edges: IntArray, cells: tuple[int, int]) -> Side:
        """Return that of cells from one to before another, given the edges of all."""
        a, b = cells
        low, high = int(edges[max(a - 1, 0)]), int(edges[min(b + 1, edges.size - 1)])
        first, last = int(edges[a]), int(edges[b])
        inner = (int(edges[a + 1]), int(edges[b - 1])) if b - a > 2 else (first, last)
        # what ends with the sensor has its end there
        inner = first if a == 0 else inner[0], last if b == edges.size - 1 else inner[1]
        return cls(first, last, low, high, inner, b - a > 2)

    @property
    def exact(self) -> bool:
        """Whether the cells beside it are single lines, of which the scan knows as much."""
        return self.first - self.low <= 1 and self.high - self.last <= 1


def sharpened(
    samples: Samples, channel: int, mode: str, lines: Side, across: Side
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first line of a box and the one behind its last, and the same across the lines.

    Where too little is known of single lines, the ends stay.

    Args:
        samples: standardised frames.
        channel: 0 for electron numbers, 1 for residuals.
        mode: what pixels share: "row", "column", "frame".
        lines: rows of the box, for "column" its columns.
        across: the other axis.
    """
    turned = mode == "column"
    rows, columns = (across, lines) if turned else (lines, across)
    box = slice(rows.low, rows.high), slice(columns.low, columns.high)
    sums: list[Any] = [0.0, 0.0]
    for (u,) in samples.chunks((channel,), *box):
        values = u.transpose(0, 2, 1) if turned else u
        sums = [a + b for a, b in zip(sums, _products(values, mode, lines, across), strict=True)]
    mask = samples.usable[box].astype(np.float32)[None]
    pairs = _products(mask.transpose(0, 2, 1) if turned else mask, mode, lines, across)
    found = (
        _ends(side, total, samples.n_frames * number)
        for side, total, number in zip((lines, across), sums, pairs, strict=True)
    )
    first, second = found
    return first, second


def _products(u: NDArray[np.float32], mode: str, lines: Side, across: Side) -> list[FloatArray]:
    """Return how much each line, and each across, shares with the inside: sums of products of pairs.

    Args:
        u: (frame, line, across), of the box and the cells beside it.
        mode: "frame", or any other for what pixels share in a line.
        lines: of the box.
        across: of the box, likewise.
    """
    of_lines, of_across = (_within(side, (side.first, side.last)) for side in (lines, across))
    if mode == "frame":
        return [
            _with_inner(u[:, :, of_across].sum(axis=2, dtype=np.float64), lines),
            _with_inner(u[:, of_lines].sum(axis=1, dtype=np.float64), across),
        ]
    band, rows = u[:, :, of_across], u[:, of_lines]
    own = band.sum(axis=2, dtype=np.float64) ** 2 - np.einsum("tyx,tyx->ty", band, band, dtype=np.float64)
    return [own.sum(axis=0), _with_inner(rows.reshape(-1, rows.shape[2]).astype(np.float64), across)]


def _within(side: Side, span: tuple[int, int]) -> slice:
    """Return lines of the sensor as those of the box and the cells beside it."""
    return slice(span[0] - side.low, span[1] - side.low)


def _with_inner(values: FloatArray, side: Side) -> FloatArray:
    """Return sums over the products of each line with the others inside, of values (n, line)."""
    inner = np.zeros(values.shape[1], np.bool_)
    inner[_within(side, side.inner)] = True
    together = values[:, inner].sum(axis=1)
    return np.asarray(together @ values - inner * np.einsum("nl,nl->l", values, values))


def _ends(side: Side, sums: FloatArray, pairs: FloatArray) -> tuple[int, int]:
    """Return the first of the lines that share as much as those inside, and the one behind the last."""
    inner = _within(side, side.inner)
    total, number = float(sums[inner].sum()), float(pairs[inner].sum())
    known = pairs > 0
    share = np.where(known, sums / np.where(known, pairs, 1.0), 0.0)
    inside = total / max(number, 1.0)
    if side.exact or not known.any() or inside < _CERTAIN / float(np.median(pairs[known])) ** 0.5:
        return side.first, side.last
    apart = np.flatnonzero(known & (share <= _HALF * inside))
    most = inner.start + int(np.argmax(share[inner]))
    begin, end = (inner.start, inner.stop) if side.sure else (most, most + 1)
    first = int(max(apart[apart < begin], default=-1)) + 1
    last = int(min(apart[apart >= end], default=known.size))
    # of lines without samples nothing is known
    those = first + np.flatnonzero(known[first:last])
    return int(those[0]) + side.low, int(those[-1]) + 1 + side.low
