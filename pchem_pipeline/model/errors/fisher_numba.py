"""Small dense algebra on the 4 x 4 information matrix, with parameters that a bound holds fixed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

_SINGULAR = 1e-12  # of the diagonal element: what is left of it after the other parameters are taken out


@kernel
def cholesky(information: NDArray[np.float64], held: NDArray[np.bool_], lower: NDArray[np.float64]) -> bool:
    """Factor the information of the parameters that are not held; False unless positive definite."""
    for row in range(4):
        for column in range(row + 1):
            value = information[row, column]
            if held[row] or held[column]:
                value = 1.0 if row == column else 0.0
            for k in range(column):
                value -= lower[row, k] * lower[column, k]
            if row != column:
                lower[row, column] = value / lower[column, column]
            elif held[row]:
                lower[row, row] = 1.0
            elif value > _SINGULAR * abs(information[row, row]):
                lower[row, row] = math.sqrt(value)
            else:
                return False
    return True


@kernel
def back_substitute(lower: NDArray[np.float64], vector: NDArray[np.float64]) -> float:
    """Solve ``L L' x = vector`` in place; return ``vector' x``, which is the squared decrement."""
    squared = 0.0
    for row in range(4):
        for k in range(row):
            vector[row] -= lower[row, k] * vector[k]
        vector[row] /= lower[row, row]
        squared += vector[row] * vector[row]
    for row in range(3, -1, -1):
        for k in range(row + 1, 4):
            vector[row] -= lower[k, row] * vector[k]
        vector[row] /= lower[row, row]
    return squared


@kernel
def invert(
    information: NDArray[np.float64], held: NDArray[np.bool_], covariance: NDArray[np.float64]
) -> bool:
    """Fill the inverse; NaN for held parameters, and everywhere (answer False) unless positive definite."""
    lower = np.zeros((4, 4))
    column = np.empty(4)
    for i in range(4):
        for j in range(4):
            covariance[i, j] = math.nan
    if not cholesky(information, held, lower):
        return False
    for i in range(4):
        if held[i]:
            continue
        for j in range(4):
            column[j] = 1.0 if j == i else 0.0
        back_substitute(lower, column)
        for j in range(4):
            if not held[j]:
                covariance[j, i] = column[j]
    return True


@kernel
def to_natural(
    theta: NDArray[np.float64],
    centre: float,
    information: NDArray[np.float64],
    held: NDArray[np.bool_],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> bool:
    """Turn theta and its information into (H, g, mu, sigma) and their covariance; see :mod:`.estep_numba`."""
    slope = np.empty(4)
    parameters[0] = math.exp(theta[0])
    parameters[1] = 1.0 / theta[1]
    parameters[2] = centre + theta[2]
    parameters[3] = math.exp(0.5 * theta[3])
    slope[0] = parameters[0]
    slope[1] = -parameters[1] * parameters[1]
    slope[2] = 1.0
    slope[3] = 0.5 * parameters[3]
    regular: bool = invert(information, held, covariance)
    for i in range(4):
        for j in range(4):
            covariance[i, j] *= slope[i] * slope[j]
    return regular
