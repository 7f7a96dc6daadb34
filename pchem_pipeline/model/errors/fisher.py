"""Observed information of a histogram under the PCD, and covariances as correlations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.law.likelihood import density_likelihood

#: Pairs of parameters, in the order of the axis ``parameter_pair``; numbers as in ``variables.PARAMETERS``.
CORRELATION_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def observed_covariance(counts: ArrayLike, origin: int, parameters: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse of Louis' observed information of one histogram at a maximum of the likelihood.

    Args:
        counts: histogram, shape (B,); need not be whole.
        origin: DN of bin 0.
        parameters: (H, g, mu, sigma).

    Returns:
        Covariance of (H, g, mu, sigma), shape (4, 4); NaN where the information is not positive definite.
    """
    weights = np.asarray(counts, np.float64)
    covariance = np.full((4, 4), np.nan)
    values = np.asarray(parameters, np.float64)
    information_numba.observed_covariance(weights, int(origin), values, density_likelihood(), covariance)
    return covariance


def correlations(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the six correlations of (H, g, mu, sigma), see :data:`CORRELATION_PAIRS`.

    With the four standard errors they are the covariance, each number once.

    Args:
        covariance: shape (..., 4, 4).

    Returns:
        Correlations, shape (..., 6); NaN where a parameter has no standard error.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    pairs = [
        covariance[..., i, j] / np.sqrt(variances[..., i] * variances[..., j]) for i, j in CORRELATION_PAIRS
    ]
    return np.stack(pairs, axis=-1)


def covariance_from(stderr: NDArray[np.float64], correlation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put the covariance of (H, g, mu, sigma) together again; the opposite of :func:`correlations`.

    Args:
        stderr: standard errors, shape (..., 4).
        correlation: shape (..., 6).

    Returns:
        Covariance, shape (..., 4, 4).
    """
    covariance = stderr[..., :, None] * stderr[..., None, :]
    for place, (i, j) in enumerate(CORRELATION_PAIRS):
        covariance[..., i, j] *= correlation[..., place]
        covariance[..., j, i] *= correlation[..., place]
    return covariance
