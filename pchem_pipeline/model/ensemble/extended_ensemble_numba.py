"""Compiled loop of :mod:`pchem_pipeline.model.ensemble.extended_ensemble`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.ensemble.ensemble_numba import _add_nuced


@kernel
def sort_masses(
    mass: NDArray[np.float64],
    base: float,
    gain: NDArray[np.float64],
    bias: NDArray[np.float64],
    width: float,
    nuced_start: int,
    nuced: NDArray[np.float64],
    nuced_square: NDArray[np.float64],
    moments: NDArray[np.float64],
) -> None:
    """Add each pixel's masses, and the squares of their sums, to the NUCed bins.

    Args:
        mass: of successive DN, shape (n, n_dn).
        base: first DN.
        gain: g, shape (n,).
        bias: mu, shape (n,).
        width: of a bin, e-.
        nuced_start: index of the first bin.
        nuced: out, sums of the masses, shape (n_bins,).
        nuced_square: out, sums of their squares.
        moments: out, sums over pixels of the mean of the NUCed value and of its square.
    """
    for p in range(mass.shape[0]):
        _add_nuced(mass[p], base, gain[p], bias[p], width, nuced_start, nuced, nuced_square)
        for i in range(mass.shape[1]):
            value = (base + i - bias[p]) * gain[p]
            moments[0] += mass[p, i] * value
            moments[1] += mass[p, i] * value * value
