"""Fisher information of the PCD: what N frames can tell, and how errors propagate."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.errors import fisher_numba, information_numba
from pchem_pipeline.model.fit.start import kernel_counts
from pchem_pipeline.model.law import estep_numba, workspace_numba
from pchem_pipeline.model.law.pcd import pcd

__all__ = [
    "CORRELATION_PAIRS",
    "correlations",
    "covariance_from",
    "cramer_rao",
    "observed_covariance",
    "propagate",
    "sandwich_covariance",
]

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
    room = np.empty(weights.size), np.empty(weights.size + 1)
    histogram, centre, _ = workspace_numba.load(weights, *room)
    exposure, gain, bias, sigma = (float(value) for value in np.asarray(parameters, np.float64))
    middle = float(origin + centre)
    theta = np.array([np.log(exposure), 1.0 / gain, bias - middle, 2.0 * np.log(sigma)])
    space = workspace_numba.make_workspace(workspace_numba.make_rows(weights.size))
    estep_numba.evaluate(histogram, theta, space, 0.0)
    covariance = np.empty((4, 4))
    fisher_numba.to_natural(theta, middle, space.information, np.zeros(4, np.bool_), np.empty(4), covariance)
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


def sandwich_covariance(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    tail_guard: float = 0.0,
) -> NDArray[np.float64]:
    """Return the covariance of the estimates that holds even where the model does not (White 1982).

    ``C (sum_i c_i s_i s_i') C`` with the inverse information C and the score s of each sample: it describes
    how estimates scatter from one set of frames to the next whatever the samples' law is, about the
    parameters of the nearest PCD. Where the model holds it agrees with C.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma) at the maximum, shape (n, 4); NaN where there is none.
        covariance: inverse of the observed information, shape (n, 4, 4); NaN where a bound holds a parameter.
        tail_guard: of the fit; samples that it left out do not count.

    Returns:
        Covariance of (H, g, mu, sigma), shape (n, 4, 4), NaN where ``covariance`` is.
    """
    middle = np.empty((counts.shape[0], 4, 4))
    information_numba.outer_scores(
        kernel_counts(counts),
        np.ascontiguousarray(origin, np.int64),
        np.ascontiguousarray(parameters, np.float64),
        tail_guard,
        middle,
    )
    bread = np.where(np.isfinite(covariance), covariance, 0.0)
    with np.errstate(invalid="ignore"):
        found = bread @ middle @ bread
    return np.where(np.isfinite(covariance), found, np.nan)


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
