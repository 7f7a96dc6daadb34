"""Starting points: from the empirical characteristic function (ECF), and from several exposures.

``phi(f) = mean exp(2 pi i f y)`` of a PCD has ``log|phi| = -2 pi^2 f^2 sigma^2 - H (1 - cos 2 pi f a)`` and
the phase ``2 pi f m + H sin 2 pi f a`` (f in cycles/DN, ``a = 1/g``). Frequencies and steps are counted in
units of 1/sd and sd of the pixel: the side lobes then always have a width near 0.16.

Between exposures the photon-transfer relation ``var_j = sigma^2 + (mean_j - mu) / g`` gives 1/g as a slope
whatever the read noise; without a sample of no electrons the read noise that splits the intercept is
scanned. Where the peaks are resolved, the starts of the single samples are better.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import FEW_STEP, QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.simd_numba import SIMD_WIDTH, counting, fused, simd_load, simd_store
from pchem_pipeline.model.fit.climb_numba import LEAST_STEP, MIN_STEP, min_log_variance, same_place, sensible
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.pixel_numba import Pixel, Sample, Scratch, copy, sample_of

FREQUENCY_STEP = 0.1  # 1/sd: less than the width of a satellite
N_FREQUENCIES = 48  # up to 4.8/sd, the satellite of H = 22
LOBE_STEP = 0.05
LOBE_FIRST = 0.25  # lowest satellite frequency tried, 1/sd: the step a is at most 4 sd
N_LOBES = 90
_SIDE_BY_SIDE = 3  # vectors of frequencies at a time
_HIGHEST_FREQUENCY = 0.5  # cycles/DN: whole numbers cannot tell f from 1 - f

N_ATTEMPTS = 2  # the first start, then all steps of the comb; at several samples some starts, then all
#: Frequencies of the scan over the step of the comb: the first is 1 over the range of the sample, each is
#: larger than the one before by a share of itself, half the width of a narrow peak, or by a third of the
#: width of a side lobe, 0.16/sd, if that is less; the last is that of H = 200 e-, or of few DN per electron.
_SCAN_SHARE, _SCAN_STEP, _SCAN_END = 0.06, 0.05, 14.4
_CLEAR = 3.0  # standard errors of the modulus of the ECF, 1 / sqrt(N)
_UNRESOLVED = 1.1  # ratio of frequencies whose lobes are in the noise
_CENTRAL_LOBE = 0.75  # 1/sd: the central lobe of any sample has ended there
_SPARSE = 0.56  # e-^2, of a sample's variance: nine times 1/16, below which the regression finds no step
_COUNTED, _HELD = 20.0, 0.4  # samples of a peak
_FEW_NOISES = (0.07, 0.12, 0.2, 0.36)  # e-
_DIM = 0.7  # log H: aliases are lower by exp(-2 H) at least, 2 % of the lobe at H = 2 e-

_LINE_NOISES = (0.15, 0.22, 0.3, 0.38, 0.46, 0.55, 0.65, 0.8, 0.95, 1.15)  # e-
_LINE_SCALES = (1.0, 0.85, 1.18, 0.7, 1.4)  # of the slope of the line
_SMALLEST_EXPOSURE = 0.02


def regression_basis() -> FloatArray:
    """Return ``1 - cos(2 pi f a)`` for every frequency f (rows) and every trial step a (columns)."""
    frequency = FREQUENCY_STEP * np.arange(1, N_FREQUENCIES + 1)
    satellite = LOBE_FIRST + LOBE_STEP * np.arange(N_LOBES)
    return np.asarray(1.0 - np.cos(math.tau * frequency[:, None] / satellite[None, :]))


@kernel(borrows=True)
def _clenshaw(histogram: Sample, first: int, end: int, work: FloatArray) -> None:
    """Leave b_0 and b_1 of Clenshaw's recurrence in ``work[2:4]``, from 2 cos(angle) in ``work[1]``.

    ``b_i = c_i + 2 cos(angle) b_{i+1} - b_{i+2}``; then ``sum c_i exp(i angle) = b_0 - b_1 exp(-i angle)``.
    """
    weights, n_bins = histogram.bins[px.WEIGHT], histogram.facts.n_bins
    for m in range(first, end, _SIDE_BY_SIDE * SIMD_WIDTH):
        turn1, turn2 = simd_load(work, 1, m), simd_load(work, 1, m + SIMD_WIDTH)
        turn3 = simd_load(work, 1, m + 2 * SIMD_WIDTH)
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
        simd_store(work, 2, m, even1)
        simd_store(work, 2, m + SIMD_WIDTH, even2)
        simd_store(work, 2, m + 2 * SIMD_WIDTH, even3)
        simd_store(work, 3, m, odd1)
        simd_store(work, 3, m + SIMD_WIDTH, odd2)
        simd_store(work, 3, m + 2 * SIMD_WIDTH, odd3)


@kernel(borrows=True)
def ecf_power(histogram: Sample, step: float, n_frequencies: int, work: FloatArray) -> None:
    """Leave the squared modulus of the ECF at ``step * (1 ... n)`` in ``work[0]``."""
    base = 2.0 * math.cos(math.tau * step)
    before, present = 2.0, base
    for m in range(n_frequencies + _SIDE_BY_SIDE * SIMD_WIDTH):
        work[1, m] = present
        before, present = present, base * present - before
    _clenshaw(histogram, 0, n_frequencies, work)
    share = 1.0 / (histogram.facts.n_frames * histogram.facts.n_frames)
    for m in range(0, n_frequencies, SIMD_WIDTH):
        turn, even, odd = simd_load(work, 1, m), simd_load(work, 2, m), simd_load(work, 3, m)
        simd_store(work, 0, m, share * (even * even + odd * odd - turn * even * odd))


@kernel(borrows=True)
def ecf_at(histogram: Sample, frequency: float) -> tuple[float, float]:
    """Return modulus (unnormalised) and phase of the ECF at one frequency, cycles/DN."""
    weights, angle = histogram.bins[px.WEIGHT], math.tau * frequency
    turn_c, turn_s = math.cos(angle), math.sin(angle)
    c0, s0 = math.cos(angle * histogram.facts.first), math.sin(angle * histogram.facts.first)
    c1, s1 = c0 * turn_c - s0 * turn_s, c0 * turn_s + s0 * turn_c
    c2, s2 = c1 * turn_c - s1 * turn_s, c1 * turn_s + s1 * turn_c
    c3, s3 = c2 * turn_c - s2 * turn_s, c2 * turn_s + s2 * turn_c
    far_c, far_s = math.cos(4.0 * angle), math.sin(4.0 * angle)
    real = imag = 0.0
    whole = histogram.facts.n_bins // 4 * 4
    for i in range(0, whole, 4):  # four DN side by side: each waits for the one four before
        w0, w1, w2, w3 = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
        real += (w0 * c0 + w1 * c1) + (w2 * c2 + w3 * c3)
        imag += (w0 * s0 + w1 * s1) + (w2 * s2 + w3 * s3)
        c0, s0 = c0 * far_c - s0 * far_s, c0 * far_s + s0 * far_c
        c1, s1 = c1 * far_c - s1 * far_s, c1 * far_s + s1 * far_c
        c2, s2 = c2 * far_c - s2 * far_s, c2 * far_s + s2 * far_c
        c3, s3 = c3 * far_c - s3 * far_s, c3 * far_s + s3 * far_c
    for i in range(whole, histogram.facts.n_bins):
        real += weights[i] * c0
        imag += weights[i] * s0
        c0, s0 = c0 * turn_c - s0 * turn_s, c0 * turn_s + s0 * turn_c
    return math.hypot(real, imag), math.atan2(imag, real)


@kernel(borrows=True)
def _regress(basis: FloatArray, power: FloatArray, floor: float, sums: FloatArray) -> tuple[float, float]:
    """Return (satellite frequency in 1/sd, H) of the best weighted regression over all trial steps.

    The power is the squared modulus of the ECF at the frequencies of `regression_basis`; those below the
    floor do not count. ``sums`` is room to work in, three rows.
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
        quadratic = 0.5 * math.tau * math.tau * f * f
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
    satellite = LOBE_FIRST + LOBE_STEP * place
    bend = before - 2.0 * best + after
    if before > 0.0 and after > 0.0 and bend < 0.0:  # vertex of the parabola through the three best
        satellite += LOBE_STEP * 0.5 * (before - after) / bend
    return satellite, best_exposure


