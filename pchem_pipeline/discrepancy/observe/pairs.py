"""Products of pixels that share a row, a column or only the frame, summed by cells of the sensor.

What pixels share adds to the covariance of all their pairs, not only to that of neighbours: a row of w pixels
has w (w - 1) / 2 pairs, and w - 1 neighbours. Samples are standardised by the variance of their pixel. Given
the histograms, frames without an effect are in random order: then products of different pixels have mean 0,
variance 1, and are uncorrelated, whatever the pixels' law, so that the sum over N of them has the standard
deviation ``sqrt(N)`` exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.discrepancy.observe.sums import CHANNELS, code_ranges, pixel_statistics
from pchem_pipeline.discrepancy.observe.sums_numba import look_up
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, PixelLaws, pixel_laws
from pchem_pipeline.effects.framework.evidence import PixelMaps

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: What pixels share: their row, their column, or only the frame (neither row nor column).
MODES = ("row", "column", "frame")
#: Lines are told apart by their number modulo this.
PERIOD = 32
#: Cells along an edge of the sensor, for lines; half as many for frames.
_CELLS = 64
#: Of each table of sums of products: two channels and the counts, as gathered and as told.
_COPIES = 9


@dataclass(frozen=True)
class FrameBlocks:
    """Frames of some rows that come by blocks.

    Attributes:
        n_frames: number of them.
        blocks: yields about so many successive frames at a time, (frame, y, x), DN.
    """

    n_frames: int
    blocks: Callable[[int], Iterable[NDArray[np.unsignedinteger[Any]]]]

    @classmethod
    def of(
        cls, frames: NDArray[np.unsignedinteger[Any]], chosen: IntArray | None = None, together: int = 1
    ) -> FrameBlocks:
        """Take frames in memory.

        Args:
            frames: codes (n, y, x), DN.
            chosen: positions of those that are meant; None: all.
            together: successive ones of these that come in the same block.
        """
        n_frames = frames.shape[0] if chosen is None else chosen.size

        def blocks(size: int) -> Iterator[NDArray[np.unsignedinteger[Any]]]:
            size = together * max(size // together, 1)
            for some in (slice(begin, begin + size) for begin in range(0, n_frames, size)):
                yield frames[some if chosen is None else chosen[some]]

        return cls(n_frames, blocks)


def laws_of_frames(frames: NDArray[np.unsignedinteger[Any]], maps: PixelMaps) -> PixelLaws:
    """Compare the histograms of frames (n, y, x) with the fit of their pixels."""
    return pixel_laws(PixelHistograms.of(frames), maps.columns, maps.usable.ravel())


@dataclass(frozen=True)
class Samples:
    """Frames as standardised deviations of their pixels, of both channels.

    Attributes:
        frames: codes (n, y, x), DN.
        first, last: smallest and largest code of each pixel's table, (y, x).
        start: row of the first one in ``tables``, (y, x).
        tables: k and r of each code over their standard deviation, (rows, 2).
        usable: pixels that count, (y, x).
        most: samples that are looked at at a time, whole frames.
    """

    frames: FrameBlocks
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    start: NDArray[np.int32]
    tables: Float32Array
    usable: BoolArray
    most: int = 1 << 20

    @classmethod
    def of(cls, frames: NDArray[np.unsignedinteger[Any]], maps: PixelMaps) -> Samples:
        """Prepare frames by the fit of their pixels."""
        return cls.by_laws(FrameBlocks.of(frames), laws_of_frames(frames, maps), maps)

    @classmethod
    def by_laws(
        cls, frames: FrameBlocks, laws: PixelLaws, maps: PixelMaps, *, standardised: bool = True
    ) -> Samples:
        """Prepare frames by the laws of their pixels, made of all samples of the frames or of more.

        Args:
            frames: codes.
            laws: of the pixels' samples.
            maps: parameters of the pixels.
            standardised: False: k (e-) and r (DN) as they are.
        """
        pixels = pixel_statistics(laws, maps)
        usable = pixels.usable
        tables = laws.tables
        if standardised:
            codes = np.where(laws.good, laws.support[:, 1], 0)
            deviation = np.sqrt(np.where(usable, pixels.variance, 1.0)).reshape(2, -1).astype(np.float32)
            tables = tables[: 1 + codes.sum()].copy()
            tables[1:] /= np.repeat(deviation.T, codes, axis=0)
            # a track of a particle is no common mode
            np.clip(tables, -FAR, FAR, out=tables)
        first, last, start = code_ranges(laws, usable)
        return cls(frames, first, last, start, tables, usable)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.frames.n_frames

    def without(self, pixels: BoolArray) -> Samples:
        """Return it without some pixels, (y, x)."""
        return replace(self, usable=self.usable & ~pixels)

    def chunks(
        self, channels: tuple[int, ...] = (0, 1), rows: slice = slice(None), columns: slice = slice(None)
    ) -> Iterator[Float32Array]:
        """Yield some frames at a time as deviations (channel, frame, y, x), 0 where not usable."""
        box = rows, columns
        first, last, start, weight = (
            np.ascontiguousarray(each[box])
            for each in (self.first, self.last, self.start, self.usable.astype(np.float32))
        )
        for block in self.frames.blocks(max(1, self.most // self.usable.size)):
            codes = np.ascontiguousarray(block[:, rows, columns])
            values = np.empty((2, *codes.shape), np.float32)
            look_up(codes, first, last, start, self.tables, weight, values)
            yield values[channels[0] : channels[-1] + 1]

    def energies(self, channel: int, mode: str, pixels: BoolArray) -> FloatArray:
        """Return the sum of the products of pairs of some pixels that share a mode, in each frame, (n,)."""
        rows, columns = (np.flatnonzero((self.usable & pixels).any(axis=axis)) for axis in (1, 0))
        if rows.size == 0:
            return np.zeros(self.n_frames)
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        inside = pixels[box].astype(np.float32)
        found = [energies(u * inside, mode) for (u,) in self.chunks((channel,), *box)]
        return np.concatenate(found)


def energies(u: Float32Array, mode: str) -> FloatArray:
    """Return the sum of the products of all pairs that share a mode, of frames (t, y, x)."""
    own = np.einsum("tyx,tyx->t", u, u, dtype=np.float64)
    rows, columns = (u.sum(axis=axis, dtype=np.float64) for axis in (2, 1))
    of_rows, of_columns = ((sums**2).sum(axis=1) for sums in (rows, columns))
    if mode == "frame":
        return np.asarray(rows.sum(axis=1) ** 2 - of_rows - of_columns + own) / 2.0
    return np.asarray((of_rows if mode == "row" else of_columns) - own) / 2.0


@dataclass(frozen=True)
class Pairs:
    """Sums of products of pairs of pixels that share a row (column, frame), by cells of the sensor.

    Cells lie across the line: groups of columns for rows. Pairs are counted twice, as (a, b) and (b, a).

    Attributes:
        sums, counts: over ranges of lines: of rows (columns) a to b - 1 the element b less a, shape
            (lines + 1, across, across); of frames, cumulative over both rows, (y + 1, y + 1, x, x).
        phases, phase_counts: the same by the column's (row's) number modulo :data:`PERIOD`, over all lines.
        rows, columns: edges of the cells, pixels.
    """

    mode: str
    sums: FloatArray
    counts: FloatArray
    phases: tuple[FloatArray, ...]
    phase_counts: tuple[FloatArray, ...]
    rows: IntArray
    columns: IntArray

    def boxes(self, table: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
        """Return ``sums`` (or ``counts``) over bands ``first`` to ``last - 1`` across the lines.

        Cumulative along the lines as the table is, the bands in the last axis.
        """
        total = np.pad(
            np.cumsum(np.cumsum(table, axis=-2), axis=-1), [(0, 0)] * (table.ndim - 2) + [(1, 0)] * 2
        )
        corners = ((last, last), (first, last), (last, first), (first, first))
        return np.asarray(
            sum(s * total[..., i, j] for s, (i, j) in zip((1, -1, -1, 1), corners, strict=True))
        )

    def from_line(self, boxes: FloatArray, first: int) -> FloatArray:
        """Return from :meth:`boxes` those of lines ``first`` to each later one, (later lines, bands)."""
        if self.mode == "frame":
            last = np.arange(first + 1, boxes.shape[0])
            return np.asarray(
                boxes[last, last] - boxes[first, last] - boxes[last, first] + boxes[first, first]
            )
        return np.asarray(boxes[first + 1 :] - boxes[first])

    @property
    def lines(self) -> IntArray:
        """Edges of the cells along which lines are counted."""
        return self.columns if self.mode == "column" else self.rows

    @property
    def across(self) -> IntArray:
        """Edges of the cells across the lines."""
        return self.rows if self.mode == "column" else self.columns


def pairs_of(samples: Samples, edges: tuple[IntArray, IntArray] | None = None) -> list[dict[str, Pairs]]:
    """Sum the products of all pairs in one pass over the frames; by channel, and by what the pixels share.

    Args:
        samples: standardised frames.
        edges: of the cells of rows and of columns, pixels; None: cells of equal size.
    """
    if edges is None:
        rows, columns = (
            np.unique(np.linspace(0, n, min(n, _CELLS) + 1).astype(np.int64)) for n in samples.usable.shape
        )
        edges = rows, columns
    counted, gathered = _Gathered(*edges), [_Gathered(*edges) for _ in CHANNELS]
    counted.add(samples.usable[None].astype(np.float32))
    for chunk in samples.chunks():
        for each, u in zip(gathered, chunk, strict=True):
            each.add(u)
    n, counts = samples.n_frames, counted.tables()
    found = []
    for each in gathered:
        tables = each.tables()
        found.append({
            mode: Pairs(
                mode,
                tables[mode][0],
                n * counts[mode][0],
                tables[mode][1],
                tuple(n * phases for phases in counts[mode][1]),
                *each.edges(mode),
            )
            for mode in MODES
        })  # fmt: skip
    return found


def pairs_bytes(shape: tuple[int, int]) -> int:
    """Return the memory that :func:`pairs_of` takes for a sensor (rows, columns), beside its frames."""
    y, x = (min(n, _CELLS) for n in shape)
    v, u = (-(-n // 2) if n > _CELLS // 2 else n for n in (y, x))
    return _COPIES * 8 * (y * x * (y + x) + (v * u) ** 2)


class _Lines:
    """Sums of products of different pixels of a line, by cells across it.

    Attributes:
        lines, across: edges of the cells.
        products: of the pixels of all lines of a cell, (line, across, across).
        phases: of pixels of a line, and of a frame in different columns, by the column's number.
    """

    def __init__(self, lines: IntArray, across: IntArray) -> None:
        """Begin with nothing."""
        self.lines, self.across = lines, across
        self.products = np.zeros((lines.size - 1, across.size - 1, across.size - 1))
        self.phases = np.zeros((2, PERIOD, PERIOD))

    def add(self, u: Float32Array, square: FloatArray) -> None:
        """Add frames (t, line, across), with the sums of their squares (line, across)."""
        cells = np.add.reduceat(u, self.across[:-1], axis=2)
        own = _summed(square, (self.lines[:-1], self.across[:-1]))
        for i, (first, last) in enumerate(pairwise(self.lines)):
            part = cells[:, first:last].reshape(-1, cells.shape[2])
            self.products[i] += part.T @ part - np.diag(own[i])
        totals = u.sum(axis=1, dtype=np.float64)
        for phases, values, squares in zip(
            self.phases, (u, totals), (square.sum(axis=0), (totals**2).sum(axis=0)), strict=True
        ):
            folded = _folded(values).reshape(-1, PERIOD)
            phases += folded.T @ folded - np.diag(_by_number(squares))


class _Gathered:
    """Sums of products of different pixels of a row, of a column, and of all of a frame.

    Attributes:
        rows, columns: of lines, with their cells; those of frames are every ``stride`` of these.
        of_frames: products of all pixels, (y', x', y', x') in two axes.
        squares: of all pixels, (y', x').
    """

    def __init__(self, rows: IntArray, columns: IntArray) -> None:
        """Begin with nothing, for cells of rows and columns with these edges."""
        self.rows, self.columns = _Lines(rows, columns), _Lines(columns, rows)
        self.stride = tuple(2 if each.size - 1 > _CELLS // 2 else 1 for each in (rows, columns))
        self.squares = np.zeros([each.size - 1 for each in self.edges("frame")])
        self.of_frames = np.zeros((self.squares.size, self.squares.size))

    def edges(self, mode: str) -> tuple[IntArray, IntArray]:
        """Return the edges of the cells of rows and of columns, pixels."""
        whole = self.rows.lines, self.rows.across
        if mode != "frame":
            return whole
        rows, columns = (
            np.append(each[:-1:step], each[-1]) for each, step in zip(whole, self.stride, strict=True)
        )
        return rows, columns

    def add(self, u: Float32Array) -> None:
        """Add frames (t, y, x)."""
        square = np.einsum("tyx,tyx->yx", u, u, dtype=np.float64)
        self.rows.add(u, square)
        self.columns.add(u.transpose(0, 2, 1), square.T)
        rows, columns = (each[:-1] for each in self.edges("frame"))
        self.squares += _summed(square, (rows, columns))
        flat = np.add.reduceat(np.add.reduceat(u, rows, axis=1), columns, axis=2).reshape(u.shape[0], -1)
        self.of_frames += flat.T @ flat

    def tables(self) -> dict[str, tuple[FloatArray, tuple[FloatArray, ...]]]:
        """Return the sums of each mode, cumulative along the lines, and by numbers; see :class:`Pairs`.

        Of frames those of pixels in different rows and columns.
        """
        of_rows, of_columns = self.rows.products, self.columns.products
        by, bx = (
            np.arange(0, size, step)
            for size, step in zip((len(of_rows), len(of_columns)), self.stride, strict=True)
        )
        i, j = np.arange(by.size), np.arange(bx.size)
        frames = self.of_frames.reshape(*2 * self.squares.shape).transpose(0, 2, 1, 3).copy()
        frames[i, i] -= _summed(of_rows, (by, bx, bx))
        frames[:, :, j, j] -= _summed(of_columns, (bx, by, by)).transpose(1, 2, 0)
        for a in i:
            frames[a, a, j, j] -= self.squares[a]
        both = self.rows.phases[1] - self.rows.phases[0], self.columns.phases[1] - self.columns.phases[0]
        return {
            "row": (_cumulative(of_rows, 1), (self.rows.phases[0],)),
            "column": (_cumulative(of_columns, 1), (self.columns.phases[0],)),
            "frame": (_cumulative(frames, 2), both),
        }


def _cumulative(table: FloatArray, axes: int) -> FloatArray:
    """Return sums along the first axes, from nothing on."""
    found = np.pad(table, [(1, 0)] * axes + [(0, 0)] * (table.ndim - axes))
    for axis in range(axes):
        found = found.cumsum(axis=axis)
    return found


def _by_number(values: FloatArray) -> FloatArray:
    """Return sums of values of lines by the line's number modulo the period, (PERIOD,)."""
    return np.bincount(np.arange(values.size) % PERIOD, values, PERIOD).astype(np.float64)


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
