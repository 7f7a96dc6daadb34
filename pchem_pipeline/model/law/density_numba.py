"""The likelihood of the density of the PCD at whole DN: E-step sums, score and Louis' observed information.

Parameters of a sample are (log H, a, m, log sigma^2) with ``a = 1/g`` and ``m = mu - centre`` (DN); the
values are counted from an integer ``centre`` near the sample's mean, so that no moment cancels.

For the values nearest to component ``j``, with ``d = y - m - j a``, the components ``j + l`` weigh in as
``(P_{j+l} / P_j) exp(-l^2 a^2 / 2 sigma^2) r^l`` with ``r = exp(d a / sigma^2)``: a polynomial in ``r``, and
``r`` is a geometric sequence over successive DN. The posterior moments of ``l`` up to the fourth give the
score and ``sum_i c_i {E[I_c | x_i] - Cov(S | x_i)}`` (Louis 1982).

First `_fill` lays the values out in a table, a column for each DN, with the polynomial's coefficients; then
one loop without branches or calls runs over the columns, eight side by side (:mod:`.simd_numba`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.pixel_numba import (
    BIAS,
    CAPACITY,
    CENTRE,
    CUMULATIVE,
    DAMPING,
    DARK,
    EXPECTATIONS,
    EXPECTED,
    FIRST,
    INFORMATION,
    LOG_VARIANCE,
    LOGLIK_ALONE,
    MAX_COMPONENTS,
    MEAN,
    N_BINS,
    N_BLOCK,
    N_FRAMES,
    N_ROWS,
    SCORE,
    STEP,
    SUM_E,
    SUM_EE,
    SUM_K,
    SUM_KE,
    SUM_KK,
    SUMS,
    VARIANCE,
    WEIGHT,
    Pixel,
    Scratch,
)
from pchem_pipeline.model.law.simd_math_numba import LN2, ROOT2, artanh_series, simd_exp, simd_log
from pchem_pipeline.model.law.simd_numba import (
    SIMD_WIDTH,
    Simd,
    counting,
    exponent_of,
    fused,
    least,
    most,
    scaled,
    simd_load,
    simd_store,
    simd_sum,
)

# nats below the nearest component at which a component is left out: exp(-22) = 3e-10 moves estimates by some
# 1e-7 standard errors; and of the log-likelihood alone
_DROPPED, _DROPPED_ALONE = 22.0, 14.0
_LARGEST_RATIO = 333.0  # logarithm; keeps r^2 finite when the peaks are needles
_SMALLEST = -700.0  # logarithm of what counts as 0 beside 1
_NOTHING = -60.0  # logarithm of a density that no number of frames makes visible

# rows of the table; the coefficients follow
_WEIGHT, _OFFSET, _NEAREST, _LEVEL, _COEFFICIENT = range(5)
# places in `totals`: the log-likelihood; the sums over c of low and low^2 (low: the lowest component); with i
# counted from it, the offset d from it and w = d - a low, sums of c times E[i], E[i^2], low E[i], d E[i] and
# low d; then of c times var(i), cov(i, i^2) and var(i^2) times powers of d and w
_LOGLIK = 0
_LOW, _LOW2, _M1, _M2, _LOW_M1, _D_M1, _LOW_D = range(1, 8)
_V11, _V11W, _V11D, _V11WW, _V11DW, _V11DD, _V12, _V12W, _V12D, _V22 = range(8, 18)
_N_TOTALS = 18

# rows of `Scratch.rows`
_TOTALS, _POWERS, _RISE, _FALL, _LOG_RISE = range(5)

_NEAREST_ROW = MAX_COMPONENTS // 2  # of `Scratch.chains`

LOG_2PI = math.log(2.0 * math.pi)


def _table_kernel(width: int) -> Callable[..., Any]:
    """Make the loop over the columns for a fixed number of components (0: given at run time)."""

    @kernel(borrows=True)
    def table_sums(
        table: NDArray[np.float64],
        columns: int,
        components: int,
        a: float,
        inverse: float,
        totals: NDArray[np.float64],
    ) -> None:
        terms = width if width > 0 else components
        half = float(terms // 2)
        loglik = sum_m1 = sum_m2 = sum_low_m1 = sum_d_m1 = sum_low_d = counting() * 0.0
        v11 = v11w = v11d = v11ww = v11dw = v11dd = v12 = v12w = v12d = v22 = loglik
        for i in range(0, columns, SIMD_WIDTH):
            c, offset = simd_load(table, _WEIGHT, i), simd_load(table, _OFFSET, i)
            place = simd_load(table, _NEAREST, i)
            low = most(place - half, 0.0)
            d = fused(place - low, a, offset)
            ratio = simd_exp(most(least(offset * (a * inverse), _LARGEST_RATIO), _SMALLEST))
            power = ratio
            term = simd_load(table, _COEFFICIENT + 1, i) * power
            s0 = simd_load(table, _COEFFICIENT, i) + term
            s1 = s2 = s3 = s4 = term
            for k in range(2, terms):
                power = power * ratio
                term = simd_load(table, _COEFFICIENT + k, i) * power
                number = float(k)
                s0 = s0 + term
                s1 = fused(term, number, s1)
                s2 = fused(term, number * number, s2)
                s3 = fused(term, number * number * number, s3)
                s4 = fused(term, number * number * number * number, s4)
            # log(s0) as in `simd_log`, its division shared with 1 / s0
            exponent = exponent_of(s0 * ROOT2)
            fraction = scaled(s0, 0.0 - exponent)
            above = fraction + 1.0
            shared = 1.0 / (s0 * above)
            each, q = shared * above, (fraction - 1.0) * (shared * s0)
            logged = fused(q + q, artanh_series(q * q), simd_load(table, _LEVEL, i))
            logged = fused(offset * (0.0 - inverse), fused(offset, -0.5, d), fused(exponent, LN2, logged))
            loglik = fused(c, logged, loglik)
            m1, m2, share = s1 * each, s2 * each, c * each
            c1, c2, minus = c * m1, c * m2, 0.0 - m1
            sum_m1, sum_m2, sum_low_d = sum_m1 + c1, sum_m2 + c2, fused(c * low, d, sum_low_d)
            sum_low_m1, sum_d_m1 = fused(c1, low, sum_low_m1), fused(c1, d, sum_d_m1)
            c11, c12, c22 = fused(c1, minus, c2), fused(c2, minus, share * s3), share * s4 - c2 * m2
            w = fused(low, 0.0 - a, d)
            c11w, c11d = c11 * w, c11 * d
            v11, v12, v22 = v11 + c11, v12 + c12, v22 + c22
            v11w, v11d = v11w + c11w, v11d + c11d
            v11ww, v11dw, v11dd = fused(c11w, w, v11ww), fused(c11d, w, v11dw), fused(c11d, d, v11dd)
            v12w, v12d = fused(c12, w, v12w), fused(c12, d, v12d)
        totals[_LOGLIK] += simd_sum(loglik)
        first = (sum_m1, sum_m2, sum_low_m1, sum_d_m1, sum_low_d)
        second = (v11, v11w, v11d, v11ww, v11dw, v11dd, v12, v12w, v12d, v22)
        for number_of, value in enumerate(first):
            totals[_M1 + number_of] += simd_sum(value)
        for number_of, value in enumerate(second):
            totals[_V11 + number_of] += simd_sum(value)

    compiled: Callable[..., Any] = table_sums
    return compiled


table_sums_3 = _table_kernel(3)
table_sums_5 = _table_kernel(5)
table_sums_7 = _table_kernel(7)
table_sums_9 = _table_kernel(9)
table_sums_any = _table_kernel(0)


@kernel(inline=True)
def _half_width(electron_noise: float, exposure: float, first: int, last: int, dropped: float) -> int:
    """Return how many components matter on either side of the nearest one, down to so many nats below it."""
    variance = electron_noise * electron_noise
    half = max(1, math.ceil(math.sqrt(2.0 * dropped * variance + 0.25) - 0.5))
    if electron_noise > 0.5:  # the Poisson factor moves the largest term away from the nearest component
        tilt = max(abs(math.log(exposure / (first + 1.0))), abs(math.log(exposure / (last + 1.0))))
        half += math.ceil(variance * tilt)
    return min(half, (MAX_COMPONENTS - 1) // 2)


@kernel(inline=True)
def _fill_steps(rows: NDArray[np.float64], first: int, count: int, log_exposure: float) -> None:
    """Fill ``H / k`` of k from ``first`` on, its inverse and its logarithm, by the eight; 1 / k of k = 0."""
    exposure = math.exp(log_exposure)
    inverse = 1.0 / exposure
    for i in range(0, count, SIMD_WIDTH):
        k = most(counting() + float(first + i), 1.0)
        simd_store(rows, _RISE, i, exposure / k)
        simd_store(rows, _FALL, i, k * inverse)
        simd_store(rows, _LOG_RISE, i, log_exposure - simd_log(k))


@kernel(inline=True)
def _fill_chains(
    chains: NDArray[np.float64], rows: NDArray[np.float64], place: int, up: int, down: int
) -> None:
    """Fill the polynomial's coefficients, relative to the nearest component, of eight successive cells.

    Neighbours differ by ``H / k`` and by an odd power of ``exp(-a^2/2 sigma^2)``.

    Args:
        chains: out, row `_NEAREST_ROW` + l of component j + l of the cells, a column for each cell.
        rows: the powers, and H / k and its inverse.
        place: where the first cell's component lies in those rows.
        up: components above the nearest one.
        down: components below it.
    """
    coefficient = counting() * 0.0 + 1.0
    simd_store(chains, _NEAREST_ROW, 0, coefficient)
    for step in range(1, up + 1):
        coefficient = coefficient * (simd_load(rows, _RISE, place + step) * rows[_POWERS, step])
        simd_store(chains, _NEAREST_ROW + step, 0, coefficient)
    coefficient = counting() * 0.0 + 1.0
    for step in range(1, down + 1):
        coefficient = coefficient * (simd_load(rows, _FALL, place - step + 1) * rows[_POWERS, step])
        simd_store(chains, _NEAREST_ROW - step, 0, coefficient)


@kernel(borrows=True)
def _sum_table(
    table: NDArray[np.float64],
    filled: int,
    width: int,
    a: float,
    inverse: float,
    what: int,
    totals: NDArray[np.float64],
    frames: float,
    expected: NDArray[np.float64],
    end: int,
) -> None:
    """Fill up the last lanes with columns of no weight, and sum with the loop for this many components.

    With ``frames``, also leave the counts expected of the columns, which end before DN ``end``.
    """
    for row in range(_COEFFICIENT + width):
        simd_store(table, row, filled, 1.0 if row == _COEFFICIENT else 0.0)
    if what == LOGLIK_ALONE:
        totals[_LOGLIK] += _loglik_alone(table, filled, width, a, inverse)
    elif width == 3:
        table_sums_3(table, filled, 3, a, inverse, totals)
    elif width == 5:
        table_sums_5(table, filled, 5, a, inverse, totals)
    elif width == 7:
        table_sums_7(table, filled, 7, a, inverse, totals)
    elif width == 9:
        table_sums_9(table, filled, 9, a, inverse, totals)
    else:
        table_sums_any(table, filled, width, a, inverse, totals)
    if frames > 0.0:
        _expect(table, filled, width, a, inverse, frames, expected, end - filled)


@kernel(inline=True)
def _mixture(
    table: NDArray[np.float64], first: int, width: int, a: float, inverse: float
) -> tuple[Simd, Simd]:
    """Return the sum of the components of eight columns, and the logarithm of what it is in units of."""
    half = float(width // 2)
    offset = simd_load(table, _OFFSET, first)
    ratio = simd_exp(most(least(offset * (a * inverse), _LARGEST_RATIO), _SMALLEST))
    power = ratio
    density = simd_load(table, _COEFFICIENT, first)
    for k in range(1, width):
        density = fused(simd_load(table, _COEFFICIENT + k, first), power, density)
        power = power * ratio
    shift = least(simd_load(table, _NEAREST, first), half) * a
    level = fused(offset * (0.0 - inverse), fused(offset, 0.5, shift), simd_load(table, _LEVEL, first))
    return density, level


@kernel(inline=True)
def _loglik_alone(table: NDArray[np.float64], filled: int, width: int, a: float, inverse: float) -> float:
    """Return the log-likelihood of the DN in the table."""
    loglik = counting() * 0.0
    for first in range(0, filled, SIMD_WIDTH):
        density, level = _mixture(table, first, width, a, inverse)
        loglik = fused(simd_load(table, _WEIGHT, first), simd_log(density) + level, loglik)
    return float(simd_sum(loglik))


@kernel(inline=True)
def _expect(
    table: NDArray[np.float64],
    filled: int,
    width: int,
    a: float,
    inverse: float,
    frames: float,
    out: NDArray[np.float64],
    start: int,
) -> None:
    """Leave the counts expected of the DN in the table in ``out`` from ``start`` on."""
    for first in range(0, filled, SIMD_WIDTH):
        density, level = _mixture(table, first, width, a, inverse)
        level = simd_exp(most(least(level, -_SMALLEST), _SMALLEST))
        simd_store(table, _WEIGHT, first, density * frames * level)
    for i in range(filled):
        out[start + i] = table[_WEIGHT, i]


@kernel(inline=True)
def _finish(
    facts: NDArray[np.float64],
    log_exposure: float,
    a: float,
    bias: float,
    inverse: float,
    totals: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Turn the totals into a sample's block of an evaluation.

    With ``S = const + alpha i + beta i^2``, ``alpha = (1, w/s2, -a/s2, -a d/s2)`` and ``beta = (0, -a/s2, 0,
    a^2/2 s2)``, the conditional covariance of the complete-data score is made of the sums of var(i),
    cov(i, i^2) and var(i^2) times powers of d and w.
    """
    n = facts[N_FRAMES]
    score, sums = out[SCORE], out[SUMS]
    exposure = math.exp(log_exposure)
    t = a * inverse
    mean = facts[MEAN] - bias
    low2, low_d, m2, d_m1 = totals[_LOW2], totals[_LOW_D], totals[_M2], totals[_D_M1]
    sum_k = totals[_LOW] + totals[_M1]
    sum_kk = low2 + 2.0 * totals[_LOW_M1] + m2
    sum_ke = low_d + d_m1 - a * (totals[_LOW_M1] + m2)
    sum_e = n * mean - a * sum_k
    sum_ee = n * (facts[VARIANCE] + mean * mean) - a * (2.0 * (low_d + d_m1) + a * (low2 - m2))
    sums[SUM_K], sums[SUM_KK], sums[SUM_KE], sums[SUM_E], sums[SUM_EE] = sum_k, sum_kk, sum_ke, sum_e, sum_ee
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
    _fill_complete(n, n * exposure, inverse, out)
    out[INFORMATION, 0] = n * exposure - v11
    out[INFORMATION + 1, 0] = -cov01
    out[INFORMATION + 2, 0] = t * v11
    out[INFORMATION + 3, 0] = -cov03
    out[INFORMATION + 1, 1] = sum_kk * inverse - cov11
    out[INFORMATION + 2, 1] = sum_k * inverse + t * cov01
    out[INFORMATION + 3, 1] = sum_ke * inverse - cov13
    out[INFORMATION + 2, 2] = n * inverse - t * t * v11
    out[INFORMATION + 3, 2] = sum_e * inverse + t * cov03
    out[INFORMATION + 3, 3] = 0.5 * sum_ee * inverse - cov33


