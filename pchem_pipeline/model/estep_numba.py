"""One evaluation of a pixel's likelihood: E-step sums, score and Louis' observed information.

Internal parameters ``theta = (log H, a, m, log sigma^2)`` with ``a = 1/g`` and ``m = mu - centre`` (DN); the
values are counted from an integer ``centre`` near the pixel's mean, so that no moment cancels.

For the values nearest to component ``j``, with ``d = y - m - j a``, the components ``j + l`` weigh in as
``(P_{j+l} / P_j) exp(-l^2 a^2 / 2 sigma^2) r^l`` with ``r = exp(d a / sigma^2)``: a polynomial in ``r``, and
``r`` is a geometric sequence over successive DN. The posterior moments of ``l`` up to the fourth give the
score and ``sum_i c_i {E[I_c | x_i] - Cov(S | x_i)}`` (Louis 1982).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.workspace_numba import (
    LOGLIK,
    N_TOTAL,
    SUM_E,
    SUM_EE,
    SUM_K,
    SUM_KE,
    SUM_KK,
    Histogram,
    Workspace,
)

# Sums may be reassociated, so that they run in vector registers: the order is then fixed by the compiler, the
# same for every pixel and every batch. NaN and infinity keep their meaning.
_REORDER = {"reassoc", "nsz", "contract", "arcp"}

_DROPPED = 30.0  # nats below the nearest component at which a component is left out: exp(-30) = 1e-13
_LARGEST_RATIO = 1e145  # keeps r^2 finite when the peaks are needles

LOG_2PI = math.log(2.0 * math.pi)

# Places in `sums`, the sums over one block of values; c count, d offset from the block's lowest component,
# m1 and m2 posterior moments of i, v11 var(i), v12 cov(i, i^2), v22 var(i^2), i counted from that component


def _block_kernel(width: int) -> Callable[..., Any]:
    """Make the loop over the values of a block for a fixed number of components (0: given at run time)."""

    @nb.njit(nogil=True, cache=True, fastmath=_REORDER, error_model="numpy")
    def block_sums(
        weights: NDArray[np.float64],
        start: int,
        stop: int,
        offset: float,
        top_ratio: float,
        powers: NDArray[np.float64],
        prior: NDArray[np.float64],
        components: int,
        densities: NDArray[np.float64],
        sums: NDArray[np.float64],
    ) -> None:
        terms = width if width > 0 else components
        n = stop - start
        a0 = ad = add = b1 = b1d = b2 = 0.0
        v11 = v11d = v11dd = v12 = v12d = v22 = 0.0
        for i in range(n):
            c = weights[start + i]
            d = offset + i
            ratio = min(top_ratio * powers[n - 1 - i], _LARGEST_RATIO)
            power = 1.0
            s0 = prior[0]
            s1 = s2 = s3 = s4 = 0.0
            for k in range(1, terms):
                power = power * ratio
                term = prior[k] * power
                s0 += term
                s1 += k * term
                s2 += k * k * term
                s3 += k * k * k * term
                s4 += k * k * k * k * term
            densities[start + i] = s0
            inverse = 1.0 / s0
            m1, m2, m3, m4 = s1 * inverse, s2 * inverse, s3 * inverse, s4 * inverse
            cd = c * d
            e11, e12, e22 = m2 - m1 * m1, m3 - m1 * m2, m4 - m2 * m2
            a0 += c
            ad += cd
            add += cd * d
            b1 += c * m1
            b1d += cd * m1
            b2 += c * m2
            v11 += c * e11
            v11d += cd * e11
            v11dd += cd * d * e11
            v12 += c * e12
            v12d += cd * e12
            v22 += c * e22
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = a0, ad, add, b1, b1d, b2
        sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = v11, v11d, v11dd, v12, v12d, v22

    kernel: Callable[..., Any] = block_sums
    return kernel


block_sums_3 = _block_kernel(3)
block_sums_5 = _block_kernel(5)
block_sums_7 = _block_kernel(7)
block_sums_9 = _block_kernel(9)
block_sums_any = _block_kernel(0)


@nb.njit(nogil=True, cache=True)
def _half_width(electron_noise: float, exposure: float, first: int, last: int) -> int:
    """Return how many components matter on either side of the nearest one."""
    variance = electron_noise * electron_noise
    half = max(1, math.ceil(math.sqrt(2.0 * _DROPPED * variance + 0.25) - 0.5))
    if electron_noise > 0.5:  # the Poisson factor moves the largest term away from the nearest component
        tilt = max(abs(math.log(exposure / (first + 1.0))), abs(math.log(exposure / (last + 1.0))))
        half += math.ceil(variance * tilt)
    return half


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
def _add_block(
    sums: NDArray[np.float64],
    low: float,
    a: float,
    s2: float,
    total: NDArray[np.float64],
    cov: NDArray[np.float64],
) -> None:
    """Add one block to the totals and to the conditional covariance of the complete-data score."""
    a0, ad, add, b1, b1d, b2 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    v11, v11d, v11dd, v12, v12d, v22 = sums[6], sums[7], sums[8], sums[9], sums[10], sums[11]
    total[SUM_K] += low * a0 + b1
    total[SUM_KK] += low * low * a0 + 2.0 * low * b1 + b2
    total[SUM_KE] += low * ad + b1d - a * low * b1 - a * b2
    total[SUM_E] += ad - a * b1
    total[SUM_EE] += add - 2.0 * a * b1d + a * a * b2
    # S = const + alpha i + beta i^2: alpha = (1, u, -a/s2, -a d/s2), u = (d - a low)/s2; beta = (0, -a/s2,
    # 0, a^2/2 s2)
    t = a / s2
    low_a = low * a
    u11 = (v11d - low_a * v11) / s2
    cov[0, 0] += v11
    cov[0, 1] += u11 - t * v12
    cov[0, 3] += 0.5 * a * t * v12 - t * v11d
    cov[1, 1] += (
        (v11dd - 2.0 * low_a * v11d + low_a * low_a * v11) / (s2 * s2)
        - 2.0 * t * (v12d - low_a * v12) / s2
        + t * t * v22
    )
    cov[1, 3] += (
        -t * (v11dd - low_a * v11d) / s2
        + 0.5 * a * t * (v12d - low_a * v12) / s2
        + t * t * v12d
        - 0.5 * a * t * t * v22
    )
    cov[3, 3] += t * t * (v11dd - a * v12d + 0.25 * a * a * v22)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _finish(
    theta: NDArray[np.float64],
    n: float,
    total: NDArray[np.float64],
    score: NDArray[np.float64],
    information: NDArray[np.float64],
) -> None:
    """Turn the totals and conditional covariances into the score and Louis' observed information."""
    exposure, a, s2 = math.exp(theta[0]), theta[1], math.exp(theta[3])
    t = a / s2
    sum_k, sum_kk, sum_ke = total[SUM_K], total[SUM_KK], total[SUM_KE]
    sum_e, sum_ee = total[SUM_E], total[SUM_EE]
    score[0] = sum_k - n * exposure
    score[1] = sum_ke / s2
    score[2] = sum_e / s2
    score[3] = 0.5 * (sum_ee / s2 - n)
    cov00, cov01, cov03 = information[0, 0], information[0, 1], information[0, 3]
    information[0, 0] = n * exposure - cov00
    information[0, 1] = -cov01
    information[0, 2] = t * cov00
    information[0, 3] = -cov03
    information[1, 1] = sum_kk / s2 - information[1, 1]
    information[1, 2] = sum_k / s2 + t * cov01
    information[1, 3] = sum_ke / s2 - information[1, 3]
    information[2, 2] = n / s2 - t * t * cov00
    information[2, 3] = sum_e / s2 + t * cov03
    information[3, 3] = 0.5 * sum_ee / s2 - information[3, 3]
    for row in range(1, 4):
        for column in range(row):
            information[row, column] = information[column, row]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _sum_block(
    width: int,
    weights: NDArray[np.float64],
    start: int,
    stop: int,
    offset: float,
    top_ratio: float,
    powers: NDArray[np.float64],
    prior: NDArray[np.float64],
    densities: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Choose the loop compiled for this number of components."""
    if width == 3:
        block_sums_3(weights, start, stop, offset, top_ratio, powers, prior, 3, densities, sums)
    elif width == 5:
        block_sums_5(weights, start, stop, offset, top_ratio, powers, prior, 5, densities, sums)
    elif width == 7:
        block_sums_7(weights, start, stop, offset, top_ratio, powers, prior, 7, densities, sums)
    elif width == 9:
        block_sums_9(weights, start, stop, offset, top_ratio, powers, prior, 9, densities, sums)
    else:
        block_sums_any(weights, start, stop, offset, top_ratio, powers, prior, width, densities, sums)


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
    work, total, score, information = space
    exposure, a, origin, s2 = math.exp(theta[0]), theta[1], theta[2], math.exp(theta[3])
    densities, powers, prior = work[0], work[1], work[2]
    j = max(0, math.floor((first - origin) / a + 0.5))
    last = max(j, math.floor((first + n_bins - 1 - origin) / a + 0.5))
    half = _half_width(math.sqrt(s2) / a, exposure, j, last)
    width = min(2 * half + 1, prior.size)
    overlap = math.exp(-0.5 * a * a / s2)
    decay = math.exp(-a / s2)
    filled = 1
    powers[0] = 1.0
    sums = work[3]
    for i in range(4):
        for k in range(4):
            information[i, k] = 0.0
    for i in range(N_TOTAL):
        total[i] = 0.0
    log_prior = j * theta[0] - exposure - math.lgamma(j + 1.0)
    loglik: float = -0.5 * cumulative[n_bins] * (theta[3] + LOG_2PI)
    start = n_bins - n_bins  # 0 as a variable, lest a constant have its own compilation
    while start < n_bins:
        stop = min(n_bins, math.ceil(origin + (j + 0.5) * a - first))
        if j == last:
            stop = n_bins
        if stop > start and cumulative[stop] > cumulative[start]:
            while filled < stop - start:
                powers[filled] = powers[filled - 1] * decay
                filled += 1
            low = max(0, j - half)
            _fill_prior(prior, j, low, width, exposure, overlap)
            nearest = first + start - origin - j * a
            shift = (j - low) * a
            top = math.exp((nearest + stop - 1 - start) * a / s2)
            _sum_block(width, weights, start, stop, nearest + shift, top, powers, prior, densities, sums)
            logs = 0.0
            for i in range(start, stop):
                logs += weights[i] * math.log(densities[i])
            d1 = sums[1] - shift * sums[0]
            d2 = sums[2] - shift * (2.0 * sums[1] - shift * sums[0])
            loglik += logs + sums[0] * log_prior - 0.5 * d2 / s2 - shift * d1 / s2
            _add_block(sums, float(low), a, s2, total, information)
            if frames > 0.0:
                level = math.log(frames) + log_prior - 0.5 * (theta[3] + LOG_2PI)
                for i in range(start, stop):
                    d = nearest + (i - start)
                    densities[i] *= math.exp(level - (0.5 * d + shift) * d / s2)
        elif frames > 0.0:
            for i in range(start, stop):
                densities[i] = 0.0
        start = max(start, stop)
        j += 1
        log_prior += theta[0] - math.log(j)
    total[LOGLIK] = loglik
    _finish(theta, cumulative[n_bins], total, score, information)
    return loglik
