"""How well a prediction agrees with a histogram: residuals, RMSE and the noise that no model can beat."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pchem_pipeline.base.arrays import FloatArray


def central_window(counts: NDArray[np.integer[Any]]) -> slice:
    """Return the bins that hold the central 99.9 % of the counts, shape (n,), which are not all zero.

    A few hot pixels stretch the axis over thousands of empty bins; an RMSE over all of them would shrink with
    the length of the axis.
    """
    cumulative = np.cumsum(counts)
    tail = 0.0005 * cumulative[-1]
    first = int(np.searchsorted(cumulative, tail, side="right"))
    last = int(np.searchsorted(cumulative, cumulative[-1] - tail, side="left"))
    return slice(first, max(last, first) + 1)


def rmse(data: FloatArray, model: FloatArray, window: slice = slice(None)) -> float:
    """Return the root mean square difference between two densities, (n,), in their unit."""
    return math.sqrt(float(np.mean((data[window] - model[window]) ** 2)))


def noise_floor(variance: FloatArray, window: slice = slice(None)) -> float:
    """Return the RMSE that counting alone causes, from the variance of the density of each bin, (n,)."""
    return math.sqrt(float(np.mean(variance[window])))


def normalised_residuals(data: FloatArray, model: FloatArray, variance: FloatArray) -> FloatArray:
    """Return ``(data - model) / sqrt(variance)``; NaN where the variance is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0, (data - model) / np.sqrt(variance), np.nan)


def chi_square(
    data: FloatArray, model: FloatArray, variance: FloatArray, counts: NDArray[np.integer[Any]]
) -> dict[str, float]:
    """Return Pearson's chi-square of an ensemble histogram with the binomial variance of its pixels.

    Over those of the n bins with at least 10 samples. The bins of one pixel are slightly anticorrelated, so
    the sum is not exactly chi-square; with many bins the difference is small. As ``value``, the number of
    bins ``dof``, and ``p``, the probability of a larger one if the model holds; NaN without bins.
    """
    use = (counts >= 10) & (variance > 0)
    value, dof = float(np.sum((data[use] - model[use]) ** 2 / variance[use])), int(use.sum())
    return {"value": value, "dof": dof, "p": float(chdtrc(dof, value)) if dof else math.nan}
