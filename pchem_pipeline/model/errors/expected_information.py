"""Expected Fisher information of one or several samples: what frames can tell, before they are taken.

In electrons the PCD depends on H and on the read noise ``s_e = g sigma`` alone, and so does the information
of one frame in the coordinates ``(H, ln g, g mu, ln sigma)``. It is the mean of the outer product of the
score, and by Fisher's identity the score of a mixture is the posterior mean of the score of the complete data
(Louis 1982), which for electron number k and deviation ``e = x - mu - k/g`` has the elements ``k/H - 1``,
``-k e g / s_e^2``, ``e g / s_e^2`` and ``(e g / s_e)^2 - 1``. Where a DN is not small against the read noise,
a sample is the cell of width 1 around a whole DN, of the probability ``sum_k P(k; H) (Phi(u_+) - Phi(u_-))``
with the analog read noise, and so is its score.

Samples of one pixel that differ in exposure share g, mu and sigma; each has an H of its own that must be
estimated too (Hendrickson et al. 2024, arXiv 2403.04498). What a sample tells about the shared ones is the
Schur complement of its H.

The density at whole DN stands for the mass of a cell; that biases the estimates once a peak is narrower than
about a DN and a half. :func:`rounding_bias` says by how much; ``fit.likelihood: exact`` or ``auto`` takes
the masses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.law.mass import parts_of_similar_width, sample_mass, sample_slopes
from pchem_pipeline.model.law.parameters import Parameters, columns_of
from pchem_pipeline.model.law.pcd import pcd_posterior
from pchem_pipeline.model.law.sample_law import SampleLaw

_NODES_PER_SIGMA = 3.0  # halving the step changes no digit that matters; see the tests
_REACH = 10.0  # read noises beyond which nothing is left
_COARSE = 1.5  # DN: cells and density differ by exp(-2 pi^2 sigma^2)
_LEAST_EXPOSURE = 1e-12  # below it a sample holds no electrons
#: Pairs of parameters, in the order of the axis ``parameter_pair``; numbers as in ``variables.PARAMETERS``.
CORRELATION_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
#: Standard errors by which rounding may bias the density's estimates before it is said (or mended).
LARGEST_BIAS = 0.05

# Peaks so wide are safe: the bias falls as sqrt(N) / sigma^4 (rounding differs from a normal law of variance
# 1/12 in the fourth cumulant), and is below 0.03 standard errors here.
_SAFE = 20.0


def expected_information(
    quanta_exposure: float, read_noise_e: float, conversion_gain: float = 0.0
) -> FloatArray:
    """Return the expected Fisher information of one frame in ``(H, ln g, g mu, ln sigma)``, shape (4, 4).

    Args:
        quanta_exposure: H > 0, e-.
        read_noise_e: s_e > 0, quantisation included, e-.
        conversion_gain: g, e-/DN, of samples in whole DN, whose bias may be anywhere between two: the inverse
            is the mean covariance; 0: as fine as can be.

    Raises:
        ValueError: an argument is not a positive number.
    """
    if not (np.isfinite([quanta_exposure, read_noise_e]).all() and min(quanta_exposure, read_noise_e) > 0):
        raise ValueError("quanta exposure and read noise must be positive")
    if read_noise_e < _COARSE * conversion_gain:
        bounds = inverse_information(_of_cells(quanta_exposure, read_noise_e, conversion_gain))
        known = np.isfinite(bounds[:, 0, 0])
        return inverse_information(bounds[known].mean(axis=0)) if known.any() else np.full((4, 4), np.nan)
    step, (low, high) = read_noise_e / _NODES_PER_SIGMA, _range(quanta_exposure, read_noise_e)
    given = pcd_posterior(np.arange(low, high, step), quanta_exposure, 1.0, 0.0, read_noise_e)
    variance = read_noise_e**2
    score = (
        given.k / quanta_exposure - 1.0,
        -given.ke / variance,
        given.e / variance,
        given.ee / variance - 1.0,
    )
    return np.asarray((score * (step * np.exp(given.log_density))) @ np.transpose(score))


def _range(quanta_exposure: float, noise_e: float) -> tuple[float, float]:
    """Return the smallest and the largest charge that samples show, e-."""
    width, reach = 12.0 * np.sqrt(quanta_exposure) + 12.0, _REACH * noise_e
    return max(0.0, np.floor(quanta_exposure - width)) - reach, quanta_exposure + width + reach


def _of_cells(quanta_exposure: float, read_noise_e: float, gain: float) -> FloatArray:
    """Return the information of one rounded frame for 8 places of the bias between two DN, (8, 4, 4)."""
    variance = (read_noise_e / gain) ** 2
    analog = max(variance - QUANTISATION_VARIANCE, 1e-6 * variance)
    low, high = _range(quanta_exposure, read_noise_e)
    bias, n_codes = np.arange(8) / 8, int((high - low) / gain) + 3
    exposure, sigma = max(quanta_exposure, _LEAST_EXPOSURE), np.sqrt(analog + QUANTISATION_VARIANCE)
    maps = [np.broadcast_to(each, bias.shape) for each in (exposure, gain, bias, sigma)]
    first = np.full(bias.size, np.floor(low / gain) - 1, np.int64)
    mass, slopes = sample_slopes(SampleLaw(), maps, first, n_codes)
    # from (log H, 1/g, mu, log sigma_R^2)
    slopes *= np.array([1.0 / exposure, -1.0 / gain, 1.0 / gain, 2.0 * variance / analog])[:, None]
    seen = mass > 1e-14 * mass.max(axis=1, keepdims=True)
    weight = np.where(seen, 1.0 / np.maximum(mass, 1e-300), 0.0)
    return np.asarray(np.einsum("nic,njc,nc->nij", slopes, slopes, weight))


def shared_information(
    quanta_exposure: float, read_noise_e: float, conversion_gain: float = 0.0
) -> FloatArray:
    """Return what one frame of a sample, its exposure unknown, tells of the other coordinates.

    A sample without electrons (bias frames, H = 0 is known) is one Gaussian: it tells bias and read noise,
    not the gain. Arguments as of :func:`expected_information`; the matrix is of shape (3, 3).

    Raises:
        ValueError: H is negative or the read noise not positive.
    """
    if 0 <= quanta_exposure < _LEAST_EXPOSURE and read_noise_e > 0:
        if read_noise_e < _COARSE * conversion_gain:
            return np.asarray(_of_cells(0.0, read_noise_e, conversion_gain).mean(axis=0)[1:, 1:])
        return np.diag([0.0, 1.0 / read_noise_e**2, 2.0])
    full = expected_information(quanta_exposure, read_noise_e, conversion_gain)
    return np.asarray(full[1:, 1:] - np.outer(full[0, 1:], full[0, 1:]) / full[0, 0])


def expected_scores(parameters: Parameters) -> tuple[FloatArray, FloatArray]:
    """Return mean and mean outer product of the density's score, the samples being rounded to whole DN.

    The latter is the expected information of one frame; the former is 0 but for what rounding does. In (H, g,
    mu, sigma) of n pixels, shape (n, 4) and (n, 4, 4); NaN without usable parameters.
    """
    columns = columns_of(parameters)
    n = columns.shape[0]
    mean, information = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    for some, first, n_codes in parts_of_similar_width(SampleLaw(), list(columns.T)):
        codes = first[:, None] + np.arange(n_codes)
        own = columns[some]
        exposure, gain, bias, sigma = (own[:, [i]] for i in range(4))
        mass = sample_mass(SampleLaw(), list(own.T), codes, smallest=1e-50)
        given, precision = pcd_posterior(codes, exposure, gain, bias, sigma), sigma**-2.0
        score = np.stack(
            [
                given.k / np.maximum(exposure, SMALLEST_MASS) - 1.0,
                -given.ke * precision / gain**2,
                given.e * precision,
                (given.ee * precision - 1.0) / sigma,
            ],
            axis=1,
        )
        weighted = score * mass[:, None]
        mean[some], information[some] = weighted.sum(axis=2), weighted @ score.swapaxes(1, 2)
    return mean, information


def correlations(covariance: FloatArray) -> FloatArray:
    """Return the correlations of :data:`CORRELATION_PAIRS`, (..., 6), from a covariance, (..., 4, 4).

    NaN where a parameter has no standard error.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    i, j = np.transpose(CORRELATION_PAIRS)
    return np.ascontiguousarray(covariance[..., i, j] / np.sqrt(variances[..., i] * variances[..., j]))


