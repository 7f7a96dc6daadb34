"""Loops of :mod:`pchem_pipeline.discrepancy.observe.tables`: efficient scores of the exact law of a pixel.

Orthogonality of the columns of :data:`.cell_scores_numba.COLUMNS` is that of Fisher's
information metric, ``sum_x f(x) h(x) p(x)``. What is left of a test function after projection on the four
directions of the parameters (and the constant) is Rao's efficient score, whose sum over the samples does not
depend on the fitted parameters to first order. To second order it does: with the parameters fitted by maximum
likelihood the sum has the expectation ``-1/2 sum_ab cov(a, b) sum_x psi(x) D_a D_b p(x)``, and the second
derivatives of p along the four directions are test functions again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.cell_scores_numba import (
    N_COLUMNS,
    N_NUISANCE,
    REACH,
    electron_range,
    fill_zeros,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_TESTS = N_COLUMNS - N_NUISANCE
_N_DIRECTIONS = N_NUISANCE - 1
_SINGULAR = 1e-9
#: Probability below which a code carries no information on the shape
NOTHING = 1e-14


@kernel
def supports(
    exposure: FloatArray,
    step: FloatArray,
    bias: FloatArray,
    width: FloatArray,
    log_negligible: float,
    electrons: IntArray,
    codes: IntArray,
) -> None:
    """Fill the ranges of electron numbers and of codes (n, 2) that the law of each pixel covers."""
    for p in range(exposure.size):
        first, last = electron_range(exposure[p], log_negligible)
        electrons[p, 0], electrons[p, 1] = first, last
        codes[p, 0] = math.floor(bias[p] + first * step[p] - REACH * width[p])
        codes[p, 1] = math.ceil(bias[p] + last * step[p] + REACH * width[p])


@kernel
def within(law: FloatArray, n: float, allowed: float) -> tuple[int, int, float, float]:
    """Return the first and last code of the support, and what is expected below and above it."""
    low, below = 0, 0.0
    while low < law.shape[0] - 1 and n * (below + law[low, 0]) < allowed:
        below += law[low, 0]
        low += 1
    high, above = law.shape[0] - 1, 0.0
    while high > low and n * (above + law[high, 0]) < allowed:
        above += law[high, 0]
        high -= 1
    return low, high, n * below, n * above


@kernel
def whiten(law: FloatArray, inverse: FloatArray, gram: FloatArray) -> bool:
    """Make the first columns of ``law`` orthonormal, and the tests orthogonal to them.

    A parameter on which the law does not depend here, or not in a way of its own, takes nothing from the
    tests: its column becomes 0. The read noise is one where each electron number has the same two codes.

    Args:
        law: columns times mass; changed in place.
        inverse: 1/p, or 0 for codes to be left out, (code,).
        gram: to fill with the triangular factor: column j was ``sum_i gram[i, j] (new column i)``,
            (N_NUISANCE, N_COLUMNS).

    Returns:
        False if no code has any mass.
    """
    fill_zeros(gram)
    for x in range(law.shape[0]):
        row, scale = law[x], inverse[x]
        for i in range(N_NUISANCE):
            value = row[i] * scale
            for j in range(i, N_COLUMNS):
                gram[i, j] += value * row[j]
    # Gaussian elimination of the Gram matrix is Gram-Schmidt of the columns
    for i in range(N_NUISANCE):
        scale = 1.0 / math.sqrt(gram[i, i]) if gram[i, i] > _SINGULAR else 0.0
        for j in range(i, N_COLUMNS):
            gram[i, j] *= scale
        for k in range(i + 1, N_NUISANCE):
            for j in range(k, N_COLUMNS):
                gram[k, j] -= gram[i, k] * gram[i, j]
    for x in range(law.shape[0]):
        row = law[x]
        for i in range(N_NUISANCE):
            value = row[i] / gram[i, i] if gram[i, i] > 0.0 else 0.0
            row[i] = value
            for j in range(i + 1, N_COLUMNS):
                row[j] -= gram[i, j] * value
    return bool(gram[0, 0] > 0.0)


@kernel
def _fit_covariance(gram: FloatArray, covariance: FloatArray, inverse: FloatArray) -> None:
    """Fill the covariance of the fit, times n, along C1, He1, He1 C1, He2 from the triangular factor."""
    fill_zeros(inverse)
    for j in range(_N_DIRECTIONS):
        if not gram[j + 1, j + 1] > 0.0:
            continue
        inverse[j, j] = 1.0 / gram[j + 1, j + 1]
        for i in range(j - 1, -1, -1):
            total = 0.0
            for k in range(i + 1, j + 1):
                total += gram[i + 1, k + 1] * inverse[k, j]
            inverse[i, j] = -total / gram[i + 1, i + 1] if gram[i + 1, i + 1] > 0.0 else 0.0
    for i in range(_N_DIRECTIONS):
        for j in range(_N_DIRECTIONS):
            total = 0.0
            for k in range(max(i, j), _N_DIRECTIONS):
                total += inverse[i, k] * inverse[j, k]
            covariance[i, j] = total


@kernel
def _curvature(covariance: FloatArray, exposure: float, curvature: FloatArray) -> None:
    """Fill the coefficients of the tests in ``sum_ab cov(a, b) D_a D_b p``, in the order of the columns.

    The directions multiply the terms of the law by C1, He1, He1 C1, He2; two of them by the products, of
    which only what is not spanned by the parameters matters.
    """
    root2 = math.sqrt(2.0)
    curvature[0] = root2 * covariance[0, 0]  # C2
    curvature[1] = 0.0  # C3
    curvature[2] = 2.0 * covariance[1, 3]  # He3
    curvature[3] = covariance[3, 3]  # He4
    curvature[4] = 2.0 * (covariance[0, 3] + covariance[1, 2]) + covariance[2, 2] / math.sqrt(
        exposure
    )  # He2C1
    curvature[5] = 2.0 * root2 * covariance[0, 2]  # He1C2
    curvature[6] = root2 * covariance[2, 2]  # He2C2
    curvature[7] = 2.0 * covariance[2, 3]  # He3C1


@kernel
def pixel_scores(
    law: FloatArray, inverse: FloatArray, seen: FloatArray, gram: FloatArray, exposure: float, out: FloatArray
) -> None:
    """Fill ``out`` (3, N_TESTS): standardised efficient scores of the samples, their skewness and kurtosis.

    Args:
        law: whitened, (code, column).
        inverse: 1/p, or 0 for codes to be left out, (code,).
        seen: samples of each code, (code,).
        gram: the triangular factor of the whitening.
        exposure: H, e-.
        out: to fill; NaN where a score has no variance.
    """
    covariance, work = np.empty((_N_DIRECTIONS, _N_DIRECTIONS)), np.empty((_N_DIRECTIONS, _N_DIRECTIONS))
    curvature, total = np.empty(N_TESTS), np.zeros(N_TESTS)
    third, fourth = np.zeros(N_TESTS), np.zeros(N_TESTS)
    products = np.zeros((N_TESTS, N_TESTS))
    n = 0.0
    for x in range(seen.size):
        scale = inverse[x]
        tests, weight = law[x, N_NUISANCE:], seen[x] * scale
        n += seen[x]
        for i in range(N_TESTS):
            value = tests[i]
            score = value * scale
            total[i] += weight * value
            cube = score * score * value
            third[i] += cube
            fourth[i] += cube * score
            for j in range(i, N_TESTS):
                products[i, j] += score * tests[j]
    _fit_covariance(gram, covariance, work)
    _curvature(covariance, exposure, curvature)
    for i in range(N_TESTS):
        variance = products[i, i]
        if variance > _SINGULAR and n > 0.0:
            bias = 0.0
            for j in range(N_TESTS):
                bias -= 0.5 * curvature[j] * products[min(i, j), max(i, j)]
            out[0, i] = (total[i] - bias) / math.sqrt(n * variance)
            out[1, i] = third[i] / (variance * math.sqrt(variance * n))
            out[2, i] = (fourth[i] / (variance * variance) - 3.0) / n
        else:
            for row in range(out.shape[0]):
                out[row, i] = math.nan
