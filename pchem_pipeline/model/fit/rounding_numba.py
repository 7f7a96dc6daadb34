"""What rounding to whole DN does to estimates from the density of the PCD."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.fisher_numba import back_substitute, cholesky, invert
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.pcd_numba import masses
from pchem_pipeline.model.law.workspace_numba import Histogram, make_rows, make_workspace

_ROUNDING = 1.0 / 12.0
_REACH = 8.0  # standard deviations


@kernel
def rounding_bias(
    exposure: float, a: float, bias: float, sigma: float, n: float, shift: NDArray[np.float64]
) -> bool:
    """Fill the bias of (log H, 1/g, mu, log sigma^2) in standard errors.

    To first order it is ``I^-1 s``, with score s and information I of the density at the truth, on the counts
    that the exact masses expect.

    Args:
        exposure: H, e-.
        a: 1/g, DN.
        bias: mu, DN; only its fraction matters.
        sigma: DN, quantisation included.
        n: frames.
        shift: out, shape (4,).

    Returns:
        Whether there is an answer: not where sigma is rounding alone.
    """
    analog2 = sigma * sigma - _ROUNDING
    if not (analog2 > 0.0 and exposure > 0.0 and math.isfinite(a + bias + n)):
        return False
    first = math.floor(-_REACH * sigma) - 1
    n_bins = int((exposure + _REACH * math.sqrt(exposure) + 8.0) * a + _REACH * sigma) + 2 - first
    offset = bias - math.floor(bias)
    places, weights = np.empty(n_bins), np.empty(n_bins)
    for i in range(n_bins):
        places[i] = float(first + i)
    same = np.ones(n_bins)
    masses(places, exposure * same, same / a, offset * same, math.sqrt(analog2) / a * same, weights)
    cumulative = np.empty(n_bins + 1)
    cumulative[0] = 0.0
    for i in range(n_bins):
        weights[i] *= n
        cumulative[i + 1] = cumulative[i] + weights[i]
    total = cumulative[n_bins]
    mean = variance = 0.0
    for i in range(n_bins):
        mean += weights[i] * places[i] / total
    for i in range(n_bins):
        variance += weights[i] * (places[i] - mean) ** 2 / total
    histogram = Histogram(weights, cumulative, n_bins, float(first), total, mean, variance)
    space = make_workspace(make_rows(n_bins))
    theta = np.array([math.log(exposure), a, offset, 2.0 * math.log(sigma)])
    evaluate(histogram, theta, space, 0.0)
    held = np.zeros(4, np.bool_)
    lower, covariance = np.zeros((4, 4)), np.empty((4, 4))
    if not cholesky(space.information, held, lower):
        return False
    for i in range(4):
        shift[i] = space.score[i]
    back_substitute(lower, shift)
    invert(space.information, held, covariance)
    for i in range(4):
        shift[i] /= math.sqrt(covariance[i, i])
    return True


@kernel
def rounding_tile(parameters: NDArray[np.float64], n: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Fill the bias of every pixel with finite parameters.

    Args:
        parameters: (H, g, mu, sigma), shape (n, 4).
        n: frames, shape (n,).
        out: out, shape (n, 4); comes as infinity, which stays where there is no answer.
    """
    shift = np.empty(4)
    for pixel in range(parameters.shape[0]):
        exposure, gain, bias, sigma = parameters[pixel]
        if rounding_bias(exposure, 1.0 / gain, bias, sigma, n[pixel], shift):
            for i in range(4):
                out[pixel, i] = shift[i]
