"""Starting points in closed form, from the empirical characteristic function (ECF) and from cumulants.

``phi(f) = mean exp(2 pi i f y)`` of a PCD has ``log|phi| = -2 pi^2 f^2 sigma^2 - H (1 - cos 2 pi f a)`` and
the phase ``2 pi f m + H sin 2 pi f a`` (f in cycles/DN, ``a = 1/g``). Frequencies and steps are counted in
units of 1/sd and sd of the pixel: the side lobes then always have a width near 0.16.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.simd_numba import LANES, counting, fused, load_lanes, store_lanes
from pchem_pipeline.model.law.workspace_numba import Histogram

FREQUENCY_STEP = 0.1  # 1/sd: less than the width of a lobe
N_FREQUENCIES = 48  # up to 4.8/sd, the lobe of H = 22
N_FREQUENCIES_WIDE = 144  # up to 14.4/sd, the lobe of H = 200
LOBE_STEP = 0.05
LOBE_FIRST = 0.25  # lowest lobe frequency tried, 1/sd: the step a is at most 4 sd
N_LOBES = 90
_SIDE_BY_SIDE = 3  # vectors of frequencies at a time
_HIGHEST_FREQUENCY = 0.5  # cycles/DN: whole numbers cannot tell f from 1 - f

_TWO_PI = 2.0 * math.pi
_MIN_VARIANCE = 1.0 / 12.0


def regression_basis() -> NDArray[np.float64]:
    """Return ``1 - cos(2 pi f a)`` for every frequency f (rows) and every trial step a (columns)."""
    frequency = FREQUENCY_STEP * np.arange(1, N_FREQUENCIES + 1)
    lobe = LOBE_FIRST + LOBE_STEP * np.arange(N_LOBES)
    return np.asarray(1.0 - np.cos(_TWO_PI * frequency[:, None] / lobe[None, :]))


@kernel
def ecf_power(
    histogram: Histogram,
    step: float,
    n_frequencies: int,
    work: NDArray[np.float64],
) -> None:
    """Leave the squared modulus of the ECF at ``step * (1 ... n)`` in ``work[0]``.

    By Clenshaw's recurrence ``b_i = c_i + 2 cos(angle) b_{i+1} - b_{i+2}``, two DN at a time and all
    frequencies side by side; ``|sum c_i exp(i angle)|^2 = b_0^2 + b_1^2 - 2 cos(angle) b_0 b_1``.
    """
    weights, n_bins = histogram.weights, histogram.n_bins
    base = 2.0 * math.cos(_TWO_PI * step)
    before, present = 2.0, base
    for m in range(n_frequencies + _SIDE_BY_SIDE * LANES):
        work[1, m] = present
        before, present = present, base * present - before
    share = 1.0 / (histogram.n * histogram.n)
    for m in range(0, n_frequencies, _SIDE_BY_SIDE * LANES):
        turn1, turn2 = load_lanes(work, 1, m), load_lanes(work, 1, m + LANES)
        turn3 = load_lanes(work, 1, m + 2 * LANES)
        odd1 = odd2 = odd3 = counting() * 0.0
        even1 = even2 = even3 = odd1 + (weights[n_bins - 1] if n_bins % 2 == 1 else 0.0)
        for i in range(n_bins // 2 * 2 - 1, 0, -2):
            right, left = weights[i], weights[i - 1]
            odd1 = fused(turn1, even1, right - odd1)
            odd2 = fused(turn2, even2, right - odd2)
            odd3 = fused(turn3, even3, right - odd3)
            even1 = fused(turn1, odd1, left - even1)
            even2 = fused(turn2, odd2, left - even2)
            even3 = fused(turn3, odd3, left - even3)
        store_lanes(work, 0, m, share * (even1 * even1 + odd1 * odd1 - turn1 * even1 * odd1))
        store_lanes(work, 0, m + LANES, share * (even2 * even2 + odd2 * odd2 - turn2 * even2 * odd2))
        store_lanes(work, 0, m + 2 * LANES, share * (even3 * even3 + odd3 * odd3 - turn3 * even3 * odd3))


@kernel
def ecf_at(histogram: Histogram, frequency: float) -> tuple[float, float]:
    """Return modulus (unnormalised) and phase of the ECF at one frequency, cycles/DN."""
    weights = histogram.weights
    angle = _TWO_PI * frequency
    co, si = math.cos(angle * histogram.first), math.sin(angle * histogram.first)
    turn_c, turn_s = math.cos(angle), math.sin(angle)
    real = imag = 0.0
    for i in range(histogram.n_bins):
        real += weights[i] * co
        imag += weights[i] * si
        co, si = co * turn_c - si * turn_s, co * turn_s + si * turn_c
    return math.hypot(real, imag), math.atan2(imag, real)


@kernel
def _regress(
    basis: NDArray[np.float64],
    power: NDArray[np.float64],
    floor: float,
    sums: NDArray[np.float64],
) -> tuple[float, float]:
    """Return (lobe frequency in 1/sd, H) of the best weighted regression over all trial steps.

    The sums of all trial steps grow side by side, frequency by frequency: that needs no other order of the
    additions to run in vector registers.

    Args:
        basis: from `regression_basis`.
        power: squared modulus of the ECF; its frequencies are those of the basis.
        floor: power below which a frequency does not count.
        sums: scratch, three rows of at least `N_LOBES`.
    """
    bb, bq, by = sums[0, :N_LOBES], sums[1, :N_LOBES], sums[2, :N_LOBES]
    for p in range(N_LOBES):
        bb[p] = 0.0
        bq[p] = 0.0
        by[p] = 0.0
    qq = qy = 0.0
    for m in range(power.size):
        weight = power[m]
        if not weight > floor:
            continue
        f = FREQUENCY_STEP * (m + 1)
        quadratic = 0.5 * _TWO_PI * _TWO_PI * f * f
        target = -0.5 * math.log(min(weight, 1.0))
        weighted_q, weighted_y = weight * quadratic, weight * target
        qq += weighted_q * quadratic
        qy += weighted_q * target
        row = basis[m]
        for p in range(N_LOBES):
            b = row[p]
            bb[p] += weight * b * b
            bq[p] += weighted_q * b
            by[p] += weighted_y * b
    best, place = 0.0, -1
    best_exposure = 1.0
    before = after = last = 0.0
    for p in range(N_LOBES):
        determinant = qq * bb[p] - bq[p] * bq[p]
        gain = 0.0
        exposure = 0.0
        if determinant > 1e-9 * qq * bb[p]:
            exposure = (qq * by[p] - bq[p] * qy) / determinant
            noise = (bb[p] * qy - bq[p] * by[p]) / determinant
            if exposure > 0.0 and noise > 0.0:
                gain = exposure * by[p] + noise * qy
        if place == p - 1:
            after = gain
        if gain > best:
            best, place, before, best_exposure = gain, p, last, exposure
        last = gain
    if place < 0:
        return 0.0, 0.0
    lobe = LOBE_FIRST + LOBE_STEP * place
    bend = before - 2.0 * best + after
    if before > 0.0 and after > 0.0 and bend < 0.0:  # vertex of the parabola through the three best
        lobe += LOBE_STEP * 0.5 * (before - after) / bend
    return lobe, best_exposure


@kernel
def assemble(
    histogram: Histogram,
    a: float,
    exposure: float,
    theta: NDArray[np.float64],
) -> tuple[bool, bool]:
    """Turn a step and a rough H into a start: noise from the lobe's height, bias from its phase.

    Returns:
        Whether there is a start, and whether the lobe stands clear of the noise.
    """
    if not (a > 0.0 and math.isfinite(a) and exposure > 0.0 and math.isfinite(exposure)):
        return False, False
    _, _, _, _, n, mean, variance = histogram
    modulus, phase = ecf_at(histogram, 1.0 / a)
    modulus /= n
    s2 = max(variance - exposure * a * a, 0.16 * a * a)
    bias = mean - exposure * a
    clear = modulus > 3.0 / math.sqrt(n)
    if clear:
        s2 = -math.log(min(modulus, 0.999)) * a * a / (2.0 * math.pi * math.pi)
        from_variance = (variance - s2) / (a * a)
        if from_variance > 0.0:
            exposure = from_variance
        anchor = phase * a / _TWO_PI
        bias = anchor + a * math.floor((mean - exposure * a - anchor) / a + 0.5)
        if bias > mean - 0.01 * a:
            bias -= a * math.ceil((bias - mean + 0.01 * a) / a)
        # a lobe that leans on the centre, H < 1, has a phase of its own: trust it only to a few tenths
        if exposure < 0.5 and abs(mean - bias - exposure * a) > 0.2 * a:
            bias = mean - exposure * a
        exposure = (mean - bias) / a
    theta[0] = math.log(exposure)
    theta[1] = a
    theta[2] = bias
    theta[3] = math.log(min(max(s2, _MIN_VARIANCE, 0.0025 * a * a), max(variance, _MIN_VARIANCE)))
    return True, clear


@kernel
def start_regression(
    histogram: Histogram,
    basis: NDArray[np.float64],
    work: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> tuple[bool, bool]:
    """Start from the regression on log|phi|; ``work`` has seven rows.

    Returns:
        Whether there is a start, and whether the side lobe at its frequency stands clear of the noise.
    """
    n, variance = histogram.n, histogram.variance
    sd = math.sqrt(variance)
    n_used = min(N_FREQUENCIES, int(_HIGHEST_FREQUENCY * sd / FREQUENCY_STEP))
    ecf_power(histogram, FREQUENCY_STEP / sd, n_used, work)
    lobe, exposure = _regress(basis, work[0, :n_used], 9.0 / n, work[4:7])
    if lobe <= 0.0:
        return False, False
    answer: tuple[bool, bool] = assemble(histogram, sd / lobe, exposure, theta)
    return answer


@kernel
def start_peak(
    histogram: Histogram,
    work: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> bool:
    """Start from the highest side lobe of the ECF; False where none stands out of the noise."""
    n, variance = histogram.n, histogram.variance
    sd = math.sqrt(variance)
    ecf_power(histogram, FREQUENCY_STEP / sd, N_FREQUENCIES_WIDE, work)
    modulus = work[0]
    for m in range(N_FREQUENCIES_WIDE):
        modulus[m] = math.sqrt(max(modulus[m], 0.0))
    best, place = 3.0 / math.sqrt(n), -1
    highest = min(N_FREQUENCIES_WIDE - 1, int(_HIGHEST_FREQUENCY * sd / FREQUENCY_STEP) - 1)
    for m in range(1, highest):
        if modulus[m] > best and modulus[m] >= modulus[m - 1] and modulus[m] >= modulus[m + 1]:
            best, place = modulus[m], m
    if place < 0:
        return False
    left, right = modulus[place - 1], modulus[place + 1]
    bend = left - 2.0 * best + right
    vertex = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    a = sd / (FREQUENCY_STEP * (place + 1 + vertex))
    electron_noise = -math.log(min(best, 0.999)) / (2.0 * math.pi * math.pi)
    exposure = max(0.05, variance / (a * a) - electron_noise)
    found: bool = assemble(histogram, a, exposure, theta)[0]
    return found


@kernel
def start_cumulants(
    histogram: Histogram,
    theta: NDArray[np.float64],
) -> bool:
    """Start from the third and fourth cumulants, ``a = k4/k3`` and ``H = k3/a^3``; good below H = 1."""
    weights, _, n_bins, first, n, mean, variance = histogram
    third = fourth = 0.0
    for i in range(n_bins):
        d = first + i - mean
        third += weights[i] * d * d * d
        fourth += weights[i] * d * d * d * d
    third /= n
    fourth = fourth / n - 3.0 * variance * variance
    if third <= 0.0 or fourth <= 0.0:
        return False
    a = fourth / third
    exposure = third / (a * a * a)
    s2 = variance - exposure * a * a
    if s2 <= _MIN_VARIANCE:
        s2 = max(_MIN_VARIANCE, 0.05 * a * a)
        exposure = max(1e-3, (variance - s2) / (a * a))
    theta[0] = math.log(max(exposure, 1e-3))
    theta[1] = a
    theta[2] = mean - exposure * a
    theta[3] = math.log(s2)
    return math.isfinite(theta[1])
