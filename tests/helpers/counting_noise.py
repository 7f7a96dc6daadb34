"""Variance of the histograms of an ensemble, from the probabilities of its pixels."""

import numpy as np


def counting_variance(
    total: np.ndarray, total_square: np.ndarray, n_pixels: int, n_frames: int, width: float = 1.0
) -> np.ndarray:
    """Return the variance of the density of an ensemble histogram, the pixels given.

    A pixel of probability p_p for a bin puts a binomial number of its m frames there, independently of the
    other pixels. Over the m P samples and bins of width w the density has variance
    ``sum_p m p_p (1 - p_p) / (m P w)^2``.

    Args:
        total: sum over pixels of p_p, shape (n,).
        total_square: sum over pixels of p_p squared, shape (n,).
        n_pixels: P.
        n_frames: m.
        width: w, in the unit of the axis.

    Returns:
        Variance of the density of each bin, shape (n,).
    """
    return np.maximum(total - total_square, 0.0) / (n_frames * (n_pixels * width) ** 2)
