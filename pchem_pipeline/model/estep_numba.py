"""One evaluation of a pixel's likelihood: E-step sums, score and Louis' observed information.

Internal parameters ``theta = (log H, a, m, log sigma^2)`` with ``a = 1/g`` and ``m = mu - centre`` (DN); the
values are counted from an integer ``centre`` near the pixel's mean, so that no moment cancels.

For the values nearest to component ``j``, with ``d = y - m - j a``, the components ``j + l`` weigh in as
``(P_{j+l} / P_j) exp(-l^2 a^2 / 2 sigma^2) r^l`` with ``r = exp(d a / sigma^2)``: a polynomial in ``r``, and
``r`` is a geometric sequence over successive DN. The posterior moments of ``l`` up to the fourth give the
score and ``sum_i c_i {E[I_c | x_i] - Cov(S | x_i)}`` (Louis 1982).

First `_fill` lays the values out in a table, a column for each DN, with the polynomial's coefficients; then
one loop without branches or calls runs over the columns, which the compiler turns into vector instructions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.workspace_numba import (
    CAPACITY,
    LANES,
    LOGLIK,
    MAX_COMPONENTS,
    Histogram,
    Workspace,
)

# Sums may be reassociated, so that they run in vector registers; NaN and infinity keep their meaning. Only
# for the reductions here: what numba links into several kernels is optimised again in each, and which copy
# runs depends on what the process compiled or loaded before. The starting points, once compiled like this,
# came out different in the last bit in a process that had just compiled them.
_REORDER = {"reassoc", "nsz", "contract", "arcp"}

_DROPPED = 30.0  # nats below the nearest component at which a component is left out: exp(-30) = 1e-13
_LARGEST_RATIO = 1e145  # keeps r^2 finite when the peaks are needles

# rows of the table; the coefficients follow
_WEIGHT, _RATIO, _OFFSET, _LOWEST, _LEVEL, _COEFFICIENT = range(6)
# places in `totals`: LOGLIK, the five sums of `Workspace.total`, then sums of c times var(i), cov(i, i^2)
# and var(i^2),
# i counted from the lowest component, times powers of the offset d from it and of w = d - a lowest
_V11, _V11W, _V11D, _V11WW, _V11DW, _V11DD, _V12, _V12W, _V12D, _V22 = range(6, 16)
_N_TOTALS = 16

LOG_2PI = math.log(2.0 * math.pi)
_LN2 = math.log(2.0)
_ROOT2 = math.sqrt(2.0)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_ONE = np.int64(0x3FF0000000000000)


@nb.njit(nogil=True, cache=True, fastmath=_REORDER, error_model="numpy")
def vector_log(x: float) -> float:
    """Return log(x) of a positive normal number, in a form that compiles to vector instructions.

    From the exponent and ``2 artanh((f - 1)/(f + 1))`` of the fraction f in [sqrt(1/2), sqrt(2)).
    """
    bits = np.float64(x).view(np.int64)
    fraction = np.int64((bits & _MANTISSA) | _ONE).view(np.float64)
    large = 1.0 if fraction > _ROOT2 else 0.0
    exponent = float((bits >> 52) - 1023) + large
    fraction = fraction * (1.0 - 0.5 * large)
    q = (fraction - 1.0) / (fraction + 1.0)
    z = q * q
    series = 1 / 15 + z * (1 / 17 + z * (1 / 19 + z / 21))
    series = 1 / 7 + z * (1 / 9 + z * (1 / 11 + z * (1 / 13 + z * series)))
    series = 1.0 + z * (1 / 3 + z * (1 / 5 + z * series))
    answer: float = exponent * _LN2 + 2.0 * q * series
    return answer


def _table_kernel(width: int) -> Callable[..., Any]:
    """Make the loop over the columns for a fixed number of components (0: given at run time)."""

    @nb.njit(nogil=True, cache=True, fastmath=_REORDER, error_model="numpy")
    def table_sums(
        table: NDArray[np.float64], columns: int, components: int, a: float, totals: NDArray[np.float64]
    ) -> None:
        terms = width if width > 0 else components
        loglik = sum_k = sum_kk = sum_ke = sum_e = sum_ee = 0.0
        v11 = v11w = v11d = v11ww = v11dw = v11dd = v12 = v12w = v12d = v22 = 0.0
        for i in range(columns):
            c, ratio, d = table[_WEIGHT, i], table[_RATIO, i], table[_OFFSET, i]
            low = table[_LOWEST, i]
            power = 1.0
            s0 = table[_COEFFICIENT, i]
            s1 = s2 = s3 = s4 = 0.0
            for k in range(1, terms):
                power = power * ratio
                term = table[_COEFFICIENT + k, i] * power
                s0 += term
                s1 += k * term
                s2 += k * k * term
                s3 += k * k * k * term
                s4 += k * k * k * k * term
            loglik += c * (table[_LEVEL, i] + vector_log(s0))
            inverse = 1.0 / s0
            m1, m2, m3, m4 = s1 * inverse, s2 * inverse, s3 * inverse, s4 * inverse
            w = d - a * low
            sum_k += c * (low + m1)
            sum_kk += c * (low * (low + 2.0 * m1) + m2)
            sum_ke += c * (low * d + m1 * w - a * m2)
            sum_e += c * (d - a * m1)
            sum_ee += c * (d * d - a * (2.0 * d * m1 - a * m2))
            c11, c12, c22 = c * (m2 - m1 * m1), c * (m3 - m1 * m2), c * (m4 - m2 * m2)
            v11 += c11
            v11w += c11 * w
            v11d += c11 * d
            v11ww += c11 * w * w
            v11dw += c11 * d * w
            v11dd += c11 * d * d
            v12 += c12
            v12w += c12 * w
            v12d += c12 * d
            v22 += c22
        first = (loglik, sum_k, sum_kk, sum_ke, sum_e, sum_ee)
        second = (v11, v11w, v11d, v11ww, v11dw, v11dd, v12, v12w, v12d, v22)
        for place, value in enumerate(first):
            totals[place] += value
        for place, value in enumerate(second):
            totals[_V11 + place] += value

    kernel: Callable[..., Any] = table_sums
    return kernel


table_sums_3 = _table_kernel(3)
table_sums_5 = _table_kernel(5)
table_sums_7 = _table_kernel(7)
table_sums_9 = _table_kernel(9)
table_sums_any = _table_kernel(0)


@nb.njit(nogil=True, cache=True)
def _half_width(electron_noise: float, exposure: float, first: int, last: int) -> int:
    """Return how many components matter on either side of the nearest one."""
    variance = electron_noise * electron_noise
    half = max(1, math.ceil(math.sqrt(2.0 * _DROPPED * variance + 0.25) - 0.5))
    if electron_noise > 0.5:  # the Poisson factor moves the largest term away from the nearest component
        tilt = max(abs(math.log(exposure / (first + 1.0))), abs(math.log(exposure / (last + 1.0))))
        half += math.ceil(variance * tilt)
    return min(half, (MAX_COMPONENTS - 1) // 2)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fill_prior(
    prior: NDArray[np.float64], nearest: int, low: int, width: int, exposure: float, overlap: float
) -> None:
    """Fill the polynomial's coefficients relative to the nearest; ``overlap = exp(-a^2/2 sigma^2)``."""
    place = nearest - low
    square = overlap * overlap
    prior[place] = 1.0
    factor = overlap
    for step in range(1, width - place):
        prior[place + step] = prior[place + step - 1] * factor * exposure / (nearest + step)
        factor *= square
    factor = overlap
    inverse = 1.0 / exposure
    for step in range(1, place + 1):
        prior[place - step] = prior[place - step + 1] * factor * (nearest - step + 1) * inverse
        factor *= square


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _sum_table(
    table: NDArray[np.float64], filled: int, width: int, a: float, totals: NDArray[np.float64]
) -> None:
    """Fill up the last vector with columns of no weight, and sum with the loop for this many components."""
    columns = (filled + LANES - 1) // LANES * LANES
    for i in range(filled, columns):
        for row in range(_COEFFICIENT + width):
            table[row, i] = 0.0
        table[_COEFFICIENT, i] = 1.0
    if width == 3:
        table_sums_3(table, columns, 3, a, totals)
    elif width == 5:
        table_sums_5(table, columns, 5, a, totals)
    elif width == 7:
        table_sums_7(table, columns, 7, a, totals)
    elif width == 9:
        table_sums_9(table, columns, 9, a, totals)
    else:
        table_sums_any(table, columns, width, a, totals)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _expect(
    table: NDArray[np.float64], filled: int, width: int, frames: float, start: int, out: NDArray[np.float64]
) -> None:
    """Leave the counts expected of the DN in the table, from ``start`` on, in ``out``."""
    for i in range(filled):
        power = 1.0
        density = table[_COEFFICIENT, i]
        for k in range(1, width):
            power *= table[_RATIO, i]
            density += table[_COEFFICIENT + k, i] * power
        out[start + i] = frames * density * math.exp(table[_LEVEL, i])


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _finish(n: float, theta: NDArray[np.float64], totals: NDArray[np.float64], space: Workspace) -> None:
    """Turn the totals into score and observed information.

    With ``S = const + alpha i + beta i^2``, ``alpha = (1, w/s2, -a/s2, -a d/s2)`` and ``beta = (0, -a/s2, 0,
    a^2/2 s2)``, the conditional covariance of the complete-data score is made of the sums of var(i),
    cov(i, i^2) and var(i^2) times powers of d and w.
    """
    total, score, information = space.total, space.score, space.information
    exposure, a, inverse = math.exp(theta[0]), theta[1], math.exp(-theta[3])
    t = a * inverse
    for i in range(6):
        total[i] = totals[i]
    sum_k, sum_kk, sum_ke, sum_e, sum_ee = totals[1], totals[2], totals[3], totals[4], totals[5]
    v11, v12, v22 = totals[_V11], totals[_V12], totals[_V22]
    cov01 = inverse * totals[_V11W] - t * v12
    cov03 = 0.5 * a * t * v12 - t * totals[_V11D]
    cov11 = inverse * (inverse * totals[_V11WW] - 2.0 * t * totals[_V12W]) + t * t * v22
    cov13 = t * inverse * (0.5 * a * totals[_V12W] - totals[_V11DW])
    cov13 += t * t * (totals[_V12D] - 0.5 * a * v22)
    cov33 = t * t * (totals[_V11DD] - a * totals[_V12D] + 0.25 * a * a * v22)
    score[0] = sum_k - n * exposure
    score[1] = sum_ke * inverse
    score[2] = sum_e * inverse
    score[3] = 0.5 * (sum_ee * inverse - n)
    information[0, 0] = n * exposure - v11
    information[0, 1] = -cov01
    information[0, 2] = t * v11
    information[0, 3] = -cov03
    information[1, 1] = sum_kk * inverse - cov11
    information[1, 2] = sum_k * inverse + t * cov01
    information[1, 3] = sum_ke * inverse - cov13
    information[2, 2] = n * inverse - t * t * v11
    information[2, 3] = sum_e * inverse + t * cov03
    information[3, 3] = 0.5 * sum_ee * inverse - cov33
    for row in range(1, 4):
        for column in range(row):
            information[row, column] = information[column, row]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fill(
    table: NDArray[np.float64],
    filled: int,
    weights: NDArray[np.float64],
    start: int,
    stop: int,
    nearest: float,
    shift: float,
    low: float,
    level: float,
    a: float,
    inverse: float,
    prior: NDArray[np.float64],
    width: int,
    powers: NDArray[np.float64],
) -> None:
    """Lay out the DN from ``start`` to ``stop``; the first is ``nearest`` DN off their nearest component."""
    n = stop - start
    top = math.exp((nearest + n - 1) * a * inverse)
    for i in range(n):
        d = nearest + i
        column = filled + i
        table[_WEIGHT, column] = weights[start + i]
        table[_RATIO, column] = min(top * powers[n - 1 - i], _LARGEST_RATIO)
        table[_OFFSET, column] = d + shift
        table[_LOWEST, column] = low
        table[_LEVEL, column] = level - (0.5 * d + shift) * d * inverse
    for k in range(width):
        coefficient = prior[k]
        row = table[_COEFFICIENT + k]
        for column in range(filled, filled + n):
            row[column] = coefficient


