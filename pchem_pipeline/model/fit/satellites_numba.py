"""The search for free satellite peaks: levels of one amplitude, with a weight of its own in each pixel.

Strong satellites lead a fit without them astray: it takes one for the peak of no electron, or the distance of
the satellites for that of the peaks. Where it describes the histogram badly, other starts are tried that have
the mean, the variance and the third cumulant of the histogram with the satellites in place: satellites on
both sides alike, and the read noise, add nothing to the third cumulant ``a^3 H``. The best amplitude is
refined. All samples of a pixel share amplitude and weight; the other combs are those of a single sample.
"""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.climb_numba import CONVERGED, Goal, ascend, find_held, newton_step, sensible
from pchem_pipeline.model.fit.search_numba import (
    CLEAR_GAP,
    Tools,
    climb_neighbours,
    climb_on,
    from_start,
    next_start,
)
from pchem_pipeline.model.fit.starts_numba import keep_start, no_starts
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Law, set_peaks
from pchem_pipeline.model.law.pixel_numba import Pixel, Sample, Scratch, copy, sample_of

_SCREEN = 0.2  # of the rise asked of free satellites, seen from the fit without them
#: steps of the other starts in units of that of a Poisson law without noise, third cumulant over variance
_SCALES = (1.04, 1.14, 1.24, 1.35, 1.47, 1.6, 1.75, 1.9, 2.1, 2.3, 2.55, 2.85, 3.3)
_NOISE_E = 0.29  # read noise there
_LEAST_WEIGHT, _MOST_WEIGHT = 0.02, 0.6  # of the satellites there
_LEAST_SKEWNESS = 0.15
_SHORTFALL = 0.25  # of the electrons, by which their variance may exceed that of the histogram
_N_ATTEMPTS = 4  # from the fit, one electron more and less, another comb
_FINER, _N_REFINED = 0.12, 12  # first step of log amplitude, and steps at most: a range of 4
_LEAST_START, _MOST_START = 0.005, 0.5  # weight of the satellites at a start


@kernel(borrows=True)
def _climb(pixel: Pixel, tools: Tools, to_beat: float, theta: FloatArray) -> float:
    """Climb with the weight of the satellites free; return log-likelihood, or -inf."""
    goal = Goal(np.bool_(True), to_beat, -math.inf, math.inf, np.bool_(False))
    outcome, loglik = climb_on(pixel, tools, goal, theta, theta)
    return loglik if outcome == CONVERGED else -math.inf


@kernel(borrows=True)
def _evaluate_weight(pixel: Pixel, theta: FloatArray, what: int, scratch: Scratch, out: FloatArray) -> float:
    """Evaluate the rise of the log-likelihood with the weight of the satellites: the mass is linear in it."""
    rise, weight, place = 0.0, theta[theta.size - 1], 1 + px.SATELLITE
    for j in range(pixel.facts.shape[0]):
        weights, room, slope, bend = pixel.bins[j, px.WEIGHT], scratch.cells[j], 0.0, 0.0
        for i in range(pixel.facts[j].n_bins):
            if weights[i] > 0.0 and room[px.MASS, i] > 0.0:
                ratio = room[px.SLOPES + place, i] / room[px.MASS, i]
                factor = 1.0 + weight * ratio
                rise += weights[i] * math.log(factor)
                ratio /= factor
                slope += weights[i] * ratio
                bend += weights[i] * ratio * ratio
        out[j, px.SCORE, place] = slope
        out[j, px.INFORMATION + place, place] = out[j, px.DAMPING + place, place] = bend
    return rise


