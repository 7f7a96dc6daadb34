"""The gap of a fit on histograms that it was not fitted to: Kullback-Leibler, nats per sample.

``2 G = 2 sum n log(n / (N p))`` against the saturated model is Wilks' statistic. A right model has of it by
chance what Poisson counts have in each cell, and what the errors of the fitted parameters add (Wald 1943).
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.gap import Gap

_QUANTILES = special.ndtri((np.arange(400) + 0.5) / 400)  # of a sum of many cells, standard deviations


def gap_of(
    counts: NDArray[np.integer],
    log_masses: FloatArray,
    n_parameters: int,
    *,
    share: float,
    kept: BoolArray | bool = True,
) -> Gap:
    """Return the gap of histograms (n, B) from a fit with so many parameters.

    ``log_masses`` are those of the codes that are ``kept`` (True: all), given that they are; ``share`` is the
    ratio of these samples to the fitted ones.
    """
    seen = np.where(kept, counts, 0).astype(np.float64)
    total = np.maximum(seen.sum(axis=1, keepdims=True), 1.0)
    ratio = np.where(seen > 0, np.log(np.maximum(seen, 1.0) / total) - log_masses, 0.0)
    value, variance = sum_over_samples(seen, ratio)
    mean, square = _of_cells(np.where(kept, np.exp(log_masses), 0.0) * total)
    # the number of samples is fixed; fit and counts are both off by chance along each parameter
    mean += 0.5 * (share * n_parameters - total.size)
    square += share * (1.0 + 0.5 * share) * n_parameters - 0.5 * total.size
    chance = mean + np.sqrt(max(square, 0.0)) * _QUANTILES
    return Gap.of(value, chance, float(total.sum()), variance=variance)


def on_all_codes(log_masses: FloatArray, kept: BoolArray, plain: FloatArray) -> FloatArray:
    """Return the log masses (n, B) of all codes: of kept ones a fit's, of the others those of the plain law.

    Kept codes have together the share of the plain law; the masses of the fit are given that they are kept.
    """
    share = np.log(np.where(kept, np.exp(plain), 0.0).sum(axis=1, keepdims=True))
    return np.where(kept, log_masses + share, plain)


def sum_over_samples(seen: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Return the sum of values over samples, both (n, B), and its variance by the samples of each row."""
    sums = (seen * values).sum(axis=1)
    variance = (seen * values**2).sum(axis=1) - sums**2 / np.maximum(seen.sum(axis=1), 1.0)
    return float(sums.sum()), float(max(variance.sum(), 0.0))


def _of_cells(expected: FloatArray) -> tuple[float, float]:
    """Return mean and variance of ``sum n log(n / e) - n + e``, nats, n being Poisson of expectation e."""
    grid, *tables = _chance_table()
    some = np.maximum(expected[expected > 0.0], np.exp(grid[0]))
    mean, variance = (float(np.interp(np.log(some), grid, values).sum()) for values in tables)
    return mean, variance


@functools.cache
def _chance_table() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return log e, from 1e-6 to 1e3, with mean and variance of ``n log(n / e) - n + e``."""
    expected = np.geomspace(1e-6, 1e3, 600)[:, None]
    n = np.arange(1500)
    mass = np.exp(special.xlogy(n, expected) - expected - special.gammaln(n + 1.0))
    values = special.kl_div(n, expected)
    mean = (mass * values).sum(axis=1)
    return np.log(expected[:, 0]), mean, (mass * values**2).sum(axis=1) - mean**2