@kernel(borrows=True)
def assemble(histogram: Sample, a: float, exposure: float, theta: FloatArray) -> tuple[bool, bool]:
    """Turn a step and a rough H into a start; return whether there is one, and whether its lobe is clear."""
    if not (a > 0.0 and math.isfinite(a) and exposure > 0.0 and math.isfinite(exposure)):
        return False, False
    clear: bool = _on_lobe(histogram, a, exposure, ecf_at(histogram, 1.0 / a), theta)
    return True, clear


@kernel(borrows=True)
def _on_lobe(
    histogram: Sample, a: float, exposure: float, lobe: tuple[float, float], theta: FloatArray
) -> bool:
    """Fill a start from modulus (unnormalised) and phase of the ECF at 1/a; return whether it is clear."""
    facts = histogram.facts
    n, mean, variance = facts.n_frames, facts.mean, facts.variance
    modulus, phase = lobe[0] / n, lobe[1]
    least = _CLEAR / math.sqrt(n)
    clear = modulus > least
    noise2 = -math.log(min(max(modulus, least), 0.999)) / (2.0 * math.pi * math.pi)
    if not clear:  # the lobe is in the noise: s_e is at least so large
        noise2 = min(max(variance / (a * a) - exposure, noise2), variance / (a * a))
    s2 = noise2 * a * a
    exposure = max((variance - s2) / (a * a), 1e-3)
    bias = mean - exposure * a
    if clear:
        anchor = phase * a / math.tau
        bias = anchor + a * math.floor((mean - exposure * a - anchor) / a + 0.5)
        if bias > mean - 0.01 * a:
            bias -= a * math.ceil((bias - mean + 0.01 * a) / a)
        # a satellite that leans on the centre, H < 1, has a phase of its own: trust it only to a few tenths
        if exposure < 0.5 and abs(mean - bias - exposure * a) > 0.2 * a:
            bias = mean - exposure * a
        exposure = (mean - bias) / a
    theta[0] = math.log(exposure)
    theta[1] = a
    theta[2] = bias
    theta[3] = math.log(
        min(max(s2, QUANTISATION_VARIANCE, 0.0025 * a * a), max(variance, QUANTISATION_VARIANCE))
    )
    return bool(clear)


