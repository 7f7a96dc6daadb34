"""Expected Fisher information of one or several samples: what frames can tell, before they are taken.

In electrons the PCD depends on H and on the read noise ``s_e = g sigma`` alone, and so does the information
of one frame in the coordinates ``(H, ln g, g mu, ln sigma)`` (:data:`COORDINATES`). It is the mean of the
outer product of the score, and by Fisher's identity the score of a mixture is the posterior mean of the score
of the complete data (Louis 1982), which for electron number k and deviation ``e = x - mu - k/g`` has the
elements ``k/H - 1``, ``-k e g / s_e^2``, ``e g / s_e^2`` and ``(e g / s_e)^2 - 1``. Where a DN is not small
against the read noise, a sample is the cell of width 1 around a whole DN, of the probability
``sum_k P(k; H) (Phi(u_+) - Phi(u_-))`` with the analog read noise, and so is its score.

Samples of one pixel that differ in exposure share g, mu and sigma; each has an H of its own that must be
estimated too (Hendrickson et al. 2024, arXiv 2403.04498). What a sample tells about the shared ones is the
Schur complement of its H.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, ndtr

from pchem_pipeline.base.units import QUANTISATION_VARIANCE

#: The coordinates in which the information depends on H and the read noise in electrons only.
COORDINATES = ("quanta_exposure", "log_gain", "bias_e", "log_read_noise_dn")

_NODES_PER_SIGMA = 3.0  # halving the step changes no digit that matters; see the tests
_REACH = 10.0  # read noises beyond which nothing is left
_COARSE = 1.5  # DN: cells and density differ by exp(-2 pi^2 sigma^2)
_LEAST_EXPOSURE = 1e-12  # below it a sample holds no electrons


def expected_information(
    quanta_exposure: float, read_noise_e: float, conversion_gain: float = 0.0
) -> NDArray[np.float64]:
    """Return the expected Fisher information of one frame in :data:`COORDINATES`.

    Args:
        quanta_exposure: H > 0, e-.
        read_noise_e: s_e > 0, quantisation included, e-.
        conversion_gain: g, e-/DN, of samples in whole DN, whose bias may be anywhere between two: the inverse
            is the mean covariance; 0: as fine as can be.

    Returns:
        Symmetric matrix, shape (4, 4); units 1/e-^2, 1/e- and 1 after those of the coordinates.

    Raises:
        ValueError: an argument is not a positive number.
    """
    if not (np.isfinite([quanta_exposure, read_noise_e]).all() and min(quanta_exposure, read_noise_e) > 0):
        raise ValueError("quanta exposure and read noise must be positive")
    width = 12.0 * np.sqrt(quanta_exposure) + 12.0
    least = max(0, int(quanta_exposure - width))
    k = np.arange(least, int(quanta_exposure + width) + 1, dtype=np.float64)
    log_mass = k * np.log(quanta_exposure) - quanta_exposure - gammaln(k + 1)
    if read_noise_e < _COARSE * conversion_gain:
        parts = _of_cells(k, np.exp(log_mass), k / quanta_exposure - 1.0, read_noise_e, conversion_gain)
        bounds = np.stack([inverse_information(part) for part in parts])
        known = np.isfinite(bounds[:, 0, 0])
        return inverse_information(bounds[known].mean(axis=0)) if known.any() else np.full((4, 4), np.nan)
    step = read_noise_e / _NODES_PER_SIGMA
    nodes = np.arange(k[0] - _REACH * read_noise_e, k[-1] + _REACH * read_noise_e, step)
    residual = nodes[:, None] - k
    with np.errstate(under="ignore"):
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


def _of_cells(
    k: NDArray[np.float64],
    mass: NDArray[np.float64],
    score: NDArray[np.float64],
    read_noise_e: float,
    gain: float,
) -> list[NDArray[np.float64]]:
    """Return the information of one rounded frame for each of some places of the bias between two DN.

    Args:
        k: electron numbers.
        mass: their probabilities.
        score: of H, at each.
        read_noise_e: s_e, quantisation included, e-.
        gain: g, e-/DN.
    """
    square = (read_noise_e / gain) ** 2
    analog = np.sqrt(max(square - QUANTISATION_VARIANCE, 1e-6 * square))
    codes = np.arange(np.floor(k[0] / gain - _REACH * analog) - 1, k[-1] / gain + _REACH * analog + 2)
    found = []
    for offset in np.arange(8) / 8:
        edges = (codes[:, None] + np.array([0.5, -0.5])[:, None, None] - offset - k / gain) / analog
        share = ndtr(edges[0]) - ndtr(edges[1])
        normal = np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi)
        moved, widened = normal[0] - normal[1], edges[0] * normal[0] - edges[1] * normal[1]
        slopes = np.stack(
            [
                share @ (mass * score),
                moved @ (mass * k) / (gain * analog),
                -moved @ mass / (gain * analog),
                -widened @ mass * square / analog**2,
            ]
        )
        whole = share @ mass
        seen = whole > 1e-14 * whole.max()
        found.append((slopes[:, seen] / whole[seen]) @ slopes[:, seen].T)
    return found


def shared_information(
    quanta_exposure: float, read_noise_e: float, conversion_gain: float = 0.0
) -> NDArray[np.float64]:
    """Return what one frame of a sample, its exposure unknown, tells of the other :data:`COORDINATES`.

    A sample without electrons (H = 0, bias frames) is one Gaussian: it tells bias and read noise, not the
    gain.

    Args:
        quanta_exposure: H >= 0, e-; 0 for bias frames, of which H is known.
        read_noise_e: s_e, e-.
        conversion_gain: as of :func:`expected_information`.

    Returns:
        Matrix, shape (3, 3).

    Raises:
        ValueError: H is negative or the read noise not positive.
    """
    if 0 <= quanta_exposure < _LEAST_EXPOSURE and read_noise_e > 0:
        if read_noise_e < _COARSE * conversion_gain:
            zero, one = np.zeros(1), np.ones(1)
            parts = _of_cells(zero, one, zero, read_noise_e, conversion_gain)
            return np.asarray(np.mean(parts, axis=0)[1:, 1:])
        return np.diag([0.0, 1.0 / read_noise_e**2, 2.0])
    full = expected_information(quanta_exposure, read_noise_e, conversion_gain)
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
