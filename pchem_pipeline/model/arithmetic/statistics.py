"""Robust standard deviations, many tests at once, and sums of squares as normal deviates.

All are of arrays in any unit.
"""

from __future__ import annotations

from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import FloatArray

#: Standard deviations of a normal law in a median absolute deviation.
OF_MEDIAN_DEVIATION = 1.4826


@overload
def robust_sd(values: ArrayLike, centre: ArrayLike | None = None) -> float: ...
@overload
def robust_sd(values: ArrayLike, centre: ArrayLike | None = None, *, axis: int) -> FloatArray: ...
def robust_sd(
    values: ArrayLike, centre: ArrayLike | None = None, *, axis: int | None = None
) -> float | FloatArray:
    """Return ``1.4826 median |v - centre|``, the standard deviation of a normal law, NaN where a value is.

    About the median, or a given centre; of all values a float, or along an axis.
    """
    seen = np.asarray(values, np.float64)
    middle = np.median(seen, axis=axis, keepdims=True) if centre is None else np.asarray(centre)
    found = OF_MEDIAN_DEVIATION * np.median(np.abs(seen - middle), axis=axis)
    return float(found) if axis is None else np.asarray(found)


def look_elsewhere(p: float, tests: float) -> float:
    """Return the chance that the smallest of ``tests`` independent p-values is ``p`` or less (Sidak 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(max(p, 0.0), 1.0 - 1e-16))))


def false_discovery(probability: NDArray[np.floating[Any]]) -> FloatArray:
    """Return the false-discovery rate at which each of many tests would be called significant.

    The step-up procedure of Benjamini and Hochberg (1995): with the p-values in ascending order,
    ``q_(i) = min_(j >= i) p_(j) n / j``. Among the pixels with q below a limit the expected share of those
    that agree with the model is at most that limit, for independent pixels.

    Of p-values of any shape, NaN where nothing was tested.

    Example:
        >>> false_discovery(np.array([0.01, 0.04, 0.5])).round(2).tolist()
        [0.03, 0.06, 0.5]
    """
    found = np.full(probability.shape, np.nan)
    tested = np.isfinite(probability)
    p = np.asarray(probability[tested], np.float64)
    order = np.argsort(p)  # scipy.stats has this, too, and takes a second to import
    raised = p[order] * (p.size / np.arange(1.0, p.size + 1.0))
    q = np.empty(p.size)
    q[order] = np.minimum(np.minimum.accumulate(raised[::-1])[::-1], 1.0)
    found[tested] = q
    return found


def chi_square(value: ArrayLike, mean: ArrayLike, variance: ArrayLike | None = None) -> FloatArray:
    """Return the normal deviate of a sum of squares, whose cube root is nearly normal (Wilson-Hilferty 1931).

    The mean, above 0, is its expectation (the degrees of freedom where the squares have variance 1); the
    variance is twice the mean if it is not given.
    """
    mu = np.asarray(mean, np.float64)
    spread = 2.0 * mu if variance is None else np.asarray(variance, np.float64)
    # a multiple of a chi-square with the same mean and variance has this many degrees of freedom
    width = spread / (9.0 * mu**2)
    ratio = np.maximum(np.asarray(value, np.float64), 0.0) / mu
    return np.asarray((np.cbrt(ratio) - (1.0 - width)) / np.sqrt(width))


def misfit(chi2: FloatArray, dof: FloatArray) -> FloatArray:
    """Return chi-square as a standard normal deviate (Wilson and Hilferty 1931), large for a poor fit.

    Unlike a p-value it does not run out of digits; NaN where there are no degrees of freedom.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return chi_square(chi2, np.where(dof > 0, dof, np.nan))


def poorest(chi2: FloatArray, dof: FloatArray, n: int) -> list[tuple[int, int]]:
    """Return (y, x) of the n pixels of the poorest fit, the poorest first; fewer where fewer were tested."""
    score = misfit(chi2, dof).ravel()
    order = np.argsort(-score, kind="stable")[:n]
    return [divmod(int(i), chi2.shape[1]) for i in order if np.isfinite(score[i])]