@kernel(borrows=True)
def start_regression(
    histogram: Sample, basis: FloatArray, work: FloatArray, theta: FloatArray
) -> tuple[bool, bool]:
    """Start from the regression on log|phi|, see `assemble`; ``work`` has seven rows."""
    n, variance = histogram.facts.n_frames, histogram.facts.variance
    sd = math.sqrt(variance)
    n_used = min(N_FREQUENCIES, int(_HIGHEST_FREQUENCY * sd / FREQUENCY_STEP))
    ecf_power(histogram, FREQUENCY_STEP / sd, n_used, work)
    satellite, exposure = _regress(basis, work[0, :n_used], 9.0 / n, work[4:7])
    if satellite <= 0.0:
        return False, False
    answer: tuple[bool, bool] = assemble(histogram, sd / satellite, exposure, theta)
    return answer


@kernel(borrows=True)
def _keep_noises(pixel: Pixel, evaluate: Any, a: float, around: int, scratch: Scratch) -> None:
    """Put combs of a step, a few DN, among the starts of a single sample.

    Some read noises are tried, and exposures, so many to either side of the one that has the variance right.
    """
    histogram, trial = sample_of(pixel, 0), scratch.small[px.HERE]
    trial[1 + px.STEP], trial[1 + px.SATELLITE] = a, 0.0
    for noise in _FEW_NOISES:
        middle = (histogram.facts.variance - QUANTISATION_VARIANCE) / (a * a) - noise * noise
        trial[1 + px.LOG_VARIANCE] = max(2.0 * math.log(noise * a), min_log_variance(a, True))
        for place in range(-around, around + 1):
            exposure = middle + 0.2 * place
            if exposure > 1e-3:
                trial[0], trial[1 + px.BIAS] = math.log(exposure), histogram.facts.mean - exposure * a
                keep_start(pixel, evaluate, True, scratch)


