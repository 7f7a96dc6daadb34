"""Unbiased moments of histograms, for every method that looks at nothing else."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class SampleMoments(NamedTuple):
    """k-statistics of n pixels, shape (n,) each; NaN where the sample is too small.

    Attributes:
        n_frames: number of samples.
        mean: DN.
        variance: DN^2.
        third: third cumulant, DN^3.
        fourth: fourth cumulant, DN^4.
    """

    n_frames: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    third: NDArray[np.float64]
    fourth: NDArray[np.float64]


def sample_moments(counts: NDArray[np.integer], origin: NDArray[np.integer]) -> SampleMoments:
    """Return the unbiased estimates of the first four cumulants (k-statistics, Fisher 1929).

    Values are centred on the mean first, so that a large bias costs no digits.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
    """
    weights = np.asarray(counts, np.float64)
    bins = np.arange(weights.shape[1], dtype=np.float64)
    n = weights.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = weights @ bins / n
        residual = bins - centre[:, None]
        powers = [np.einsum("ij,ij->i", weights, residual**power) for power in (2, 3, 4)]
        second, third, fourth = powers
        variance = np.where(n > 1, second / (n - 1), np.nan)
        skew = np.where(n > 2, n * third / ((n - 1) * (n - 2)), np.nan)
        top = n * (n + 1) * fourth - 3 * (n - 1) * second**2
        kurtosis = np.where(n > 3, top / ((n - 1) * (n - 2) * (n - 3)), np.nan)
    return SampleMoments(n, np.asarray(origin, np.float64) + centre, variance, skew, kurtosis)
