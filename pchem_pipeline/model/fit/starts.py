"""Starting points of PCH-EM in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit import starts_numba
from pchem_pipeline.model.fit.starts_numba import regression_basis
from pchem_pipeline.model.law.inputs import kernel_counts

#: The methods, in the order of the axis ``method`` of :func:`starting_points`.
START_METHODS = ("regression", "side_lobe", "cumulants")


def starting_points(counts: NDArray[np.integer], origin: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the closed-form starting points of every pixel.

    From the empirical characteristic function ``phi(f) = mean exp(2 pi i f x)`` of a PCD, with
    ``log|phi| = -2 pi^2 f^2 sigma^2 - H (1 - cos 2 pi f / g)`` and phase ``2 pi f mu + H sin 2 pi f / g``:
    *regression* fits the former by weighted least squares for a grid of gains (good for H < 15), *side_lobe*
    takes the highest satellite beyond the central one (needs H > 0.7 and sigma g < 0.48 e-). *cumulants* sets
    ``1/g = k4/k3`` and ``H = k3 g^3`` (good for H < 1).

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).

    Returns:
        (H, g, mu, sigma) by method, shape (n, 3, 4); NaN where a method has no answer.
    """
    counts = kernel_counts(counts)
    out = np.full((counts.shape[0], len(START_METHODS), 4), np.nan)
    starts_numba.start_tile(counts, np.asarray(origin, np.int64), regression_basis(), out)
    return out
