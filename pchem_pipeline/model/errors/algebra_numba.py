"""Algebra of the information of a pixel's samples: an arrow of blocks, with parameters that stay.

See :mod:`pchem_pipeline.model.law.pixel_numba` for the parameters and for what an evaluation holds. The
exposure of each sample is eliminated first; the shared parameters are left with a matrix of their own (Schur
complement).
"""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.pixel_numba import Scratch

# of the diagonal element: what must be left of it after the other parameters are taken out; a comb that
# fits whole numbers, whose bias and gain can make up for each other, has less
_SINGULAR = 1e-6
_SMALLEST = 1e-10  # of the damping matrix: less is lost in rounding


@kernel(borrows=True)
def cholesky(
    matrix: FloatArray, start: int, end: int, least: float, held: BoolArray, lower: FloatArray
) -> bool:
    """Factor the rows start ... end - 1 of a matrix, a lower triangle; False unless positive definite.

    The rows that are held are taken for those of a unit matrix; of the diagonal elements of the others a
    share must be left.
    """
    for row in range(start, end):
        for column in range(start, row + 1):
            value = matrix[row, column]
            if held[row - start] or held[column - start]:
                value = 1.0 if row == column else 0.0
            for k in range(start, column):
                value -= lower[row, k] * lower[column, k]
            if row != column:
                lower[row, column] = value / lower[column, column]
            elif held[row - start]:
                lower[row, row] = 1.0
            elif value > least * abs(matrix[row, row]):
                lower[row, row] = math.sqrt(value)
            else:
                return False
    return True


@kernel(borrows=True)
def back_substitute(lower: FloatArray, start: int, end: int, vector: FloatArray) -> float:
    """Solve ``L L' x = vector`` in rows start ... end - 1, in place; return ``vector' x``."""
    squared = 0.0
    for row in range(start, end):
        for k in range(start, row):
            vector[row] -= lower[row, k] * vector[k]
        vector[row] /= lower[row, row]
        squared += vector[row] * vector[row]
    for row in range(end - 1, start - 1, -1):
        for k in range(row + 1, end):
            vector[row] -= lower[k, row] * vector[k]
        vector[row] /= lower[row, row]
    return squared


@kernel(inline=True, borrows=True)
def _solve_without_satellites(at: FloatArray, share: float, scratch: Scratch, step: FloatArray) -> float:
    """Do as :func:`solve_arrow` where there are no satellites: by L D L', five times faster."""
    n, held = at.shape[0], scratch.flags[px.HELD]
    squared = right1 = right2 = right3 = 0.0
    a11 = a21 = a22 = a31 = a32 = a33 = 0.0
    for j in range(n):
        block = at[j]
        inverse = 0.0
        if not held[j]:
            own = block[px.INFORMATION, 0] + share * block[px.DAMPING, 0]
            if not own > _SMALLEST * block[px.DAMPING, 0]:
                return math.nan
            inverse = 1.0 / own
        score = block[px.SCORE, 0]
        squared += score * score * inverse
        across1 = block[px.INFORMATION + 1, 0] + share * block[px.DAMPING + 1, 0]
        across2 = block[px.INFORMATION + 2, 0] + share * block[px.DAMPING + 2, 0]
        across3 = block[px.INFORMATION + 3, 0] + share * block[px.DAMPING + 3, 0]
        factor1, factor2, factor3 = across1 * inverse, across2 * inverse, across3 * inverse
        right1 += block[px.SCORE, 1] - factor1 * score
        right2 += block[px.SCORE, 2] - factor2 * score
        right3 += block[px.SCORE, 3] - factor3 * score
        a11 += block[px.INFORMATION + 1, 1] + share * block[px.DAMPING + 1, 1] - factor1 * across1
        a21 += block[px.INFORMATION + 2, 1] + share * block[px.DAMPING + 2, 1] - factor2 * across1
        a22 += block[px.INFORMATION + 2, 2] + share * block[px.DAMPING + 2, 2] - factor2 * across2
        a31 += block[px.INFORMATION + 3, 1] + share * block[px.DAMPING + 3, 1] - factor3 * across1
        a32 += block[px.INFORMATION + 3, 2] + share * block[px.DAMPING + 3, 2] - factor3 * across2
        a33 += block[px.INFORMATION + 3, 3] + share * block[px.DAMPING + 3, 3] - factor3 * across3
    if held[n]:
        a11, a21, a31, right1 = 1.0, 0.0, 0.0, 0.0
    if held[n + 1]:
        a22, a21, a32, right2 = 1.0, 0.0, 0.0, 0.0
    if held[n + 2]:
        a33, a31, a32, right3 = 1.0, 0.0, 0.0, 0.0
    l21, l31 = a21 / a11, a31 / a11
    d2, d3 = a22 - l21 * a21, a33 - l31 * a31
    rest = a32 - l31 * a21
    l32 = rest / d2
    d3 -= l32 * rest
    regular = a11 > 0.0 and d2 > _SINGULAR * abs(a22) and d3 > _SINGULAR * abs(a33)
    if not regular:
        return math.nan
    right2 -= l21 * right1
    right3 -= l31 * right1 + l32 * right2
    step3 = right3 / d3
    step2 = right2 / d2 - l32 * step3
    step1 = right1 / a11 - l21 * step2 - l31 * step3
    step[n], step[n + 1], step[n + 2], step[n + px.SATELLITE] = step1, step2, step3, 0.0
    for j in range(n):
        block = at[j]
        step[j] = 0.0
        if not held[j]:
            value = (
                block[px.SCORE, 0] - (block[px.INFORMATION + 1, 0] + share * block[px.DAMPING + 1, 0]) * step1
            )
            value -= (block[px.INFORMATION + 2, 0] + share * block[px.DAMPING + 2, 0]) * step2
            value -= (block[px.INFORMATION + 3, 0] + share * block[px.DAMPING + 3, 0]) * step3
            step[j] = value / (block[px.INFORMATION, 0] + share * block[px.DAMPING, 0])
    return squared + right1 * right1 / a11 + right2 * right2 / d2 + right3 * step3