@kernel(borrows=True)
def _fill_complete(n: float, of_exposure: float, inverse: float, out: NDArray[np.float64]) -> None:
    """Fill the complete-data information, of parameters whose electron numbers are known; lower triangle."""
    sums = out[SUMS]
    out[DAMPING, 0] = of_exposure
    for row in range(1, 4):
        out[DAMPING + row, 0] = 0.0
    out[DAMPING + 1, 1] = sums[SUM_KK] * inverse
    out[DAMPING + 2, 1] = sums[SUM_K] * inverse
    out[DAMPING + 2, 2] = n * inverse
    out[DAMPING + 3, 1] = sums[SUM_KE] * inverse
    out[DAMPING + 3, 2] = sums[SUM_E] * inverse
    out[DAMPING + 3, 3] = 0.5 * sums[SUM_EE] * inverse


@kernel(inline=True)
def _fill(
    table: NDArray[np.float64],
    filled: int,
    bins: NDArray[np.float64],
    ends: tuple[int, int],
    offset: float,
    place: int,
    level: float,
) -> None:
    """Lay out the DN from one end to the other; the first is ``offset`` DN off component ``place``.

    Columns are written by the eight: what that writes too much, the next ones overwrite.
    """
    start, stop = ends
    for i in range(0, stop - start, SIMD_WIDTH):
        simd_store(table, _WEIGHT, filled + i, simd_load(bins, WEIGHT, start + i))
        simd_store(table, _OFFSET, filled + i, counting() + (offset + i))
        simd_store(table, _NEAREST, filled + i, float(place))
        simd_store(table, _LEVEL, filled + i, level)


