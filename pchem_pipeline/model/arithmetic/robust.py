"""Figures that a few values far from the others do not move, and normal deviates of squares and of many.

All are of arrays in any unit.
"""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike

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
    """Return ``1.4826 median |v - centre|``, the standard deviation of a normal law.

    Args:
        values: any shape; NaN where any of them is.
        centre: of the law; None: the median.
        axis: along which; None: of all values, a float.
    """
    seen = np.asarray(values, np.float64)
    middle = np.median(seen, axis=axis, keepdims=True) if centre is None else np.asarray(centre)
    found = OF_MEDIAN_DEVIATION * np.median(np.abs(seen - middle), axis=axis)
    return float(found) if axis is None else np.asarray(found)


def look_elsewhere(p: float, tests: float) -> float:
    """Return the chance that the smallest of ``tests`` independent p-values is ``p`` or less (Sidak 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(max(p, 0.0), 1.0 - 1e-16))))


def chi_square(value: ArrayLike, mean: ArrayLike, variance: ArrayLike | None = None) -> FloatArray:
    """Return the normal deviate of a sum of squares, whose cube root is nearly normal (Wilson-Hilferty 1931).

    Args:
        value: the sum.
        mean: its expectation (the degrees of freedom where the squares have variance 1), above 0.
        variance: its variance; twice the mean if None.
    """
    mu = np.asarray(mean, np.float64)
    spread = 2.0 * mu if variance is None else np.asarray(variance, np.float64)
    # a multiple of a chi-square with the same mean and variance has this many degrees of freedom
    width = spread / (9.0 * mu**2)
    ratio = np.maximum(np.asarray(value, np.float64), 0.0) / mu
    return np.asarray((np.cbrt(ratio) - (1.0 - width)) / np.sqrt(width))
