"""Efficient scores of the exact law of pixels.

Orthogonality of the columns of :data:`~pchem_pipeline.model.law.cell_scores_numba.COLUMNS` is that of
Fisher's information metric, ``sum_x f(x) h(x) p(x)``. What is left of a test function after projection on the
four directions of the parameters (and the constant) is Rao's efficient score, whose sum over the samples does
not depend on the fitted parameters to first order. To second order it does: with the parameters fitted by
maximum likelihood the sum has the expectation ``-1/2 sum_ab cov(a, b) sum_x psi(x) D_a D_b p(x)``, and the
second derivatives of p along the four directions are test functions again.

All arrays are of n pixels at once, each over x codes: what is beyond the codes of a pixel has no mass.
"""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE

N_TESTS = N_COLUMNS - N_NUISANCE
_SINGULAR = 1e-9


def whiten(law: FloatArray, inverse: FloatArray) -> FloatArray:
    """Make the first columns of ``law`` orthonormal, and the tests orthogonal to them.

    A parameter on which the law does not depend here, or not in a way of its own, takes nothing from the
    tests: its column becomes 0. The read noise is one where each electron number has the same two codes.

    Args:
        law: columns times mass; changed in place, (N_COLUMNS, n, x).
        inverse: 1/p, or 0 for codes to be left out, (n, x).

    Returns:
        The triangular factor: column j was ``sum_i factor[i, j] (new column i)``, (N_NUISANCE, N_COLUMNS, n).
    """
    factor: FloatArray = np.einsum("ipx,jpx->ijp", law[:N_NUISANCE] * inverse, law)
    # Gaussian elimination of the Gram matrix is Gram-Schmidt of the columns
    for i in range(N_NUISANCE):
        regular = factor[i, i] > _SINGULAR
        factor[i] *= np.where(regular, 1.0 / np.sqrt(np.where(regular, factor[i, i], 1.0)), 0.0)
        factor[i, :i] = 0.0
        for k in range(i + 1, N_NUISANCE):
            factor[k] -= factor[i, k] * factor[i]
        law[i] /= np.where(regular, factor[i, i], np.inf)[:, None]
        law[i + 1 :] -= factor[i, i + 1 :, :, None] * law[i]
    return factor


def efficient_scores(
    law: FloatArray, inverse: FloatArray, seen: FloatArray, factor: FloatArray, exposure: FloatArray
) -> FloatArray:
    """Compute the standardised efficient scores of the samples, their skewness and kurtosis, (n, 3, N_TESTS).

    Args:
        law: whitened, (N_COLUMNS, n, x).
        inverse: 1/p, or 0 for codes to be left out, (n, x).
        seen: samples of each code, (n, x).
        factor: of the whitening.
        exposure: H, e-, (n,).

    Returns:
        NaN where a score has no variance.
    """
    tests = law[N_NUISANCE:]
    scores = tests * inverse
    products = np.einsum("ipx,jpx->ijp", scores, tests)
    variance, samples = np.einsum("iip->ip", products), seen.sum(axis=1)
    total = np.einsum("ipx,px->ip", scores, seen)
    bias = -0.5 * np.einsum("jp,ijp->ip", _curvature(_fit_covariance(factor), exposure), products)
    cubes = scores * scores * tests
    third, fourth = cubes.sum(axis=2), np.einsum("ipx,ipx->ip", cubes, scores)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = [
            (total - bias) / np.sqrt(samples * variance),
            third / (variance * np.sqrt(variance * samples)),
            (fourth / variance**2 - 3.0) / samples,
        ]
    known = (variance > _SINGULAR) & (samples > 0.0)
    return np.asarray(np.where(known, found, np.nan).transpose(2, 0, 1))


def _fit_covariance(factor: FloatArray) -> FloatArray:
    """Return the covariance of the fit, times the samples, along C1, He1, He1 C1, He2, (4, 4, n)."""
    of_fit = np.moveaxis(factor[1:, 1:N_NUISANCE], 2, 0)
    known = np.diagonal(of_fit, axis1=1, axis2=2) > 0.0
    both = known[:, :, None] & known[:, None, :]
    inverse = np.linalg.inv(np.where(both, of_fit, np.eye(N_NUISANCE - 1))) * both
    return np.asarray(np.einsum("pik,pjk->ijp", inverse, inverse))


def _curvature(covariance: FloatArray, exposure: FloatArray) -> FloatArray:
    """Return the coefficients of the tests in ``sum_ab cov(a, b) D_a D_b p``, in their order, (N_TESTS, n).

    The directions multiply the terms of the law by C1, He1, He1 C1, He2; two of them by the products, of
    which only what is not spanned by the parameters matters.
    """
    c, root2 = covariance, np.sqrt(2.0)
    return np.stack([
        root2 * c[0, 0],  # C2
        np.zeros_like(exposure),  # C3
        2.0 * c[1, 3],  # He3
        c[3, 3],  # He4
        2.0 * (c[0, 3] + c[1, 2]) + c[2, 2] / np.sqrt(exposure),  # He2C1
        2.0 * root2 * c[0, 2],  # He1C2
        root2 * c[2, 2],  # He2C2
        2.0 * c[2, 3],  # He3C1
    ])  # fmt: skip
