"""Fisher information of the PCD: what N frames can tell, and how errors propagate."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.law.likelihood import density_likelihood
from pchem_pipeline.model.law.pcd import pcd

#: Pairs of parameters, in the order of the axis ``parameter_pair``; numbers as in ``variables.PARAMETERS``.
CORRELATION_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

_NODES_PER_SIGMA = 4.0  # the sum over nodes is then exact to rounding: the density is smooth


def cramer_rao(
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    read_noise_dn: ArrayLike,
    n_frames: ArrayLike,
) -> NDArray[np.float64]:
    """Return the Cramer-Rao bound: the smallest covariance of unbiased estimates of (H, g, mu, sigma).

    The expected information is the observed information (Louis 1982) of the histogram that the model itself
    expects, summed over a fine grid of values. The bias does not matter.

    Args:
        quanta_exposure: H > 0, e-.
        conversion_gain: g, e-/DN.
        read_noise_dn: sigma, DN.
        n_frames: N.

    Returns:
        Covariance, shape (..., 4, 4) of the broadcast shape; NaN where the information is singular.
    """
    arrays = np.broadcast_arrays(
        *[np.asarray(a, np.float64) for a in (quanta_exposure, conversion_gain, read_noise_dn, n_frames)]
    )
    flat = [a.ravel() for a in arrays]
    out = np.stack([_bound(*map(float, point)) for point in zip(*flat, strict=True)])
    return out.reshape(*arrays[0].shape, 4, 4)


def _bound(exposure: float, gain: float, sigma: float, n_frames: float) -> NDArray[np.float64]:
    """Return the bound at one point; values are counted in sigma / 4, so that any gain is resolved."""
    unit = sigma / _NODES_PER_SIGMA
    scaled_gain = gain * unit
    electrons = exposure + 12.0 * np.sqrt(exposure) + 12.0
    first = -int(10 * _NODES_PER_SIGMA)
    nodes = np.arange(first, int(electrons / scaled_gain) - first)
    weights = n_frames * pcd(nodes, exposure, scaled_gain, 0.0, _NODES_PER_SIGMA)
    covariance = observed_covariance(weights, first, (exposure, scaled_gain, 0.0, _NODES_PER_SIGMA))
    scale = np.array([1.0, 1.0 / unit, unit, unit])
    return covariance * np.outer(scale, scale)


def joint_cramer_rao(
    quanta_exposure: ArrayLike, conversion_gain: float, read_noise_dn: float, n_frames: ArrayLike
) -> NDArray[np.float64]:
    """Return the smallest covariance of unbiased estimates of (H_1 ... H_J, g, mu, sigma) from J samples.

    The information of independent samples adds up; that of each is the inverse of
    :func:`cramer_rao`.

    Args:
        quanta_exposure: H_j, e-, shape (J,); 0: a sample without electrons, H not estimated.
        conversion_gain: g, e-/DN.
        read_noise_dn: sigma, DN.
        n_frames: N_j, shape (J,) or one for all.

    Returns:
        Covariance, shape (J + 3, J + 3); zeros in the rows and columns of samples without electrons.
    """
    exposures = np.asarray(quanta_exposure, np.float64)
    frames = np.broadcast_to(np.asarray(n_frames, np.float64), exposures.shape)
    size = exposures.size + 3
    information = np.zeros((size, size))
    for j, (exposure, n) in enumerate(zip(exposures, frames, strict=True)):
        if exposure > 0:
            place = [j, *range(size - 3, size)]
            own = cramer_rao(exposure, conversion_gain, read_noise_dn, 1.0)
            information[np.ix_(place, place)] += n * np.linalg.inv(own)
        else:
            information[size - 2, size - 2] += n / read_noise_dn**2
            information[size - 1, size - 1] += 2.0 * n / read_noise_dn**2
    free = [*np.flatnonzero(exposures > 0), *range(size - 3, size)]
    bound = np.zeros((size, size))
    bound[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    return bound


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


def propagate(covariance: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard error of a function of (H, g, mu, sigma) by the delta method.

    Args:
        covariance: shape (..., 4, 4).
        gradient: of the function, shape (..., 4).

    Returns:
        ``sqrt(gradient' covariance gradient)``, shape (...).
    """
    return np.asarray(np.sqrt(np.einsum("...i,...ij,...j->...", gradient, covariance, gradient)))


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
