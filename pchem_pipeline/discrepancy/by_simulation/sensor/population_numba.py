"""Loops of :mod:`.population`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.algebra_numba import back_substitute, cholesky

FloatArray = NDArray[np.float64]

_ARRIVED = 0.2  # nats, twice the rise that a further step promises: more, and a point is no maximum
_APART = 4.0  # squared standard deviations between two maxima


@kernel
def _invert(
    matrix: FloatArray, free: NDArray[np.bool_], lower: FloatArray, column: FloatArray, inverse: FloatArray
) -> float:
    """Fill the inverse of a positive definite matrix, NaN for another; return log |matrix|."""
    n, log_determinant = matrix.shape[0], 0.0
    if not cholesky(matrix, np.int64(0), n, 0.0, free, lower):
        for i in range(n):
            for j in range(n):
                inverse[i, j] = math.nan
        return math.nan
    for i in range(n):
        log_determinant += 2.0 * math.log(lower[i, i])
        for j in range(n):
            column[j] = 1.0 if i == j else 0.0
        back_substitute(lower, np.int64(0), n, column)
        for j in range(n):
            inverse[j, i] = column[j]
    return log_determinant


@kernel
def solve_parabolas(
    theta: FloatArray,
    value: FloatArray,
    score: FloatArray,
    information: FloatArray,
    centre: FloatArray,
    prior: FloatArray,
    widening: FloatArray,
    parabolic: bool,
    mean: FloatArray,
    covariance: FloatArray,
    evidence: FloatArray,
    counts: NDArray[np.bool_],
) -> None:
    """Fill posterior means, covariances and evidence of parabolas under a Gaussian population.

    Args:
        theta: maxima of the likelihood or points near them, shape (j, n, 4).
        value: log-likelihood there, shape (j, n).
        score: its slopes, shape (j, n, 4).
        information: its curvature, shape (j, n, 4, 4).
        centre: of the population, shape (4,).
        prior: its inverse scatter, shape (4, 4).
        widening: of the scatter for each pixel, shape (n,).
        parabolic: the likelihood is a parabola: one step arrives from anywhere.
        mean: out, posterior means; theta where a step does not arrive, shape (j, n, 4).
        covariance: out, shape (j, n, 4, 4).
        evidence: out, log of the posterior's integral, without the prior's factor, shape (j, n).
        counts: out, whether it is a maximum, and not one of the earlier ones; the first always, shape (j, n).
    """
    n_kinds, n, size = theta.shape
    precision, lower = np.empty((n_kinds, size, size)), np.zeros((size, size))
    off, slope, ends = np.empty(size), np.empty(size), np.empty((n_kinds, size))
    free = np.zeros(size, np.bool_)
    for pixel in range(n):
        for j in range(n_kinds):
            for a in range(size):
                for b in range(size):
                    precision[j, a, b] = information[j, pixel, a, b] + prior[a, b] / widening[pixel]
            determinant = _invert(precision[j], free, lower, slope, covariance[j, pixel])
            far = promised = 0.0
            for a in range(size):
                off[a] = theta[j, pixel, a] - centre[a]
            for a in range(size):
                pull = 0.0
                for b in range(size):
                    pull += prior[a, b] * off[b] / widening[pixel]
                far += off[a] * pull
                slope[a] = score[j, pixel, a] - pull
            for a in range(size):
                step = 0.0
                for b in range(size):
                    step += covariance[j, pixel, a, b] * slope[b]
                promised += slope[a] * step
                ends[j, a] = theta[j, pixel, a] + step
            arrived = parabolic or promised < _ARRIVED
            evidence[j, pixel] = value[j, pixel] + 0.5 * (promised - far - determinant)
            for a in range(size):
                mean[j, pixel, a] = ends[j, a] if arrived else theta[j, pixel, a]
            counts[j, pixel] = arrived or j == 0
            for i in range(j):
                apart = 0.0
                for a in range(size):
                    for b in range(size):
                        apart += (ends[j, a] - ends[i, a]) * precision[i, a, b] * (ends[j, b] - ends[i, b])
                if counts[i, pixel] and not apart > _APART:
                    counts[j, pixel] = False
