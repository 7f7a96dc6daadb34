"""The ensemble predicted with an extended law: the mean of the pixels' exact masses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.ensemble import extended_ensemble_numba
from pchem_pipeline.model.ensemble.ensemble import DnAxis, EnsembleSums, NucedAxis
from pchem_pipeline.model.law.inputs import satellites_of
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.parameters import FloatArray, UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

__all__ = ["ExtendedSums", "extended_sums"]

_CHUNK = 4_000_000  # masses held at a time


@dataclass(frozen=True)
class ExtendedSums:
    """Sums over pixels under an extended law.

    Attributes:
        sums: masses and their squares on both axes, as without effects.
        nuced_sum: sum over pixels of the mean of the NUCed value, e-.
        nuced_sum_square: sum of the mean of its square, e-^2.
    """

    sums: EnsembleSums
    nuced_sum: float
    nuced_sum_square: float


def extended_sums(
    pixels: UsablePixels,
    satellites: tuple[ArrayLike, ArrayLike] | None,
    model: SampleLaw,
    dn: DnAxis,
    nuced: NucedAxis,
) -> ExtendedSums:
    """Sum the pixels' masses at the integer DN, and the same masses sorted into NUCed bins.

    The mean over the pixels replaces that of their PCDs (Hendrickson et al. 2023, eq. full_ensemble_dist).

    Args:
        pixels: the n pixels.
        satellites: amplitude (e-) and weight of the free satellites of each, shape (n,); None: none.
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
    columns = pixels.maps
    own = satellites_of(pixels, satellites, n)
    step = max(1, _CHUNK // dn.size)
    for first in range(0, n, step):
        part = np.arange(first, min(first + step, n))
        amplitude, weight = own[part].T
        mass = sample_mass(model.of(part), [c[part] for c in columns], dn.dn, satellites=(amplitude, weight))
        _add(mass, raw, raw_square)
        extended_ensemble_numba.sort_masses(
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
    return ExtendedSums(EnsembleSums(n, raw, raw_square, bins, bins_square), *map(float, moments))


def _add(mass: NDArray[np.float64], raw: FloatArray, raw_square: FloatArray) -> None:
    raw += mass.sum(axis=0)
    raw_square += (mass * mass).sum(axis=0)
