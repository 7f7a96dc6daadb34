"""Summaries of a stack for a quick look: variances, covariances, and where on the sensor these differ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.families import cell_edges
from pchem_pipeline.discrepancy.observe.laws import FAR, chi_square
from pchem_pipeline.discrepancy.observe.sums import MINIMUM_BLOCKS
from pchem_pipeline.discrepancy.scan import Suspect, scan_map
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.model.maps.ordered import Ordered

#: Cells along an edge of the maps that are scanned; of a larger sensor pixels are taken together.
_CELLS = 128
#: Pixels that are looked at together.
_AT_ONCE = 1 << 17
#: Lines whose sums are looked at together.
_LINES_AT_ONCE = 1 << 12


@dataclass(frozen=True)
class Lines:
    """Sums over lines (rows, or columns in a group of rows) of some frames, and moments of their pixels."""

    sums: NDArray[np.signedinteger]  # of the lines in each frame, (frame, line), DN
    starts: IntArray  # first frame of each block of frames, (b,)
    freedom: float  # frames less blocks
    variance: FloatArray  # sum of the variances of a line's pixels, (line,), DN^2
    pairs: FloatArray  # sum of products of variances over ordered pairs of no neighbours, (line,), DN^4
    neighbours: FloatArray  # sum of the covariances of neighbours along the line, (line,), DN^2
    length: IntArray  # pixels of each line that vary: excluded ones do not

    @property
    def n_pairs(self) -> FloatArray:
        """Ordered pairs of pixels of a line that are no neighbours, (line,)."""
        return np.maximum((self.length - 1.0) * (self.length - 2.0), 0.0)

    @cached_property
    def _means(self) -> FloatArray:
        """Mean of each line over each block, (b, line), DN."""
        blocks = np.split(self.sums, self.starts[1:])
        return np.stack([each.sum(axis=0, dtype=np.int64) / len(each) for each in blocks])

    def centred(self, frames: slice = slice(None), lines: slice = slice(None)) -> FloatArray:
        """Return sums of some frames or lines (all take much memory) less their mean over each block, DN."""
        values = self.sums[frames, lines].astype(np.float64)
        first = frames.indices(self.sums.shape[0])[0]
        block = np.searchsorted(self.starts, np.arange(first, first + len(values)), side="right") - 1
        for each in np.unique(block):
            values[block == each] -= self._means[each, lines]
        return values

    @cached_property
    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Mean covariance of such pairs in each line, and its standard error by chance, DN^2, (line,).

        Given the samples of each pixel, in random order and independent of those of others, the sum of the
        products of all pairs has the expectation 0 and exactly this variance, whatever the pixels' law.
        """
        parts = [slice(i, i + _LINES_AT_ONCE) for i in range(0, self.variance.size, _LINES_AT_ONCE)]
        centred = (self.centred(lines=part) for part in parts)
        square = np.concatenate([np.einsum("tl,tl->l", each, each) for each in centred]) / self.freedom
        rest = square - self.variance - 2.0 * self.neighbours
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.sqrt(2.0 * self.pairs / self.freedom) / self.n_pairs
            return rest / self.n_pairs, np.where(error > 0, error, np.nan)


