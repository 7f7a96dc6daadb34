"""The search for the highest maximum of a pixel's likelihood with the density, and its goodness of fit."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import FEW_STEP, QUANTISATION_VARIANCE
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.arithmetic.significance import SMALLEST_EXPECTATION
from pchem_pipeline.model.errors.algebra_numba import invert_arrow
from pchem_pipeline.model.fit.climb_numba import CONVERGED, DEGENERATE, Goal, Limits, find_held, same_place
from pchem_pipeline.model.fit.starts_numba import N_ATTEMPTS, fill_starts, keep_start, longer_steps, no_starts
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Law
from pchem_pipeline.model.law.density_numba import LOG_2PI
from pchem_pipeline.model.law.pixel_numba import Pixel, Scratch, copy

NO_DATA, TOO_FEW_BINS = int(FitStatus.NO_DATA), int(FitStatus.TOO_FEW_BINS)
FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED = int(FitStatus.NOT_CONVERGED), int(FitStatus.GAIN_NOT_IDENTIFIED)
EXPOSURE_AT_BOUND, BIAS_AMBIGUOUS = int(FitStatus.EXPOSURE_AT_BOUND), int(FitStatus.BIAS_AMBIGUOUS)
NOT_INFORMATIVE, COARSE_STEPS = int(FitStatus.NOT_INFORMATIVE), int(FitStatus.COARSE_STEPS)
GAIN_AMBIGUOUS = int(FitStatus.GAIN_AMBIGUOUS)

#: What a search, and the loop over the pixels, finds of one beside its parameters.
RESULT = np.dtype(
    [
        ("status", "i8"),
        ("evaluations", "i8"),
        ("lowest_dn", "i8"),
        ("highest_dn", "i8"),
        ("frames", "i8"),
        ("log_likelihood", "f8"),
        ("gap", "f8"),  # nats to the runner-up
        ("chi2", "f8"),
        ("freedom", "i8"),
        ("outlying", "f8"),  # samples where none are expected
        ("amplitude", "f8"),  # of free satellites, e-
        ("weight", "f8"),
    ],
    align=True,
)

CLEAR_GAP = 30.0  # nats: a neighbour this far below is not climbed to the end
SUSPICIOUS = 3.0  # standard normal: a goodness of fit that calls for the other starts
_SURE_GAP = 80.0  # nats: where so much is expected, and the fit is good, it is surely more than those 30 ...
_SURE_THRESHOLDS = 4.0  # ... and, so many times the gap that counts as ambiguous, more than that, too
_FINE_STEP = 5.0  # DN per electron: below it climbs from a neighbour also meet combs that fit whole numbers
_CLEAR_LOBE = 3.0  # standard errors: a side lobe of the characteristic function that settles the gain
_SURE_LOBE = 5.0  # the same where the model does not fit: other starts have only helped below 3
_MOST_MOVES, _MOST_STEPS = 40, 16.0
_LEAST_BRIGHT = 3.0  # e-: a dimmer brightest sample does not tell neighbouring gains apart
_BLURRED2, _LEAST_SKEWNESS = 0.64, 0.02  # e-^2: read noise without peaks; a skewness of H = 2500 e-
_SAME_GAIN, _SAME_RIVAL = 0.03, 0.1  # relative; nats
SURELY_SEEN = 40.0  # nats: where so much is expected of the peaks alone, they are no chance ...
_UNSEEN = 0.1  # ... and where so little, no error rests on them
_LOCKED_NOISE = 0.15  # DN: below it each electron number has one code, and many combs have these codes
_FEWEST_CODES = 7.0  # of which the four parameters leave two free shares
_COARSE_NOISE = 0.6  # DN: below it, or below so many DN per electron, rounding is more than additive noise
_COARSE_STEP = 2.5
NEAR_TWO = 0.06  # e-/DN from 0.5: combs of whole numbers with aliases
_SAME_COMB = 1e-3  # nats: two maxima of one comb, farther apart in height than climbs to one of them

FITTED_PARAMETERS = len(PARAMETERS)  # of one sample


class Tools(NamedTuple):
    """What the search works with; likelihood and climb are called by their addresses.

    The basis is that of the regression on the characteristic function.
    """

    limits: Limits
    evaluate: Any
    climb: Any
    basis: FloatArray
    scratch: Scratch


class Task(NamedTuple):
    """What is asked of a search, and what is known before."""

    law: Law  # of all pixels
    row: int  # of the pixel in it
    amplitudes: FloatArray  # of free satellites to try, e-
    near: FloatArray  # theta near the maximum, v with the rounding; its step is 0 where nothing is known
    gap: float  # nats of that answer above its runner-up


class Found(NamedTuple):
    """How far a search has come."""

    loglik: float  # log-likelihood of the best maximum, -inf without one
    runner_up: float  # that of the next one
    degenerate: bool | np.bool_  # a climb ran towards one Gaussian


@kernel(borrows=True)
def climb_on(
    pixel: Pixel, tools: Tools, goal: Goal, known: FloatArray, theta: FloatArray
) -> tuple[int, float]:
    """Climb, see :func:`.climb_numba.climb`."""
    outcome, loglik = tools.climb(pixel, tools.evaluate, tools.limits, goal, known, theta, tools.scratch)
    return outcome, loglik


@kernel(borrows=True)
def from_start() -> Goal:
    """Return the goal of a climb from a start."""
    return Goal(np.bool_(True), -math.inf, -math.inf, math.inf, np.bool_(False))


@kernel(borrows=True)
def goal_beside(first: bool, loglik: float, runner_up: float) -> Goal:
    """Return the goal of a climb from a start, or from a neighbour, the best and the next known."""
    return Goal(np.bool_(first), loglik - CLEAR_GAP, runner_up, loglik, np.bool_(False))


@kernel(borrows=True)
def nats_of_peaks(pixel: Pixel, best: FloatArray) -> float:
    """Return the nats that peaks of contrast ``2 r``, ``r = exp(-2 pi^2 s_e^2)``, bring: ``N r^2``."""
    n, frames = pixel.facts.shape[0], 0.0
    for j in range(n):
        if not pixel.facts[j].dark:
            frames += pixel.facts[j].n_frames
    noise2 = math.exp(best[n + px.LOG_VARIANCE]) / best[n + px.STEP] ** 2
    return frames * math.exp(-4.0 * math.pi**2 * noise2)


@kernel(borrows=True)
def _most_electrons(pixel: Pixel, theta: FloatArray) -> float:
    """Return the largest exposure of a pixel's samples, e-."""
    most = 0.0
    for j in range(pixel.facts.shape[0]):
        if not pixel.facts[j].dark:
            most = max(most, math.exp(theta[j]))
    return most