def covariance_from(stderr: FloatArray, correlation: FloatArray) -> FloatArray:
    """Return the covariance, (..., 4, 4), from standard errors, (..., 4), and correlations, (..., 6)."""
    covariance = stderr[..., :, None] * stderr[..., None, :]
    i, j = np.transpose(CORRELATION_PAIRS)
    covariance[..., i, j] *= correlation
    covariance[..., j, i] *= correlation
    return covariance


def inverse_information(information: ArrayLike) -> FloatArray:
    """Return the smallest covariance, the inverse of information, (..., n, n); NaN where it is singular."""
    matrix = np.asarray(information, np.float64)
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    known = np.asarray(np.isfinite(matrix).all(axis=(-2, -1)) & (diagonal > 0).all(axis=-1))
    root = np.sqrt(np.where(known[..., None], diagonal, 1.0))
    scale = root[..., :, None] * root[..., None, :]
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], matrix / scale, np.eye(root.shape[-1])))
    known &= values[..., 0] > 1e-12 * values[..., -1]
    values = np.where(known[..., None], values, 1.0)
    inverse = (vectors / values[..., None, :]) @ vectors.swapaxes(-2, -1) / scale
    return np.where(known[..., None, None], inverse, np.nan)


def rounding_bias(parameters: Sequence[FloatArray], n_frames: NDArray[np.generic]) -> FloatArray:
    """Return the bias that rounding to whole DN gives to estimates from the density, in standard errors.

    To first order, ``I^-1 E[s]``: the mean score of the density under the exact masses, through the inverse
    of its information. Of (H, g, mu, sigma) of n pixels, shape (n, 4); infinite where there is no answer.
    """
    columns, frames = columns_of(parameters), np.asarray(n_frames, np.float64)
    out = np.full(columns.shape, np.inf)
    usable = (columns[:, 0] > 0.0) & (columns[:, 3] ** 2 > QUANTISATION_VARIANCE)
    score, information = expected_scores(list(columns[usable].T))
    bound = inverse_information(information)
    errors = np.sqrt(np.diagonal(bound, axis1=1, axis2=2) / frames[usable, None])
    out[usable] = np.nan_to_num(np.einsum("nij,nj->ni", bound, score) / errors, nan=np.inf)
    return out


def rounding_may_matter(variance: FloatArray, n_frames: NDArray[np.generic]) -> BoolArray:
    """Return where peaks, or whole histograms, of these variances (DN^2) are not wide enough."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.sqrt(np.asarray(n_frames, np.float64)) > _SAFE * variance**2)


def biased_by_rounding(parameters: Sequence[FloatArray], n_frames: NDArray[np.generic]) -> BoolArray:
    """Return in which pixels rounding biases the density's estimates by more than :data:`LARGEST_BIAS`.

    Arguments as of :func:`rounding_bias`, shape (n,); a pixel without parameters is not biased.
    """
    sigma, frames = np.asarray(parameters[3], np.float64), np.asarray(n_frames, np.float64)
    suspects = np.flatnonzero(np.isfinite(sigma) & rounding_may_matter(sigma**2, frames))
    biased = np.zeros(sigma.shape, np.bool_)
    found = rounding_bias([np.asarray(each)[suspects] for each in parameters], frames[suspects])
    biased[suspects] = ~(np.abs(found).max(axis=1, initial=0.0) < LARGEST_BIAS)
    return biased
