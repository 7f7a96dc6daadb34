"""Regions of the sensor in a quick look: maps of all pixels from all frames, and their scan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.families import cell_edges
from pchem_pipeline.discrepancy.observe.laws import FAR, chi_square
from pchem_pipeline.discrepancy.observe.sums import MINIMUM_BLOCKS
from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.discrepancy.scan import Suspect, scan_map
from pchem_pipeline.effects.framework.region import Region

#: Cells along an edge of the maps that are scanned; of a larger sensor pixels are taken together.
_CELLS = 128
#: Pixels that are looked at together.
_AT_ONCE = 1 << 17


def block_deviations(sums: StackSums) -> FloatArray:
    """Return the mean of each pixel over each block, less that over the run and that of all pixels, DN."""
    means = sums.block_means()
    # the median over the pixels, for what all of them do: hot pixels move more
    return np.asarray(means - np.median(means, axis=(1, 2))[:, None, None])


@dataclass(frozen=True)
class CellMap:
    """Clipped sums over cells of a map of the sensor whose pixels are N(0, 1) where nothing is wrong.

    Attributes:
        rows, columns: edges of the cells, pixels.
        sums: of the values, (cell y, cell x).
        counts: pixels that have one.
    """

    rows: IntArray
    columns: IntArray
    sums: FloatArray
    counts: FloatArray

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

    def mask(self, cells: BoolArray) -> BoolArray:
        """Return the pixels of some cells, (y, x)."""
        return np.repeat(np.repeat(cells, np.diff(self.rows), axis=0), np.diff(self.columns), axis=1)


def sensor_cells(sums: StackSums) -> dict[str, CellMap]:
    """Return maps of all pixels, all frames, each N(0, 1) where samples are independent, summed over cells.

    ``next_x`` and ``next_y`` (covariance with the next pixel), ``lag`` (with the frame before) and, of four
    blocks of frames or more, ``spread`` (block means scatter); a pixel that never changes does not count.
    """
    v, root = sums.variance, math.sqrt(sums.freedom_of_all)
    names = ("next_x", "next_y", "lag")
    found = {name: CellMap.empty(sums.shape) for name in names}
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
            chi2 = (sums.lengths[:, None, None] * block_deviations(sums) ** 2).sum(axis=0) / v
        found["spread"] = CellMap.empty(sums.shape)
        found["spread"].add(chi_square(chi2, sums.lengths.size - 1.0))
    return found


def sensor_places(maps: Mapping[str, CellMap], significance: float) -> dict[str, Suspect]:
    """Return the part of the sensor where each map stands out most; none where it is everywhere alike.

    Args:
        maps: by name, as :func:`sensor_cells` makes them.
        significance: largest probability of a chance in any of them.

    Returns:
        Places whose means are those of the map, standard deviations of a pixel.
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
    region = Region.of_mask(cells.mask(inside))
    return replace(places[0], region=region, inside=means[0], outside=means[1])
