"""Where on the sensor a quick look finds something: maps of all pixels from all frames, and their scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.discrepancy.scan import scan_map
from pchem_pipeline.effects.framework.region import Region

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Cells along an edge of the maps that are scanned; of a larger sensor pixels are taken together.
_CELLS = 128
_CLIP = 6.0
_FEWEST_BLOCKS = 4
#: Axis along which the values of a map are of a pixel and the next one.
_NEXT_ALONG = {"next_x": 1, "next_y": 0}


@dataclass(frozen=True)
class SensorPlace:
    """A part of the sensor whose map stands out.

    Attributes:
        region: the place.
        p: probability of such a place by chance, anywhere on the sensor.
        inside, outside: mean of the map there and elsewhere, standard deviations of a pixel.
    """

    region: Region
    p: float
    inside: float
    outside: float

    @property
    def only_there(self) -> bool:
        """Whether little of it is elsewhere."""
        return abs(self.outside) < 0.25 * abs(self.inside)


def sensor_maps(sums: StackSums) -> dict[str, FloatArray]:
    """Return maps of all pixels from all frames, each N(0, 1) where samples are independent, (y, x).

    ``next_x`` and ``next_y`` (covariance with the next pixel), ``lag`` (with the frame before) and, of four
    blocks of frames or more, ``spread`` (block means scatter); NaN where a pixel never changes.
    """
    v, root = sums.variance, math.sqrt(sums.freedom_of_all)
    right, down = np.full(v.shape, np.nan), np.full(v.shape, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        right[:, :-1] = sums.next_x[:, :-1] / np.sqrt(v[:, :-1] * v[:, 1:]) * root
        down[:-1] = sums.next_y[:-1] / np.sqrt(v[:-1] * v[1:]) * root
        found = {"next_x": right, "next_y": down, "lag": sums.lag / v * root}
        if sums.lengths.size >= _FEWEST_BLOCKS:
            deviations = block_deviations(sums)
            chi2 = (sums.lengths[:, None, None] * deviations**2).sum(axis=0) / v
            found["spread"] = chi_square(chi2, sums.lengths.size - 1.0)
    return {name: np.where(np.isfinite(values), values, np.nan) for name, values in found.items()}


def block_deviations(sums: StackSums) -> FloatArray:
    """Return the mean of each pixel over each block, less that over the run and that of all pixels, DN."""
    means = sums.block_sum / sums.lengths[:, None, None]
    means -= np.average(means, axis=0, weights=sums.lengths)
    # the median over the pixels, for what all of them do: hot pixels move more
    return np.asarray(means - np.median(means, axis=(1, 2))[:, None, None])


def sensor_place(name: str, values: FloatArray, significance: float) -> SensorPlace | None:
    """Return the part of the sensor where a map stands out most; None where it is everywhere alike.

    Args:
        name: of the map, as :func:`sensor_maps` calls it.
        values: the map.
        significance: largest probability of a chance.
    """
    coarse, usable, edges = _coarse(values)
    places = scan_map(
        coarse, usable, significance=significance, most=1, single=False, next_along=_NEXT_ALONG.get(name)
    )
    if not places:
        return None
    cells = places[0].region.mask(coarse.shape)
    mask = np.repeat(np.repeat(cells, np.diff(edges[0]), axis=0), np.diff(edges[1]), axis=1)
    some = np.isfinite(values)
    inside, outside = some & mask, some & ~mask
    if not (inside.any() and outside.any()):
        return None
    means = [float(np.clip(values[part], -_CLIP, _CLIP).mean()) for part in (inside, outside)]
    return SensorPlace(Region.of_mask(mask), places[0].p, means[0], means[1])


def _coarse(values: FloatArray) -> tuple[FloatArray, BoolArray, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return a map of cells, standard normal as its pixels are, which of them have any, and their edges."""
    ny, nx = values.shape
    rows, columns = (np.unique(np.linspace(0, n, min(n, _CELLS) + 1).astype(np.int64)) for n in (ny, nx))
    some = np.isfinite(values)
    kept = np.where(some, np.clip(values, -_CLIP, _CLIP), 0.0)

    def summed(of: NDArray[np.float64]) -> FloatArray:
        return np.asarray(np.add.reduceat(np.add.reduceat(of, rows[:-1], axis=0), columns[:-1], axis=1))

    count = summed(some.astype(np.float64))
    return summed(kept) / np.sqrt(np.maximum(count, 1.0)), count > 0, (rows, columns)