@kernel(borrows=True)
def _with_weight(pixel: Pixel, tools: Tools, theta: FloatArray) -> tuple[float, float, float]:
    """Set the likeliest weight of the free satellites.

    Returns the log-likelihood without them, its rise by the weight, and that expected of all parameters.
    """
    scratch, limits, last = tools.scratch, tools.limits, theta.size - 1
    at, fixed = scratch.evaluations[px.AT], scratch.flags[px.FIXED]
    theta[last] = 0.0
    without: float = tools.evaluate(pixel, theta, px.DERIVATIVES, scratch, at)
    scratch.used[0] += 1
    find_held(theta, at, fixed, limits, scratch.flags[px.HELD])
    expected, _ = newton_step(at, 0.0, 1.0, scratch, scratch.small[px.STEPS])
    theta[last] = _LEAST_WEIGHT
    for i in range(last):
        fixed[i] = True
    _, rise, _, _ = ascend(pixel, _evaluate_weight, limits, from_start(), theta, theta, scratch)
    for i in range(last):
        fixed[i] = i < pixel.facts.shape[0] and pixel.facts[i].dark
    theta[last] = min(max(theta[last], _LEAST_START), _MOST_START)
    return without, rise, expected


@kernel(borrows=True)
def _from_fit(pixel: Pixel, tools: Tools, theta: FloatArray) -> bool:
    """Add the weight of free satellites to the fit without; False where nothing speaks for them."""
    _, rise, expected = _with_weight(pixel, tools, theta)
    least = _SCREEN * tools.limits.satellite_rise
    return bool(rise > least or expected > least)


@kernel(borrows=True)
def _beside(direction: float, pixel: Pixel, tools: Tools, theta: FloatArray) -> float:
    """Move ``theta`` by one electron; return the log-likelihood there, -inf where H would end."""
    n = pixel.facts.shape[0]
    for j in range(n):
        exposure = math.exp(theta[j]) + direction
        if not pixel.facts[j].dark:
            if not exposure > 0.03:
                return -math.inf
            theta[j] = math.log(exposure)
    theta[n + px.BIAS] -= direction * theta[n + px.STEP]
    without, rise, _ = _with_weight(pixel, tools, theta)
    return float(without + rise)


@kernel(borrows=True)
def _with_cumulants(
    a: float, third: float, histogram: Sample, moments: tuple[float, float, float], theta: FloatArray
) -> bool:
    """Fill ``theta`` of a single sample from the cumulants of its histogram, given the step, DN.

    The moments are the first three of the levels beside the quiet one, e-. Return whether such satellites can
    have these cumulants, chance aside.
    """
    m1, m2, m3 = moments
    weight, exposure, spread = 0.1, 0.0, 0.0
    for _ in range(4 if m1 != 0.0 or m3 != 0.0 else 1):
        own = weight * (m3 - weight * m1 * (3.0 * m2 - 2.0 * weight * m1 * m1))
        exposure = third / a**3 - own
        spread = histogram.facts.variance / (a * a) - exposure - _NOISE_E * _NOISE_E
        weight = min(max(spread / (m2 - weight * m1 * m1), _LEAST_WEIGHT), _MOST_WEIGHT)
    if not exposure > 0.03 or spread < -_SHORTFALL * exposure:
        return False
    theta[0] = math.log(exposure)
    theta[1 + px.STEP] = a
    theta[1 + px.BIAS] = histogram.facts.mean - a * (exposure + weight * m1)
    theta[1 + px.LOG_VARIANCE] = 2.0 * math.log(_NOISE_E * a)
    theta[1 + px.SATELLITE] = weight
    fine: bool = sensible(theta, math.inf, True)
    return fine


@kernel(borrows=True)
def _from_cumulants(pixel: Pixel, law: Law, amplitude: float, tools: Tools, theta: FloatArray) -> bool:
    """Fill ``theta`` with the likeliest comb of a histogram's cumulants; return whether there is one."""
    scratch, histogram = tools.scratch, sample_of(pixel, 0)
    third = m1 = m2 = m3 = 0.0
    for i in range(histogram.facts.n_bins):
        third += histogram.bins[px.WEIGHT][i] * (histogram.facts.first + i - histogram.facts.mean) ** 3
    # the third cumulant, DN^3, but at least that of a small skewness
    third = max(
        third / histogram.facts.n_frames,
        _LEAST_SKEWNESS * histogram.facts.variance * math.sqrt(histogram.facts.variance),
    )
    for side in range(law.pattern.shape[0]):
        shift = law.pattern[side, 0] * amplitude
        m1 += law.pattern[side, 1] * shift
        m2 += law.pattern[side, 1] * shift * shift
        m3 += law.pattern[side, 1] * shift * shift * shift
    if abs(m1) < 1e-9 * amplitude:
        m1 = m3 = 0.0
    no_starts(scratch.small[px.HEIGHTS])
    for scale in _SCALES:
        a = scale * third / histogram.facts.variance
        if _with_cumulants(a, third, histogram, (m1, m2, m3), scratch.small[px.HERE]):
            keep_start(pixel, tools.evaluate, True, scratch)
    return bool(next_start(scratch, theta))


