"""Places whose pixels share noise of their rows, columns or frames: a scan over all pairs of pixels.

Of every band of lines, every band across them, every rectangle, every n-th line, and the lines that stand out
each by itself the mean covariance of the pairs inside is compared with that of all other pairs, so that noise
which all pixels share has no place. Given the histograms, frames without an effect are in random order: then
products of different standardised pixels have mean 0, variance 1, and are uncorrelated, whatever the pixels'
law. So the standard error of a mean of N pairs is ``1 / sqrt(N)``, or what the frames' scatter gives where
that is more; the skewness of the sum of squares behind it is removed (Wilson and Hilferty 1931). The p-value
is the union bound over the places of the family, the families, modes and channels.

Boxes are of cells, each of several rows or columns of a large sensor; each round of finer cells
(:func:`.families.with_sharp_ends`) is another pass over the frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy import families
from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.sums import CHANNELS, Samples, energies
from pchem_pipeline.discrepancy.scan import Suspect
from pchem_pipeline.effects.framework.region import Region, Taps
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE

#: What pixels share: their row, their column, or only the frame (neither row nor column); and how many axes
#: of a table of their pairs are rows, and columns.
MODES = {"row": (1, 2), "column": (2, 1), "frame": (2, 2)}
#: Pixels of a place, and its share of the sensor at most.
FEWEST_PIXELS, LARGEST = 16, 0.6
#: Lines are distinguished by their number modulo this.
PERIOD = 32
#: Cells along an edge of the sensor, for lines; half as many for frames.
_CELLS = 64
#: Of each table of sums of products: two channels and the counts, as gathered and as returned.
_COPIES = 9
_CONTRAST = 0.4  # mean outside of a place over that inside, at most
#: Guesses that are held against the scatter of the frames, the most significant first.
_MEASURED = 8
#: Families of places (boxes, and two of lines at a period and scattered lines), modes and channels; half of
#: them, since places count to one side only.
_LOG_LOOKS = math.log((len(families.BOXES) + 2) * len(MODES) * len(CHANNELS) / 2.0)
_LINE_BY_CHANCE = 1e-4  # probability of a line that stands out by itself, among all


@dataclass(frozen=True, kw_only=True)
class Shared(Suspect):
    """A place whose pixels move together, unlike the rest; inside and outside are mean correlations of pairs.

    Channel 0 is that of electron numbers, 1 of residuals; the mode (row, column, frame) is what pixels share.
    """

    channel: int
    mode: str


class _Guess(NamedTuple):
    """The best place of a family, of one channel and mode."""

    place: families.Place
    channel: int
    mode: str


def scan_pairs(samples: Samples, *, significance: float = SIGNIFICANCE, most: int = 2) -> list[Shared]:
    """Return the places whose pixels share noise, the most significant first, each without those before it.

    The significance is that of any place, mode and channel; there are ``most`` places at most.
    """
    found: list[Shared] = []
    while len(found) < most and samples.usable.sum() > 2 * FEWEST_PIXELS:
        place = _most_significant(samples, math.log(significance))
        if place is None:
            break
        found.append(place)
        samples = samples.without(place.region.mask(samples.usable.shape))
    return found


def shared_elsewhere(samples: Samples, place: Shared) -> Region | None:
    """Return all pixels outside a place if they share noise among themselves, as those inside do."""
    rest = samples.without(place.region.mask(samples.usable.shape))
    if rest.usable.sum() <= 2 * FEWEST_PIXELS:
        return None
    pairs = pairs_of(rest)[place.channel][place.mode]
    z = float(pairs.sums.flat[-1]) / math.sqrt(max(2.0 * float(pairs.counts.flat[-1]), 1.0))
    return Region.of_mask(rest.usable) if special.log_ndtr(-z) <= math.log(SIGNIFICANCE) else None


def _most_significant(samples: Samples, log_limit: float) -> Shared | None:
    """Return the place of the smallest probability that holds against the scatter of the frames, too."""
    # the tables of pairs are large, and what is guessed from them is all that is kept
    guesses = [
        _Guess(place, channel, mode)
        for channel, modes in enumerate(pairs_of(samples))
        for mode, contrast in modes.items()
        for place in _places(contrast, mode, samples.usable)
        if place is not None
    ]
    for guess in sorted(guesses, key=lambda each: each.place.log_p)[:_MEASURED]:
        if guess.place.log_p > log_limit - _LOG_LOOKS:
            break
        shared = _measured(samples, guess)
        if _holds(shared, log_limit):
            sharper = _with_ends(samples, guess)
            measured = shared if sharper is guess else _measured(samples, sharper)
            return measured if _holds(measured, log_limit) else shared
    return None


def _holds(place: Shared, log_limit: float) -> bool:
    """Return whether a place is significant, and little of it is elsewhere."""
    return place.log_p <= log_limit and abs(place.outside) < _CONTRAST * place.inside


def _measured(samples: Samples, guess: _Guess) -> Shared:
    """Return a place with its significance by theory or by the scatter of the frames, whichever is less."""
    place, channel, mode = guess
    parts = samples.usable & place.mask, samples.usable
    energy, total = (samples.energies(channel, mode, part) for part in parts)
    n = energy.size
    # the products of ones are the number of pairs
    own, every = (float(energies(part[None].astype(np.float32), mode)[0]) for part in parts)
    share = own / every
    apart = energy - share * total
    by_theory = math.sqrt(n * own * (1.0 - share))
    by_scatter = float(np.std(apart) * math.sqrt(n))
    z = float(apart.sum()) / max(by_theory, by_scatter)
    # partners of each pixel: squares of sums over w of them have this many degrees of freedom
    partners = 2.0 * own / max(int(parts[0].sum()), 1)
    freedom = 2.0 * n * own / max(partners - 1.0, 1e-9) ** 2
    z = float(chi_square(freedom + z * math.sqrt(2.0 * freedom), freedom))
    return Shared(
        family=place.family,
        z=z,
        log_p=min(0.0, float(special.log_ndtr(-z)) + place.log_places + _LOG_LOOKS),
        inside=float(energy.sum()) / (n * own),
        outside=(float(total.sum()) - float(energy.sum())) / max(n * (every - own), 1.0),
        region=_region(place),
        channel=channel,
        mode=mode,
    )


def _region(place: families.Place) -> Region:
    """Return a place as a region, lines at a period as such."""
    if place.family != "period":
        return Region.of_mask(place.mask)
    of_rows = bool(place.mask.all(axis=1).any())
    first, second = np.flatnonzero(place.mask.any(axis=int(of_rows)))[:2].tolist()
    return Region(taps=Taps(every=second - first, which=(first,), along="rows" if of_rows else "columns"))


def _with_ends(samples: Samples, guess: _Guess) -> _Guess:
    """Return a box with its ends among finer cells, each scanned with another pass over the frames."""

    def at(edges: families.Edges) -> PairContrast:
        return pairs_of(samples, edges)[guess.channel][guess.mode]

    place = families.with_sharp_ends(guess.place, at)
    if place is guess.place:
        return guess
    # of lines without samples nothing is known
    inside = place.mask & samples.usable
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    mask = np.zeros_like(inside)
    mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return guess._replace(place=replace(place, mask=mask))


# -- families -----------------------------------------------------------------------------------


def _places(contrast: PairContrast, mode: str, usable: BoolArray) -> Iterator[families.Place | None]:
    """Yield the best place of each family."""
    if contrast.counts.flat[-1] > 0:
        yield from (families.box(contrast, family) for family in families.BOXES)
        yield from (families.every_nth(contrast, axis) for axis in (1, 0))
        if mode != "frame":
            yield _scattered(contrast, 0 if mode == "row" else 1, usable)


def _scattered(contrast: PairContrast, axis: int, usable: BoolArray) -> families.Place | None:
    """Return the rows (axis 0) or columns (1) that stand out each by itself, where they are not one band."""
    cells = contrast.edges
    ranges = [(np.array([0]), np.array([each.size - 1])) for each in cells]
    ends = np.arange(cells[axis].size)
    ranges[axis] = ends[:-1], ends[1:]
    sums, counts = (
        families.box_sums(table, contrast.axes, *ranges).ravel() for table in (contrast.sums, contrast.counts)
    )
    some, n = counts > 0, sums.size
    if some.sum() < 3:
        return None
    usual = float(np.median(sums[some] / counts[some]))
    z = np.zeros(n)
    z[some] = (sums[some] - usual * counts[some]) / np.sqrt(2.0 * counts[some])
    chosen = z > -special.ndtri(_LINE_BY_CHANCE / n)
    lines = np.repeat(chosen, np.diff(cells[axis]))
    mask = np.broadcast_to(lines if axis else lines[:, None], usable.shape)
    size = int((mask & usable).sum())
    if not (np.diff(np.flatnonzero(chosen)) > 1).any() or not FEWEST_PIXELS <= size <= LARGEST * usable.sum():
        return None
    together = float(z[chosen] @ np.sqrt(counts[chosen]) / np.sqrt(counts[chosen].sum()))
    # of all sets of as many lines
    return families.Place("scattered", mask, together, math.log(2.0 * special.binom(n, int(chosen.sum()))))


# -- sums of products of pairs -------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PairContrast(families.Contrast):
    """Sums of products of pairs of pixels that share a row (column, frame), over boxes of the sensor.

    Pairs are counted twice, as (a, b) and (b, a). Only sums that are too large count. ``by_number`` has sums
    and counts of all by the numbers modulo :data:`PERIOD` of their rows and of their columns, (2, PERIOD,
    PERIOD); 0 for lines that the pixels share.
    """

    area: FloatArray  # pixels that count, cumulative over the cells, (y, x)
    by_number: tuple[FloatArray, FloatArray]

    def boxes(self, rows: families.Ranges, columns: families.Ranges) -> FloatArray:
        """Return the deviations of all boxes of some ranges of cells, 0 where one is too small or large."""
        size = families.box_sums(self.area, (1, 1), rows, columns)
        some = (size >= FEWEST_PIXELS) & (size <= LARGEST * self.area[-1, -1])
        return np.where(some, super().boxes(rows, columns), 0.0)

    def phases(self, axis: int, period: int) -> FloatArray:
        """Return the deviations of every n-th row or column, by their numbers modulo the period."""
        parts = (each[axis].reshape(PERIOD // period, period, -1, period) for each in self.by_number)
        return self.null(*(part.sum(axis=(0, 2)).diagonal() for part in parts))


def pairs_of(samples: Samples, edges: families.Edges | None = None) -> list[dict[str, PairContrast]]:
    """Sum the products of all pairs in one pass over the frames; by channel, and by what the pixels share.

    ``edges`` are those of the cells of rows and of columns, pixels; None: cells of equal size.
    """
    if edges is None:
        rows, columns = (families.cell_edges(n, _CELLS) for n in samples.usable.shape)
        edges = rows, columns
    counted, gathered = _Gathered(edges), [_Gathered(edges) for _ in CHANNELS]
    counted.add(samples.usable[None].astype(np.float32))
    for chunk in samples.chunks():
        for each, u in zip(gathered, chunk, strict=True):
            each.add(u)
    n = samples.n_frames
    counts = {
        mode: (families.cumulative(n * table), n * rest) for mode, (table, rest) in counted.tables().items()
    }
    area = families.cumulative(samples.usable.astype(np.float64))

    def contrast(mode: str, table: FloatArray, by_number: FloatArray) -> PairContrast:
        cells, (number, number_by) = counted.edges(mode), counts[mode]
        return PairContrast(
            edges=cells,
            sums=families.cumulative(table),
            counts=number,
            # that pairs are counted twice doubles the variance of a sum
            null=families.normal(float(table.sum()), float(number.flat[-1]), 2.0, 1.0, one_sided=True),
            axes=MODES[mode],
            area=area[np.ix_(*cells)],
            by_number=(by_number, number_by),
        )

    return [{mode: contrast(mode, *each) for mode, each in g.tables().items()} for g in gathered]


def pairs_bytes(shape: tuple[int, int]) -> int:
    """Return the memory that :func:`pairs_of` takes for a sensor (rows, columns), beside its frames."""
    y, x = (min(n, _CELLS) for n in shape)
    v, u = (-(-n // 2) if n > _CELLS // 2 else n for n in (y, x))
    return _COPIES * 8 * (y * x * (y + x) + (v * u) ** 2)


class _Gathered:
    """Sums of products of different pixels of a row, of a column, and of all of a frame."""

    def __init__(self, cells: families.Edges) -> None:
        self.cells = cells  # edges of those of rows and of columns
        y, x = (each.size - 1 for each in cells)
        self.stride = [2 if n > _CELLS // 2 else 1 for n in (y, x)]  # of the cells of frames in these
        self.lines = np.zeros((y, x, x)), np.zeros((x, y, y))  # products of pixels of a row, of a column
        # of pixels of a row (column), and of a frame, by the numbers of their columns (rows)
        self.by_number = np.zeros((2, 2, PERIOD, PERIOD))
        self.squares = np.zeros([each.size - 1 for each in self.edges("frame")])  # of all pixels
        self.frames = np.zeros((self.squares.size, self.squares.size))  # products of all pixels

    def edges(self, mode: str) -> families.Edges:
        """Return the edges of the cells of rows and of columns, pixels."""
        strides = self.stride if mode == "frame" else (1, 1)
        rows, columns = (
            np.append(each[:-1:n], each[-1]) for each, n in zip(self.cells, strides, strict=True)
        )
        return rows, columns

    def add(self, u: Float32Array) -> None:
        """Add frames (t, y, x)."""
        square = np.einsum("tyx,tyx->yx", u, u, dtype=np.float64)
        self._add_lines(0, u, square)
        self._add_lines(1, u.transpose(0, 2, 1), square.T)
        rows, columns = (each[:-1] for each in self.edges("frame"))
        self.squares += _summed(square, (rows, columns))
        flat = np.add.reduceat(np.add.reduceat(u, rows, axis=1), columns, axis=2).reshape(u.shape[0], -1)
        self.frames += flat.T @ flat

    def _add_lines(self, axis: int, u: Float32Array, square: FloatArray) -> None:
        """Add frames (t, line, across), with the sums of their squares (line, across)."""
        lines, across = self.cells[axis], self.cells[1 - axis]
        cells = np.add.reduceat(u, across[:-1], axis=2)
        own = _summed(square, (lines[:-1], across[:-1]))
        for i, (first, last) in enumerate(pairwise(lines)):
            part = cells[:, first:last].reshape(-1, cells.shape[2])
            self.lines[axis][i] += part.T @ part - np.diag(own[i])
        totals = u.sum(axis=1, dtype=np.float64)
        squares = square.sum(axis=0), (totals**2).sum(axis=0)
        for sums, values, each in zip(self.by_number[axis], (u, totals), squares, strict=True):
            folded = _folded(values).reshape(-1, PERIOD)
            sums += folded.T @ folded - np.diag(_folded(each))

    def tables(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return the sums of each mode by cells, (y, x, x), (y, y, x) or (y, y, x, x), and by numbers."""
        by, bx = (np.arange(0, len(each), n) for each, n in zip(self.lines, self.stride, strict=True))
        i, j = np.arange(by.size), np.arange(bx.size)
        # of frames those of pixels in different rows and columns
        frames = self.frames.reshape(*2 * self.squares.shape).transpose(0, 2, 1, 3).copy()
        frames[i, i] -= _summed(self.lines[0], (by, bx, bx))
        frames[:, :, j, j] -= _summed(self.lines[1], (bx, by, by)).transpose(1, 2, 0)
        for a in i:
            frames[a, a, j, j] -= self.squares[a]
        # rows by the number of their columns, columns by that of their rows
        (of_rows, by_column), (of_columns, by_row) = self.by_number
        none = np.zeros_like(of_rows)
        return {
            "row": (self.lines[0], np.stack([none, of_rows])),
            "column": (self.lines[1].transpose(1, 2, 0), np.stack([of_columns, none])),
            "frame": (frames, np.stack([by_row - of_columns, by_column - of_rows])),
        }


def _summed(values: FloatArray, starts: tuple[IntArray, ...]) -> FloatArray:
    """Return sums of groups along each axis."""
    for axis, first in enumerate(starts):
        values = np.add.reduceat(values, first, axis=axis)
    return values


def _folded(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return sums over the last axis by its number modulo the period, (..., PERIOD)."""
    missing = -values.shape[-1] % PERIOD
    padded = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]) if missing else values
    return np.asarray(padded.reshape(*values.shape[:-1], -1, PERIOD).sum(axis=-2))
