"""Expected information of pixels under the PCD, and covariances as correlations."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.law.mass import parts_of_similar_width, sample_mass
from pchem_pipeline.model.law.parameters import Parameters, columns_of
from pchem_pipeline.model.law.pcd import pcd_posterior
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Pairs of parameters, in the order of the axis ``parameter_pair``; numbers as in ``variables.PARAMETERS``.
CORRELATION_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


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
