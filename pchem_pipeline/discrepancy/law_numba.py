"""Loops of :mod:`pchem_pipeline.discrepancy.tables`: the exact law of a pixel over its codes.

With ``K ~ Poisson(H)`` and ``x = round(mu + K / g + s Z)`` the conditional expectation of a product of a
Hermite polynomial of Z and a Charlier polynomial of K given the code x is closed form, because the integral
of ``He_a phi`` over a cell is ``-He_(a-1) phi`` between its edges. The columns of ``law`` hold ``sum_k P(k)
C_b(k) int_cell He_a phi`` for the products of :data:`COLUMNS`; column 0 (a = b = 0) is the mass itself.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["COLUMNS", "NOTHING", "N_COLUMNS", "N_NUISANCE", "N_TESTS", "fill_law", "supports", "within"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: (Hermite, Charlier) orders: 1, the four directions of the PCD's parameters, then the tests.
COLUMNS = (
    (0, 0), (0, 1), (1, 0), (1, 1), (2, 0),
    (0, 2), (0, 3), (3, 0), (4, 0), (2, 1), (1, 2), (2, 2), (3, 1),
)  # fmt: skip
N_NUISANCE = 5
N_TESTS = len(COLUMNS) - N_NUISANCE
N_COLUMNS = len(COLUMNS)
#: Standard deviations of the read noise that a peak reaches
REACH = 7.0
#: Probability below which a code carries no information on the shape
NOTHING = 1e-14


@njit(nogil=True, cache=True)
def electron_range(exposure: float, negligible: float) -> tuple[int, int]:
    """Return the smallest and largest electron number with at least the negligible probability."""
    mode = int(exposure)
    log_top = mode * math.log(exposure) - exposure - math.lgamma(mode + 1.0)
    last, log_p = mode, log_top
    while log_p > negligible:
        last += 1
        log_p += math.log(exposure / last)
    first, log_p = mode, log_top
    while first > 0 and log_p > negligible:
        log_p += math.log(first / exposure)
        first -= 1
    return first, last


@njit(nogil=True, cache=True)
def fill_law(
    exposure: float, step: float, offset: float, width: float, first: int, last: int, law: FloatArray
) -> None:
    """Fill ``law`` (code, column) of one pixel.

    Args:
        exposure: H, e-.
        step: 1/g, DN.
        offset: mu minus the DN of row 0, DN.
        width: analog read noise, DN.
        first: smallest electron number.
        last: largest electron number.
        law: to fill; its first dimension is the number of codes.
    """
    law[:] = 0.0
    n_codes = law.shape[0]
    root = math.sqrt(exposure)
    c2, c3 = math.sqrt(2.0) * exposure, math.sqrt(6.0) * exposure * root
    inverse = 1.0 / width
    log_h = math.log(exposure)
    for k in range(first, last + 1):
        weight = math.exp(k * log_h - exposure - math.lgamma(k + 1.0))
        d = k - exposure
        one = weight * d / root
        two = weight * (d * d - k) / c2
        three = weight * (d * d * d - 3.0 * k * d + 2.0 * k) / c3
        mean = offset + k * step
        start = max(0, math.ceil(mean - REACH * width))
        stop = min(n_codes - 1, math.floor(mean + REACH * width))
        z = (start - 0.5 - mean) * inverse
        tail = 0.5 * math.erfc(abs(z) * 0.7071067811865476)
        density = math.exp(-0.5 * z * z) * 0.3989422804014327
        for x in range(start, stop + 1):
            up = (x + 0.5 - mean) * inverse
            tail_up = 0.5 * math.erfc(abs(up) * 0.7071067811865476)
            density_up = math.exp(-0.5 * up * up) * 0.3989422804014327
            if z > 0.0:
                h0 = tail - tail_up
            elif up < 0.0:
                h0 = tail_up - tail
            else:
                h0 = 1.0 - tail - tail_up
            h1 = density - density_up
            h2 = z * density - up * density_up
            h3 = (z * z - 1.0) * density - (up * up - 1.0) * density_up
            h4 = z * (z * z - 3.0) * density - up * (up * up - 3.0) * density_up
            row = law[x]
            row[0] += weight * h0
            row[1] += one * h0
            row[2] += weight * h1
            row[3] += one * h1
            row[4] += weight * h2
            row[5] += two * h0
            row[6] += three * h0
            row[7] += weight * h3
            row[8] += weight * h4
            row[9] += one * h2
            row[10] += two * h1
            row[11] += two * h2
            row[12] += one * h3
            z, tail, density = up, tail_up, density_up


@njit(nogil=True, cache=True)
def supports(
    exposure: FloatArray,
    step: FloatArray,
    bias: FloatArray,
    width: FloatArray,
    log_negligible: float,
    electrons: IntArray,
    codes: IntArray,
) -> None:
    """Fill the ranges of electron numbers and of codes (n, 2) that the law of each pixel covers."""
    for p in range(exposure.size):
        first, last = electron_range(exposure[p], log_negligible)
        electrons[p, 0], electrons[p, 1] = first, last
        codes[p, 0] = math.floor(bias[p] + first * step[p] - REACH * width[p])
        codes[p, 1] = math.ceil(bias[p] + last * step[p] + REACH * width[p])


@njit(nogil=True, cache=True)
def within(law: FloatArray, n: float, allowed: float) -> tuple[int, int, float, float]:
    """Return the first and last code of the support, and what is expected below and above it."""
    low, below = 0, 0.0
    while low < law.shape[0] - 1 and n * (below + law[low, 0]) < allowed:
        below += law[low, 0]
        low += 1
    high, above = law.shape[0] - 1, 0.0
    while high > low and n * (above + law[high, 0]) < allowed:
        above += law[high, 0]
        high -= 1
    return low, high, n * below, n * above