@kernel(borrows=True)
def solve_arrow(at: FloatArray, share: float, scratch: Scratch, step: FloatArray) -> float:
    """Fill the step with the information and a share of the damping matrix, 0 for what stays (flags `HELD`).

    Return the squared decrement, NaN unless the matrix is positive definite.
    """
    n, held, small = at.shape[0], scratch.flags[px.HELD], scratch.small
    if held[n + px.SATELLITE]:
        return float(_solve_without_satellites(at, share, scratch, step))
    right, schur, lower = small[px.RIGHT], small[px.SCHUR : px.LOWER], small[px.LOWER : px.HERE]
    for row in range(1, px.N_BLOCK):
        right[row] = 0.0
        for column in range(1, row + 1):
            schur[row, column] = 0.0
    squared = 0.0
    for j in range(n):
        block = at[j]
        for row in range(1, px.N_BLOCK):
            right[row] += block[px.SCORE, row]
            for column in range(1, row + 1):
                schur[row, column] += (
                    block[px.INFORMATION + row, column] + share * block[px.DAMPING + row, column]
                )
        if held[j]:
            continue
        own = block[px.INFORMATION, 0] + share * block[px.DAMPING, 0]
        if not own > _SMALLEST * block[px.DAMPING, 0]:
            return math.nan
        squared += block[px.SCORE, 0] * block[px.SCORE, 0] / own
        for row in range(1, px.N_BLOCK):
            across = block[px.INFORMATION + row, 0] + share * block[px.DAMPING + row, 0]
            factor = across / own
            right[row] -= factor * block[px.SCORE, 0]
            for column in range(1, row + 1):
                schur[row, column] -= factor * (
                    block[px.INFORMATION + column, 0] + share * block[px.DAMPING + column, 0]
                )
    for row in range(1, px.N_BLOCK):
        if held[n + row - 1]:
            right[row] = 0.0
    if not cholesky(schur, 1, px.N_BLOCK, _SINGULAR, held[n:], lower):
        return math.nan
    squared += float(back_substitute(lower, 1, px.N_BLOCK, right))
    for row in range(1, px.N_BLOCK):
        step[n + row - 1] = 0.0 if held[n + row - 1] else right[row]
    for j in range(n):
        block = at[j]
        step[j] = 0.0
        if not held[j]:
            value = block[px.SCORE, 0]
            for row in range(1, px.N_BLOCK):
                across = block[px.INFORMATION + row, 0] + share * block[px.DAMPING + row, 0]
                value -= across * step[n + row - 1]
            step[j] = value / (block[px.INFORMATION, 0] + share * block[px.DAMPING, 0])
    return squared


