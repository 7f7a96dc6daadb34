"""The search with the cells integrated: from a fit with the density, or other starts where that misleads."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import FEW_STEP, QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.fit.climb_numba import ALIASED_STEP, CONVERGED, LEAST_STEP
from pchem_pipeline.model.fit.satellites_numba import search_satellites
from pchem_pipeline.model.fit.search_numba import (
    CLEAR_GAP,
    FIT_NOT_CONVERGED,
    NEAR_TWO,
    SURELY_SEEN,
    SUSPICIOUS,
    Found,
    Task,
    Tools,
    above_blurred,
    climb_neighbours,
    climb_on,
    climb_starts,
    examine,
    fall_and_parabola,
    from_start,
    judge,
    loglik_without_gain,
    nats_of_peaks,
    rival_moves_gain,
    score_of,
)
from pchem_pipeline.model.fit.starts_numba import (
    add_line_starts,
    alias_of_step,
    combs_of_step,
    fill_starts,
    keep_start,
    no_starts,
    scan_steps,
)
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.pixel_numba import Pixel, copy

_LEAST_VARIANCE = 0.01  # DN^2, of the analog read noise at a start
# of the variance and the exposure of the density's fit, left to the pixel itself at the start
_LEAST_SHARE = 0.1
_POOR = float(-special.ndtri(SIGNIFICANCE))  # standard normal: a pixel at a limit is started anew
# what calls for other starts of free satellites: a bad fit (standard normal), or unresolved peaks, e-
_SUSPICIOUS = 2.3
_UNRESOLVED = 0.45
_CUT_SHARE = 0.005  # of a sample at a limit, beyond which the starts of the whole sample mislead
_CUT_EXPOSURES = (0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 0.8, 1.2, 1.8, 2.5, 3.3, 4.2, 5.3, 6.8, 9.0)  # e-
_CUT_NOISE_E, _CUT_RATIO = 0.28, 1.2
_STEPS, _AROUND = 3, 3  # biases per electron, and to either side


@kernel(borrows=True)
def _from_density(pixel: Pixel, warm: bool, near: FloatArray, theta: FloatArray) -> None:
    """Fill ``theta`` from parameters with the whole variance of the read noise.

    Unless ``warm``, what the law adds to exposures and read noise is taken off, but for a tenth.
    """
    n = pixel.facts.shape[0]
    copy(near, theta)
    a = near[n + px.STEP]
    analog2 = max(
        math.exp(near[n + px.LOG_VARIANCE]) - QUANTISATION_VARIANCE, _LEAST_VARIANCE if not warm else 1e-6
    )
    left = frames = 0.0
    for j in range(n):
        facts, law, k = pixel.facts[j], pixel.laws[j], math.exp(near[j])
        if facts.dark:
            k = 0.0
        elif not warm:
            exposure = k
            for i in range(pixel.mixtures.shape[2]):
                exposure -= pixel.mixtures[j, px.ADDED_WEIGHT, i] * pixel.mixtures[j, px.ADDED_EXPOSURE, i]
            theta[j] = math.log(max(exposure, _LEAST_SHARE * k))
        spread = law.extra_e2 + k * (law.per_electron + k * law.per_electron2)
        own = 0.0
        for i in range(facts.n_peaks):
            own += pixel.peaks[j, px.SHARE, i] * pixel.peaks[j, px.WIDTH, i] ** 2
        left += facts.n_frames * (analog2 - a * a * spread - law.extra_dn2) / own
        frames += facts.n_frames
    if not warm:
        analog2 = max(left / frames, _LEAST_SHARE * analog2)
    theta[n + px.LOG_VARIANCE] = math.log(analog2)
    theta[n + px.SATELLITE] = 0.0


@kernel(borrows=True)
def _share_at_limits(pixel: Pixel) -> float:
    """Return the largest share of a sample in the codes that hold what lies beyond the limits."""
    largest = 0.0
    for j in range(pixel.facts.shape[0]):
        facts, found = pixel.facts[j], 0.0
        for i in range(facts.n_bins):
            if i <= facts.bottom or i + 1 >= facts.top:
                found += pixel.bins[j, px.WEIGHT, i]
        largest = max(largest, found / facts.n_frames)
    return largest


@kernel(borrows=True)
def _scan_cut(pixel: Pixel, tools: Tools) -> None:
    """Put the likeliest combs of a cut sample among the starts.

    Of a cut histogram the median stays. So steps from the range of the sample down, exposures, and biases
    around the one that has the median right are all tried.
    """
    trial, place = tools.scratch.small[px.HERE], 0
    facts, cumulative = pixel.facts[0], pixel.bins[0, px.CUMULATIVE]
    no_starts(tools.scratch.small[px.HEIGHTS])
    while cumulative[place + 1] < 0.5 * facts.n_frames:
        place += 1
    a, least = facts.n_bins + 1.0, max(0.25 * math.sqrt(facts.variance), LEAST_STEP)
    while a > least:
        for exposure in _CUT_EXPOSURES:
            middle = max(exposure - 0.3, 0.0)  # e-: the median of the electrons, to a third
            for around in range(-_AROUND, _AROUND + 1):
                trial[0], trial[1 + px.STEP], trial[1 + px.SATELLITE] = math.log(exposure), a, 0.0
                trial[1 + px.BIAS] = facts.first + place - a * (middle + around / _STEPS)
                trial[1 + px.LOG_VARIANCE] = 2.0 * math.log(max(_CUT_NOISE_E * a, 0.3))
                keep_start(pixel, tools.evaluate, True, tools.scratch)
        a /= _CUT_RATIO


@kernel(borrows=True)
def _climb_few(pixel: Pixel, tools: Tools, best: FloatArray, out: Any, found: Found) -> Found:
    """Climb from starts ranked by the cells, where a DN is no small part of an electron."""
    scratch = tools.scratch
    if pixel.facts.shape[0] == 1:
        scan_steps(pixel, tools.evaluate, True, scratch)
    else:
        fill_starts(1, False, pixel, tools.basis, tools.evaluate, scratch)
        add_line_starts(pixel, tools.evaluate, True, True, scratch)
    found = climb_starts(pixel, tools, False, found, best, out)
    return found


@kernel(borrows=True)
def _climb_known(pixel: Pixel, tools: Tools, near: FloatArray, best: FloatArray) -> Found:
    """Climb from a fit with the density, what the law adds taken off, or else from the fit as it is."""
    trial = tools.scratch.small[px.HERE]
    for as_it_is in (tools.limits.warm, np.bool_(True)):
        _from_density(pixel, as_it_is, near, trial)
        outcome, loglik = climb_on(pixel, tools, from_start(), trial, trial)
        if outcome == CONVERGED:
            copy(trial, best)
            return Found(loglik, -math.inf, np.bool_(False))
    return Found(-math.inf, -math.inf, np.bool_(False))


@kernel
def _flat_at_two(pixel: Pixel, tools: Tools, best: FloatArray, loglik: float) -> bool:
    """Return whether the log-likelihood of a single sample is flat towards 2 DN per electron."""
    if abs(1.0 / best[1 + px.STEP] - 0.5) > NEAR_TWO:
        return False
    combs_of_step(pixel, tools.evaluate, 2.0, tools.scratch)
    fall, parabola = fall_and_parabola(pixel, tools, best, loglik, 1 + px.STEP)
    return bool(fall < CLEAR_GAP and 2.0 * fall < parabola)


@kernel
def _start_anew(
    pixel: Pixel,
    tools: Tools,
    known: bool,
    cut: bool,
    score: float,
    gap: float,
    best: FloatArray,
    out: Any,
    found: Found,
) -> Found:
    """Climb from other starts in pixels that the density may have led astray.

    These are at the limits of the codes, have few DN per electron, or a climb that did not arrive; under
    another law also those with a near rival.
    """
    n, limits = pixel.facts.shape[0], tools.limits
    place = n + px.STEP
    if cut and (limits.scan or not best[place] > 0.0 or score > _POOR):
        _scan_cut(pixel, tools)
        found = climb_starts(pixel, tools, False, found, best, out)
    few = not best[place] > FEW_STEP
    astray = few or score > SUSPICIOUS
    rivalled = n == 1 and not limits.warm and min(gap, found.loglik - found.runner_up) < limits.gap
    lost = known and not best[place] > 0.0
    if lost or (astray if limits.scan else rivalled):
        found = _climb_few(pixel, tools, best, out, found)
    if not (limits.scan and best[place] < ALIASED_STEP):
        return found
    if abs(1.0 / best[place] - 0.5) > NEAR_TWO:
        alias_of_step(pixel, tools.evaluate, best, tools.scratch)
        found = climb_starts(pixel, tools, False, found, best, out)
    elif n == 1:
        for nearer in (1.0, 3.0):
            a = 1.0 / (0.5 - (1.0 / best[place] - 0.5) / nearer)
            combs_of_step(pixel, tools.evaluate, a, tools.scratch)
            found = climb_starts(pixel, tools, False, found, best, out)
    return found


@kernel
def _try_satellites(
    pixel: Pixel, tools: Tools, task: Task, unsure: bool, best: FloatArray, out: Any, found: Found
) -> Found:
    """Try free satellites of each amplitude; ``out`` is that of the fit with those that are kept."""
    n = pixel.facts.shape[0]
    noise = math.exp(0.5 * best[n + px.LOG_VARIANCE]) / best[n + px.STEP]
    poor = score_of(out) > _SUSPICIOUS or noise > _UNRESOLVED
    amplitude = search_satellites(
        best, found.loglik, pixel, task.law, task.row, task.amplitudes, unsure, poor, tools
    )
    loglik = examine(pixel, tools, best, out)
    if amplitude > 0.0:
        out.freedom = max(out.freedom - 2, 0)
    out.amplitude, out.weight = amplitude, best[n + px.SATELLITE]
    return Found(loglik, found.runner_up, found.degenerate)


def search_with(satellites: bool) -> Callable[..., int]:
    """Make the search; ``satellites``: with what tries free ones."""

    def search_cells(pixel: Pixel, tools: Tools, task: Task, best: FloatArray, out: Any) -> int:
        """Find the most likely parameters of one pixel with its cells integrated, under any law.

        From a fit with the density, or with nearly this law; its neighbours are tried where that fit does not
        exclude them, or where its law was too different to do so. Pixels that the density may have led astray
        are also started anew. Where the law has free satellites, each amplitude is tried. Arguments and
        results as of :func:`.search_numba.search_density`.
        """
        n, limits, null = pixel.facts.shape[0], tools.limits, loglik_without_gain(pixel)
        known = task.near[n + px.STEP] > 0.0
        gap, score = task.gap if known else math.inf, math.inf
        best[n + px.STEP] = 0.0
        tools.scratch.flags[px.FIXED, n + px.SATELLITE] = True
        out.amplitude = out.weight = 0.0
        found = Found(-math.inf, -math.inf, np.bool_(False))
        at_limits = not limits.warm and _share_at_limits(pixel) > _CUT_SHARE
        cut = n == 1 and at_limits
        if known:
            found = _climb_known(pixel, tools, task.near, best)
        if best[n + px.STEP] > 0.0:
            loglik, runner_up = found.loglik, found.runner_up
            if cut or gap < CLEAR_GAP or (limits.reshapes and not limits.warm):
                loglik, runner_up = climb_neighbours(pixel, tools, best, loglik)
                if runner_up > -math.inf and (cut or not limits.scan):
                    gap = math.inf  # that of another law, or of a sample that nothing cuts
            examine(pixel, tools, best, out)
            score = score_of(out)
            found = Found(loglik, runner_up, found.degenerate)
        found = _start_anew(pixel, tools, known, cut, score, gap, best, out, found)
        if not best[n + px.STEP] > 0.0:
            out.freedom = 0
            out.evaluations += tools.scratch.used[0]
            return FIT_NOT_CONVERGED
        bias_gap = min(gap, found.loglik - found.runner_up)
        blurred = math.inf
        if n == 1 and not (limits.warm or limits.reshapes):
            blurred = min(found.loglik - null, above_blurred(pixel, tools, best, found.loglik))
        gap = min(bias_gap, found.loglik - null, blurred)
        if satellites and task.amplitudes.size > 0:
            found = _try_satellites(pixel, tools, task, gap < CLEAR_GAP, best, out, found)
        out.log_likelihood, out.gap = found.loglik, gap
        out.evaluations += tools.scratch.used[0]
        # the density has told whether there is a gain: it knows no other law than one Gaussian does
        above_null = math.inf if known else found.loglik - null
        of_gain = rival_moves_gain(pixel, tools, best, found.loglik, found.loglik - bias_gap)
        of_gain = of_gain or (n == 1 and limits.scan and _flat_at_two(pixel, tools, best, found.loglik))
        # of several samples, combs that the limits leave open are not looked for
        unsure = nats_of_peaks(pixel, best) < SURELY_SEEN or best[n + px.STEP] < FEW_STEP
        if n == 1:
            unsure = bias_gap < limits.gap
        of_gain = of_gain or (at_limits and unsure)
        word = judge(pixel, limits, best, above_null, blurred, bias_gap, of_gain)
        return int(word)

    return search_cells