@kernel(borrows=True)
def _keep_lobe(
    pixel: Pixel, evaluate: Any, cells: bool, a: float, lobe: tuple[float, float], scratch: Scratch
) -> None:
    """Put the comb of a step among the starts.

    Of few DN per electron and a low H other frequencies add to the lobe; there some read noises are tried.
    """
    histogram, trial = sample_of(pixel, 0), scratch.small[px.HERE]
    trial[1 + px.SATELLITE] = 0.0
    _on_lobe(histogram, a, math.inf, lobe, trial)
    if cells:
        analog = max(math.exp(trial[1 + px.LOG_VARIANCE]) - QUANTISATION_VARIANCE, 1e-6)
        trial[1 + px.LOG_VARIANCE] = max(math.log(analog), min_log_variance(a, cells))
    keep_start(pixel, evaluate, cells, scratch)
    if cells and a < FEW_STEP and trial[0] < _DIM:
        _keep_noises(pixel, evaluate, a, 0, scratch)


@kernel(borrows=True)
def scan_steps(pixel: Pixel, evaluate: Any, cells: bool, scratch: Scratch) -> None:
    """Put the likeliest combs of any step among the starts of a single sample.

    ``phi(1/a) = exp(-2 pi^2 s^2) exp(2 pi i mu / a)`` for a comb of step a and read noise s (e-), whatever H
    is: modulus and phase give s and mu, mean and variance H. A step of more than the range of the sample
    leaves no second peak, one of a few DN below ``sd / 14`` has H > 200 e-; between them the frequencies are
    closer than the likelihood's maxima. Past the central lobe few are tried of those that stay in the noise,
    ``3 / sqrt(N)``.
    """
    histogram, work = sample_of(pixel, 0), scratch.rows
    no_starts(scratch.small[px.HEIGHTS])
    first, sd = work.shape[1] - px.SCANNED, math.sqrt(histogram.facts.variance)
    highest = min(max(_SCAN_END / sd, 1.0 / FEW_STEP), 1.0 / (LEAST_STEP if cells else MIN_STEP))
    end, frequency = first, 1.0 / (histogram.facts.n_bins + 1.0)
    while frequency < highest and end < work.shape[1] - _SIDE_BY_SIDE * SIMD_WIDTH:
        work[0, end], work[1, end] = frequency, 2.0 * math.cos(math.tau * frequency)
        frequency += min(_SCAN_SHARE * frequency, _SCAN_STEP / sd)
        end += 1
    for m in range(end, work.shape[1]):
        work[1, m] = 0.0
    _clenshaw(histogram, first, end, work)
    last = 0.0
    for m in range(first, end):
        frequency = work[0, m]
        real = work[2, m] - 0.5 * work[3, m] * work[1, m]
        imaginary = work[3, m] * math.sin(math.tau * frequency)
        lobe = (
            math.hypot(real, imaginary),
            math.atan2(imaginary, real) + math.tau * frequency * histogram.facts.first,
        )
        central, clear = (
            frequency * sd < _CENTRAL_LOBE,
            lobe[0] > _CLEAR * math.sqrt(histogram.facts.n_frames),
        )
        if central or clear or frequency > _UNRESOLVED * last:
            last = frequency
            _keep_lobe(pixel, evaluate, cells, 1.0 / frequency, lobe, scratch)


