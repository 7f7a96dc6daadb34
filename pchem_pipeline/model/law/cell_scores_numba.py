"""The probability of a code, and its products with Hermite and Charlier polynomials of noise and electrons.

With ``K ~ Poisson(H)`` and ``x = round(mu + K / g + s Z)`` the conditional expectation of a product of a
Hermite polynomial of Z and a Charlier polynomial of K given the code x is closed form, because the integral
of ``He_a phi`` over a cell is ``-He_(a-1) phi`` between its edges. The columns of ``law`` hold ``sum_k P(k)
C_b(k) int_cell He_a phi`` for the products of :data:`COLUMNS`; column 0 (a = b = 0) is the mass itself.
"""

from __future__ import annotations

import math

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.normal_numba import normal_mass

#: (Hermite, Charlier) orders: 1, the four directions of the PCD's parameters, then the tests.
COLUMNS = (
    (0, 0), (0, 1), (1, 0), (1, 1), (2, 0),
    (0, 2), (0, 3), (3, 0), (4, 0), (2, 1), (1, 2), (2, 2), (3, 1),
)  # fmt: skip
N_NUISANCE = 5
N_COLUMNS = len(COLUMNS)
#: Standard deviations of the read noise that a peak reaches
REACH = 7.5
_SHORTEST_REACH = 2.0
# DN per read noise: cells narrower than this are integrated by a series, to 1e-4 at five deviations
_NARROW = 0.7


@kernel
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


@kernel
def _add_peak(
    weight: float,
    one: float,
    two: float,
    three: float,
    mean: float,
    width: float,
    reach: float,
    law: FloatArray,
) -> None:
    """Add the peak of one electron number: ``weight`` and its products with the Charlier polynomials."""
    start = max(0, math.ceil(mean - reach * width))
    stop = min(law.shape[0] - 1, math.floor(mean + reach * width))
    cell = 1.0 / width
    narrow = cell <= _NARROW
    c2, c4, c6 = cell**2 / 24.0, cell**4 / 1920.0, cell**6 / 322560.0
    z = (start - 0.5 - mean) * cell
    # the density at edges and middles of the cells, by the ratio of successive values, itself geometric
    half = 0.5 * cell
    density = math.exp(-0.5 * z * z) * 0.3989422804014327
    ratio, shrink = math.exp(-half * (z + 0.5 * half)), math.exp(-half * half)
    edge1, edge2 = density, z * density
    edge3, edge4 = (z * z - 1.0) * density, z * (z * z - 3.0) * density
    for x in range(start, stop + 1):
        density *= ratio
        ratio *= shrink
        up = (x + 0.5 - mean) * cell
        if narrow:
            # the mean over the cell by the even derivatives in its middle, which are Hermite polynomials
            t = (up - half) ** 2
            series = 1.0 + c2 * (t - 1.0) + c4 * (t * (t - 6.0) + 3.0)
            h0 = cell * density * (series + c6 * (t * (t * (t - 15.0) + 45.0) - 15.0))
        else:
            h0 = normal_mass(up - cell, up)
        density *= ratio
        ratio *= shrink
        t = up * up
        up1, up2 = density, up * density
        up3, up4 = (t - 1.0) * density, (t - 3.0) * up2
        h1, h2, h3 = edge1 - up1, edge2 - up2, edge3 - up3
        row = law[x]
        row[0] += weight * h0
        row[1] += one * h0
        row[2] += weight * h1
        row[3] += one * h1
        row[4] += weight * h2
        row[5] += two * h0
        row[6] += three * h0
        row[7] += weight * h3
        row[8] += weight * (edge4 - up4)
        row[9] += one * h2
        row[10] += two * h1
        row[11] += two * h2
        row[12] += one * h3
        edge1, edge2, edge3, edge4 = up1, up2, up3, up4


@kernel
def fill_law(
    exposure: float, step: float, offset: float, width: float, first: int, last: int, law: FloatArray
) -> None:
    """Fill ``law`` (code, column) of one pixel, of electron numbers from first to last.

    The step is 1/g, the offset mu minus the DN of row 0, the width the analog read noise, all in DN.
    """
    for i in range(law.shape[0]):  # a slice takes numba ten times as long to compile
        for j in range(law.shape[1]):
            law[i, j] = 0.0
    root = math.sqrt(exposure)
    c2, c3 = math.sqrt(2.0) * exposure, math.sqrt(6.0) * exposure * root
    log_h = math.log(exposure)
    for k in range(first, last + 1):
        log_weight = k * log_h - exposure - math.lgamma(k + 1.0)
        weight = math.exp(log_weight)
        d = k - exposure
        # beyond, the density is below that of a likely peak at the same distance
        reach = math.sqrt(max(REACH * REACH + 2.0 * log_weight, _SHORTEST_REACH**2))
        _add_peak(
            weight,
            weight * d / root,
            weight * (d * d - k) / c2,
            weight * (d * d * d - 3.0 * k * d + 2.0 * k) / c3,
            offset + k * step,
            width,
            reach,
            law,
        )
