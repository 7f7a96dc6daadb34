"""Checks of the frame means as a time series: drift, periods, autocorrelation."""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.observe.laws import FAR, SLOWEST, best, chi_square
from pchem_pipeline.discrepancy.observe.sums import FEWEST_FRAMES
from pchem_pipeline.discrepancy.quick.checks import Check, check_of
from pchem_pipeline.model.arithmetic.robust import look_elsewhere, robust_sd

#: Frequencies on either side from which the noise around one is taken.
_AROUND = 64


def normal_p(z: float, *, two_sided: bool = False) -> float:
    """Return the probability that a normal deviate is larger (or larger in magnitude)."""
    return float(2.0 * special.ndtr(-abs(z)) if two_sided else special.ndtr(-z))


def series_checks(mean: FloatArray) -> list[Check]:
    """Return the checks of the frames' means over the same pixels, DN, (n,).

    White frame noise passes all of them.
    """
    n = mean.size
    if n < FEWEST_FRAMES:
        return []
    centre = float(np.median(mean))
    spread = max(robust_sd(mean, centre), 1e-300)
    series = np.clip(mean - centre, -FAR * spread, FAR * spread)
    series -= series.mean()
    # of frames two apart: neither a drift nor a difference of even and odd frames adds to it
    noise = float(np.mean((series[2:] - series[:-2]) ** 2)) / 2.0
    if not noise > 0:
        return []
    smooth, drift = _drift(series, noise)
    rest = series - smooth
    return [drift, _period(rest), _memory(rest)]


def _drift(series: FloatArray, noise: float) -> tuple[FloatArray, Check]:
    """Compute the slow part of a series and test it (Neyman's smooth test, adaptive: Fan 1996)."""
    n = series.size
    cuts = [k for k in SLOWEST if k <= n // 16]
    time = np.pi * (np.arange(n) + 0.5) / n
    waves = np.sqrt(2.0 / n) * np.cos(np.arange(1, cuts[-1] + 1)[:, None] * time)
    heights = waves @ series
    energy = np.cumsum(heights**2) / noise
    # the noise is itself an estimate, from n differences that overlap
    z = [float(chi_square(energy[k - 1], k, 2.0 * k + 3.0 * k * k / n)) for k in cuts]
    chosen = cuts[int(np.argmax(z))]
    smooth = heights[:chosen] @ waves[:chosen]
    p = normal_p(best(*z, independent=0.5 * (1 + len(z))))
    excess = max(float(energy[chosen - 1]) - chosen, 0.0) * noise / n
    peak = float(np.ptp(smooth))
    where = f"{peak:.2g} DN peak to peak"
    check = check_of("drift", p, math.sqrt(excess), limit=math.sqrt(16.0 * noise / n), where=where)
    return (smooth if p < 1e-3 else np.zeros(n)), check


def _period(series: FloatArray) -> Check:
    """Test the highest peak of the periodogram against its surroundings (F-test); the last one is at 1/2."""
    n = series.size
    power = np.abs(np.fft.rfft(series)[1:]) ** 2
    freedom = np.full(power.size, 2.0)
    freedom[n // 2 - 1 :] = 1.0 if n % 2 == 0 else 2.0
    around, width = _around(power)
    p = special.fdtrc(freedom, 2.0 * width, power / np.maximum(around, 1e-300))
    at = int(np.argmin(p))
    # a line between two frequencies spreads over those around it
    near = power[max(at - 2, 0) : at + 3]
    height = max(float(near.sum()) - near.size * float(around[at]), 0.0)
    words = f"period {n / (at + 1):.4g} frames" if freedom[at] == 2.0 else "even and odd frames differ"
    size = math.sqrt(freedom[at] * height) / n
    return check_of("period", look_elsewhere(float(p[at]), power.size), size, where=words)


def _around(power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean power around each frequency, itself left out, and of how many it is."""
    size = power.size
    total = np.concatenate([[0.0], np.cumsum(power)])
    index = np.arange(size)
    low, high = np.maximum(index - _AROUND, 0), np.minimum(index + _AROUND + 1, size)
    inner_low, inner_high = np.maximum(index - 1, 0), np.minimum(index + 2, size)
    count = (high - low) - (inner_high - inner_low)
    sums = total[high] - total[low] - total[inner_high] + total[inner_low]
    return np.maximum(sums, 0.0) / np.maximum(count, 1), np.maximum(count, 1).astype(np.float64)


def _memory(series: FloatArray) -> Check:
    """Test the lag-1 autocorrelation of the frame means."""
    n = series.size
    total = float(series @ series)
    correlation = float(series[1:] @ series[:-1]) / max(total, 1e-300) + 1.0 / n
    p = normal_p(correlation * math.sqrt(n), two_sided=True)
    return check_of("frame_lag", p, correlation, limit=5.7 / math.sqrt(n))