@kernel
def _refine(
    amplitude: float, theta: FloatArray, highest: float, pixel: Pixel, law: Law, index: int, tools: Tools
) -> float:
    """Climb in the amplitude, too, from a maximum; update ``theta`` and return the amplitude, e-."""
    trial = tools.scratch.small[px.HERE]
    heights = np.empty(2)
    step, target = _FINER, 0.0
    for attempt in range(_N_REFINED):
        start = amplitude
        for side in range(3):
            if side == 2:
                # the vertex of the parabola through the three, where both sides are lower
                bend = heights[0] + heights[1] - 2.0 * highest
                if amplitude != start or not -math.inf < bend < 0.0:
                    break
                target = 0.5 * step * (heights[0] - heights[1]) / bend
            else:
                target = (2.0 * side - 1.0) * step
            tried = start * math.exp(target)
            set_peaks(law, index, tried, pixel)
            copy(theta, trial)
            found = _climb(pixel, tools, -math.inf, trial)
            if side < 2:
                heights[side] = found
            if found > highest:
                amplitude, highest = tried, found
                copy(trial, theta)
        if amplitude == start or target not in (-step, step):
            step *= 0.3
        if attempt > 0 and step < 0.02:
            break
    return amplitude


@kernel
def search_satellites(
    theta: FloatArray,
    loglik: float,
    pixel: Pixel,
    law: Law,
    index: int,
    amplitudes: FloatArray,
    unsure: bool,
    thorough: bool,
    tools: Tools,
) -> float:
    """Try free satellites of each amplitude; keep the best in ``theta`` where the likelihood rises by enough.

    ``unsure``: a start with one electron more is tried, too; one with one less always is. ``thorough``: both
    are however unlikely, and starts on other combs. Return the amplitude kept, e-, 0 without one.
    """
    scratch, weight, best = tools.scratch, theta.size - 1, theta.copy()
    trial, fixed = scratch.small[px.HERE], scratch.flags[px.FIXED]
    kept, highest = 0.0, loglik + tools.limits.satellite_rise
    # a satellite above the others is no one's peak of no electron: only an unsure fit may be below
    likely = loglik - CLEAR_GAP if not thorough else -math.inf
    fixed[weight] = False
    for amplitude in amplitudes:
        set_peaks(law, index, amplitude, pixel)
        for attempt in range(_N_ATTEMPTS):
            copy(theta, trial)
            usable = False
            if attempt == 0:
                usable = _from_fit(pixel, tools, trial)
            elif attempt == 1 and (unsure or thorough):
                usable = _beside(1.0, pixel, tools, trial) > likely
            elif attempt == 2:
                usable = _beside(-1.0, pixel, tools, trial) > likely
            elif attempt == 3 and thorough and pixel.facts.shape[0] == 1:
                usable = _from_cumulants(pixel, law, amplitude, tools, trial)
            if not usable:
                continue
            found = _climb(pixel, tools, -math.inf if attempt == 0 else highest, trial)
            if thorough and found > highest - CLEAR_GAP:
                found, _ = climb_neighbours(pixel, tools, trial, found)
            if found > highest:
                kept, highest = amplitude, found
                copy(trial, best)
    if kept > 0.0:
        copy(best, theta)
        kept = _refine(kept, theta, highest, pixel, law, index, tools)
    fixed[weight] = kept == 0.0
    set_peaks(law, index, kept, pixel)
    return kept
