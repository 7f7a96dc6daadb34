"""Expected Fisher information of one or several samples: what frames can tell, before they are taken.

In electrons the PCD depends on H and on the read noise ``s_e = g sigma`` alone, and so does the information
of one frame in the coordinates ``(H, ln g, g mu, ln sigma)`` (:data:`COORDINATES`). It is the mean of the
outer product of the score, and by Fisher's identity the score of a mixture is the posterior mean of the score
of the complete data (Louis 1982), which for electron number k and deviation ``e = x - mu - k/g`` has the
elements ``k/H - 1``, ``-k e g / s_e^2``, ``e g / s_e^2`` and ``(e g / s_e)^2 - 1``.

Samples of one pixel that differ in exposure share g, mu and sigma; each has an H of its own that must be
estimated too (Hendrickson et al. 2024, arXiv 2403.04498). What a sample tells about the shared ones is the
Schur complement of its H.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

#: The coordinates in which the information depends on H and the read noise in electrons only.
COORDINATES = ("quanta_exposure", "log_gain", "bias_e", "log_read_noise_dn")

_NODES_PER_SIGMA = 3.0  # halving the step changes no digit that matters; see the tests
_REACH = 10.0  # read noises beyond which nothing is left
_LEAST_EXPOSURE = 1e-12  # below it a sample holds no electrons


def expected_information(quanta_exposure: float, read_noise_e: float) -> NDArray[np.float64]:
    """Return the expected Fisher information of one frame in :data:`COORDINATES`.

    Args:
        quanta_exposure: H > 0, e-.
        read_noise_e: s_e > 0, quantisation included, e-.

    Returns:
        Symmetric matrix, shape (4, 4); units 1/e-^2, 1/e- and 1 after those of the coordinates.

    Raises:
        ValueError: an argument is not a positive number.
    """
    if not (np.isfinite([quanta_exposure, read_noise_e]).all() and min(quanta_exposure, read_noise_e) > 0):
        raise ValueError("quanta exposure and read noise are positive numbers")
    width = 12.0 * np.sqrt(quanta_exposure) + 12.0
    least = max(0, int(quanta_exposure - width))
    k = np.arange(least, int(quanta_exposure + width) + 1, dtype=np.float64)
    step = read_noise_e / _NODES_PER_SIGMA
    nodes = np.arange(k[0] - _REACH * read_noise_e, k[-1] + _REACH * read_noise_e, step)
    residual = nodes[:, None] - k
    with np.errstate(under="ignore"):
        log_mass = k * np.log(quanta_exposure) - quanta_exposure - gammaln(k + 1)
        joint = log_mass - 0.5 * (residual / read_noise_e) ** 2
        top = joint.max(axis=1)
        posterior = np.exp(joint - top[:, None])
        total = posterior.sum(axis=1)
        weight = np.exp(top) * total * (step / (np.sqrt(2 * np.pi) * read_noise_e))
        posterior /= total[:, None]
        scaled = residual / read_noise_e**2
        score = np.stack(
            [
                posterior @ k / quanta_exposure - 1.0,
                -np.einsum("ij,ij,j->i", posterior, scaled, k),
                np.einsum("ij,ij->i", posterior, scaled),
                np.einsum("ij,ij,ij->i", posterior, scaled, residual) - 1.0,
            ]
        )
        return np.asarray((score * weight) @ score.T)


def shared_information(quanta_exposure: float, read_noise_e: float) -> NDArray[np.float64]:
    """Return what one frame of a sample, its exposure unknown, tells of the other :data:`COORDINATES`.

    A sample without electrons (H = 0, bias frames) is one Gaussian: it tells bias and read noise, not the
    gain.

    Args:
        quanta_exposure: H >= 0, e-; 0 for bias frames, of which H is known.
        read_noise_e: s_e, e-.

    Returns:
        Matrix, shape (3, 3).

    Raises:
        ValueError: H is negative or the read noise not positive.
    """
    if 0 <= quanta_exposure < _LEAST_EXPOSURE and read_noise_e > 0:
        return np.diag([0.0, 1.0 / read_noise_e**2, 2.0])
    full = expected_information(quanta_exposure, read_noise_e)
    return np.asarray(full[1:, 1:] - np.outer(full[0, 1:], full[0, 1:]) / full[0, 0])


def inverse_information(information: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest covariance, the inverse of an information matrix; NaN where it is singular.

    Args:
        information: shape (n, n), of one frame or of a sum over frames.
    """
    matrix = np.asarray(information, np.float64)
    scale = np.sqrt(np.diagonal(matrix))
    if not (scale > 0).all():
        return np.full(matrix.shape, np.nan)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    if values[0] <= 1e-12 * values[-1]:
        return np.full(matrix.shape, np.nan)
    return np.asarray((vectors / values) @ vectors.T / np.outer(scale, scale))
