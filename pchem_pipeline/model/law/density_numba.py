"""The likelihood of the density of the PCD at whole DN: E-step sums, score and Louis' observed information.

Parameters of a sample are (log H, a, m, log sigma^2) with ``a = 1/g`` and ``m = mu - centre`` (DN); the
values are counted from an integer ``centre`` near the sample's mean, so that no moment cancels.

For the values nearest to component ``j``, with ``d = y - m - j a``, the components ``j + l`` weigh in as
``(P_{j+l} / P_j) exp(-l^2 a^2 / 2 sigma^2) r^l`` with ``r = exp(d a / sigma^2)``: a polynomial in ``r``. Its
derivatives are factorial moments of ``l``; from them come those of the residual ``e = y - m - k a``, and with
``k = (y - m - e) / a`` those of ``k`` and of ``k e``. They give the score and
``sum_i c_i {E[I_c | x_i] - Cov(S | x_i)}`` (Louis 1982).

The values go through one loop by the eight, side by side (`simd_numba`): blocks of bins, so short that
all bins of one are nearest to one of two successive components. What such a block needs is laid out before,
for eight blocks at a time, and blocks without samples are passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import LEAST_EXPONENT
from pchem_pipeline.model.arithmetic.simd_math_numba import simd_exp, simd_log
from pchem_pipeline.model.arithmetic.simd_numba import (
    SIMD_WIDTH,
    Simd,
    counting,
    fused,
    least,
    most,
    nearest,
    simd_load,
    simd_store,
    simd_sum,
    spliced,
)
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.pixel_numba import Pixel, Scratch

# nats below the nearest component at which a component is left out: exp(-22) = 3e-10 moves estimates by some
# 1e-7 standard errors; and of the log-likelihood alone
_DROPPED, _DROPPED_ALONE = 22.0, 14.0
_LONGEST = 340.0  # logarithm of r, its largest and smallest, times half the components: needles
_ALL_BINS = 1e9

# columns of the row `_TOTALS`: the log-likelihood; with y = x - mu the sums of E[e], E[e]^2 and y E[e]; over
# a^2 those of var(e) times 1, y and y^2, of cov(e, e^2) times 1 and y, and of var(e^2)
_LOGLIK, _E, _EE, _YE, _V11, _V11Y, _V11YY, _V12, _V12Y, _V22 = range(10)

# rows of `Scratch.rows`; with two numbers: of the nearest component and of the next; `_DENSITY`: of each bin,
# over a factor of its own
_TOTALS, _LEVEL, _CELL, _OWN, _DISTANCE, _RATIO, _CUT, _DENSITY = 0, 1, 2, 3, 4, 6, 8, 9

LOG_2PI = math.log(2.0 * math.pi)


class _Comb(NamedTuple):
    """The components of a sample, and the blocks of bins."""

    a: float  # 1/g, DN
    inverse: float  # 1/sigma^2
    zero: float  # where component 0 lies, bins after the first
    first: int  # component nearest to the first bin
    last: int  # component nearest to the last bin
    half: int  # components that matter on either side of the nearest one
    n_bins: int
    stride: int  # bins of a block: no more than lie next to two components


@kernel(inline=True, borrows=True)
def _half_width(electron_noise: float, exposure: float, first: int, last: int, dropped: float) -> int:
    """Return how many components matter on either side of the nearest one, down to so many nats below it."""
    variance = electron_noise * electron_noise
    half = math.sqrt(2.0 * dropped * variance + 0.25) - 0.5
    if electron_noise > 0.5:  # the Poisson factor moves the largest term away from the nearest component
        half += variance * max(
            abs(math.log(exposure / (first + 1.0))), abs(math.log(exposure / (last + 1.0)))
        )
    return min(max(1, math.ceil(half)), (px.MAX_COMPONENTS - 1) // 2)


@kernel(inline=True, borrows=True)
def _fill_levels(
    rows: FloatArray, log_factorials: FloatArray, comb: _Comb, log_exposure: float, constant: float
) -> None:
    """Fill the logarithms of the weights of components, from ``first - half`` to ``last + half + 1``."""
    lowest, end = comb.first - comb.half, comb.last + comb.half + 2
    known = end + px.N_NEGATIVE + SIMD_WIDTH <= log_factorials.shape[1]
    for k in range(lowest, end, SIMD_WIDTH):
        number = counting() + float(k)
        if known:
            log_factorial = simd_load(log_factorials, 0, k + px.N_NEGATIVE)
        else:  # Stirling's series: all of these are large
            per = 1.0 / number
            rest = fused(per, fused(per * per, -1.0 / 360.0, 1.0 / 12.0), 0.5 * LOG_2PI)
            log_factorial = fused(number + 0.5, simd_log(number), rest - number)
        simd_store(rows, _LEVEL, k - lowest, fused(number, log_exposure, constant - log_factorial))


@kernel(inline=True, borrows=True)
def _fill_coefficients(coefficients: FloatArray, rows: FloatArray, comb: _Comb) -> None:
    """Fill the coefficients of the polynomials: from component j to the one before a factor (j + l) / j."""
    half, n = comb.half, comb.last - comb.first
    power = -0.5 * comb.a * comb.a * comb.inverse
    for place in range(0, 2 * half + 1, SIMD_WIDTH):
        side = counting() + float(place - half)
        there = least(most(side + float(comb.last + 1), 0.0), 1.0)
        level = simd_load(rows, _LEVEL, n + place) - rows[_LEVEL, n + half]
        own = there * simd_exp(most(fused(side * side, power, level), LEAST_EXPONENT))
        simd_store(coefficients, n, place, own)
        for cell in range(n - 1, -1, -1):
            j = float(comb.first + cell + 1)
            own = own * ((side + j) * (1.0 / j))
            simd_store(coefficients, cell, place, own)


@kernel(inline=True, borrows=True)
def _fill_blocks(rows: FloatArray, comb: _Comb, n_blocks: int) -> None:
    """Fill the rows `_CELL` to `_CUT` of the blocks.

    Which component is nearest to the first bin, and to how many bins; for it and the next one the distance
    of the first bin from the lowest component that matters, and ``exp(d a / sigma^2)`` there, whose logarithm
    ends far to the left: what is cut off goes to `_CUT`.
    """
    a, half, scale = comb.a, comb.half, comb.a * comb.inverse
    longest = _LONGEST / half
    for block in range(0, n_blocks, SIMD_WIDTH):
        place = fused(counting() + float(block), float(comb.stride), -comb.zero)
        j = least(most(nearest(place * (1.0 / a)), float(comb.first)), float(comb.last))
        offset = fused(j, -a, place)
        every = most(j - float(comb.last - 1), 0.0) * _ALL_BINS
        logarithm = offset * scale
        kept = most(logarithm, -longest)
        simd_store(rows, _CELL, block, j - float(comb.first))
        simd_store(rows, _OWN, block, nearest(0.5 * a + 0.5 - offset) + every)
        simd_store(rows, _DISTANCE, block, offset + half * a)
        simd_store(rows, _DISTANCE + 1, block, offset + (half - 1) * a)
        simd_store(rows, _RATIO, block, simd_exp(least(kept, longest)))
        simd_store(rows, _RATIO + 1, block, simd_exp(least(most(logarithm - scale * a, -longest), longest)))
        simd_store(rows, _CUT, block, (logarithm - kept) * float(half))
    # the last logarithms that are taken reach beyond the bins, and the last block may not
    simd_store(rows, _DENSITY, (comb.n_bins - 1) // SIMD_WIDTH * SIMD_WIDTH, counting() * 0.0 + 1.0)


@kernel(inline=True, borrows=True)
def _lanes(
    block: int, own: int, cell: int, half: int, rows: FloatArray, ratios: Simd, most_ratio: float
) -> tuple[Simd, Simd, Simd]:
    """Return distance from the lowest component that matters, r and level of the bins of a block."""
    d = counting() + spliced(own, rows[_DISTANCE, block], rows[_DISTANCE + 1, block])
    r = least(ratios * spliced(own, rows[_RATIO, block], rows[_RATIO + 1, block]), most_ratio)
    level = spliced(own, rows[_LEVEL, cell + half], rows[_LEVEL, cell + half + 1])
    if rows[_CUT, block] < 0.0:
        level = level + spliced(own, rows[_CUT, block], 0.0)
    return d, r, level


@kernel(inline=True, borrows=True)
def _weighted_logs(bins: FloatArray, rows: FloatArray, n_bins: int) -> Simd:
    """Sum up counts times the logarithms of `_DENSITY`, in a loop so short that several are under way."""
    total = counting() * 0.0
    for i in range(0, n_bins, SIMD_WIDTH):
        total = fused(simd_load(bins, px.WEIGHT, i), simd_log(simd_load(rows, _DENSITY, i)), total)
    return total


@kernel(inline=True, borrows=True)
def _add_moments(
    a: float,
    square: float,
    d: Simd,
    y: Simd,
    c: Simd,
    moments: tuple[Simd, Simd, Simd, Simd, Simd],
    sums: Any,
) -> Any:
    """Add a block to the sums that follow the log-likelihood in `_TOTALS`.

    The moments are the density over its Gaussian factor, and its first four in components above the lowest
    one that matters, from which the bins are so far away, d; y are bins less mu, c counts.
    """
    p0, s1, s2, s3, s4 = moments
    sum_e, sum_ee, sum_ye, v11, v11y, v11yy, v12, v12y, v22 = sums
    each = 1.0 / p0
    m1, m2, share = s1 * each, s2 * each, c * each
    c11, cm2 = c * fused(-0.0 - m1, m1, m2), c * m2
    c12 = a * fused(-0.0 - cm2, m1, share * s3)
    c22 = fused(-0.0 - cm2, m2, share * s4)
    e, dd = fused(m1, -a, d), d + d
    ce, cy, w12 = c * e, c11 * y, fused(dd, c11, -0.0 - c12)
    w22 = fused(dd, w12 - c12, square * c22)
    return (
        *(sum_e + ce, fused(ce, e, sum_ee), fused(ce, y, sum_ye)),
        *(v11 + c11, v11y + cy, fused(cy, y, v11yy)),
        *(v12 + w12, fused(w12, y, v12y), v22 + w22),
    )


def _sums_kernel(width: int) -> Callable[..., Any]:
    """Make the loop over the blocks for a fixed number of components (0: given by the comb)."""

    @kernel(borrows=True)
    def sums_of(
        bins: FloatArray, comb: _Comb, n_blocks: int, rows: FloatArray, coefficients: FloatArray
    ) -> None:
        terms = width if width > 0 else 2 * comb.half + 1
        a, half = comb.a, terms // 2
        square, spread = a * a, -0.5 * comb.inverse
        most_ratio, ratios = math.exp(_LONGEST / half), simd_exp(counting() * (a * comb.inverse))
        zero = counting() * 0.0
        loglik, sums = zero, (zero, zero, zero, zero, zero, zero, zero, zero, zero)
        for block in range(n_blocks):
            start = block * comb.stride
            stop = min(start + comb.stride, comb.n_bins)
            if not bins[px.CUMULATIVE, stop] > bins[px.CUMULATIVE, start]:
                simd_store(rows, _DENSITY, start, zero + 1.0)
                continue
            cell, own = int(rows[_CELL, block]), int(rows[_OWN, block])
            left, right = coefficients[cell], coefficients[cell + 1]
            c = spliced(stop - start, simd_load(bins, px.WEIGHT, start), 0.0)
            y = counting() + (start - comb.zero)
            d, r, level = _lanes(block, own, cell, half, rows, ratios, most_ratio)
            # by Horner's rule: the polynomial, and its n-th derivatives over n!
            p2 = spliced(own, left[terms - 1], right[terms - 1])
            p1 = fused(p2, r, spliced(own, left[terms - 2], right[terms - 2]))
            p0 = fused(p1, r, spliced(own, left[terms - 3], right[terms - 3]))
            p1 = fused(p2, r, p1)
            rr = r * r
            if terms > 3:
                p3, p2, p1 = p2, fused(p2, r, p1), fused(p1, r, p0)
                p0 = fused(p0, r, spliced(own, left[terms - 4], right[terms - 4]))
                p4, p3, p2, p1 = p3, fused(p3, r, p2), fused(p2, r, p1), fused(p1, r, p0)
                p0 = fused(p0, r, spliced(own, left[terms - 5], right[terms - 5]))
                for k in range(terms - 6, -1, -1):
                    p4, p3 = fused(p4, r, p3), fused(p3, r, p2)
                    p2, p1 = fused(p2, r, p1), fused(p1, r, p0)
                    p0 = fused(p0, r, spliced(own, left[k], right[k]))
                s1, u2, u3, u4 = r * p1, rr * p2, rr * (r * p3), rr * (rr * p4)
                s3 = fused(u3, 6.0, fused(u2, 6.0, s1))
                s4 = fused(u4, 24.0, fused(u3, 36.0, fused(u2, 14.0, s1)))
            else:
                s1, u2 = r * p1, rr * p2
                s3, s4 = fused(u2, 6.0, s1), fused(u2, 14.0, s1)
            simd_store(rows, _DENSITY, start, p0)
            loglik = fused(c, fused(d * d, spread, level), loglik)
            sums = _add_moments(a, square, d, y, c, (p0, s1, fused(u2, 2.0, s1), s3, s4), sums)
        loglik = loglik + _weighted_logs(bins, rows, comb.n_bins)
        for place, value in enumerate((loglik, *sums)):
            rows[_TOTALS, place] = simd_sum(value)

    compiled: Callable[..., Any] = sums_of
    return compiled


sums_of_3 = _sums_kernel(3)
sums_of_5 = _sums_kernel(5)
sums_of_7 = _sums_kernel(7)
sums_of_9 = _sums_kernel(9)
sums_of_any = _sums_kernel(0)


@kernel(borrows=True)
def _loglik_alone(
    bins: FloatArray, comb: _Comb, n_blocks: int, rows: FloatArray, coefficients: FloatArray, frames: float
) -> float:
    """Return the log-likelihood; with ``frames``, leave instead the counts expected of all bins."""
    half, spread = comb.half, -0.5 * comb.inverse
    most_ratio, ratios = math.exp(_LONGEST / half), simd_exp(counting() * (comb.a * comb.inverse))
    loglik = counting() * 0.0
    for block in range(n_blocks):
        start = block * comb.stride
        stop = min(start + comb.stride, comb.n_bins)
        if frames == 0.0 and not bins[px.CUMULATIVE, stop] > bins[px.CUMULATIVE, start]:
            simd_store(rows, _DENSITY, start, counting() * 0.0 + 1.0)
            continue
        cell, own = int(rows[_CELL, block]), int(rows[_OWN, block])
        left, right = coefficients[cell], coefficients[cell + 1]
        d, r, level = _lanes(block, own, cell, half, rows, ratios, most_ratio)
        density = spliced(own, left[2 * half], right[2 * half])
        for k in range(2 * half - 1, -1, -1):
            density = fused(density, r, spliced(own, left[k], right[k]))
        level = fused(d * d, spread, level)
        if frames > 0.0:
            level = simd_exp(most(least(level, -LEAST_EXPONENT), LEAST_EXPONENT))
            simd_store(bins, px.EXPECTED, start, density * frames * level)
        else:
            c = spliced(stop - start, simd_load(bins, px.WEIGHT, start), 0.0)
            simd_store(rows, _DENSITY, start, density)
            loglik = fused(c, level, loglik)
    if frames == 0.0:
        loglik = loglik + _weighted_logs(bins, rows, comb.n_bins)
    return float(simd_sum(loglik))


@kernel(inline=True, borrows=True)
def _finish(
    facts: Any,
    log_exposure: float,
    a: float,
    bias: float,
    inverse: float,
    totals: FloatArray,
    out: FloatArray,
) -> None:
    """Turn the totals into a sample's block of an evaluation.

    The complete-data score is ``(k - H, k e/s2, e/s2, e^2/2 s2 - 1/2)`` with ``k = (y - e)/a``.
    """
    n = facts.n_frames
    score, sums = out[px.SCORE], out[px.SUMS]
    exposure = math.exp(log_exposure)
    t = a * inverse
    mean = facts.mean - bias
    sum_e, sum_ee, sum_ye = totals[_E], totals[_EE] + a * a * totals[_V11], totals[_YE]
    sum_k = (n * mean - sum_e) / a
    sum_ke = (sum_ye - sum_ee) / a
    sum_kk = (n * (facts.variance + mean * mean) - 2.0 * sum_ye + sum_ee) / (a * a)
    sums[px.SUM_K], sums[px.SUM_KK], sums[px.SUM_KE] = sum_k, sum_kk, sum_ke
    sums[px.SUM_E], sums[px.SUM_EE] = sum_e, sum_ee
    v11, v12, v22 = totals[_V11], totals[_V12], totals[_V22]
    cov01 = inverse * (v12 - totals[_V11Y])
    score[0] = sum_k - n * exposure
    score[1] = sum_ke * inverse
    score[2] = sum_e * inverse
    score[3] = 0.5 * (sum_ee * inverse - n)
    _fill_complete(n, n * exposure, inverse, out)
    out[px.INFORMATION, 0] = n * exposure - v11
    out[px.INFORMATION + 1, 0] = -cov01
    out[px.INFORMATION + 2, 0] = t * v11
    out[px.INFORMATION + 3, 0] = 0.5 * t * v12
    out[px.INFORMATION + 1, 1] = sum_kk * inverse - inverse * inverse * (
        totals[_V11YY] - 2.0 * totals[_V12Y] + v22
    )
    out[px.INFORMATION + 2, 1] = sum_k * inverse + t * cov01
    out[px.INFORMATION + 3, 1] = sum_ke * inverse - 0.5 * t * inverse * (totals[_V12Y] - v22)
    out[px.INFORMATION + 2, 2] = n * inverse - t * t * v11
    out[px.INFORMATION + 3, 2] = sum_e * inverse - 0.5 * t * t * v12
    out[px.INFORMATION + 3, 3] = 0.5 * sum_ee * inverse - 0.25 * t * t * v22


@kernel(borrows=True)
def _fill_complete(n: float, of_exposure: float, inverse: float, out: FloatArray) -> None:
    """Fill the complete-data information, of parameters whose electron numbers are known; lower triangle."""
    sums = out[px.SUMS]
    out[px.DAMPING, 0] = of_exposure
    for row in range(1, 4):
        out[px.DAMPING + row, 0] = 0.0
    out[px.DAMPING + 1, 1] = sums[px.SUM_KK] * inverse
    out[px.DAMPING + 2, 1] = sums[px.SUM_K] * inverse
    out[px.DAMPING + 2, 2] = n * inverse
    out[px.DAMPING + 3, 1] = sums[px.SUM_KE] * inverse
    out[px.DAMPING + 3, 2] = sums[px.SUM_E] * inverse
    out[px.DAMPING + 3, 3] = 0.5 * sums[px.SUM_EE] * inverse


@kernel(inline=True, borrows=True)
def _evaluate_sample(
    pixel: Pixel,
    sample: int,
    own: tuple[float, float, float, float],
    what: int,
    scratch: Scratch,
    out: FloatArray,
) -> float:
    """Evaluate one sample with electrons at its (log H, 1/g, mu - centre, log sigma^2)."""
    facts, bins = pixel.facts[sample], pixel.bins[sample]
    log_exposure, a, origin, log_variance = own
    n_bins, zero = facts.n_bins, origin - facts.first
    rows, coefficients = scratch.rows, scratch.coefficients
    exposure, inverse = math.exp(log_exposure), math.exp(-log_variance)
    j = max(0, math.floor(0.5 - zero / a))
    last = max(j, math.floor((n_bins - 1 - zero) / a + 0.5))
    dropped = _DROPPED_ALONE if what == px.LOGLIK_ALONE else _DROPPED
    half = _half_width(1.0 / math.sqrt(a * a * inverse), exposure, j, last, dropped)
    if last - j + 2 > coefficients.shape[0]:  # finer than any gain that is looked for
        return -math.inf
    stride = min(SIMD_WIDTH, math.ceil(a))
    n_blocks = (n_bins + stride - 1) // stride
    comb = _Comb(a, inverse, zero, j, last, half, n_bins, stride)
    constant = 0.5 * (half * half * a * a * inverse - log_variance - LOG_2PI) - exposure
    _fill_levels(rows, scratch.log_factorials, comb, log_exposure, constant)
    _fill_coefficients(coefficients, rows, comb)
    _fill_blocks(rows, comb, n_blocks)
    if what == px.LOGLIK_ALONE:
        return float(_loglik_alone(bins, comb, n_blocks, rows, coefficients, 0.0))
    if half == 1:
        sums_of_3(bins, comb, n_blocks, rows, coefficients)
    elif half == 2:
        sums_of_5(bins, comb, n_blocks, rows, coefficients)
    elif half == 3:
        sums_of_7(bins, comb, n_blocks, rows, coefficients)
    elif half == 4:
        sums_of_9(bins, comb, n_blocks, rows, coefficients)
    else:
        sums_of_any(bins, comb, n_blocks, rows, coefficients)
    if what == px.EXPECTATIONS:
        _loglik_alone(bins, comb, n_blocks, rows, coefficients, facts.n_frames)
    _finish(facts, log_exposure, a, origin, inverse, rows[_TOTALS], out)
    return float(rows[_TOTALS, _LOGLIK])


@kernel(inline=True, borrows=True)
def _evaluate_dark(
    pixel: Pixel, j: int, bias: float, log_variance: float, expect: bool, out: FloatArray
) -> float:
    """Evaluate a sample without electrons, one Gaussian."""
    facts, inverse = pixel.facts[j], math.exp(-log_variance)
    n, deviation = facts.n_frames, facts.mean - bias
    for row in range(px.N_ROWS):
        for column in range(px.N_BLOCK):
            out[row, column] = 0.0
    sum_e, sum_ee = n * deviation, n * (facts.variance + deviation * deviation)
    out[px.SUMS, px.SUM_E], out[px.SUMS, px.SUM_EE] = sum_e, sum_ee
    out[px.SCORE, 2] = sum_e * inverse
    out[px.SCORE, 3] = 0.5 * (sum_ee * inverse - n)
    _fill_complete(n, 0.0, inverse, out)
    for row in range(2, 4):
        for column in range(2, row + 1):
            out[px.INFORMATION + row, column] = out[px.DAMPING + row, column]
    if expect:
        sd = math.exp(0.5 * log_variance)
        for i in range(facts.n_bins):
            z = (facts.first + i - bias) / sd
            pixel.bins[j, px.EXPECTED, i] = n * math.exp(-0.5 * z * z) / (sd * math.sqrt(2.0 * math.pi))
    loglik: float = -0.5 * (n * (LOG_2PI + log_variance) + sum_ee * inverse)
    return loglik


def evaluate_density(pixel: Pixel, theta: FloatArray, what: int, scratch: Scratch, out: FloatArray) -> float:
    """Evaluate log-likelihood, score, observed information and E-step sums of all samples of a pixel.

    Args:
        pixel: histograms, with their moments.
        theta: parameters, shape (J + N_SHARED,).
        what: `LOGLIK_ALONE`, `DERIVATIVES`, or `EXPECTATIONS`, left of each DN in the pixel's ``bins``.
        scratch: room to work in.
        out: out, the evaluation; lower triangles of the matrices.
    """
    n = pixel.facts.shape[0]
    a, bias, log_variance = theta[n + px.STEP], theta[n + px.BIAS], theta[n + px.LOG_VARIANCE]
    loglik = 0.0
    for j in range(n):
        own_bias = bias - pixel.facts[j].centre
        if pixel.facts[j].dark:
            loglik += _evaluate_dark(pixel, j, own_bias, log_variance, what == px.EXPECTATIONS, out[j])
        else:
            own = theta[j], a, own_bias, log_variance
            loglik += _evaluate_sample(pixel, j, own, what, scratch, out[j])
    return loglik