@kernel(borrows=True)
def no_starts(heights: FloatArray) -> None:
    """Forget all starts."""
    for i in range(px.N_KEPT):
        heights[i] = -math.inf


@kernel(borrows=True)
def _keep_rescaled(
    pixel: Pixel, evaluate: Any, cells: bool, best: FloatArray, factor: float, scratch: Scratch
) -> None:
    """Put a maximum among the starts with a longer step and the same means, bias and read noise in DN."""
    n, trial = pixel.facts.shape[0], scratch.small[px.HERE]
    copy(best, trial)
    trial[n + px.STEP] *= factor
    trial[n + px.LOG_VARIANCE] = max(trial[n + px.LOG_VARIANCE], min_log_variance(trial[n + px.STEP], cells))
    for j in range(n):
        trial[j] -= math.log(factor)
    keep_start(pixel, evaluate, cells, scratch)


@kernel(borrows=True)
def alias_of_step(pixel: Pixel, evaluate: Any, best: FloatArray, scratch: Scratch) -> None:
    """Put the comb of frequency ``1 - 1/a``, which whole numbers show at 1/a, among the starts."""
    no_starts(scratch.small[px.HEIGHTS])
    n, cells = pixel.facts.shape[0], True
    a = 1.0 / (1.0 - 1.0 / best[n + px.STEP])
    if n > 1:
        _keep_rescaled(pixel, evaluate, cells, best, a / best[n + px.STEP], scratch)
    else:
        _keep_lobe(pixel, evaluate, cells, a, ecf_at(sample_of(pixel, 0), 1.0 / a), scratch)


@kernel(borrows=True)
def combs_of_step(pixel: Pixel, evaluate: Any, a: float, scratch: Scratch) -> None:
    """Put the likeliest combs of a few DN per electron, of one step, among the starts; see `_keep_noises`."""
    no_starts(scratch.small[px.HEIGHTS])
    _keep_noises(pixel, evaluate, a, 2, scratch)


@kernel(borrows=True)
def _holds_one(histogram: Sample, theta: FloatArray) -> bool:
    """Return whether more than 0.4 of the samples expected in the peak of one electron are near it."""
    exposure, a, noise = math.exp(theta[0]), theta[1], math.exp(0.5 * theta[3])
    facts, cumulative = histogram.facts, histogram.bins[px.CUMULATIVE]
    empty = facts.n_frames * math.exp(-exposure)
    middle = theta[2] + a - facts.first
    low = min(max(int(middle - 0.25 * a + 1.0), 0), facts.n_bins)
    high = min(max(int(middle + 0.25 * a + 1.0), low), facts.n_bins)
    tail = 0.5 * empty * math.erfc(0.75 * a / noise / math.sqrt(2.0))
    seen = cumulative[high] - cumulative[low] - tail
    return bool(empty * exposure > _COUNTED and seen > _HELD * empty * exposure)


@kernel(borrows=True)
def longer_steps(
    pixel: Pixel, evaluate: Any, poor: bool, best: FloatArray, least: float, scratch: Scratch
) -> None:
    """Put combs of longer steps than a maximum's among the starts.

    Where H and read noise are low, the comb of half the step fits them with no sample at each second peak,
    unless the peak of one electron is there. Several samples that fit poorly may have such a comb at any
    exposure. Starts below ``least`` are left out.
    """
    cells = False
    histogram, heights = sample_of(pixel, 0), scratch.small[px.HEIGHTS]
    no_starts(heights)
    n = pixel.facts.shape[0]
    a = best[n + px.STEP]
    for j in range(n):
        if not (pixel.facts[j].variance < _SPARSE * a * a or (n > 1 and poor)):
            return
    if n == 1 and _holds_one(histogram, best):
        return
    for multiple in (1.3, 1.6, 2.0, 2.5, 3.0, 4.0, 5.0):
        if n == 1 and multiple * a < histogram.facts.n_bins:
            lobe = ecf_at(histogram, 1.0 / (multiple * a))
            _keep_lobe(pixel, evaluate, cells, multiple * a, lobe, scratch)
        elif n > 1:
            _keep_rescaled(pixel, evaluate, cells, best, multiple, scratch)
    for i in range(px.N_KEPT):
        if heights[i] < least:
            heights[i] = -math.inf