@kernel(inline=True)
def _fill_coefficients(
    table: NDArray[np.float64],
    filled: int,
    n: int,
    chains: NDArray[np.float64],
    first: int,
    cell: int,
    width: int,
) -> None:
    """Fill the coefficients of ``n`` columns of a cell, of ``width`` components from row ``first`` on."""
    for row in range(width):
        coefficient = chains[first + row, cell]
        for i in range(0, n, SIMD_WIDTH):
            simd_store(table, _COEFFICIENT + row, filled + i, coefficient)


@kernel(inline=True)
def _evaluate_sample(
    pixel: Pixel,
    sample: int,
    own: tuple[float, float, float, float],
    what: int,
    scratch: Scratch,
    out: NDArray[np.float64],
) -> float:
    """Evaluate one sample with electrons at its (log H, 1/g, mu - centre, log sigma^2)."""
    facts, bins = pixel.facts[sample], pixel.bins[sample]
    log_exposure, a, origin, log_variance = own
    cumulative, expected = bins[CUMULATIVE], bins[EXPECTED]
    n_bins, first = int(facts[N_BINS]), facts[FIRST]
    frames = facts[N_FRAMES] if what == EXPECTATIONS else 0.0
    rows, table, chains = scratch.rows, scratch.table, scratch.chains
    totals = rows[_TOTALS]
    exposure, inverse = math.exp(log_exposure), math.exp(-log_variance)
    j = max(0, math.floor((first - origin) / a + 0.5))
    last = max(j, math.floor((first + n_bins - 1 - origin) / a + 0.5))
    dropped = _DROPPED_ALONE if what == LOGLIK_ALONE else _DROPPED
    half = _half_width(1.0 / math.sqrt(a * a * inverse), exposure, j, last, dropped)
    width = 2 * half + 1
    lowest, cell = j - half, 0
    _fill_steps(rows, lowest, max(last, half) + half + 2 - lowest, log_exposure)
    power = math.exp(-0.5 * a * a * inverse)
    square = power * power
    for step in range(1, width):
        rows[_POWERS, step] = power
        power *= square
    for i in range(_N_TOTALS):
        totals[i] = 0.0
    level = j * log_exposure - exposure - math.lgamma(j + 1.0) - 0.5 * (log_variance + LOG_2PI)
    start = n_bins - n_bins  # 0 as a variable, lest a constant have its own compilation
    filled = start
    while start < n_bins:
        if cell == 0:
            _fill_chains(chains, rows, j - lowest, width - 1 - min(j, half), half)
        end = min(n_bins, math.ceil(origin + (j + 0.5) * a - first))
        if j == last:
            end = n_bins
        held = cumulative[end] - cumulative[start] if end > start else 0.0
        if end > start and (held > 0.0 or (frames > 0.0 and level > _NOTHING)):
            low = max(0, j - half)
            totals[_LOW] += held * low
            totals[_LOW2] += held * low * low
            while start < end:
                stop = min(end, start + CAPACITY)
                if filled + stop - start > CAPACITY:
                    _sum_table(table, filled, width, a, inverse, what, totals, frames, expected, start)
                    filled = 0
                offset = first + start - origin - j * a
                _fill(table, filled, bins, (start, stop), offset, j, level)
                _fill_coefficients(table, filled, stop - start, chains, _NEAREST_ROW + low - j, cell, width)
                filled += stop - start
                start = stop
        elif end > start:
            if frames > 0.0:
                _sum_table(table, filled, width, a, inverse, what, totals, frames, expected, start)
                filled = 0
                for i in range(start, end):
                    expected[i] = 0.0
            start = end
        j += 1
        cell = cell + 1 if cell + 1 < SIMD_WIDTH else 0
        level += rows[_LOG_RISE, j - lowest]
    _sum_table(table, filled, width, a, inverse, what, totals, frames, expected, n_bins)
    if what != LOGLIK_ALONE:
        _finish(facts, log_exposure, a, origin, inverse, totals, out)
    return float(totals[_LOGLIK])


