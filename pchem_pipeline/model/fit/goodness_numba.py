"""Pearson chi-square of a histogram, adjacent bins merged."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

SMALLEST_EXPECTATION = 5.0
FITTED_PARAMETERS = 4


@kernel
def pearson(
    weights: NDArray[np.float64], expectations: NDArray[np.float64], n_bins: int, n: float
) -> tuple[float, int]:
    """Compare counts with what is expected of each DN, adjacent DN merged until 5 are expected.

    What is expected outside the window belongs to the last group, so that the expectations sum to ``n``.

    Returns:
        Chi-square and its degrees of freedom, groups - 1 - 4; (NaN, 0) where none are left.
    """
    chi2 = 0.0
    groups = 0
    seen = expected = 0.0
    remaining = n
    for i in range(n_bins):
        seen += weights[i]
        expected += expectations[i]
        if expected >= SMALLEST_EXPECTATION and remaining - expected >= SMALLEST_EXPECTATION:
            chi2 += (seen - expected) ** 2 / expected
            groups += 1
            remaining -= expected
            seen = expected = 0.0
    if remaining > 0.0:
        chi2 += (seen - remaining) ** 2 / remaining
        groups += 1
    freedom = groups - 1 - FITTED_PARAMETERS
    if freedom <= 0:
        return math.nan, 0
    return chi2, freedom


@kernel
def normal_score(chi2: float, freedom: int) -> float:
    """Return the chi-square as a standard normal deviate (Wilson and Hilferty 1931); 0 without freedom."""
    if freedom <= 0:
        return 0.0
    spread = 2.0 / (9.0 * freedom)
    deviate: float = ((chi2 / freedom) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread)
    return deviate
