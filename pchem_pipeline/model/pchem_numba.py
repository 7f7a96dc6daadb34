"""The fit of one pixel and the loop over the pixels of a tile."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.estep_numba import LOG_2PI, N_TOTAL, evaluate
from pchem_pipeline.model.fisher_numba import to_natural
from pchem_pipeline.model.goodness_numba import normal_score, pearson
from pchem_pipeline.model.polish_numba import (
    CONVERGED,
    DEGENERATE,
    MAX_STEP,
    MIN_LOG_EXPOSURE,
    copy,
    min_log_variance,
    polish,
    same_maximum,
)
from pchem_pipeline.model.polish_numba import N_LIMITS as POLISH_LIMITS
from pchem_pipeline.model.start_numba import (
    N_FREQUENCIES_WIDE,
    assemble,
    start_cumulants,
    start_peak,
    start_regression,
)

# bits of fit_status; a test compares them with FitStatus
NO_DATA, TOO_FEW_BINS, FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED, EXPOSURE_AT_BOUND = 1, 2, 4, 8, 16
BIAS_AMBIGUOUS, NOT_INFORMATIVE, COARSE_STEPS = 32, 64, 1024

# places in `limits`, after those of `polish`
GAP_THRESHOLD, NOISE_LIMIT = POLISH_LIMITS, POLISH_LIMITS + 1
N_LIMITS = POLISH_LIMITS + 2

# columns of `out`
LOG_LIKELIHOOD, GAP, CHI2 = 0, 1, 2
N_OUT = 3

N_WORK = 9  # rows of scratch

_CLEAR_GAP = 30.0  # nats: a neighbour this far below is not polished to the end
_SUSPICIOUS = 3.0  # standard normal: a goodness of fit that calls for the other starts
_SUSPICIOUS_NOISE = 0.45  # e-: above it the side lobe sinks into the noise and the first start errs more often
_MOST_MOVES = 40
_MIN_STEP = 1.0  # DN per electron, of a start
_COARSE_NOISE = 0.6  # DN: below it, or below so many DN per electron, rounding is more than additive noise
_COARSE_STEP = 2.5
_N_SCAN = 25  # steps of the scan over the gain, from a fifth of the sd to 2.5 sd


@nb.njit(nogil=True, cache=True, error_model="numpy")
def log_likelihood_gaussian(n: float, variance: float) -> float:
    """Return the log-likelihood of the best single Gaussian, the limit g to infinity."""
    return -0.5 * n * (LOG_2PI + 1.0 + math.log(max(variance, 1.0 / 12.0)))


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _climb_neighbours(
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    n_bins: int,
    first: float,
    best: NDArray[np.float64],
    best_loglik: float,
    limits: NDArray[np.float64],
    work: NDArray[np.float64],
    total: NDArray[np.float64],
    score: NDArray[np.float64],
    information: NDArray[np.float64],
) -> tuple[float, float, int]:
    """Move to a neighbour (H -+ 1, mu +- 1/g) while one is more likely; ``best`` is updated in place.

    Returns:
        Log-likelihood of the best, that of the best neighbour left (-inf without one), evaluations.
    """
    trial = np.empty(4)
    runner_up = -math.inf
    used = 0
    came_from = 0.0
    moves = 0
    direction = 1.0
    tried = 0
    while tried < 2:
        exposure = math.exp(best[0]) + direction
        if direction != came_from and exposure > 0.03:
            trial[0] = math.log(exposure)
            trial[1] = best[1]
            trial[2] = best[2] - direction * best[1]
            trial[3] = best[3]
            outcome, loglik, count = polish(
                weights, cumulative, n_bins, first, trial, limits, best_loglik - _CLEAR_GAP,
                best, best_loglik, work, total, score, information,
            )  # fmt: skip
            used += count
            if outcome != DEGENERATE and not same_maximum(best, trial):
                if loglik > best_loglik and outcome == CONVERGED and moves < _MOST_MOVES:
                    runner_up = best_loglik
                    copy(trial, best)
                    best_loglik = loglik
                    came_from = -direction
                    moves += 1
                    tried = 0
                    continue
                runner_up = max(runner_up, loglik)
            elif loglik > best_loglik and outcome == CONVERGED:
                copy(trial, best)
                best_loglik = loglik
        direction = -direction
        tried += 1
    return best_loglik, runner_up, used


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _first_start(
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    n_bins: int,
    first: float,
    n: float,
    mean: float,
    variance: float,
    basis: NDArray[np.float64],
    work: NDArray[np.float64],
    total: NDArray[np.float64],
    score: NDArray[np.float64],
    information: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> bool:
    """Fill ``theta`` with the regression's start, or, if that sees no side lobe, the likeliest of three."""
    usable, clear = start_regression(weights, n_bins, first, n, mean, variance, basis, work, theta)
    if usable and clear:
        return True
    trial = np.empty(4)
    best = -math.inf
    if usable:
        best = evaluate(weights, cumulative, n_bins, first, theta, work, total, score, information, 0.0)
    for which in range(2):
        if which == 0:
            found = start_peak(weights, n_bins, first, n, mean, variance, work, trial)
        else:
            found = start_cumulants(weights, n_bins, first, n, mean, variance, trial)
        if found and trial[1] > _MIN_STEP:
            loglik = evaluate(weights, cumulative, n_bins, first, trial, work, total, score, information, 0.0)
            if loglik > best:
                best = loglik
                copy(trial, theta)
                usable = True
    return usable


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _scan(
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    n_bins: int,
    first: float,
    n: float,
    mean: float,
    variance: float,
    work: NDArray[np.float64],
    total: NDArray[np.float64],
    score: NDArray[np.float64],
    information: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> bool:
    """Fill ``theta`` with the likeliest of a row of gains, the read noise taken as 0.35 e-."""
    trial = np.empty(4)
    best = -math.inf
    for place in range(_N_SCAN):
        a = math.sqrt(variance) * 0.2 * 12.5 ** (place / (_N_SCAN - 1.0))
        exposure = variance / (a * a) - 0.1225
        if exposure > 0.0 and a > _MIN_STEP:
            assemble(weights, n_bins, first, n, mean, variance, a, exposure, trial)
            trial[3] = math.log(max(0.1225 * a * a, 1.0 / 12.0))
            loglik = evaluate(weights, cumulative, n_bins, first, trial, work, total, score, information, 0.0)
            if loglik > best:
                best = loglik
                copy(trial, theta)
    return best > -math.inf


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _other_start(
    which: int,
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    n_bins: int,
    first: float,
    n: float,
    mean: float,
    variance: float,
    best: NDArray[np.float64],
    work: NDArray[np.float64],
    total: NDArray[np.float64],
    score: NDArray[np.float64],
    information: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> bool:
    """Fill ``theta`` with one of the starts kept for suspicious pixels."""
    if which == 0:
        return start_peak(weights, n_bins, first, n, mean, variance, work, theta)
    if which == 1:
        return start_cumulants(weights, n_bins, first, n, mean, variance, theta)
    if which == 2:
        return _scan(
            weights, cumulative, n_bins, first, n, mean, variance, work, total, score, information, theta
        )
    if not best[1] > 0.0:
        return False
    scale = 2.0 if which == 3 else 0.5  # the maxima at half and at twice the gain
    exposure = math.exp(best[0]) / scale
    theta[0] = math.log(exposure)
    theta[1] = best[1] * scale
    theta[2] = mean - exposure * theta[1]
    theta[3] = math.log(max(variance - exposure * theta[1] ** 2, 0.09 * theta[1] ** 2))
    return True


@nb.njit(nogil=True, cache=True, error_model="numpy")
def fit_pixel(
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    n_bins: int,
    first: float,
    n: float,
    mean: float,
    variance: float,
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    work: NDArray[np.float64],
    best: NDArray[np.float64],
    information: NDArray[np.float64],
    out: NDArray[np.float64],
) -> tuple[int, int, int]:
    """Find the most likely parameters of one pixel.

    Args:
        weights: counts of successive DN.
        cumulative: running sums of the weights, one longer.
        n_bins: number of DN in use.
        first: first DN minus the centre.
        n: number of frames.
        mean: mean of the values minus the centre.
        variance: variance of the values, DN^2.
        basis: of the regression on the ECF.
        limits: bounds and limits.
        work: scratch.
        best: out, theta at the maximum.
        information: out, observed information there.
        out: out, a row of results; the columns named at the top of this module.

    Returns:
        Status word, evaluations, degrees of freedom of the goodness of fit.
    """
    trial, score, total, scratch = np.empty(4), np.empty(4), np.empty(N_TOTAL), np.empty((4, 4))
    best_loglik, runner_up = -math.inf, -math.inf
    gaussian = log_likelihood_gaussian(n, variance)
    used = freedom = 0
    degenerate = False
    for i in range(4):
        best[i] = 0.0
    for attempt in range(-1, 5):
        if attempt < 0:
            usable = _first_start(
                weights, cumulative, n_bins, first, n, mean, variance, basis, work, total, score, scratch, trial
            )
        else:
            usable = _other_start(
                attempt, weights, cumulative, n_bins, first, n, mean, variance, best,
                work, total, score, scratch, trial,
            )  # fmt: skip
        if not usable:
            continue
        outcome, loglik, count = polish(
            weights, cumulative, n_bins, first, trial, limits, -math.inf,
            trial, math.inf, work, total, score, scratch,
        )  # fmt: skip
        used += count
        if outcome == DEGENERATE:
            degenerate = True
        if outcome != CONVERGED or (best[1] > 0.0 and same_maximum(best, trial)):
            continue
        if loglik <= best_loglik:
            runner_up = max(runner_up, loglik)
            continue
        runner_up = best_loglik
        copy(trial, best)
        loglik, beside, count = _climb_neighbours(
            weights, cumulative, n_bins, first, best, loglik, limits, work, total, score, scratch
        )
        used += count + 1
        runner_up = max(beside, runner_up)
        best_loglik = evaluate(weights, cumulative, n_bins, first, best, work, total, score, information, n)
        out[CHI2], freedom = pearson(weights, work[0], n_bins, n)
        noise = math.exp(0.5 * best[3]) / best[1]
        if normal_score(out[CHI2], freedom) < _SUSPICIOUS and noise < _SUSPICIOUS_NOISE:
            break
    if not best[1] > 0.0:
        return GAIN_NOT_IDENTIFIED if degenerate else FIT_NOT_CONVERGED, used, 0
    out[LOG_LIKELIHOOD] = best_loglik
    out[GAP] = best_loglik - max(runner_up, gaussian)
    return _judge(best, best_loglik, runner_up, gaussian, limits), used, freedom


@nb.njit(nogil=True, cache=True, error_model="numpy")
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


@nb.njit(nogil=True, cache=True, error_model="numpy")
def load_pixel(
    counts: NDArray[np.unsignedinteger],
    weights: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    summary: NDArray[np.float64],
) -> tuple[int, int, int]:
    """Copy a histogram without its empty ends and sum it up.

    Returns:
        First occupied bin, bins from there to the last occupied one, occupied bins; ``summary`` receives the
        number of frames, mean and variance (DN, counted from the first occupied bin).
    """
    low, high = 0, counts.size
    while low < high and counts[low] == 0:
        low += 1
    while high > low and counts[high - 1] == 0:
        high -= 1
    n_bins = high - low
    cumulative[0] = 0.0
    occupied = 0
    moment = 0.0
    for i in range(n_bins):
        c = float(counts[low + i])
        weights[i] = c
        cumulative[i + 1] = cumulative[i] + c
        moment += c * i
        if c > 0.0:
            occupied += 1
    n = cumulative[n_bins]
    mean = moment / n if n > 0.0 else 0.0
    square = 0.0
    for i in range(n_bins):
        square += weights[i] * (i - mean) ** 2
    summary[0] = n
    summary[1] = mean
    summary[2] = square / n if n > 0.0 else 0.0
    return low, n_bins, occupied


@nb.njit(nogil=True, cache=True, error_model="numpy")
def fit_tile(
    counts: NDArray[np.unsignedinteger],
    origin: NDArray[np.int64],
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> None:
    """Fit every row of ``counts``; pixels do not influence each other.

    Args:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
        basis: of the regression on the ECF.
        limits: bounds and limits, shape (N_LIMITS,).
        parameters: out, (H, g, mu, sigma), shape (n, 4); comes as NaN.
        covariance: out, shape (n, 4, 4); comes as NaN.
        out: out, shape (n, N_OUT); comes as NaN.
        words: out, per pixel: status, evaluations, degrees of freedom, first and last DN seen; shape (n, 5);
            comes as 0.
    """
    n_most = counts.shape[1]
    work = np.empty((N_WORK, max(n_most + 2, N_FREQUENCIES_WIDE)))
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    summary, theta, information = np.empty(3), np.empty(4), np.empty((4, 4))
    held = np.zeros(4, np.bool_)
    own_limits = limits.copy()
    for pixel in range(counts.shape[0]):
        low, n_bins, occupied = load_pixel(counts[pixel], weights, cumulative, summary)
        words[pixel, 3] = origin[pixel] + low
        words[pixel, 4] = origin[pixel] + low + n_bins - 1
        if occupied < 3:
            words[pixel, 0] = NO_DATA if occupied == 0 else TOO_FEW_BINS
            continue
        middle = float(math.floor(summary[1]))
        own_limits[MAX_STEP] = 4.0 * n_bins + 10.0
        status, words[pixel, 1], words[pixel, 2] = fit_pixel(
            weights, cumulative, n_bins, -middle, summary[0], summary[1] - middle, summary[2],
            basis, own_limits, work, theta, information, out[pixel],
        )  # fmt: skip
        if theta[1] > 0.0:
            held[0] = status & EXPOSURE_AT_BOUND != 0
            held[3] = theta[3] <= min_log_variance(theta[1]) + 1e-9
            centre = float(origin[pixel] + low) + middle
            if not to_natural(theta, centre, information, held, parameters[pixel], covariance[pixel]):
                status |= FIT_NOT_CONVERGED
        words[pixel, 0] = status
