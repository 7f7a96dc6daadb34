"""The ensemble predicted with a grown law: the mean of the pixels' exact masses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.ensemble import grown_ensemble_numba
from pchem_pipeline.model.ensemble.ensemble import DnAxis, EnsembleSums, NucedAxis
from pchem_pipeline.model.law.mass import marginal_mass
from pchem_pipeline.model.law.sample_law import MarginalModel
from pchem_pipeline.model.maps.pixels import FloatArray, PixelParameters

__all__ = ["GrownSums", "grown_sums"]

_CHUNK = 4_000_000  # masses held at a time


@dataclass(frozen=True)
class GrownSums:
    """Sums over pixels under a grown law.

    Attributes:
        sums: masses and their squares on both axes, as without effects.
        nuced_sum: sum over pixels of the mean of the NUCed value, e-.
        nuced_sum_square: sum of the mean of its square, e-^2.
    """

    sums: EnsembleSums
    nuced_sum: float
    nuced_sum_square: float


def grown_sums(
    pixels: PixelParameters,
    lobes: tuple[FloatArray, FloatArray] | None,
    model: MarginalModel,
    dn: DnAxis,
    nuced: NucedAxis,
) -> GrownSums:
    """Sum the pixels' masses at the integer DN, and the same masses sorted into NUCed bins.

    The mean over the pixels replaces that of their PCDs (Hendrickson et al. 2023, eq. full_ensemble_dist).

    Args:
        pixels: the n pixels.
        lobes: amplitude (e-) and weight of the free lobes of each, shape (n,); None: none.
        model: the law.
        dn: axis of the raw prediction; it should hold all of the data.
        nuced: axis of the NUCed prediction.

    Returns:
        The sums.
    """
    raw, raw_square = np.zeros((2, dn.size))
    bins, bins_square = np.zeros((2, nuced.size))
    moments = np.zeros(2)
    n = len(pixels)
    columns = pixels.columns()
    step = max(1, _CHUNK // dn.size)
    for first in range(0, n, step):
        part = np.arange(first, min(first + step, n))
        own = None if lobes is None else (lobes[0][part], lobes[1][part])
        mass = marginal_mass(model.of(part), [c[part] for c in columns], dn.dn, lobes=own)
        _add(mass, raw, raw_square)
        grown_ensemble_numba.sort_masses(
            mass,
            float(dn.start),
            columns[1][part],
            columns[2][part],
            nuced.width,
            nuced.start,
            bins,
            bins_square,
            moments,
        )
    return GrownSums(EnsembleSums(n, raw, raw_square, bins, bins_square), *map(float, moments))


def _add(mass: NDArray[np.float64], raw: FloatArray, raw_square: FloatArray) -> None:
    raw += mass.sum(axis=0)
    raw_square += (mass * mass).sum(axis=0)
