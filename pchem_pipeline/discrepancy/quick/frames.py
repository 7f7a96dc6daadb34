"""Checks of single frames and of their means as a series: exposures, odd frames, drift, periods, memory.

Of several exposures, such as dark and light frames in one folder, the means form separate levels, and the
variance over their pixels grows with the mean like shot noise. A jump of the offset separates the means only.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage, special

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.laws import FAR, SLOWEST, best, chi_square
from pchem_pipeline.discrepancy.observe.sums import FEWEST_FRAMES
from pchem_pipeline.discrepancy.quick.checks import Check, check_of
from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.model.arithmetic.significance import CERTAIN
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere, robust_sd
from pchem_pipeline.model.histogram import odd_frames

#: Frames of a level, at least, and as a share of all.
_FEWEST_OF_LEVEL, _LEAST_SHARE = 4, 0.01
#: Growth of the variance with the mean, as a share of that of shot noise; an offset has none.
_SHOT_SHARE = 0.25
_MOST_LEVELS = 8
_SHOWN = 3
#: Frequencies on either side, but for the next ones, from which the noise around one is taken.
_AROUND = 64


def normal_p(z: float, *, two_sided: bool = False) -> float:
    """Return the probability that a normal deviate is larger (or larger in magnitude)."""
    return float(2.0 * special.ndtr(-abs(z)) if two_sided else special.ndtr(-z))


def series_checks(mean: FloatArray) -> list[Check]:
    """Return the checks of the frames' means over the same pixels, DN, (n,); white noise passes them."""
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
    beside = np.ones(2 * _AROUND + 1)
    beside[_AROUND - 1 : _AROUND + 2] = 0.0
    total, width = (
        ndimage.convolve1d(each, beside, mode="constant") for each in (power, np.ones(power.size))
    )
    around = total / width
    p = special.fdtrc(freedom, 2.0 * width, power / np.maximum(around, 1e-300))
    at = int(np.argmin(p))
    # a line between two frequencies spreads over those around it
    near = power[max(at - 2, 0) : at + 3]
    height = max(float(near.sum()) - near.size * float(around[at]), 0.0)
    words = f"period {n / (at + 1):.4g} frames" if freedom[at] == 2.0 else "even and odd frames differ"
    size = math.sqrt(freedom[at] * height) / n
    return check_of("period", look_elsewhere(float(p[at]), power.size), size, where=words)


def _memory(series: FloatArray) -> Check:
    """Test the lag-1 autocorrelation of the frame means."""
    n = series.size
    total = float(series @ series)
    correlation = float(series[1:] @ series[:-1]) / max(total, 1e-300) + 1.0 / n
    p = normal_p(correlation * math.sqrt(n), two_sided=True)
    return check_of("frame_lag", p, correlation, limit=5.7 / math.sqrt(n))


# -- frames of several exposures ---------------------------------------------------------------------


def levels_check(
    mean: FloatArray, variance: FloatArray, gain: float, empty: IntArray | tuple[()] = ()
) -> Check:
    """Test whether the frames are of several exposures, from mean and variance of each over its pixels, DN.

    Frames without samples of the sensor (``empty``) are no exposure. The gain is the median, e-/DN.
    """
    parts, p = _parted(mean, variance, gain, np.setdiff1d(np.arange(mean.size), empty))
    levels = sorted(((float(mean[part].mean()), part) for part in parts), key=lambda level: level[0])
    words = "; ".join(f"{odd_frames.frame_words(part, 1)} at {dn:.4g} DN" for dn, part in levels[:_SHOWN])
    more = f" and {len(levels) - _SHOWN} more levels" if len(levels) > _SHOWN else ""
    return check_of("levels", p, levels[-1][0] - levels[0][0], where=words + more if len(levels) > 1 else "")


