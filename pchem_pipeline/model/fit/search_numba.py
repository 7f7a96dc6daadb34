"""The search for the highest maximum of a pixel's likelihood with the density, and its goodness of fit."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.fit.climb_numba import (
    CONVERGED,
    DEGENERATE,
    Goal,
    Limits,
    same_place,
)
from pchem_pipeline.model.fit.starts_numba import fill_starts, n_attempts
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.cells_numba import Law
from pchem_pipeline.model.law.density_numba import LOG_2PI
from pchem_pipeline.model.law.pixel_numba import (
    AT_BEST,
    BIAS,
    DARK,
    EXPECTED,
    HEIGHTS,
    HERE,
    KEPT_STARTS,
    LOG_VARIANCE,
    N_BINS,
    N_FRAMES,
    N_KEPT,
    OTHER,
    STEP,
    VARIANCE,
    WEIGHT,
    Pixel,
    Scratch,
    copy,
)

FloatArray = NDArray[np.float64]

NO_DATA, TOO_FEW_BINS = int(FitStatus.NO_DATA), int(FitStatus.TOO_FEW_BINS)
FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED = int(FitStatus.NOT_CONVERGED), int(FitStatus.GAIN_NOT_IDENTIFIED)
EXPOSURE_AT_BOUND, BIAS_AMBIGUOUS = int(FitStatus.EXPOSURE_AT_BOUND), int(FitStatus.BIAS_AMBIGUOUS)
NOT_INFORMATIVE, COARSE_STEPS = int(FitStatus.NOT_INFORMATIVE), int(FitStatus.COARSE_STEPS)

# columns of a row of results
LOG_LIKELIHOOD, GAP, CHI2, OUTLYING, AMPLITUDE, SATELLITE_WEIGHT = range(6)
N_OUT = 6

CLEAR_GAP = 30.0  # nats: a neighbour this far below is not climbed to the end
SUSPICIOUS = 3.0  # standard normal: a goodness of fit that calls for the other starts
_SURE_GAP = 80.0  # nats: where so much is expected, and the fit is good, it is surely more than those 30 ...
_SURE_THRESHOLDS = 4.0  # ... and, so many times the gap that counts as ambiguous, more than that, too
_FEW_STEP = 3.0  # DN per electron
_FINE_STEP = 5.0  # DN per electron: below it climbs from a neighbour also meet combs that fit whole numbers
_CLEAR_LOBE = 3.0  # standard errors: a side lobe of the characteristic function that settles the gain
_SURE_LOBE = 5.0  # the same where the model does not fit: other starts have only helped below 3
_MOST_MOVES = 40
_LEAST_BRIGHT = 3.0  # e-: a dimmer brightest sample does not tell neighbouring gains apart
_COARSE_NOISE = 0.6  # DN: below it, or below so many DN per electron, rounding is more than additive noise
_COARSE_STEP = 2.5

SMALLEST_EXPECTATION = 5.0
FITTED_PARAMETERS = 4  # of one sample


class Tools(NamedTuple):
    """What the search works with.

    Attributes:
        limits: bounds and limits.
        evaluate, climb: the likelihood, and the climb on it, called by their addresses.
        basis: of the regression on the characteristic function.
        scratch: room to work in.
    """

    limits: Limits
    evaluate: Any
    climb: Any
    basis: FloatArray
    scratch: Scratch


@kernel(borrows=True)
def climb_on(
    pixel: Pixel, tools: Tools, goal: Goal, known: FloatArray, theta: FloatArray
) -> tuple[int, float, int]:
    """Climb, see :func:`.climb_numba.climb`."""
    outcome, loglik, used = tools.climb(
        pixel, tools.evaluate, tools.limits, goal, known, theta, tools.scratch
    )
    return outcome, loglik, used


@kernel(inline=True)
def from_start() -> Goal:
    """Return the goal of a climb from a start."""
    return Goal(np.bool_(True), -math.inf, math.inf, np.bool_(False))


@kernel(inline=True)
def _neighbour(which: int, pixel: Pixel, theta: FloatArray, out: FloatArray) -> bool:
    """Fill ``out`` with a neighbour of ``theta``: one electron more or (odd ``which``) fewer.

    The first two move the bias: all H_j +- 1, mu -+ 1/g. The others keep it and move
        the gain, so
    that the brightest sample alone has an electron more or less: the combs agree at the bias and there.
    """
    n = pixel.facts.shape[0]
    direction = -1.0 if which % 2 else 1.0
    copy(theta, out)
    most = 0.0
    for j in range(n):
        if pixel.facts[j, DARK] == 0.0:
            most = max(most, math.exp(theta[j]))
    if not most + direction > 0.03:
        return False
    if which < 2:
        for j in range(n):
            out[j] = math.log(max(math.exp(theta[j]) + direction, 0.01))
        out[n + BIAS] -= direction * theta[n + STEP]
        return True
    factor = (most + direction) / most
    for j in range(n):
        out[j] += math.log(factor)
    out[n + STEP] /= factor
    return most > _LEAST_BRIGHT


@kernel(borrows=True)
def climb_neighbours(
    pixel: Pixel, tools: Tools, best: FloatArray, best_loglik: float
) -> tuple[float, float, int]:
    """Move to a neighbour while one is more likely.

    Args:
        pixel: its samples.
        tools: of the search.
        best: a maximum; out: the likeliest of its neighbours.
        best_loglik: its log-likelihood.

    Returns:
        Log-likelihood of the best, that of the best other one (-inf without one), evaluations.
    """
    trial, runner_up = tools.scratch.small[OTHER], -math.inf
    # combs of few DN per electron, too, differ in their gains
    n = pixel.facts.shape[0]
    n_neighbours = 2 if n == 1 and (not tools.limits.cells or best[n + STEP] > _FEW_STEP) else 4
    came_from, used, moves, which = -1, 0, 0, int(np.int64(0))
    while which < n_neighbours:
        if which == came_from or not _neighbour(which, pixel, best, trial):
            which += 1
            continue
        goal = Goal(np.bool_(False), best_loglik - CLEAR_GAP, best_loglik, np.bool_(False))
        outcome, loglik, count = climb_on(pixel, tools, goal, best, trial)
        used += count
        higher = outcome == CONVERGED and loglik > best_loglik
        if outcome == DEGENERATE or same_place(best, trial, tools.limits.cells):
            if higher:
                copy(trial, best)
                best_loglik = loglik
            which += 1
        elif higher and moves < _MOST_MOVES:
            runner_up = max(runner_up, best_loglik)
            copy(trial, best)
            best_loglik = loglik
            came_from = which ^ 1
            moves += 1
            which -= which % 2
        else:
            runner_up = max(runner_up, loglik)
            which += 1
    return best_loglik, runner_up, used


@kernel(borrows=True)
def loglik_without_gain(pixel: Pixel) -> float:
    """Return the log-likelihood of Gaussians of one width, each at the mean of its sample: g to infinity."""
    n = square = 0.0
    for j in range(pixel.facts.shape[0]):
        n += pixel.facts[j, N_FRAMES]
        square += pixel.facts[j, N_FRAMES] * pixel.facts[j, VARIANCE]
    return -0.5 * n * (LOG_2PI + 1.0 + math.log(max(square / n, QUANTISATION_VARIANCE)))


@kernel(inline=True)
def side_lobe(pixel: Pixel, theta: FloatArray) -> float:
    """Return the height exp(-2 pi^2 s_e^2) of the side lobe in units of its noise, 1/sqrt(N) at most.

    Where the satellite sinks into the noise, maxima at other gains come as near as the right one.
    """
    n = pixel.facts.shape[0]
    most = 0.0
    for j in range(n):
        if pixel.facts[j, DARK] == 0.0:
            most = max(most, pixel.facts[j, N_FRAMES])
    noise2 = math.exp(theta[n + LOG_VARIANCE]) / theta[n + STEP] ** 2
    return math.sqrt(most) * math.exp(-2.0 * math.pi**2 * noise2)


@kernel(inline=True)
def _settled(
    pixel: Pixel, theta: FloatArray, clear: bool, chi2: float, freedom: int, score: float
) -> tuple[bool, bool]:
    """Tell whether a maximum fits well, its gain settled, and whether other starts have a chance at all.

    They have none where the fit is good, nor where it is poor and the side lobe all the same far out of the
    noise, which a misfit raises by sqrt(chi2 / freedom): then the model is wrong, and not the start.

    Args:
        pixel: its samples.
        theta: the maximum.
        clear: a side lobe of one of several samples stands clear of the noise.
        chi2: of the goodness of fit.
        freedom: its degrees of freedom.
        score: as a standard normal deviate.
    """
    n, lobe = pixel.facts.shape[0], side_lobe(pixel, theta)
    good = score < SUSPICIOUS and ((n > 1 and not clear) or lobe > _CLEAR_LOBE)
    of_the_model = n == 1 and freedom > 0 and lobe > _SURE_LOBE * math.sqrt(chi2 / max(freedom, 1))
    return good, not (good or of_the_model)


@kernel(inline=True)
def expected_gap(n: float, theta: FloatArray) -> float:
    """Return how many nats the likelier neighbour (H -+ 1, mu +- 1/g) of a right answer is expected below it.

    For peaks apart, two Poisson laws a step apart in k; where the peaks merge, what is left of the ripple.
    The constants are from climbs on exact histograms of one sample (H 0.05..32, s_e 0.1..0.46 e-): the gap
    found is 0.78 to 2.4 times this, unless there is no such maximum.
    """
    exposure, noise2 = math.exp(theta[0]), math.exp(theta[3]) / (theta[1] * theta[1])
    ripple = 1.2 * noise2 * math.exp(4.0 * math.pi**2 * noise2)
    gap: float = n / (2.0 + exposure * (4.0 * exposure + ripple))
    return gap


@kernel(borrows=True)
def pearson(
    weights: NDArray[np.float64], expectations: NDArray[np.float64], n_bins: int, n: float
) -> tuple[float, int]:
    """Compare counts with what is expected of each DN, adjacent DN merged until 5 are expected.

    What is expected outside the window belongs to the last group, so that the expectations sum to ``n``.

    Returns:
        Chi-square and its degrees of freedom, groups - 1 - 4; (NaN, 0) where none are left.
    """
    chi2 = 0.0
    groups = 0
    seen = expected = 0.0
    remaining = n
    for i in range(n_bins):
        seen += weights[i]
        expected += expectations[i]
        if expected >= SMALLEST_EXPECTATION and remaining - expected >= SMALLEST_EXPECTATION:
            chi2 += (seen - expected) ** 2 / expected
            groups += 1
            remaining -= expected
            seen = expected = 0.0
    if remaining > 0.0:
        chi2 += (seen - remaining) ** 2 / remaining
        groups += 1
    freedom = groups - 1 - FITTED_PARAMETERS
    if freedom <= 0:
        return math.nan, 0
    return chi2, freedom


@kernel(borrows=True)
def normal_score(chi2: float, freedom: int) -> float:
    """Return the chi-square as a standard normal deviate (Wilson and Hilferty 1931); 0 without freedom."""
    if freedom <= 0:
        return 0.0
    spread = 2.0 / (9.0 * freedom)
    deviate: float = ((chi2 / freedom) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread)
    return deviate


@kernel(borrows=True)
def goodness(pixel: Pixel) -> tuple[float, int]:
    """Return Pearson's chi-square of all samples, from the counts expected, and its degrees of freedom.

    Each sample's exposure is a fitted parameter of its own; 1/g, mu and sigma are fitted once.
    """
    chi2, freedom = 0.0, 1 - FITTED_PARAMETERS
    for j in range(pixel.facts.shape[0]):
        bins, facts = pixel.bins[j], pixel.facts[j]
        own, degrees = pearson(bins[WEIGHT], bins[EXPECTED], int(facts[N_BINS]), facts[N_FRAMES])
        if degrees > 0:
            chi2 += own
            freedom += degrees + FITTED_PARAMETERS
            if facts[DARK] == 0.0:
                freedom -= 1
    if freedom <= 0:
        return math.nan, 0
    return chi2, freedom


@kernel(borrows=True)
def outlying(pixel: Pixel, floor: float) -> float:
    """Return how many samples lie at DN of which fewer than ``floor`` are expected."""
    found = 0.0
    for j in range(pixel.facts.shape[0]):
        bins = pixel.bins[j]
        for i in range(int(pixel.facts[j, N_BINS])):
            if bins[EXPECTED, i] < floor:
                found += bins[WEIGHT, i]
    return found


@kernel(borrows=True)
def examine(pixel: Pixel, tools: Tools, theta: FloatArray, out: FloatArray) -> tuple[float, int, float]:
    """Evaluate at a maximum; return log-likelihood, degrees of freedom and score of the goodness of fit.

    Its chi-square and the number of samples that are not expected go to ``out``; the evaluation to `AT_BEST`.
    """
    scratch = tools.scratch
    loglik: float = tools.evaluate(pixel, theta, True, scratch, scratch.evaluations[AT_BEST])
    out[OUTLYING] = outlying(pixel, tools.limits.floor)
    out[CHI2], freedom = goodness(pixel)
    return loglik, freedom, normal_score(out[CHI2], freedom)


@kernel(borrows=True)
def judge(pixel: Pixel, limits: Limits, best: FloatArray, above_null: float, gap: float) -> int:
    """Return the status word of a converged pixel.

    Args:
        pixel: its samples.
        limits: bounds and limits.
        best: the maximum.
        above_null: nats above the likelihood without a gain.
        gap: nats above the runner-up, that likelihood aside.
    """
    n, status = pixel.facts.shape[0], 0
    sigma, a = math.exp(0.5 * best[n + LOG_VARIANCE]), best[n + STEP]
    at_bound = True
    for j in range(n):
        at_bound = at_bound and (pixel.facts[j, DARK] > 0.0 or best[j] <= limits.bound + 1e-9)
    if above_null < limits.gap:
        status |= GAIN_NOT_IDENTIFIED
    if gap < limits.gap:
        status |= BIAS_AMBIGUOUS
    if at_bound:
        status |= EXPOSURE_AT_BOUND
    if not limits.cells and (sigma < _COARSE_NOISE or a < _COARSE_STEP):
        status |= COARSE_STEPS
    if n == 1:
        if limits.cells:
            sigma = math.sqrt(sigma * sigma + QUANTISATION_VARIANCE)
        if sigma / a > limits.noise:
            status |= NOT_INFORMATIVE
    return status


def search_density(
    pixel: Pixel,
    tools: Tools,
    law: Law,
    index: int,
    amplitudes: FloatArray,
    near: FloatArray,
    gap: float,
    best: FloatArray,
    out: FloatArray,
) -> tuple[int, int, int]:
    """Find the most likely parameters of one pixel with the density.

    Where an answer is known to be near, the maximum next to it is taken as long as it fits well.

    The first start is climbed from, and its neighbours, unless the fit is good and much better than
    any neighbour of such a pixel: were a neighbour the right one, the fit could not be good. Where the
    goodness of fit or a side lobe in the noise raises suspicion, the other starts follow; the likeliest
    maximum is kept.

    Args:
        pixel: its samples.
        tools: of the search, with the density; out: score and information at the maximum in `AT_BEST`.
        law: of a search with the cells.
        index: of a search with the cells.
        amplitudes: of a search with the cells.
        near: theta near the maximum; its step is 0 where nothing is known.
        gap: nats of that answer above its runner-up.
        best: out, theta at the maximum; its step is 0 where there is none.
        out: out, a row of results; the columns are named at the top of this module.

    Returns:
        Status word, evaluations, degrees of freedom of the goodness of fit.
    """
    n, trial, limits = pixel.facts.shape[0], tools.scratch.small[HERE], tools.limits
    heights, kept = tools.scratch.small[HEIGHTS], tools.scratch.small[KEPT_STARTS:HEIGHTS]
    place = n + STEP
    best_loglik, runner_up = -math.inf, -math.inf
    goal = from_start()
    null = loglik_without_gain(pixel)
    sure = max(_SURE_GAP, _SURE_THRESHOLDS * limits.gap)
    used = freedom = 0
    degenerate = False
    best[place] = 0.0
    if near[place] > 0.0:
        copy(near, trial)
        outcome, loglik, used = climb_on(pixel, tools, goal, trial, trial)
        if outcome == CONVERGED:
            _, freedom, score = examine(pixel, tools, trial, out)
            if score < SUSPICIOUS:
                copy(trial, best)
                out[LOG_LIKELIHOOD], out[GAP] = loglik, min(gap, loglik - null)
                return judge(pixel, limits, best, loglik - null, math.inf), used + 1, freedom
    for attempt in range(n_attempts(n)):
        clear, count = fill_starts(attempt, pixel, tools.basis, tools.evaluate, best, tools.scratch)
        used += count
        unsure = True
        for _ in range(1 if n == 1 or (clear and attempt == 0) else N_KEPT):
            which = 0
            for i in range(1, N_KEPT):
                if heights[i] > heights[which]:
                    which = i
            if heights[which] == -math.inf:
                break
            heights[which] = -math.inf
            copy(kept[which], trial)
            if n > 1 and best[place] > 0.0 and same_place(best, trial, tools.limits.cells):
                continue
            outcome, loglik, count = climb_on(pixel, tools, goal, trial, trial)
            used += count
            if outcome == DEGENERATE:
                degenerate = True
                continue
            if best[place] > 0.0 and same_place(best, trial, tools.limits.cells):
                continue
            if outcome != CONVERGED or loglik <= best_loglik:
                runner_up = max(runner_up, loglik)
                continue
            runner_up = max(runner_up, best_loglik)
            copy(trial, best)
            best_loglik, freedom, score = examine(pixel, tools, best, out)
            used += 1
            good, unsure = _settled(pixel, best, clear, out[CHI2], freedom, score)
            if n == 1:
                expected = expected_gap(pixel.facts[0, N_FRAMES], best)
                if good and freedom > 0 and expected > sure and best[place] > _FINE_STEP:
                    runner_up = max(runner_up, best_loglik - expected)
                    break
            higher, beside, count = climb_neighbours(pixel, tools, best, loglik)
            used += count
            runner_up = max(beside, runner_up)
            if higher > loglik:
                best_loglik, freedom, score = examine(pixel, tools, best, out)
                used += 1
                good, unsure = _settled(pixel, best, clear, out[CHI2], freedom, score)
        if not unsure:
            break
    if not best[place] > 0.0:
        return GAIN_NOT_IDENTIFIED if degenerate else FIT_NOT_CONVERGED, used, 0
    out[LOG_LIKELIHOOD] = best_loglik
    out[GAP] = best_loglik - max(runner_up, null)
    return judge(pixel, limits, best, best_loglik - null, best_loglik - runner_up), used, freedom