@nb.njit(nogil=True, cache=True, error_model="numpy")
def evaluate(histogram: Histogram, theta: NDArray[np.float64], space: Workspace, frames: float) -> float:
    """Evaluate log-likelihood, E-step sums, score and observed information of one pixel.

    Args:
        histogram: of the pixel.
        theta: (log H, a, m, log sigma^2).
        space: scratch; out: sums, score and information.
        frames: leave the counts of each DN expected in so many frames in ``space.rows[0]``; nothing if 0.

    Returns:
        The log-likelihood, nats.
    """
    weights, cumulative, n_bins, first, _, _, _ = histogram
    table, expected, powers, totals = space.table, space.rows[0], space.rows[1], space.rows[2]
    prior = space.rows[3]
    exposure, a, origin, inverse = math.exp(theta[0]), theta[1], theta[2], math.exp(-theta[3])
    j = max(0, math.floor((first - origin) / a + 0.5))
    last = max(j, math.floor((first + n_bins - 1 - origin) / a + 0.5))
    half = _half_width(1.0 / math.sqrt(a * a * inverse), exposure, j, last)
    width = 2 * half + 1
    overlap = math.exp(-0.5 * a * a * inverse)
    decay = math.exp(-a * inverse)
    powers[0] = 1.0
    known = 1
    for i in range(_N_TOTALS):
        totals[i] = 0.0
    level = j * theta[0] - exposure - math.lgamma(j + 1.0) - 0.5 * (theta[3] + LOG_2PI)
    start = n_bins - n_bins  # 0 as a variable, lest a constant have its own compilation
    filled = start
    while start < n_bins:
        end = min(n_bins, math.ceil(origin + (j + 0.5) * a - first))
        if j == last:
            end = n_bins
        empty = end <= start or cumulative[end] == cumulative[start]
        if not empty:
            low = max(0, j - half)
            _fill_prior(prior, j, low, width, exposure, overlap)
        while start < end:
            stop = min(end, start + CAPACITY)
            if filled + stop - start > CAPACITY:
                _sum_table(table, filled, width, a, totals)
                filled = 0
            if empty:
                if frames > 0.0:
                    for i in range(start, end):
                        expected[i] = 0.0
                stop = end
            else:
                while known < stop - start:
                    powers[known] = powers[known - 1] * decay
                    known += 1
                nearest = first + start - origin - j * a
                shift = (j - low) * a
                _fill(
                    table, filled, weights, start, stop, nearest, shift, float(low), level, a, inverse,
                    prior, width, powers,
                )  # fmt: skip
                if frames > 0.0:
                    _expect(table[:, filled:], stop - start, width, frames, start, expected)
                filled += stop - start
            start = stop
        j += 1
        level += theta[0] - math.log(j)
    _sum_table(table, filled, width, a, totals)
    _finish(cumulative[n_bins], theta, totals, space)
    return float(totals[LOGLIK])
