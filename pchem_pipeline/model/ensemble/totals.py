"""The axes of the ensemble, and the sums over its pixels: two rows of numbers that need only be added."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis

#: Sizes of error of the electron numbers told apart; the last one is: and more.
ERROR_SIZES = 8

_INTEGERS = (
    "pixels",
    "excluded",
    "outside",
    "outside_all",
    "nuced_outside",
    "electrons_beyond",
    "compared",
    "signed_error",
)
_FLOATS = (
    "nuced_sum",
    "nuced_sum_square",
    "nuced_predicted_sum",
    "nuced_predicted_sum_square",
    "error",
    "error_variance",
)
#: Variances of the predictions by the errors of the maps.
MODEL_ERRORS = ("pcd_error", "nuced_error")


@dataclass(frozen=True)
class EnsembleAxes:
    """The axes of the ensemble, and where each sum stands in the rows of a tile.

    Attributes:
        dn: DN of the raw ensemble.
        nuced: bins of the NUCed ensemble.
        n_k: number of electron numbers.
    """

    dn: DnAxis
    nuced: NucedAxis
    n_k: int

    @cached_property
    def integers(self) -> dict[str, slice]:
        """Place of each tally in the row of integers."""
        lengths = {"counts": self.dn.size, "counts_all": self.dn.size, "nuced_counts": self.nuced.size}
        lengths |= {"electron_counts": self.n_k, "error_sizes": ERROR_SIZES}
        return _places(lengths | dict.fromkeys(_INTEGERS, 1))

    @cached_property
    def floats(self) -> dict[str, slice]:
        """Place of each sum in the row of floats."""
        lengths = dict.fromkeys(("pcd", "pcd_variance", "share", "share_all"), self.dn.size)
        lengths |= dict.fromkeys(("nuced", "nuced_variance", "nuced_share"), self.nuced.size)
        lengths |= dict.fromkeys(("electron_share", "electron_expected"), self.n_k)
        lengths |= dict(zip(MODEL_ERRORS, (self.dn.size, self.nuced.size), strict=True))
        return _places(lengths | dict.fromkeys(_FLOATS, 1))


def _places(lengths: dict[str, int]) -> dict[str, slice]:
    ends = np.cumsum(list(lengths.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(lengths.items(), ends, strict=True)}


@dataclass(frozen=True)
class EnsembleTotals:
    """The sums over all tiles.

    Attributes:
        axes: axes of the ensemble.
        integers: total of the rows of integers.
        floats: total of the rows of floats.
        samples: chosen frames of a pixel, all frames of a pixel; (1, 1) for ready-made histograms.
    """

    axes: EnsembleAxes
    integers: IntArray
    floats: FloatArray
    samples: tuple[int, int]

    def count(self, name: str) -> int:
        """Return a tally that is one number."""
        return int(self.integers[self.axes.integers[name]][0])

    def counts(self, name: str) -> IntArray:
        """Return a tally along an axis."""
        return self.integers[self.axes.integers[name]]

    def mean(self, name: str) -> FloatArray:
        """Return the mean over the pixels of a sum."""
        return self.floats[self.axes.floats[name]] / self.count("pixels")

    def variance(self, name: str) -> FloatArray:
        """Return the variance of the mean over the pixels, from the sum of the pixels' variances."""
        return self.mean(name) / self.count("pixels")