@kernel(borrows=True)
def fill_theta(pixel: Pixel, a: float, bias: float, noise2: float, cells: bool, theta: FloatArray) -> bool:
    """Fill ``theta`` for a step, DN, a bias less the centre, DN, and sigma^2, DN^2: exposures from the means.

    A negative sigma^2 is what the variances leave. Return whether that makes sense.
    """
    if not (a > 0.0 and math.isfinite(a) and math.isfinite(bias)):
        return False
    n_samples = pixel.facts.shape[0]
    n = rest = 0.0
    brightest = 0.0
    for j in range(n_samples):
        facts = pixel.facts[j]
        exposure = 0.0
        if not facts.dark:
            exposure = max((facts.centre + facts.mean - bias) / a, _SMALLEST_EXPOSURE)
        brightest = max(brightest, exposure)
        theta[j] = math.log(max(exposure, 1e-6))
        weight = facts.n_frames / (1.0 + exposure)
        rest += weight * (facts.variance - exposure * a * a)
        n += weight
    if noise2 < 0.0:
        noise2 = max(rest / n, 0.02 * a * a)
    theta[n_samples + px.STEP] = a
    theta[n_samples + px.BIAS] = bias
    theta[n_samples + px.LOG_VARIANCE] = max(math.log(max(noise2, 1e-6)), min_log_variance(a, cells))
    theta[n_samples + px.SATELLITE] = 0.0
    return brightest > _SMALLEST_EXPOSURE


@kernel(borrows=True)
def variance_line(pixel: Pixel) -> tuple[float, float, float]:
    """Return the slope of the variances against the means, and the point (mean, variance) that it is through.

    Weighted by the inverse variance of a variance near a normal law. The slope is 0 where the means do not
    differ.
    """
    weight_sum = x_sum = y_sum = 0.0
    for j in range(pixel.facts.shape[0]):
        facts = pixel.facts[j]
        weight = facts.n_frames / max(facts.variance**2, 1e-6)
        weight_sum += weight
        x_sum += weight * (facts.centre + facts.mean)
        y_sum += weight * facts.variance
    x0, y0 = x_sum / weight_sum, y_sum / weight_sum
    xx = xy = 0.0
    for j in range(pixel.facts.shape[0]):
        facts = pixel.facts[j]
        weight = facts.n_frames / max(facts.variance**2, 1e-6)
        x = facts.centre + facts.mean - x0
        xx += weight * x * x
        xy += weight * x * (facts.variance - y0)
    return (xy / xx if xx > 0.0 else 0.0), x0, y0


@kernel(borrows=True)
def _line_start(
    scale: float,
    noise: float,
    first: bool,
    pixel: Pixel,
    line: tuple[float, float, float],
    cells: bool,
    theta: FloatArray,
) -> bool:
    """Fill ``theta`` with a start on the line of variance against mean, at a read noise in e-."""
    slope, x0, y0 = line
    a = slope * scale
    if not a > 0.0:
        return False
    noise2 = (noise * a) ** 2
    bias = x0 - (y0 - noise2) / a
    for j in range(pixel.facts.shape[0]):
        if pixel.facts[j].dark:  # it knows bias and read noise by itself
            if not first:
                return False
            bias = pixel.facts[j].centre + pixel.facts[j].mean
            noise2 = pixel.facts[j].variance
    answer: bool = fill_theta(pixel, a, bias, noise2, cells, theta)
    return answer


