"""Pearson's chi-square of the histograms of a pixel, adjacent bins merged."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.pixel_numba import DARK, EXPECTED, N_BINS, N_FRAMES, WEIGHT, Pixel

SMALLEST_EXPECTATION = 5.0
FITTED_PARAMETERS = 4


@kernel(borrows=True)
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


@kernel(borrows=True)
def normal_score(chi2: float, freedom: int) -> float:
    """Return the chi-square as a standard normal deviate (Wilson and Hilferty 1931); 0 without freedom."""
    if freedom <= 0:
        return 0.0
    spread = 2.0 / (9.0 * freedom)
    deviate: float = ((chi2 / freedom) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread)
    return deviate


@kernel(borrows=True)
def goodness(pixel: Pixel) -> tuple[float, int]:
    """Return Pearson's chi-square of all samples, from the counts expected, and its degrees of freedom.

    Each sample's exposure is a fitted parameter of its own; 1/g, mu and sigma are fitted once.
    """
    chi2, freedom = 0.0, 1 - FITTED_PARAMETERS
    for j in range(pixel.facts.shape[0]):
        bins, facts = pixel.bins[j], pixel.facts[j]
        own, degrees = pearson(bins[WEIGHT], bins[EXPECTED], int(facts[N_BINS]), facts[N_FRAMES])
        if degrees > 0:
            chi2 += own
            freedom += degrees + FITTED_PARAMETERS
            if facts[DARK] == 0.0:
                freedom -= 1
    if freedom <= 0:
        return math.nan, 0
    return chi2, freedom


@kernel(borrows=True)
def outlying(pixel: Pixel, floor: float) -> float:
    """Return how many samples lie at DN of which fewer than ``floor`` are expected."""
    found = 0.0
    for j in range(pixel.facts.shape[0]):
        bins = pixel.bins[j]
        for i in range(int(pixel.facts[j, N_BINS])):
            if bins[EXPECTED, i] < floor:
                found += bins[WEIGHT, i]
    return found
