"""The fit of one pixel, from its starts to the likeliest maximum."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.candidates_numba import N_OTHERS, first_start, other_start
from pchem_pipeline.model.fit.goodness_numba import normal_score, pearson
from pchem_pipeline.model.fit.outliers_numba import outlying
from pchem_pipeline.model.fit.polish_numba import (
    CONVERGED,
    DEGENERATE,
    MIN_LOG_EXPOSURE,
    N_POLISH_LIMITS,
    polish,
    same_maximum,
)
from pchem_pipeline.model.law.estep_numba import LOG_2PI, evaluate
from pchem_pipeline.model.law.workspace_numba import (
    Histogram,
    Workspace,
    copy,
)

# bits of fit_status; a test compares them with FitStatus
NO_DATA, TOO_FEW_BINS, FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED, EXPOSURE_AT_BOUND = 1, 2, 4, 8, 16
BIAS_AMBIGUOUS, NOT_INFORMATIVE, COARSE_STEPS = 32, 64, 1024

# places in `limits`, after those of `polish`
GAP_THRESHOLD, NOISE_LIMIT = N_POLISH_LIMITS, N_POLISH_LIMITS + 1
FLOOR, MOST_OUTLIERS = N_POLISH_LIMITS + 2, N_POLISH_LIMITS + 3  # of the tail guard; a floor of 0 is none
N_LIMITS = N_POLISH_LIMITS + 4

# columns of `out`
LOG_LIKELIHOOD, GAP, CHI2, OUTLYING = 0, 1, 2, 3
N_OUT = 4

# columns of `words`
STATUS, EVALUATIONS, FREEDOM, LOWEST_DN, HIGHEST_DN, FRAMES = range(6)
N_WORDS = 6

_CLEAR_GAP = 30.0  # nats: a neighbour this far below is not polished to the end
_SURE_GAP = 80.0  # nats: where so much is expected, and the fit is good, it is surely more than those 30 ...
_SURE_THRESHOLDS = 4.0  # ... and, so many times the gap that counts as ambiguous, more than that, too
_FINE_STEP = 5.0  # DN per electron: below it climbs from a neighbour also meet combs that fit whole numbers
_SUSPICIOUS = 3.0  # standard normal: a goodness of fit that calls for the other starts
_CLEAR_LOBE = 3.0  # standard errors: a side lobe of the characteristic function that settles the gain
_MOST_MOVES = 40
_COARSE_NOISE = 0.6  # DN: below it, or below so many DN per electron, rounding is more than additive noise
_COARSE_STEP = 2.5


@kernel
def log_likelihood_gaussian(n: float, variance: float) -> float:
    """Return the log-likelihood of the best single Gaussian, the limit g to infinity."""
    return -0.5 * n * (LOG_2PI + 1.0 + math.log(max(variance, 1.0 / 12.0)))


@kernel
def climb_neighbours(
    histogram: Histogram,
    best: NDArray[np.float64],
    best_loglik: float,
    limits: NDArray[np.float64],
    space: Workspace,
) -> tuple[float, float, int]:
    """Move to a neighbour (H -+ 1, mu +- 1/g) while one is more likely.

    Args:
        histogram: of the pixel.
        best: a maximum, theta; out: the likeliest of the row.
        best_loglik: its log-likelihood.
        limits: bounds and limits.
        space: scratch.

    Returns:
        Log-likelihood of the best, that of the best neighbour left (-inf without one), evaluations.
    """
    trial = np.empty(4)
    runner_up = -math.inf
    came_from, direction = 0.0, 1.0
    used = moves = tried = 0
    while tried < 2:
        exposure = math.exp(best[0]) + direction
        if direction != came_from and exposure > 0.03:
            trial[0] = math.log(exposure)
            trial[1] = best[1]
            trial[2] = best[2] - direction * best[1]
            trial[3] = best[3]
            outcome, loglik, count = polish(
                histogram, trial, limits, best_loglik - _CLEAR_GAP, best, best_loglik, space
            )
            used += count
            higher = loglik > best_loglik and outcome == CONVERGED
            if outcome != DEGENERATE and not same_maximum(best, trial):
                if higher and moves < _MOST_MOVES:
                    runner_up = best_loglik
                    copy(trial, best)
                    best_loglik = loglik
                    came_from = -direction
                    moves += 1
                    tried = 0
                    continue
                runner_up = max(runner_up, loglik)
            elif higher:
                copy(trial, best)
                best_loglik = loglik
        direction = -direction
        tried += 1
    return best_loglik, runner_up, used


@kernel
def side_lobe(histogram: Histogram, theta: NDArray[np.float64]) -> float:
    """Return the height exp(-2 pi^2 s_e^2) of the ECF's side lobe in units of its noise, 1/sqrt(N).

    Where the lobe sinks into the noise, maxima at other gains come as near as the right one.
    """
    noise2 = math.exp(theta[3]) / (theta[1] * theta[1])
    return math.sqrt(histogram.n) * math.exp(-2.0 * math.pi**2 * noise2)


@kernel
def expected_gap(n: float, theta: NDArray[np.float64]) -> float:
    """Return how many nats the likelier neighbour (H -+ 1, mu +- 1/g) of a right answer is expected below it.

    For peaks apart, two Poisson laws a step apart in k; where the peaks merge, what is left of the ripple.
    The constants are from climbs on exact histograms (H 0.05..32, s_e 0.1..0.46 e-): the gap found is 0.78 to
    2.4 times this, unless there is no such maximum.
    """
    exposure, noise2 = math.exp(theta[0]), math.exp(theta[3]) / (theta[1] * theta[1])
    ripple = 1.2 * noise2 * math.exp(4.0 * math.pi**2 * noise2)
    gap: float = n / (2.0 + exposure * (4.0 * exposure + ripple))
    return gap


@kernel
def _judge(
    best: NDArray[np.float64], loglik: float, runner_up: float, gaussian: float, limits: NDArray[np.float64]
) -> int:
    """Return the status word of a converged pixel."""
    status = 0
    if loglik - gaussian < limits[GAP_THRESHOLD]:
        status |= GAIN_NOT_IDENTIFIED
    if loglik - runner_up < limits[GAP_THRESHOLD]:
        status |= BIAS_AMBIGUOUS
    if math.exp(0.5 * best[3]) / best[1] > limits[NOISE_LIMIT]:
        status |= NOT_INFORMATIVE
    if best[0] <= limits[MIN_LOG_EXPOSURE] + 1e-9:
        status |= EXPOSURE_AT_BOUND
    if math.exp(0.5 * best[3]) < _COARSE_NOISE or best[1] < _COARSE_STEP:
        status |= COARSE_STEPS
    return status


@kernel
def _examine(
    histogram: Histogram,
    theta: NDArray[np.float64],
    at_best: Workspace,
    floor: float,
    out: NDArray[np.float64],
) -> tuple[float, int, float]:
    """Return log-likelihood, degrees of freedom and normal score of the goodness of fit.

    Its chi-square and the number of samples that are not expected go to ``out``.
    """
    loglik = evaluate(histogram, theta, at_best, histogram.n)
    out[OUTLYING] = outlying(histogram.weights, at_best.rows[0], histogram.n_bins, floor)
    out[CHI2], freedom = pearson(histogram.weights, at_best.rows[0], histogram.n_bins, histogram.n)
    return loglik, freedom, normal_score(out[CHI2], freedom)


@kernel
def fit_pixel(
    histogram: Histogram,
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    space: Workspace,
    near: NDArray[np.float64],
    best: NDArray[np.float64],
    at_best: Workspace,
    out: NDArray[np.float64],
) -> tuple[int, int, int]:
    """Find the most likely parameters of one pixel.

    Where an answer is known to be near, the maximum next to it is taken as long as it fits well.

    The first start is polished and its neighbours are climbed, unless the fit is good and much better than
    any neighbour of such a pixel: were a neighbour the right one, the fit could not be good. Where the
    goodness of fit or a side lobe in the noise raises suspicion, the other starts follow; the likeliest
    maximum is kept.

    Args:
        histogram: of the pixel.
        basis: of the regression on the ECF.
        limits: bounds and limits.
        space: scratch.
        near: theta near the maximum; its step is 0 where nothing is known.
        best: out, theta at the maximum; its step is 0 where there is none.
        at_best: out, score and information there; may share its rows with ``space``.
        out: out, a row of results; the columns are named at the top of this module.

    Returns:
        Status word, evaluations, degrees of freedom of the goodness of fit.
    """
    trial = np.empty(4)
    best_loglik, runner_up = -math.inf, -math.inf
    gaussian = log_likelihood_gaussian(histogram.n, histogram.variance)
    sure = max(_SURE_GAP, _SURE_THRESHOLDS * limits[GAP_THRESHOLD])
    used = freedom = 0
    degenerate = False
    best[1] = 0.0
    if near[1] > 0.0:
        copy(near, trial)
        outcome, loglik, used = polish(histogram, trial, limits, -math.inf, trial, math.inf, space)
        if outcome == CONVERGED:
            _, freedom, score = _examine(histogram, trial, at_best, limits[FLOOR], out)
            if score < _SUSPICIOUS:
                copy(trial, best)
                out[LOG_LIKELIHOOD], out[GAP] = loglik, loglik - gaussian
                return _judge(best, loglik, -math.inf, gaussian, limits), used + 1, freedom
    for attempt in range(-1, N_OTHERS):
        if attempt < 0:
            usable = first_start(histogram, basis, space, trial)
        else:
            usable = other_start(attempt, histogram, best, space, trial)
        if not usable:
            continue
        outcome, loglik, count = polish(histogram, trial, limits, -math.inf, trial, math.inf, space)
        used += count
        if outcome == DEGENERATE:
            degenerate = True
            continue
        if best[1] > 0.0 and same_maximum(best, trial):
            continue
        if outcome != CONVERGED or loglik <= best_loglik:
            runner_up = max(runner_up, loglik)
            continue
        runner_up = max(runner_up, best_loglik)
        copy(trial, best)
        best_loglik, freedom, score = _examine(histogram, best, at_best, limits[FLOOR], out)
        used += 1
        expected = expected_gap(histogram.n, best)
        good = score < _SUSPICIOUS and side_lobe(histogram, best) > _CLEAR_LOBE
        if good and freedom > 0 and expected > sure and best[1] > _FINE_STEP:
            runner_up = max(runner_up, best_loglik - expected)
            break
        higher, beside, count = climb_neighbours(histogram, best, loglik, limits, space)
        used += count
        runner_up = max(beside, runner_up)
        if higher > loglik:
            best_loglik, freedom, score = _examine(histogram, best, at_best, limits[FLOOR], out)
            used += 1
            good = score < _SUSPICIOUS and side_lobe(histogram, best) > _CLEAR_LOBE
        if good:
            break
    if not best[1] > 0.0:
        return GAIN_NOT_IDENTIFIED if degenerate else FIT_NOT_CONVERGED, used, 0
    out[LOG_LIKELIHOOD] = best_loglik
    out[GAP] = best_loglik - max(runner_up, gaussian)
    return _judge(best, best_loglik, runner_up, gaussian, limits), used, freedom