@kernel(borrows=True)
def _regression_start(
    j: int, pixel: Pixel, basis: FloatArray, scratch: Scratch, theta: FloatArray
) -> tuple[bool, bool]:
    """Fill ``theta`` with the start from the regression of sample j, see `assemble`."""
    facts = pixel.facts
    if facts[j].dark or facts[j].occupied < 3:
        return False, False
    own = scratch.small[px.OTHER]
    found, clear = start_regression(sample_of(pixel, j), basis, scratch.rows, own)
    if not found:
        return False, False
    bias = facts[j].centre + own[2]
    noise2 = math.exp(own[3])
    for i in range(facts.shape[0]):
        if facts[i].dark:
            bias = facts[i].centre + facts[i].mean
            noise2 = facts[i].variance
    return fill_theta(pixel, own[1], bias, noise2, False, theta), clear


@kernel(borrows=True)
def keep_start(pixel: Pixel, evaluate: Any, cells: bool, scratch: Scratch) -> None:
    """Put the start `HERE` among the likeliest, which lie apart."""
    trial, kept, heights = (
        scratch.small[px.HERE],
        scratch.small[px.KEPT_STARTS : px.HEIGHTS],
        scratch.small[px.HEIGHTS],
    )
    if not sensible(trial, pixel.longest_step, cells):
        return
    scratch.used[0] += 1
    loglik: float = evaluate(pixel, trial, px.LOGLIK_ALONE, scratch, scratch.evaluations[px.AT])
    place, few = -1, np.bool_(cells and trial[pixel.facts.shape[0] + px.STEP] < FEW_STEP)
    for i in range(px.N_KEPT):
        if heights[i] > -math.inf and same_place(kept[i], trial, few):
            if loglik <= heights[i]:
                return
            place = i
            break
    if place < 0:
        place = 0
        for i in range(1, px.N_KEPT):
            if heights[i] < heights[place]:
                place = i
        if loglik <= heights[place]:
            return
    heights[place] = loglik
    copy(trial, kept[place])


@kernel(borrows=True)
def fill_starts(
    attempt: int, quick: bool, pixel: Pixel, basis: FloatArray, evaluate: Any, scratch: Scratch
) -> bool:
    """Fill the starts of an attempt from `KEPT_STARTS` on, and their `HEIGHTS`: -inf where there are fewer.

    ``quick``: the first start of a single sample is taken although its side lobe is in the noise. Return
    whether a side lobe of one of several samples stands clear of it.
    """
    n_samples, any_clear = pixel.facts.shape[0], False
    trial, heights = scratch.small[px.HERE], scratch.small[px.HEIGHTS]
    no_starts(heights)
    if n_samples == 1:
        if attempt > 0:
            scan_steps(pixel, evaluate, False, scratch)
            return False
        start = scratch.small[px.KEPT_STARTS]
        start[1 + px.SATELLITE] = trial[1 + px.SATELLITE] = 0.0
        found, clear = start_regression(sample_of(pixel, 0), basis, scratch.rows, start)
        if clear or (quick and found):
            heights[0] = 0.0
        return False
    for j in range(n_samples):
        found, clear = _regression_start(j, pixel, basis, scratch, trial)
        any_clear = any_clear or (found and clear)
        if found:
            keep_start(pixel, evaluate, False, scratch)
    if attempt > 0 or not any_clear:
        add_line_starts(pixel, evaluate, False, attempt > 0, scratch)
    return any_clear


@kernel(borrows=True)
def add_line_starts(pixel: Pixel, evaluate: Any, cells: bool, thorough: bool, scratch: Scratch) -> None:
    """Put starts on the line of variance against mean among the likeliest."""
    line, trial = variance_line(pixel), scratch.small[px.HERE]
    for scale in _LINE_SCALES:
        if scale != 1.0 and not thorough:
            break
        for place in range(len(_LINE_NOISES)):
            if _line_start(scale, _LINE_NOISES[place], place == 0, pixel, line, cells, trial):
                keep_start(pixel, evaluate, cells, scratch)