@dataclass(frozen=True)
class StackSums:
    """Summaries of a stack, as the stage ``histogram`` makes them; of a long run those of some blocks."""

    numbers: IntArray  # of the frames that the sums are of, odd ones left out, increasing, (n,)
    n_blocks: int  # blocks of the stack
    lengths: IntArray  # frames of each block whose sums are at hand, (b,)
    block_sum: IntArray  # of each pixel, (b, y, x), DN
    block_sum_square: IntArray  # of each pixel, (b, y, x), DN^2
    row_sum: IntArray  # of the frames of these blocks, (frame, y), DN
    column_blocks: IntArray  # which of these blocks have column sums at hand, increasing
    column_sum: NDArray[np.signedinteger]  # of their frames, over groups of rows, (frame, group, x), DN
    all_means: FloatArray  # of all frames of the stack, over all pixels, DN
    all_variances: FloatArray  # the same, DN^2
    lag: FloatArray  # covariance of successive frames within all blocks, (y, x), DN^2
    next_x: FloatArray  # covariance with the next pixel along x, NaN without one
    next_y: FloatArray  # the same along y
    odd: dict[str, IntArray] = field(default_factory=dict)  # frames by kind: empty, copied, far
    spectrum: Mapping[str, float] = field(default_factory=dict)  # of the first frames: `FrameSpectrum.line`

    @property
    def n_frames(self) -> int:
        """Frames that the sums are of."""
        return self.numbers.size

    @property
    def frame_mean(self) -> FloatArray:
        """Mean over all pixels of each of these frames, DN, (n,)."""
        return self.all_means[self.numbers]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.block_sum.shape[1], self.block_sum.shape[2]

    @property
    def starts(self) -> IntArray:
        """First frame of each block among those at hand, (b,)."""
        return np.asarray(np.cumsum(self.lengths) - self.lengths)

    @property
    def freedom(self) -> float:
        """Frames less blocks: degrees of freedom of what is taken within the blocks at hand."""
        return float(self.lengths.sum() - self.lengths.size)

    @property
    def freedom_of_all(self) -> float:
        """The same of all blocks, within which the covariances are taken."""
        return float(self.n_frames - self.n_blocks)

    def _variance(self, blocks: IntArray | slice) -> FloatArray:
        """Return the variance of each pixel within some blocks, (y, x), DN^2."""
        lengths = self.lengths[blocks]
        within = np.zeros(self.shape)
        parts = (self.block_sum[blocks], self.block_sum_square[blocks], lengths.tolist())
        for total, square, length in zip(*parts, strict=True):  # block by block: each is as large as a map
            between = total.astype(np.float64)
            between *= between
            between /= length
            within += np.subtract(square, between, out=between)
        within /= float(lengths.sum() - lengths.size)
        return within

    def block_means(self, *, apart: bool) -> FloatArray:
        """Return the mean of each pixel over each block at hand, less that over all, (b, y, x), DN.

        ``apart``: less the median over the pixels, too, which hot pixels do not move.
        """
        means = self.block_sum / self.lengths[:, None, None]
        means -= np.average(means, axis=0, weights=self.lengths)
        return np.asarray(means - np.median(means, axis=(1, 2), keepdims=True)) if apart else means

    @cached_property
    def mean_signal(self) -> FloatArray:
        """Mean of each pixel over the frames of the blocks at hand, (y, x), DN."""
        return np.asarray(self.block_sum.sum(axis=0) / float(self.lengths.sum()))

    @cached_property
    def typical_signal(self) -> tuple[float, float]:
        """Median and robust standard deviation of the mean signal over the pixels, DN."""
        known = Ordered.of(self.mean_signal)
        return known.median, known.robust_sd

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of each pixel within blocks, (y, x), DN^2."""
        return self._variance(slice(None))

    def n_varying(self, rows: BoolArray) -> int:
        """Return the number of pixels of some rows that vary."""
        return int(np.count_nonzero(self.variance[rows] > 0.0))

    @cached_property
    def rows(self) -> Lines:
        """Sums over the rows of all frames."""
        whole = np.zeros(1, np.int64)
        return _lines(self.row_sum, self.lengths, self.variance.T, self.next_x.T, whole)

    @cached_property
    def columns(self) -> Lines:
        """Sums over the columns of each group of rows, (group, x) in one axis, of some blocks."""
        some, groups = self.column_blocks, np.arange(0, self.shape[0], ROW_GROUP)
        variance = self.variance if some.size == self.lengths.size else self._variance(some)
        sums = self.column_sum.reshape(self.column_sum.shape[0], -1)
        return _lines(sums, self.lengths[some], variance, self.next_y, groups)


def _lines(
    sums: NDArray[np.signedinteger],
    lengths: IntArray,
    variance: FloatArray,
    covariance: FloatArray,
    groups: IntArray,
) -> Lines:
    """Return lines along the first axis of maps (along, across), cut into groups of pixels by their first."""
    total, square = (np.add.reduceat(each, groups, axis=0) for each in (variance, variance**2))
    product = np.zeros_like(variance)
    np.multiply(variance[:-1], variance[1:], out=product[:-1])
    product[groups[1:] - 1] = 0.0  # no product crosses the border of a group
    along = np.add.reduceat(product, groups, axis=0)
    del product  # as large as a map
    return Lines(
        sums,
        np.asarray(np.cumsum(lengths) - lengths),
        float(lengths.sum() - lengths.size),
        total.ravel(),
        (total**2 - square - 2.0 * along).ravel(),
        np.add.reduceat(np.nan_to_num(covariance), groups, axis=0).ravel(),
        np.add.reduceat(variance > 0.0, groups, axis=0, dtype=np.int64).ravel(),
    )


# -- maps of the sensor, and their scan --------------------------------------------------------------


@dataclass(frozen=True)
class CellMap:
    """Clipped sums over cells of a map of the sensor whose pixels are N(0, 1) where nothing is wrong."""

    rows: IntArray  # edges of the cells, pixels
    columns: IntArray  # edges of the cells, pixels
    sums: FloatArray  # of the values, (cell y, cell x)
    counts: FloatArray  # pixels that have one

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> CellMap:
        """Begin with no pixel of a sensor of some rows and columns."""
        rows, columns = (cell_edges(n, _CELLS) for n in shape)
        size = rows.size - 1, columns.size - 1
        return cls(rows, columns, np.zeros(size), np.zeros(size))

    def add(self, values: FloatArray, first: int = 0) -> None:
        """Add rows of the map from the row ``first`` on, (y, x)."""
        some = np.isfinite(values)
        kept = np.where(some, np.clip(values, -FAR, FAR), 0.0)
        at = np.searchsorted(self.rows, np.arange(first, first + values.shape[0]), side="right") - 1
        for total, part in ((self.sums, kept), (self.counts, some.astype(np.float64))):
            np.add.at(total, at, np.add.reduceat(part, self.columns[:-1], axis=1))


def sensor_cells(sums: StackSums) -> dict[str, CellMap]:
    """Return maps of all pixels, all frames, each N(0, 1) where samples are independent, summed over cells.

    ``next_x`` and ``next_y`` (covariance with the next pixel), ``lag`` (with the frame before) and, of four
    blocks of frames or more, ``spread`` (block means scatter); a pixel that never changes does not count.
    """
    v, root = sums.variance, math.sqrt(sums.freedom_of_all)
    found = {name: CellMap.empty(sums.shape) for name in ("next_x", "next_y", "lag")}
    rows = max(1, _AT_ONCE // v.shape[1])
    for first in range(0, v.shape[0], rows):
        band = slice(first, first + rows)
        right, down = v[band, 1:], v[first + 1 : first + 1 + rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            next_x = sums.next_x[band, :-1] / np.sqrt(v[band, :-1] * right) * root
            next_y = sums.next_y[band][: len(down)] / np.sqrt(v[band][: len(down)] * down) * root
            found["lag"].add(sums.lag[band] / v[band] * root, first)
        found["next_x"].add(np.pad(next_x, ((0, 0), (0, 1)), constant_values=np.nan), first)
        found["next_y"].add(next_y, first)
    if sums.lengths.size >= MINIMUM_BLOCKS:
        with np.errstate(divide="ignore", invalid="ignore"):
            chi2 = (sums.lengths[:, None, None] * sums.block_means(apart=True) ** 2).sum(axis=0) / v
        found["spread"] = CellMap.empty(sums.shape)
        found["spread"].add(chi_square(chi2, sums.lengths.size - 1.0))
    return found


def sensor_places(maps: Mapping[str, CellMap], significance: float) -> dict[str, Suspect]:
    """Return the part of the sensor where each map stands out most; none where it is everywhere alike.

    The significance is that of any map. Means of a place are in standard deviations of a pixel.
    """
    found = {name: _place(name, cells, significance / len(maps)) for name, cells in maps.items()}
    return {name: place for name, place in found.items() if place is not None}


def _place(name: str, cells: CellMap, significance: float) -> Suspect | None:
    usable = cells.counts > 0
    # standard normal as the pixels are
    scaled = cells.sums / np.sqrt(np.maximum(cells.counts, 1.0))
    along = {"next_x": 1, "next_y": 0}.get(name)
    places = scan_map(scaled, usable, significance=significance, most=1, single=False, next_along=along)
    if not places:
        return None
    inside = places[0].region.mask(usable.shape)
    if not (usable[inside].any() and usable[~inside].any()):
        return None
    means = [float(cells.sums[part].sum() / cells.counts[part].sum()) for part in (inside, ~inside)]
    pixels = np.repeat(np.repeat(inside, np.diff(cells.rows), axis=0), np.diff(cells.columns), axis=1)
    return replace(places[0], region=Region.of_mask(pixels), inside=means[0], outside=means[1])
