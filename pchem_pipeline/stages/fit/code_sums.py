"""Samples of each code over the pixels of a tile that have a value, counted while the fit has its histograms.

The ensemble compares all frames of the sensor with the model, and would decode every histogram again for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.ensemble.ensemble import DnAxis
from pchem_pipeline.model.law.parameters import usable_pixels


class CodeSums:
    """Sums over pixels of a tile, to be added to and then kept in its marker.

    Args:
        origin: DN of bin 0 of all pixels of the tile.
        bins: of a histogram.
    """

    def __init__(self, origin: NDArray[np.integer[Any]], bins: int) -> None:
        self._start = int(origin.min())
        self._samples = np.zeros(int(origin.max()) - self._start + bins, np.int64)
        self._outside = 0

    def add(self, histogram: Mapping[str, NDArray[Any]], fit: Mapping[str, NDArray[Any]]) -> None:
        """Add some pixels: their ``counts``, ``origin``, ``under`` and ``over``, and what the fit found."""
        usable = usable_pixels(*(fit[name] for name in PARAMETERS))
        counts, origin = histogram["counts"][usable], histogram["origin"][usable]
        for first in np.unique(origin):  # few: windows begin at round numbers
            place = int(first) - self._start
            some = counts[origin == first].sum(axis=0, dtype=np.int64)
            self._samples[place : place + some.size] += some
        for name in ("under", "over"):
            self._outside += int(histogram[name][usable].sum(dtype=np.int64))

    def content(self) -> dict[str, Any]:
        """Return the codes that occur (DN), the samples of each, and those outside of the histograms."""
        occupied = np.flatnonzero(self._samples)
        return {
            "dn": (self._start + occupied).tolist(),
            "samples": self._samples[occupied].tolist(),
            "outside": self._outside,
        }


def on_axis(content: Mapping[str, Any], axis: DnAxis) -> tuple[NDArray[np.int64], int]:
    """Return the samples at each DN of an axis, and those beyond it; see :meth:`CodeSums.content`."""
    place = np.array(content["dn"], np.int64) - axis.start
    samples = np.array(content["samples"], np.int64)
    inside = (place >= 0) & (place < axis.size)
    found = np.zeros(axis.size, np.int64)
    found[place[inside]] = samples[inside]
    return found, int(samples[~inside].sum()) + int(content["outside"])
