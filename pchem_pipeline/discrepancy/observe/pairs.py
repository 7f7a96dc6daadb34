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

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.families import (
    Contrast,
    Edges,
    Ranges,
    box_sums,
    cell_edges,
    cumulative,
    normal,
)
from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.discrepancy.observe.sums import CHANNELS, code_ranges, pixel_statistics
from pchem_pipeline.discrepancy.observe.sums_numba import look_up
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, PixelLaws, pixel_laws
from pchem_pipeline.effects.framework.evidence import PixelMaps

#: What pixels share: their row, their column, or only the frame (neither row nor column); and how many axes
#: of a table of their pairs are rows, and columns.
MODES = {"row": (1, 2), "column": (2, 1), "frame": (2, 2)}
#: Pixels of a place, and its share of the sensor at most.
FEWEST_PIXELS, LARGEST = 16, 0.6
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


@dataclass(frozen=True, kw_only=True)
class PairContrast(Contrast):
    """Sums of products of pairs of pixels that share a row (column, frame), over boxes of the sensor.

    Pairs are counted twice, as (a, b) and (b, a). Only sums that are too large count.

    Attributes:
        area: pixels that count, cumulative over the cells, (y, x).
        by_number: sums and counts of all by the numbers modulo :data:`PERIOD` of their rows and of their
            columns, (2, PERIOD, PERIOD); 0 for lines that the pixels share.
    """

    area: FloatArray
    by_number: tuple[FloatArray, FloatArray]

    def boxes(self, rows: Ranges, columns: Ranges) -> FloatArray:
        """Return the deviations of all boxes of some ranges of cells, 0 where one is too small or large."""
        size = box_sums(self.area, (1, 1), rows, columns)
        some = (size >= FEWEST_PIXELS) & (size <= LARGEST * self.area[-1, -1])
        return np.where(some, super().boxes(rows, columns), 0.0)

    def phases(self, axis: int, period: int) -> FloatArray:
        """Return the deviations of every n-th row or column, by their numbers modulo the period."""
        parts = (each[axis].reshape(PERIOD // period, period, -1, period) for each in self.by_number)
        return self.null(*(part.sum(axis=(0, 2)).diagonal() for part in parts))


def pairs_of(samples: Samples, edges: Edges | None = None) -> list[dict[str, PairContrast]]:
    """Sum the products of all pairs in one pass over the frames; by channel, and by what the pixels share.

    Args:
        samples: standardised frames.
        edges: of the cells of rows and of columns, pixels; None: cells of equal size.
    """
    if edges is None:
        rows, columns = (cell_edges(n, _CELLS) for n in samples.usable.shape)
        edges = rows, columns
    counted, gathered = _Gathered(edges), [_Gathered(edges) for _ in CHANNELS]
    counted.add(samples.usable[None].astype(np.float32))
    for chunk in samples.chunks():
        for each, u in zip(gathered, chunk, strict=True):
            each.add(u)
    n = samples.n_frames
    counts = {mode: (cumulative(n * table), n * rest) for mode, (table, rest) in counted.tables().items()}
    area = cumulative(samples.usable.astype(np.float64))
    found: list[dict[str, PairContrast]] = []
    for each in gathered:
        found.append({})
        for mode, (table, by_number) in each.tables().items():
            cells, (number, number_by) = each.edges(mode), counts[mode]
            found[-1][mode] = PairContrast(
                edges=cells,
                sums=cumulative(table),
                counts=number,
                # that pairs are counted twice doubles the variance of a sum
                null=normal(float(table.sum()), float(number.flat[-1]), 2.0, 1.0, one_sided=True),
                axes=MODES[mode],
                area=area[np.ix_(*cells)],
                by_number=(by_number, number_by),
            )
    return found


def pairs_bytes(shape: tuple[int, int]) -> int:
    """Return the memory that :func:`pairs_of` takes for a sensor (rows, columns), beside its frames."""
    y, x = (min(n, _CELLS) for n in shape)
    v, u = (-(-n // 2) if n > _CELLS // 2 else n for n in (y, x))
    return _COPIES * 8 * (y * x * (y + x) + (v * u) ** 2)


class _Gathered:
    """Sums of products of different pixels of a row, of a column, and of all of a frame.

    Attributes:
        cells: edges of the cells of rows and of columns; those of frames are every ``stride`` of these.
        lines: products of the pixels of a row (y, x, x), and of a column (x, y, y).
        by_number: of pixels of a row (column), and of a frame, by the numbers of their columns (rows).
        frames: products of all pixels, (y' x', y' x').
        squares: of all pixels, (y', x').
    """

    def __init__(self, cells: Edges) -> None:
        """Begin with nothing, for cells of rows and columns with these edges."""
        self.cells = cells
        y, x = (each.size - 1 for each in cells)
        self.stride = [2 if n > _CELLS // 2 else 1 for n in (y, x)]
        self.lines = np.zeros((y, x, x)), np.zeros((x, y, y))
        self.by_number = np.zeros((2, 2, PERIOD, PERIOD))
        self.squares = np.zeros([each.size - 1 for each in self.edges("frame")])
        self.frames = np.zeros((self.squares.size, self.squares.size))

    def edges(self, mode: str) -> Edges:
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
        """Return the sums of each mode by cells, (y, x, x), (y, y, x) or (y, y, x, x), and by numbers.

        Of frames those of pixels in different rows and columns.
        """
        by, bx = (np.arange(0, len(each), n) for each, n in zip(self.lines, self.stride, strict=True))
        i, j = np.arange(by.size), np.arange(bx.size)
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