@kernel(borrows=True)
def _count_neighbours(pixel: Pixel, cells: bool, theta: FloatArray) -> int:
    """Return how many neighbours a maximum has: of its bias two, the others differ in their gains.

    The variance of several samples leaves ``sqrt(2 / N)`` of the gain open; three times that is tried.
    """
    n = pixel.facts.shape[0]
    if n == 1:
        return 4 if cells and not theta[n + px.STEP] > FEW_STEP else 2
    frames = pixel.facts[0].n_frames
    for j in range(n):
        frames = min(frames, pixel.facts[j].n_frames)
    reach = 3.0 * math.sqrt(2.0 / frames) * _most_electrons(pixel, theta)
    return 4 + 2 * int(min(reach, _MOST_STEPS))


@kernel(borrows=True)
def _neighbour(which: int, pixel: Pixel, theta: FloatArray, out: FloatArray) -> bool:
    """Fill ``out`` with a neighbour of ``theta``: electrons more or (odd ``which``) fewer.

    The first two move the bias: all H_j +- 1, mu -+ 1/g. The others move the gain, so that the brightest
    sample has 1, 2, ... electrons more or less.
    """
    n, most = pixel.facts.shape[0], _most_electrons(pixel, theta)
    change = max(float(which // 2), 1.0) * (-1.0 if which % 2 else 1.0)
    copy(theta, out)
    if not most + change > 0.03:
        return False
    if which < 2:
        for j in range(n):
            out[j] = math.log(max(math.exp(theta[j]) + change, 0.01))
        out[n + px.BIAS] -= change * theta[n + px.STEP]
        return True
    factor = (most + change) / most
    for j in range(n):
        out[j] += math.log(factor)
    out[n + px.STEP] /= factor
    return bool(most > _LEAST_BRIGHT)


@kernel(borrows=True)
def climb_neighbours(pixel: Pixel, tools: Tools, best: FloatArray, best_loglik: float) -> tuple[float, float]:
    """Move ``best`` to a neighbour while one is more likely.

    Return its log-likelihood, and that of the best other one, -inf without one.
    """
    trial, runner_up = tools.scratch.small[px.OTHER], -math.inf
    came_from, moves, which = -1, 0, 0
    while which < _count_neighbours(pixel, tools.limits.cells, best):
        if which == came_from or not _neighbour(which, pixel, best, trial):
            which += 1
            continue
        goal = goal_beside(False, best_loglik, runner_up)
        outcome, loglik = climb_on(pixel, tools, goal, best, trial)
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
            which = 0  # the new one has neighbours of both kinds
        else:
            runner_up = max(runner_up, loglik)
            which += 1
    return best_loglik, runner_up


@kernel(borrows=True)
def loglik_without_gain(pixel: Pixel) -> float:
    """Return the log-likelihood of Gaussians of one width, each at the mean of its sample: g to infinity."""
    n = square = 0.0
    for j in range(pixel.facts.shape[0]):
        n += pixel.facts[j].n_frames
        square += pixel.facts[j].n_frames * pixel.facts[j].variance
    return -0.5 * n * (LOG_2PI + 1.0 + math.log(max(square / n, QUANTISATION_VARIANCE)))


@kernel(borrows=True)
def loglik_without_ripple(pixel: Pixel, evaluate: Any, cells: bool, scratch: Scratch) -> float:
    """Return the log-likelihood of a single sample without peaks, the rival of combs seen by chance.

    Mean, variance and skewness are those of the sample, the read noise is 0.8 e-, whose peaks have a contrast
    of ``2 exp(-2 pi^2 0.8^2) = 7e-6``: ``H / (H + 0.8^2)^(3/2)`` is the skewness, or as near to it as that
    read noise lets it.
    """
    facts, weights, trial = pixel.facts[0], pixel.bins[0, px.WEIGHT], scratch.small[px.HERE]
    third = 0.0
    for i in range(facts.n_bins):
        third += weights[i] * (facts.first + i - facts.mean) ** 3
    skewness = max(third / facts.n_frames / facts.variance**1.5, _LEAST_SKEWNESS)
    low, high = 2.0 * _BLURRED2, 4.0 / skewness**2 + 10.0
    while high > 1.001 * low:
        middle = math.sqrt(low * high)
        if middle > skewness * (middle + _BLURRED2) ** 1.5:
            low = middle
        else:
            high = middle
    a = math.sqrt(facts.variance / (low + _BLURRED2))
    rounding = QUANTISATION_VARIANCE if cells else 0.0
    trial[0], trial[1 + px.STEP], trial[1 + px.BIAS] = math.log(low), a, facts.mean - low * a
    trial[1 + px.LOG_VARIANCE] = math.log(max(_BLURRED2 * a * a - rounding, 0.01))
    trial[1 + px.SATELLITE] = 0.0
    loglik: float = evaluate(pixel, trial, px.LOGLIK_ALONE, scratch, scratch.evaluations[px.AT])
    return loglik


@kernel(borrows=True)
def side_lobe(pixel: Pixel, theta: FloatArray) -> float:
    """Return the height exp(-2 pi^2 s_e^2) of the side lobe in units of its noise, 1/sqrt(N) at most.

    Where the satellite sinks into the noise, maxima at other gains come as near as the right one.
    """
    n = pixel.facts.shape[0]
    most = 0.0
    for j in range(n):
        if not pixel.facts[j].dark:
            most = max(most, pixel.facts[j].n_frames)
    noise2 = math.exp(theta[n + px.LOG_VARIANCE]) / theta[n + px.STEP] ** 2
    return math.sqrt(most) * math.exp(-2.0 * math.pi**2 * noise2)


@kernel(borrows=True)
def settled(pixel: Pixel, theta: FloatArray, clear: bool, above_null: float, out: Any) -> tuple[bool, bool]:
    """Return whether a maximum fits well, its gain settled, and whether others may be higher.

    They do not where the fit is good and far above one Gaussian, nor where it is poor and the side lobe all
    the same far out of the noise, which a misfit raises by sqrt(chi2 / freedom): then the model is wrong, and
    not the start. ``clear``: a side lobe of one of several samples stands clear of the noise.
    """
    n, lobe = pixel.facts.shape[0], side_lobe(pixel, theta)
    good = score_of(out) < SUSPICIOUS and ((n > 1 and not clear) or lobe > _CLEAR_LOBE)
    good = good and (n > 1 or above_null > CLEAR_GAP)
    misfit = math.sqrt(out.chi2 / max(out.freedom, 1))
    of_the_model = n == 1 and out.freedom > 0 and lobe > _SURE_LOBE * misfit
    return good, not (good or of_the_model)


@kernel(borrows=True)
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
def pearson(weights: FloatArray, expectations: FloatArray, n_bins: int, n: float) -> tuple[float, int]:
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
        own, degrees = pearson(bins[px.WEIGHT], bins[px.EXPECTED], facts.n_bins, facts.n_frames)
        if degrees > 0:
            chi2 += own
            freedom += degrees + FITTED_PARAMETERS
            if not facts.dark:
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
        for i in range(pixel.facts[j].n_bins):
            if bins[px.EXPECTED, i] < floor:
                found += bins[px.WEIGHT, i]
    return found


@kernel(borrows=True)
def examine(pixel: Pixel, tools: Tools, theta: FloatArray, out: Any) -> float:
    """Evaluate at a maximum, into `AT_BEST`; fill goodness of fit and outliers; return the log-likelihood."""
    scratch = tools.scratch
    loglik: float = tools.evaluate(pixel, theta, px.EXPECTATIONS, scratch, scratch.evaluations[px.AT_BEST])
    scratch.used[0] += 1
    out.outlying = outlying(pixel, tools.limits.floor)
    out.chi2, out.freedom = goodness(pixel)
    return loglik


@kernel(borrows=True)
def score_of(out: Any) -> float:
    """Return the goodness of fit in a row of results as a standard normal deviate."""
    score: float = normal_score(out.chi2, out.freedom)
    return score


@kernel(borrows=True)
def judge(
    pixel: Pixel,
    limits: Limits,
    best: FloatArray,
    above_null: float,
    above_blurred: float,
    gap: float,
    of_gain: bool,
) -> int:
    """Return the status word of a converged pixel.

    The maximum is so many nats above the likelihoods without a gain and without peaks, of which twice the
    smallest gap is asked: combs of many steps had the chance to come out higher. ``gap`` is that to the
    runner-up; ``of_gain``: one that is near has another gain.
    """
    n, status = pixel.facts.shape[0], 0
    sigma, a = math.exp(0.5 * best[n + px.LOG_VARIANCE]), best[n + px.STEP]
    at_bound = True
    for j in range(n):
        at_bound = at_bound and (pixel.facts[j].dark or best[j] <= limits.bound + 1e-9)
    if above_null < limits.gap:
        status |= GAIN_NOT_IDENTIFIED
    if gap < limits.gap:
        status |= BIAS_AMBIGUOUS
    if of_gain:
        status |= GAIN_AMBIGUOUS
    if n == 1 and min(above_null, above_blurred) < 2.0 * limits.gap:
        status |= GAIN_AMBIGUOUS
    if at_bound:
        status |= EXPOSURE_AT_BOUND
    if not limits.cells and (sigma < _COARSE_NOISE or a < _COARSE_STEP):
        status |= COARSE_STEPS
    if n > 1 and limits.cells and sigma < _COARSE_NOISE and 1.0 / a > 0.5 - NEAR_TWO:
        status |= GAIN_AMBIGUOUS  # combs with the same codes are looked for in single samples only
    if n == 1:
        if limits.cells and (sigma < _LOCKED_NOISE or pixel.facts[0].occupied < _FEWEST_CODES):
            status |= GAIN_AMBIGUOUS
        if limits.cells:
            sigma = math.sqrt(sigma * sigma + QUANTISATION_VARIANCE)
        if sigma / a > limits.noise:
            status |= NOT_INFORMATIVE
    return status


@kernel(borrows=True)
def rival_moves_gain(pixel: Pixel, tools: Tools, best: FloatArray, loglik: float, runner_up: float) -> bool:
    """Return whether a rival within the smallest gap of a single sample's maximum has another gain.

    An electron more or fewer hardly moves the gain where peaks are resolved, which then bring many nats by
    themselves. Any other rival has a gain of its own.
    """
    least, highest, trial = loglik - tools.limits.gap, -math.inf, tools.scratch.small[px.OTHER]
    if pixel.facts.shape[0] > 1 or not runner_up > least:
        return False
    blurred = loglik_without_ripple(pixel, tools.evaluate, tools.limits.cells, tools.scratch)
    if loglik - blurred < CLEAR_GAP:
        return True
    for which in range(2):
        if _neighbour(which, pixel, best, trial):
            outcome, height = climb_on(pixel, tools, from_start(), best, trial)
            if outcome == CONVERGED and height > least:
                highest = max(highest, height)
                if abs(trial[1 + px.STEP] - best[1 + px.STEP]) > _SAME_GAIN * best[1 + px.STEP]:
                    return True
    return bool(runner_up > highest + _SAME_RIVAL)


@kernel(borrows=True)
def next_start(scratch: Scratch, theta: FloatArray) -> bool:
    """Take the highest of the starts; False where none is left."""
    heights, which = scratch.small[px.HEIGHTS], 0
    for i in range(1, px.N_KEPT):
        if heights[i] > heights[which]:
            which = i
    if heights[which] == -math.inf:
        return False
    heights[which] = -math.inf
    copy(scratch.small[px.KEPT_STARTS + which], theta)
    return True


@kernel
def fall_and_parabola(
    pixel: Pixel, tools: Tools, best: FloatArray, loglik: float, which: int
) -> tuple[float, float]:
    """Return by how many nats the log-likelihood falls to other values of a parameter, and by its error.

    The scratch holds the evaluation at the maximum, and starts, of which the two highest are climbed from
    with the parameter fixed. The fall is infinite where nothing is to be known.
    """
    scratch, top, covariance = tools.scratch, -math.inf, np.empty((best.size, best.size))
    at, held, trial, change = (
        scratch.evaluations[px.AT_BEST],
        scratch.flags[px.HELD],
        scratch.small[px.HERE],
        0.0,
    )
    find_held(best, at, scratch.flags[px.FIXED], tools.limits, held)
    if not invert_arrow(at, best, held, covariance):
        return math.inf, 0.0
    scratch.flags[px.FIXED, which] = True
    for _ in range(2):
        if next_start(scratch, trial):
            change = trial[which] - best[which]
            top = max(top, climb_on(pixel, tools, from_start(), trial, trial)[1])
    scratch.flags[px.FIXED, which] = False
    return loglik - top, 0.5 * change**2 / covariance[which, which]


@kernel
def ripple_by_chance(pixel: Pixel, tools: Tools, best: FloatArray, loglik: float) -> bool:
    """Return whether the standard errors of several samples rest on peaks that may be seen by chance.

    They then exclude read noises that the likelihood does not. One without peaks, 0.8 e-, has the same
    variances with a bias and exposures that are off by the difference of the squares, e-.
    """
    n, trial = pixel.facts.shape[0], tools.scratch.small[px.HERE]
    more = _BLURRED2 - math.exp(best[n + px.LOG_VARIANCE]) / best[n + px.STEP] ** 2
    if more < 0.0 or nats_of_peaks(pixel, best) < _UNSEEN:
        return False
    copy(best, trial)
    for j in range(n):
        trial[j] = math.log(math.exp(best[j]) + more)
    trial[n + px.BIAS] -= more * best[n + px.STEP]
    trial[n + px.LOG_VARIANCE] = math.log(_BLURRED2 * best[n + px.STEP] ** 2)
    no_starts(tools.scratch.small[px.HEIGHTS])
    keep_start(pixel, tools.evaluate, tools.limits.cells, tools.scratch)
    fall, parabola = fall_and_parabola(pixel, tools, best, loglik, n + px.LOG_VARIANCE)
    least = tools.limits.gap
    return bool(fall < 2.0 * least and parabola > 2.0 * max(fall, least))


@kernel(borrows=True)
def above_blurred(pixel: Pixel, tools: Tools, best: FloatArray, loglik: float) -> float:
    """Return the nats that a maximum is above the likelihood without peaks; infinite where that is sure."""
    if pixel.facts.shape[0] > 1 or nats_of_peaks(pixel, best) > SURELY_SEEN:
        return math.inf
    above: float = loglik - loglik_without_ripple(pixel, tools.evaluate, tools.limits.cells, tools.scratch)
    return above


@kernel(borrows=True)
def _weigh(pixel: Pixel, tools: Tools, clear: bool, found: Found, best: FloatArray, out: Any) -> Found:
    """Examine a new best maximum and, unless the fit rules them out, its neighbours; keep the likeliest."""
    n, loglik, runner_up = pixel.facts.shape[0], found.loglik, found.runner_up
    at_best = examine(pixel, tools, best, out)
    if n == 1 and not tools.limits.cells:
        good, _ = settled(pixel, best, clear, math.inf, out)
        expected = expected_gap(pixel.facts[0].n_frames, best)
        sure = max(_SURE_GAP, _SURE_THRESHOLDS * tools.limits.gap)
        if good and out.freedom > 0 and expected > sure and best[n + px.STEP] > _FINE_STEP:
            return Found(at_best, max(runner_up, at_best - expected), found.degenerate)
    higher, beside = climb_neighbours(pixel, tools, best, loglik)
    if higher > loglik:
        at_best = examine(pixel, tools, best, out)
    return Found(at_best, max(beside, runner_up), found.degenerate)


@kernel(borrows=True)
def _climb_start(
    pixel: Pixel, tools: Tools, clear: bool, found: Found, trial: FloatArray, best: FloatArray, out: Any
) -> Found:
    """Climb from ``trial``; a higher maximum takes the place of ``best``."""
    n, cells = pixel.facts.shape[0], tools.limits.cells
    known, goal = best[n + px.STEP] > 0.0, from_start()
    # of several samples, and of cells, one comb may have two maxima
    if known and n == 1 and not cells:
        goal = goal_beside(True, found.loglik, found.runner_up)
    outcome, loglik = climb_on(pixel, tools, goal, best, trial)
    if outcome == DEGENERATE:
        return Found(found.loglik, found.runner_up, np.bool_(True))
    same = known and same_place(best, trial, cells)
    least = found.loglik + _SAME_COMB if same and not cells else found.loglik
    if outcome != CONVERGED or loglik <= least:
        # where a climb did not arrive, a higher value is none of the density's likelihood
        no_rival = same or (outcome != CONVERGED and loglik > found.loglik and not cells)
        runner_up = found.runner_up if no_rival else max(found.runner_up, loglik)
        return Found(found.loglik, runner_up, found.degenerate)
    runner_up = found.runner_up if same else max(found.runner_up, found.loglik)
    copy(trial, best)
    if same and cells:  # its neighbours are known
        return Found(examine(pixel, tools, best, out), runner_up, found.degenerate)
    weighed: Found = _weigh(pixel, tools, clear, Found(loglik, runner_up, found.degenerate), best, out)
    return weighed


@kernel(borrows=True)
def climb_starts(pixel: Pixel, tools: Tools, clear: bool, found: Found, best: FloatArray, out: Any) -> Found:
    """Climb from the starts, the highest first; a higher maximum takes the place of ``best``."""
    trial = tools.scratch.small[px.HERE]
    while next_start(tools.scratch, trial):
        found = _climb_start(pixel, tools, clear, found, trial, best, out)
    return found


@kernel(borrows=True)
def _stay_near(pixel: Pixel, tools: Tools, task: Task, trial: FloatArray, out: Any) -> tuple[bool, float]:
    """Climb from what is known; return whether that fits well, and its log-likelihood."""
    copy(task.near, trial)
    outcome, loglik = climb_on(pixel, tools, from_start(), trial, trial)
    if outcome != CONVERGED:
        return False, loglik
    examine(pixel, tools, trial, out)
    return score_of(out) < SUSPICIOUS, loglik


def search_density(pixel: Pixel, tools: Tools, task: Task, best: FloatArray, out: Any) -> int:
    """Find the most likely parameters of one pixel with the density.

    Where an answer is known to be near, the maximum next to it is taken as long as it fits well. Otherwise
    the first start is climbed from; where the goodness of fit or a side lobe in the noise raises suspicion,
    the other starts follow; the likeliest maximum is kept.

    ``best`` becomes theta at the maximum, its step 0 where there is none, ``out`` is filled, see `RESULT`;
    score and information at the maximum are in `AT_BEST`. Return the status word.
    """
    n, limits, null = pixel.facts.shape[0], tools.limits, loglik_without_gain(pixel)
    used, trial, heights = tools.scratch.used, tools.scratch.small[px.HERE], tools.scratch.small[px.HEIGHTS]
    best[n + px.STEP] = 0.0
    if task.near[n + px.STEP] > 0.0:
        fits, loglik = _stay_near(pixel, tools, task, trial, out)
        if fits:
            copy(trial, best)
            out.log_likelihood, out.gap = loglik, min(task.gap, loglik - null)
            word = judge(pixel, limits, best, loglik - null, math.inf, math.inf, False)
            out.evaluations += used[0]
            return int(word)
    found = Found(-math.inf, -math.inf, np.bool_(False))
    for attempt in range(N_ATTEMPTS):
        clear = fill_starts(attempt, limits.quick, pixel, tools.basis, tools.evaluate, tools.scratch)
        before = found.loglik
        if clear and attempt == 0:
            most = -math.inf
            for i in range(px.N_KEPT):  # the highest is kept
                most = max(most, heights[i])
            for i in range(px.N_KEPT):
                heights[i] = heights[i] if heights[i] == most else -math.inf
        found = climb_starts(pixel, tools, clear, found, best, out)
        if (n > 1 or attempt == 0) and best[n + px.STEP] > 0.0:
            poor, least = score_of(out) > SUSPICIOUS, found.loglik - CLEAR_GAP
            longer_steps(pixel, tools.evaluate, poor, best, least, tools.scratch)
            found = climb_starts(pixel, tools, clear, found, best, out)
        if found.loglik > before and not settled(pixel, best, clear, found.loglik - null, out)[1]:
            break
        if limits.quick and found.loglik - null > limits.gap:
            break
    out.evaluations += used[0]
    if not best[n + px.STEP] > 0.0:
        out.freedom = 0
        return GAIN_NOT_IDENTIFIED if found.degenerate else FIT_NOT_CONVERGED
    out.log_likelihood = found.loglik
    blurred = above_blurred(pixel, tools, best, found.loglik)
    out.gap = min(found.loglik - max(found.runner_up, null), blurred)
    of_gain = rival_moves_gain(pixel, tools, best, found.loglik, found.runner_up)
    gap = found.loglik - found.runner_up
    word = judge(pixel, limits, best, found.loglik - null, blurred, gap, of_gain)
    return int(word)