@kernel
def invert_arrow(at: FloatArray, theta: FloatArray, held: BoolArray, covariance: FloatArray) -> bool:
    """Fill the inverse of the observed information of (H_1 ... H_J, 1/g, mu, v, q).

    In H itself, ``-d2 L / dH2 = (I + s) / H^2`` with information I and score s in log H: it stays finite
    where the exposure is at its lower bound. Zeros for what stays; return whether the information is positive
    definite.
    """
    n = at.shape[0]
    factors, own = np.zeros((n, px.N_BLOCK)), np.zeros(n)
    schur, lower, column = (
        np.zeros((px.N_BLOCK, px.N_BLOCK)),
        np.zeros((px.N_BLOCK, px.N_BLOCK)),
        np.zeros(px.N_BLOCK),
    )
    for row in range(n + px.N_SHARED):
        for other in range(n + px.N_SHARED):
            covariance[row, other] = 0.0
    for j in range(n):
        block = at[j]
        for row in range(1, px.N_BLOCK):
            for other in range(1, row + 1):
                schur[row, other] += block[px.INFORMATION + row, other]
        if held[j]:
            continue
        exposure = math.exp(theta[j])
        own[j] = (block[px.INFORMATION, 0] + block[px.SCORE, 0]) / (exposure * exposure)
        if not own[j] > 0.0:
            return False
        for row in range(1, px.N_BLOCK):
            factors[j, row] = block[px.INFORMATION + row, 0] / exposure / own[j]
        for row in range(1, px.N_BLOCK):
            for other in range(1, row + 1):
                schur[row, other] -= factors[j, row] * factors[j, other] * own[j]
    if not cholesky(schur, 1, px.N_BLOCK, _SINGULAR, held[n:], lower):
        return False
    for i in range(1, px.N_BLOCK):
        if held[n + i - 1]:
            continue
        for row in range(1, px.N_BLOCK):
            column[row] = 1.0 if row == i else 0.0
        back_substitute(lower, 1, px.N_BLOCK, column)
        for row in range(1, px.N_BLOCK):
            covariance[n + row - 1, n + i - 1] = 0.0 if held[n + row - 1] else column[row]
    for j in range(n):
        for i in range(px.N_SHARED):
            value = 0.0
            for row in range(1, px.N_BLOCK):
                value += covariance[n + i, n + row - 1] * factors[j, row]
            covariance[j, n + i] = covariance[n + i, j] = -value
    for j in range(n):
        for other in range(n):
            value = 0.0
            for row in range(1, px.N_BLOCK):
                value -= covariance[j, n + row - 1] * factors[other, row]
            covariance[j, other] = value
        if not held[j]:
            covariance[j, j] += 1.0 / own[j]
    return True


@kernel
def enclose(at: FloatArray, theta: FloatArray, covariance: FloatArray) -> None:
    """Replace the inverse information C by the sandwich ``C (sum of squared scores) C`` (White 1982).

    The evaluation at the maximum has the squared scores in the place of the damping matrix.
    """
    n, size = at.shape[0], theta.size
    middle, half = np.zeros((size, size)), np.zeros((size, size))
    for j in range(n):
        scale = math.exp(-theta[j])
        for row in range(px.N_BLOCK):
            for column in range(row + 1):
                value = at[j, px.DAMPING + row, column]
                value *= (scale if row == 0 else 1.0) * (scale if column == 0 else 1.0)
                place = j if row == 0 else n + row - 1
                other = j if column == 0 else n + column - 1
                middle[place, other] += value
                if place != other:
                    middle[other, place] += value
    for row in range(size):
        for column in range(size):
            for k in range(size):
                half[row, column] += middle[row, k] * covariance[k, column]
    product = np.zeros((size, size))
    for row in range(size):
        for column in range(size):
            for k in range(size):
                product[row, column] += covariance[row, k] * half[k, column]
    for row in range(size):
        for column in range(size):
            covariance[row, column] = product[row, column]


@kernel
def to_natural(
    theta: FloatArray,
    dark: BoolArray,
    held: BoolArray,
    rounding: float,
    full: FloatArray,
    parameters: FloatArray,
    covariance: FloatArray,
) -> None:
    """Turn theta and its covariance into (H_1 ... H_J, g, mu, sigma) and theirs.

    Args:
        theta: parameters, mu counted from 0.
        dark: which samples hold no electrons: H = 0.
        held: parameters that a bound holds: NaN in their rows and columns, but for dark samples, where it is
            0.
        rounding: variance that sigma has beside v, DN^2.
        full: covariance of (H_1 ... H_J, 1/g, mu, v, q).
        parameters: out, shape (J + 3,).
        covariance: out, shape (J + 3, J + 3).
    """
    n = dark.size
    slope = np.ones(n + px.N_SHARED)
    for j in range(n):
        parameters[j] = 0.0 if dark[j] else math.exp(theta[j])
    variance = math.exp(theta[n + px.LOG_VARIANCE])
    parameters[n] = 1.0 / theta[n]
    parameters[n + 1] = theta[n + 1]
    parameters[n + 2] = math.sqrt(variance + rounding)
    slope[n] = -parameters[n] * parameters[n]
    slope[n + 2] = 0.5 * variance / parameters[n + 2]
    for row in range(n + 3):
        for column in range(n + 3):
            known = (row < n or not held[row]) and (column < n or not held[column])
            covariance[row, column] = full[row, column] * slope[row] * slope[column] if known else math.nan
