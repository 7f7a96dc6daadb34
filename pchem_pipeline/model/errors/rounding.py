"""What rounding to whole DN does to estimates from the density of the PCD.

The density at whole DN stands for the mass of a cell; that biases the estimates once a peak is narrower than
about a DN and a half. :func:`rounding_bias` says by how much; ``fit.likelihood: exact`` or ``auto`` takes
the masses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.expected_information import expected_scores, inverse_information
from pchem_pipeline.model.law.parameters import columns_of

#: Standard errors by which rounding may bias the density's estimates before it is said (or mended).
LARGEST_BIAS = 0.05

# Peaks so wide are safe: the bias falls as sqrt(N) / sigma^4 (rounding differs from a normal law of variance
# 1/12 in the fourth cumulant), and is below 0.03 standard errors here.
_SAFE = 20.0


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
