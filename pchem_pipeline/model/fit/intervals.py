"""Confidence intervals: from the profile likelihood, or as so many standard errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pchem_pipeline.model.fit import profile_numba
from pchem_pipeline.model.fit.start import kernel_counts

__all__ = ["INTERVAL_NAMES", "profile_intervals", "quantile_of"]

#: What has an interval, in the order of the axis ``quantity``.
INTERVAL_NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")


def quantile_of(level: float) -> float:
    """Return z such that a standard normal lies within -+ z with probability ``level``.

    Example:
        >>> round(quantile_of(0.95), 3)
        1.96
    """
    return float(ndtri(0.5 * (1.0 + level)))


def profile_intervals(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    parameters: NDArray[np.float64],
    level: float = 0.6827,
) -> NDArray[np.float64]:
    """Return intervals at whose ends the profile likelihood has fallen by ``z^2 / 2`` nats.

    All other parameters are at their best for each value of the one (Venzon and Moolgavkar 1988). Unlike
    ``estimate -+ z stderr`` the ends need not be symmetric, and they follow a change of parameter: the
    interval of ``sigma_e- = g sigma`` is that of its logarithm.

    Args:
        counts: histograms, shape (n, B), without outliers
            (:func:`~pchem_pipeline.model.fit.outliers.without_outliers`).
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma) at the maximum, shape (n, 4); NaN where there is none.
        level: probability that an interval covers the truth.

    Returns:
        Lower and upper ends by pixel and quantity (:data:`INTERVAL_NAMES`), in the units of the quantities,
        shape (n, 5, 2); NaN where the likelihood does not fall far enough on that side.
    """
    ends = np.full((counts.shape[0], profile_numba.N_TARGETS, 2), np.nan)
    profile_numba.profile_tile(
        kernel_counts(counts),
        np.ascontiguousarray(origin, np.int64),
        np.ascontiguousarray(parameters, np.float64),
        quantile_of(level),
        ends,
    )
    found = np.empty_like(ends)
    found[:, 0] = np.exp(ends[:, 0])
    found[:, 1] = 1.0 / ends[:, 1, ::-1]  # a larger step is a smaller gain
    found[:, 2] = ends[:, 2]
    found[:, 3:] = np.exp(0.5 * ends[:, 3:])
    return found
