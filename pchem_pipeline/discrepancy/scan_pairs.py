"""Places whose pixels share noise of their rows, columns or frames: a scan over all pairs of pixels.

Of every band of lines, every band across them, every rectangle, every n-th line, and the lines that stand out
each by itself the mean covariance of the pairs inside is compared with that of all other pairs, so that noise
which all pixels share has no place. The standard error is ``1 / sqrt(N)`` of N pairs (:mod:`.observe.pairs`),
or what the frames' scatter gives where that is more; the sum of squares behind it is skewed, which Wilson and
Hilferty's root takes away. The probability is the union bound over the places of the family, the families,
modes and channels.

Boxes are of cells, each of several rows or columns of a large sensor. Around the ends of a box that stands
out the same scan goes on with ever finer cells, down to single lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.pairs import MODES, PERIOD, Pairs, Samples, energies, pairs_of
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.scan import PERIODS, Suspect, integral, successive
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
_BOXES = ("lines", "across", "rectangle")
_FAMILIES = len(_BOXES) + 2
_LINE_BY_CHANCE = 1e-4  # probability of a line that stands out by itself, among all
#: Cells in the place of the two beside an end of a box, so few that those of both ends are summed one by one,
#: and how often they are made finer.
_FINER, _ROUNDS = 14, 4


@dataclass(frozen=True, kw_only=True)
class Shared(Suspect):
    """A place whose pixels move together, unlike the rest; inside and outside are mean correlations of pairs.

    Attributes:
        channel: 0 for electron numbers, 1 for residuals.
        mode: row, column or frame: what the pixels share.
    """

    channel: int
    mode: str


class _Best(NamedTuple):
    """The best place of a family, by its standard errors, and how many were tried."""

    family: str
    z: float
    places: float
    region: Region


def _region(mode: str, shape: tuple[int, ...], boxes: Sequence[tuple[slice, slice]]) -> Region:
    """Return the pixels of boxes, of lines and across them."""
    mask = np.zeros(shape, np.bool_)
    turned = mask.T if mode == "column" else mask
    for box in boxes:
        turned[box] = True
    return Region.of_mask(mask)


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
    # the tables of pairs are large, and what is guessed from them is all that is kept
    guesses = sorted(
        (
            (_log_p(best.z, best.places), channel, pairs.mode, (pairs.rows, pairs.columns), best)
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
    for log_p, channel, mode, edges, best in guesses[:_MEASURED]:
        if log_p > log_limit:
            break
        place = _measured(samples, channel, mode, best)
        if _holds(place, log_limit):
            sharper = _with_ends(samples, channel, mode, edges, best)
            return sharper if sharper is not None and _holds(sharper, log_limit) else place
    return None


def _holds(place: Shared, log_limit: float) -> bool:
    """Tell whether a place is significant, and little of it is elsewhere."""
    return place.log_p <= log_limit and abs(place.outside) < _CONTRAST * place.inside


def _log_p(z: float, places: float) -> float:
    """Return the logarithm of the union bound over the places of a family, all families and modes."""
    looks = places * _FAMILIES * len(MODES) * len(CHANNELS)
    return min(0.0, float(special.log_ndtr(-z)) + math.log(max(looks, 1.0)))


def _measured(samples: Samples, channel: int, mode: str, best: _Best) -> Shared:
    """Return a place with its significance by theory or by the scatter of the frames, whichever is less."""
    inside = best.region.mask((samples.usable.shape[0], samples.usable.shape[1]))
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
        region=best.region,
        channel=channel,
        mode=mode,
    )


def _with_ends(
    samples: Samples, channel: int, mode: str, edges: tuple[IntArray, IntArray], best: _Best
) -> Shared | None:
    """Return the place of a box with its ends told line by line; None where the scan knows as much."""
    shape, given, tried = (samples.usable.shape[0], samples.usable.shape[1]), best, best.places
    for _ in range(_ROUNDS if best.family in _BOXES else 0):
        inside = best.region.mask(shape)
        ends = [
            _ends(each, np.asarray(inside.any(axis=axis))) for each, axis in zip(edges, (1, 0), strict=True)
        ]
        if all(after - before == 2 for of_axis in ends for before, _, after in of_axis):
            break
        edges = _finer(ends[0], shape[0]), _finer(ends[1], shape[1])
        boxes = _boxes(pairs_of(samples, edges)[channel][mode], samples.usable)
        box = next((each for each in boxes if each.family == best.family), None)
        if box is None:
            return None
        tried += box.places
        best = box._replace(places=tried)
    if best is given:
        return None
    # of lines without samples nothing is known
    inside = best.region.mask(shape) & samples.usable
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    whole = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return _measured(samples, channel, mode, best._replace(region=_region("", shape, [whole])))


def _ends(edges: IntArray, inside: BoolArray) -> list[tuple[int, int, int]]:
    """Return where ranges of lines begin and end, between the edges of the cells beside."""
    ends = np.flatnonzero(np.diff(inside)) + 1
    return [(int(edges[edges < end][-1]), int(end), int(edges[edges > end][0])) for end in ends]


def _finer(ends: Sequence[tuple[int, int, int]], lines: int) -> IntArray:
    """Return the edges of finer cells around ends of ranges of lines, and one cell for what is between."""
    fine = [np.linspace(low, high, min(high - low, _FINER) + 1) for low, _, high in ends]
    return np.unique(np.concatenate([[0, lines], *ends, *fine]).astype(np.int64))


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
    area = integral(usable if pairs.mode != "column" else usable.T)[np.ix_(pairs.lines, pairs.across)]
    best: dict[str, tuple[float, tuple[slice, slice]]] = {}
    tried = dict.fromkeys(_BOXES, 0)
    for a in range(lines):
        counted = pairs.from_line(counts, a)
        size = area[a + 1 :, d] - area[a, d] - area[a + 1 :, c] + area[a, c]
        some = (size >= FEWEST_PIXELS) & (size <= LARGEST * usable.sum()) & (counted > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = pairs.from_line(sums, a) - counted * total / number
            z /= np.sqrt(2.0 * counted * (1.0 - counted / number))
        every, full = np.zeros_like(some), np.zeros_like(some)
        every[-1], full[:, whole] = a == 0, True
        for family, which in zip(_BOXES, (full & ~every, every & ~full, ~every & ~full), strict=True):
            of_family = np.where(some & which, z, 0.0)
            last, band = np.unravel_index(int(np.argmax(of_family)), z.shape)
            tried[family] += int((some & which).sum())
            if of_family[last, band] > best.get(family, (0.0,))[0]:
                of_lines = slice(pairs.lines[a], pairs.lines[a + 1 + last])
                of_across = slice(pairs.across[c[band]], pairs.across[d[band]])
                best[family] = float(of_family[last, band]), (of_lines, of_across)
    return [
        _Best(family, z, tried[family], _region(pairs.mode, usable.shape, [box]))
        for family, (z, box) in best.items()
    ]


def _periods(pairs: Pairs) -> list[_Best]:
    """Return the best set of every n-th column, and of every n-th row where they share the line."""
    ways: tuple[Literal["rows", "columns"], ...] = ("columns", "rows")
    ways = {"row": ways[:1], "column": ways[1:], "frame": ways}[pairs.mode]
    best, taps, tried = 0.0, None, 0
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
                if z > best:
                    best, taps = z, Taps(every=period, which=(phase,), along=along)
    return [] if taps is None else [_Best("period", best, tried, Region(taps=taps))]


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
    region = _region(pairs.mode, usable.shape, spans)
    return [_Best("scattered", together, float(np.exp(log_places)), region)]
