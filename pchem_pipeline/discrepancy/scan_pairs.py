"""Places whose pixels share noise of their rows, columns or frames: a scan over all pairs of pixels.

Of every band of lines, every band across them, every rectangle, every n-th line, and the lines that stand out
each by itself the mean covariance of the pairs inside is compared with that of all other pairs, so that noise
which all pixels share has no place. The standard error is ``1 / sqrt(N)`` of N pairs (:mod:`.observe.pairs`),
or what the frames' scatter gives where that is more; the sum of squares behind it is skewed, which Wilson and
Hilferty's root takes away. The probability is the union bound over the places of the family, the families,
modes and channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.pairs import MODES, PERIOD, Pairs, Samples, pairs_of
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.scan import PERIODS, SIGNIFICANCE, Suspect, successive
from pchem_pipeline.discrepancy.scan_edges import Side, sharpened
from pchem_pipeline.effects.framework.region import Region, Taps

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
    """The best place of a family: cells of lines and across them, or a tap, or lines; z, number of places."""

    family: str
    z: float
    places: float
    lines: tuple[int, int] = (0, 0)
    across: tuple[int, int] = (0, 0)
    taps: Taps | None = None
    scattered: tuple[int, ...] = ()


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


def _most_significant(samples: Samples, log_limit: float) -> Shared | None:
    """Return the place of the smallest probability that holds against the scatter of the frames, too."""
    shape = samples.usable.shape[0], samples.usable.shape[1]
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
        region = _region(best, pairs, shape)
        if region is None:
            continue
        place = _measured(samples, channel, pairs.mode, region, best)
        if _holds(place, log_limit):
            sharper = _with_ends(samples, channel, pairs, best, place)
            place = sharper if _holds(sharper, log_limit) else place
            return place
    return None


def _holds(place: Shared, log_limit: float) -> bool:
    """Tell whether a place is significant, and little of it is elsewhere."""
    return place.log_p <= log_limit and abs(place.outside) < _CONTRAST * place.inside


def _log_p(z: float, places: float) -> float:
    """Return the logarithm of the union bound over the places of a family, all families and modes."""
    looks = places * _FAMILIES * len(MODES) * len(CHANNELS)
    return min(0.0, float(special.log_ndtr(-z)) + math.log(max(looks, 1.0)))


def _region(best: _Best, pairs: Pairs, shape: tuple[int, int]) -> Region | None:
    """Return the pixels of a place in the sensor's rows and columns; None for all of it."""
    if best.taps is not None:
        return Region(taps=best.taps)
    mask = np.zeros(shape, np.bool_)
    turned = mask.T if pairs.mode == "column" else mask
    if best.scattered:
        for line in best.scattered:
            turned[pairs.lines[line] : pairs.lines[line + 1]] = True
    else:
        lines, across = (
            slice(int(edges[a]), int(edges[b]))
            for edges, (a, b) in ((pairs.lines, best.lines), (pairs.across, best.across))
        )
        turned[lines, across] = True
    return None if mask.all() else Region.of_mask(mask)


def _measured(samples: Samples, channel: int, mode: str, region: Region, best: _Best) -> Shared:
    """Return a place with its significance by theory or by the scatter of the frames, whichever is less."""
    inside = region.mask((samples.usable.shape[0], samples.usable.shape[1]))
    usable = samples.usable
    energy, total = (samples.energies(channel, mode, part) for part in (usable & inside, usable))
    n = energy.size
    own, every = (_number_of_pairs(part, mode) for part in (usable & inside, usable))
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


def _with_ends(samples: Samples, channel: int, pairs: Pairs, best: _Best, place: Shared) -> Shared:
    """Return the place of a box with its ends told line by line."""
    lines, across = Side.of(pairs.lines, best.lines), Side.of(pairs.across, best.across)
    if best.taps is not None or best.scattered or (lines.exact and across.exact):
        return place
    ends = [slice(*each) for each in sharpened(samples, channel, pairs.mode, lines, across)]
    mask = np.zeros((samples.usable.shape[0], samples.usable.shape[1]), np.bool_)
    mask[tuple(ends[::-1] if pairs.mode == "column" else ends)] = True
    if mask.all():
        return place
    return _measured(samples, channel, pairs.mode, Region.of_mask(mask), best)


def _number_of_pairs(pixels: BoolArray, mode: str) -> float:
    """Return the pairs of pixels that share a mode in one frame."""
    size = float(pixels.sum())
    rows, columns = (float((pixels.sum(axis=axis, dtype=np.float64) ** 2).sum()) for axis in (1, 0))
    twice = {"row": rows - size, "column": columns - size, "frame": size**2 - rows - columns + size}
    return twice[mode] / 2.0


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
    return [each for each in best.values() if each.z > 0]


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
        across = int(bands[0][band]), int(bands[1][band])
        best = replace(best, z=float(z[last, band]), lines=(first, first + 1 + int(last)), across=across)
    return replace(best, places=best.places + tried)


def _areas(usable: BoolArray, lines: IntArray, across: IntArray) -> FloatArray:
    """Return the usable pixels before each edge, (lines + 1, across + 1)."""
    total = np.pad(np.cumsum(np.cumsum(usable, axis=0, dtype=np.int64), axis=1), ((1, 0), (1, 0)))
    return np.asarray(total[np.ix_(lines, across)], np.float64)


def _periods(pairs: Pairs) -> list[_Best]:
    """Return the best set of every n-th column, and of every n-th row where they share the line."""
    ways = {"row": ("columns",), "column": ("rows",), "frame": ("columns", "rows")}[pairs.mode]
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
                    taps = Taps(
                        every=period, which=(phase,), along="columns" if along == "columns" else "rows"
                    )
                    best = _Best("period", z, 1.0, taps=taps)
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
    return [_Best("scattered", together, float(np.exp(log_places)), scattered=tuple(chosen.tolist()))]