def _parted(
    mean: FloatArray, variance: FloatArray, gain: float, frames: IntArray
) -> tuple[list[IntArray], float]:
    """Return the frames of each level, and the least p-value of the growth of the variance between two."""
    levels, p = [frames], 1.0
    if frames.size < odd_frames.FEWEST_FRAMES:  # of 16, chance leaves such a gap in one of 400 runs
        return levels, p
    fewest = max(_FEWEST_OF_LEVEL, int(np.ceil(_LEAST_SHARE * frames.size)))
    while len(levels) < _MOST_LEVELS:
        for number, frames in enumerate(levels):
            if halves := _halves(frames, mean, variance, gain, fewest):
                p = min(p, _p_larger(variance[halves[0]], variance[halves[1]]))
                levels[number : number + 1] = halves
                break
        else:
            break
    return levels, p


def _p_larger(low: FloatArray, high: FloatArray) -> float:
    """Return the one-sided p-value of Student's test that the mean of ``high`` is larger."""
    n = low.size + high.size
    within = (low.size * low.var() + high.size * high.var()) / (n - 2.0)
    error = np.sqrt(max(within, 1e-300) * (1.0 / low.size + 1.0 / high.size))
    return float(special.stdtr(n - 2.0, -(high.mean() - low.mean()) / error))


def _halves(
    frames: IntArray, mean: FloatArray, variance: FloatArray, gain: float, fewest: int
) -> list[IntArray]:
    """Return frames in two parts (Otsu 1979) with a clean gap of the means and more shot noise, or []."""
    n = frames.size
    if n < 2 * fewest:
        return []
    ordered = frames[np.argsort(mean[frames], kind="stable")]
    values = mean[ordered] - mean[ordered].mean()
    count = np.arange(fewest, n - fewest + 1)
    below = np.cumsum(values)[count - 1]
    cut = int(count[np.argmax(below**2 / (count * (n - count)))])
    low, high = values[:cut], values[cut:]
    within = float(np.sqrt((cut * low.var() + (n - cut) * high.var()) / n))
    # the halves of a normal or a uniform distribution of n frames are some 4/n standard deviations apart
    if high[0] - low[-1] <= CERTAIN * within:
        return []
    halves = [np.sort(ordered[:cut]), np.sort(ordered[cut:])]
    low, high = halves
    grown = float(np.median(variance[high]) - np.median(variance[low]))
    return halves if grown * gain > _SHOT_SHARE * float(mean[high].mean() - mean[low].mean()) else []


# -- odd frames --------------------------------------------------------------------------------------


def odd_frame_checks(sums: StackSums) -> list[Check]:
    """Return whether frames are far, moved, empty or copies: all other checks are of the rest."""
    n, odd = sums.all_means.size, sums.odd
    if not odd:
        return []
    equal = odd_frames.chance_of_copies(sums.rows.variance, n)
    checks = []
    for name, kinds, p in (
        ("odd_frames", ("far",), n * odd_frames.FAR_CHANCE),
        ("empty_frames", ("empty",), n * odd_frames.FAR_CHANCE),
        ("repeated_frames", ("copied",), equal),
        ("moved_frames", ("moved_x", "moved_y"), n * odd_frames.FAR_CHANCE),
    ):
        some = {kind: odd[kind] for kind in kinds if kind in odd}
        number = sum(frames.size for frames in some.values())
        where = odd_frames.odd_words(some, sums.all_means, sums.all_variances)
        if name in ("empty_frames", "repeated_frames"):  # the title says how they are odd
            where = odd_frames.frame_words(odd[kinds[0]])
        p = min(p, 1.0) if number else 1.0
        how = _without(np.concatenate([*some.values(), np.empty(0, np.int64)]), n)
        checks.append(check_of(name, p, number / n, limit=1.0 / n, where=where, how=how))
    return checks


def _without(frames: IntArray, n: int) -> str:
    """Return how a run of n frames does without some of them: a range leaves out its ends."""
    if frames.size and int(frames.max()) == frames.size - 1:
        return f"with --frames {frames.size}: (input.frame_range)"
    if frames.size and int(frames.min()) == n - frames.size:
        return f"with --frames :{n - frames.size} (input.frame_range)"
    return "of the files"