@kernel(inline=True)
def _evaluate_dark(
    pixel: Pixel, j: int, bias: float, log_variance: float, expect: bool, out: NDArray[np.float64]
) -> float:
    """Evaluate a sample without electrons, one Gaussian."""
    facts, inverse = pixel.facts[j], math.exp(-log_variance)
    n, deviation = facts[N_FRAMES], facts[MEAN] - bias
    for row in range(N_ROWS):
        for column in range(N_BLOCK):
            out[row, column] = 0.0
    sum_e, sum_ee = n * deviation, n * (facts[VARIANCE] + deviation * deviation)
    out[SUMS, SUM_E], out[SUMS, SUM_EE] = sum_e, sum_ee
    out[SCORE, 2] = sum_e * inverse
    out[SCORE, 3] = 0.5 * (sum_ee * inverse - n)
    _fill_complete(n, 0.0, inverse, out)
    for row in range(2, 4):
        for column in range(2, row + 1):
            out[INFORMATION + row, column] = out[DAMPING + row, column]
    if expect:
        sd = math.exp(0.5 * log_variance)
        for i in range(int(facts[N_BINS])):
            z = (facts[FIRST] + i - bias) / sd
            pixel.bins[j, EXPECTED, i] = n * math.exp(-0.5 * z * z) / (sd * math.sqrt(2.0 * math.pi))
    loglik: float = -0.5 * (n * (LOG_2PI + log_variance) + sum_ee * inverse)
    return loglik


def evaluate_density(
    pixel: Pixel, theta: NDArray[np.float64], what: int, scratch: Scratch, out: NDArray[np.float64]
) -> float:
    """Evaluate log-likelihood, score, observed information and E-step sums of all samples of a pixel.

    Args:
        pixel: histograms; their moments take part, too.
        theta: parameters, shape (J + N_SHARED,).
        what: `LOGLIK_ALONE`, `DERIVATIVES`, or `EXPECTATIONS`, left of each DN in the pixel's ``bins``.
        scratch: room to work in.
        out: out, the evaluation; lower triangles of the matrices.

    Returns:
        The log-likelihood, nats.
    """
    n = pixel.facts.shape[0]
    a, bias, log_variance = theta[n + STEP], theta[n + BIAS], theta[n + LOG_VARIANCE]
    loglik = 0.0
    for j in range(n):
        own_bias = bias - pixel.facts[j, CENTRE]
        if pixel.facts[j, DARK] > 0.0:
            loglik += _evaluate_dark(pixel, j, own_bias, log_variance, what == EXPECTATIONS, out[j])
        else:
            own = theta[j], a, own_bias, log_variance
            loglik += _evaluate_sample(pixel, j, own, what, scratch, out[j])
    return loglik
