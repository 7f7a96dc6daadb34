"""From a start to the nearest maximum of the likelihood: damped Newton steps, EM where that does not help.

A share of the damping matrix is added to the observed information, more of it where that is not positive
definite and after a step that disappoints (Levenberg and Marquardt). With the density that matrix is the
complete-data information: the step turns from Newton's into a shortened EM step, and at last into one,
eqs. (update_eqns) of Hendrickson et al. 2023 from the sums of all samples (multi-sample PCH-EM, Hendrickson
and Haefner 2024). With the cells it is the sum of the squared scores. The likelihood never falls.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import FEW_STEP, QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.algebra_numba import solve_arrow
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.pixel_numba import Pixel, Scratch, copy, copy_evaluation

# outcomes
CONVERGED = 0
NOT_CONVERGED = 1
DEGENERATE = 2  # ran towards one Gaussian: g to infinity, or an empty second peak
FAR_BELOW = 3  # given up: too far below the likelihood to beat
_GOING, _AT_KNOWN = 4, 5  # within a climb: not there yet; heading for the maximum that is known

MIN_LOG_VARIANCE = math.log(QUANTISATION_VARIANCE)
MIN_ELECTRON_NOISE = 0.03  # of the density: below it the polynomials of the E-step overflow
MAX_ELECTRON_NOISE = 3.0  # above it there is one Gaussian to all intents
# DN per electron: whole numbers do not tell 1/a from 1 - 1/a, and MIN_STEP is the alias of 6
ALIASED_STEP = 6.0
MIN_STEP = 1.2  # DN per electron, of the density: a comb with a tooth at each DN would fit any whole numbers
LEAST_STEP, LEAST_NOISE_DN, LEAST_NOISE_E = 0.6, 0.05, 0.02  # of the cells
MAX_LOG_EXPOSURE = math.log(1e5)
MOST_SATELLITE = 0.95
_LEAST_SHARE = 1e-5  # of the damping matrix in a damped step
_REFUSED, _REFUSED_CELLS = 3e-5, 1e-2  # after a step that was refused
# where the information is not positive definite: most of the step is the damping matrix's
_INDEFINITE_CELLS = 1.0
_SURELY_LOWER = 1e-4  # nats still to rise, where that much cannot reach the likelihood that is known
_LARGEST_SHARE = 3.0  # beyond it an EM step is taken, where there is one
_MOST_SHARE = 1e9
_BRIGHT = 3.0  # e-: a dimmer brightest sample does not tell neighbouring gains apart


class Limits(NamedTuple):
    """Bounds and limits of a climb and of the search, see :mod:`pchem_pipeline.model.fit.settings`."""

    bound: float  # smallest log H
    tolerance: float  # rise of the log-likelihood below which a climb ends, nats
    most: int  # evaluations allowed in a climb
    warm_up: int  # EM steps before the first Newton step, from a start
    only_em: bool  # take nothing but EM steps from a start
    cells: bool  # integrate the cells; else take the density
    gap: float  # nats below which a bias is ambiguous and a gain not identified
    noise: float  # e-, above which one sample does not inform
    floor: float  # expected frames per DN of the tail guard; 0: none
    most_outliers: float  # largest share of the frames that it leaves out
    satellite_rise: float  # nats that free satellites must bring
    reshapes: bool  # the law changes more than the width of peaks: look at neighbours
    warm: bool  # a start is of nearly the same law, not of the density
    scan: bool  # look for other starts at few DN per electron
    quick: bool  # with the density, the first maximum that tells the gain will do
    sandwich: bool  # the covariance is to hold even where the model does not


class Goal(NamedTuple):
    """What a climb is for.

    Attributes:
        first: it comes from a start, not from a neighbour: it may warm up by EM steps.
        to_beat: give up once twice the expected rise would leave the log-likelihood below.
        to_pass: give up once four times the expected rise would: a lower maximum says nothing new.
        known: log-likelihood of a maximum known already: the climb ends where it heads for that one, or
            has all but reached a lower one; infinite without one.
        tied: 1/g moves sigma with it, so that ``sigma g`` stays: the profile of the read noise in e-.
    """

    first: bool | np.bool_
    to_beat: float
    to_pass: float
    known: float
    tied: bool | np.bool_


@kernel(borrows=True)
def min_log_variance(a: float, cells: bool) -> float:
    """Return the lower bound of v for a step a: rounding, or little, and a floor in e-."""
    if cells:
        return 2.0 * math.log(max(LEAST_NOISE_DN, LEAST_NOISE_E * a))
    return max(MIN_LOG_VARIANCE, 2.0 * math.log(MIN_ELECTRON_NOISE * a))


@kernel(borrows=True)
def keep_inside(theta: FloatArray, limits: Limits) -> None:
    """Move ``theta`` to the nearest allowed values."""
    n = theta.size - px.N_BLOCK + 1
    for j in range(n):
        theta[j] = max(limits.bound, theta[j])
    floor = min_log_variance(theta[n + px.STEP], limits.cells)
    theta[n + px.LOG_VARIANCE] = max(theta[n + px.LOG_VARIANCE], floor)
    theta[n + px.SATELLITE] = min(max(theta[n + px.SATELLITE], 0.0), MOST_SATELLITE)


@kernel(borrows=True)
def brightest(theta: FloatArray) -> float:
    """Return the largest log H."""
    most: float = theta[0]
    for j in range(1, theta.size - px.N_BLOCK + 1):
        most = max(most, theta[j])
    return most


@kernel(borrows=True)
def sensible(theta: FloatArray, longest_step: float, cells: bool) -> bool:
    """Return whether parameters that are sought are where they can be told from those of Gaussians."""
    n = theta.size - px.N_BLOCK + 1
    a = theta[n + px.STEP]
    noise = math.exp(0.5 * theta[n + px.LOG_VARIANCE]) / a
    least = LEAST_STEP if cells else MIN_STEP
    inside = longest_step == px.KNOWN or (noise < MAX_ELECTRON_NOISE and least < a < longest_step)
    return bool(inside and brightest(theta) < MAX_LOG_EXPOSURE)


@kernel(borrows=True)
def same_place(left: FloatArray, right: FloatArray, cells: bool) -> bool:
    """Return whether two points belong to one maximum.

    The bias is the same within 0.3 e-, and so is the mean of the brightest sample; with the density of one
    sample the step within 10 %. Of cells of few DN per electron maxima are closer: a tenth of that.
    """
    n = left.size - px.N_BLOCK + 1
    a, most = left[n + px.STEP], _BRIGHT
    reach = (0.03 if cells and a < FEW_STEP else 0.3) * a
    if n > 1 or cells:
        most = max(math.exp(brightest(left)), _BRIGHT)
    near = abs(left[n + px.BIAS] - right[n + px.BIAS]) < reach
    return bool(near and abs(a - right[n + px.STEP]) * most < reach)


@kernel(borrows=True)
def find_held(theta: FloatArray, at: FloatArray, fixed: BoolArray, limits: Limits, held: BoolArray) -> None:
    """Return which parameters stay: those fixed, and at a bound that the likelihood pushes against."""
    n = at.shape[0]
    noise = satellite = 0.0
    for j in range(n):
        held[j] = fixed[j] or (theta[j] <= limits.bound + 1e-12 and at[j, px.SCORE, 0] <= 0.0)
        noise += at[j, px.SCORE, 1 + px.LOG_VARIANCE]
        satellite += at[j, px.SCORE, 1 + px.SATELLITE]
    held[n + px.STEP], held[n + px.BIAS] = fixed[n + px.STEP], fixed[n + px.BIAS]
    floor = min_log_variance(theta[n + px.STEP], limits.cells)
    at_floor = theta[n + px.LOG_VARIANCE] <= floor + 1e-12 and noise <= 0.0
    held[n + px.LOG_VARIANCE] = fixed[n + px.LOG_VARIANCE] or at_floor
    weight = theta[n + px.SATELLITE]
    at_end = (weight <= 0.0 and satellite <= 0.0) or (weight >= MOST_SATELLITE and satellite >= 0.0)
    held[n + px.SATELLITE] = fixed[n + px.SATELLITE] or at_end


@kernel(inline=True, borrows=True)
def em_step(pixel: Pixel, theta: FloatArray, at: FloatArray, limits: Limits, out: FloatArray) -> bool:
    """One EM update, eq. (update_eqns), from an evaluation of the density; False where it is not defined.

    Written in the residuals e = x - mu - k/g of the present parameters, without cancellation.
    """
    samples = at.shape[0]
    n = sum_k = sum_kk = sum_ke = sum_e = sum_ee = 0.0
    for j in range(samples):
        sums = at[j, px.SUMS]
        n += pixel.facts[j].n_frames
        sum_k, sum_kk, sum_ke = sum_k + sums[px.SUM_K], sum_kk + sums[px.SUM_KK], sum_ke + sums[px.SUM_KE]
        sum_e, sum_ee = sum_e + sums[px.SUM_E], sum_ee + sums[px.SUM_EE]
    exposure = sum_k / n
    spread = sum_kk / n - exposure * exposure
    if not (exposure > 0.0 and spread > 0.0):
        return False
    mean_e = sum_e / n
    # C - xbar A = a (B - A^2) + (sum of k e - A sum of e) / N
    change = (sum_ke / n - exposure * mean_e) / spread
    a = theta[samples + px.STEP] + change
    residual = sum_ee / n - mean_e * mean_e - change * change * spread
    if not (a > 0.0 and math.isfinite(a)):
        return False
    copy(theta, out)
    for j in range(samples):
        own = at[j, px.SUMS, px.SUM_K] / pixel.facts[j].n_frames
        out[j] = max(limits.bound, math.log(own)) if own > 0.0 else limits.bound
    out[samples + px.STEP] = a
    out[samples + px.BIAS] = theta[samples + px.BIAS] + mean_e - change * exposure
    out[samples + px.LOG_VARIANCE] = max(min_log_variance(a, limits.cells), math.log(max(residual, 1e-3)))
    return True


@kernel(borrows=True)
def newton_step(
    at: FloatArray, share: float, least: float, scratch: Scratch, step: FloatArray
) -> tuple[float, float]:
    """Fill the damped step of the parameters that are not held.

    Returns:
        Half the squared Newton decrement, the expected rise of the log-likelihood (NaN without a step), and
        the share of the damping matrix that it took.
    """
    squared = solve_arrow(at, share, scratch, step)
    while not squared >= 0.0:
        share = max(least, 3.0 * share)
        if share > _MOST_SHARE:
            return math.nan, share
        squared = solve_arrow(at, share, scratch, step)
    return 0.5 * squared, share


@kernel(borrows=True)
def _take_step(theta: FloatArray, step: FloatArray, tied: float, limits: Limits, out: FloatArray) -> float:
    """Take a Newton step, shortened to stay where the quadratic can be trusted; return the factor.

    With ``tied`` not negative the read noise in e- stays, that variance of rounding (DN^2) included.
    """
    n = theta.size - px.N_BLOCK + 1
    a = theta[n + px.STEP]
    longest = max(abs(step[n + px.STEP]) / (0.1 * a), abs(step[n + px.BIAS]) / (0.4 * a))
    longest = max(longest, abs(step[n + px.LOG_VARIANCE]) / 0.5, abs(step[n + px.SATELLITE]) / 0.3)
    for j in range(n):
        longest = max(longest, abs(step[j]) / 0.5)
    factor = 1.0 if longest <= 1.0 else 1.0 / longest
    for i in range(theta.size):
        out[i] = theta[i] + factor * step[i]
    if tied >= 0.0:
        ratio = out[n + px.STEP] / a
        variance = (math.exp(theta[n + px.LOG_VARIANCE]) + tied) * ratio * ratio - tied
        out[n + px.LOG_VARIANCE] = math.log(max(variance, 1e-12))
    keep_inside(out, limits)
    return factor


@kernel(inline=True, borrows=True)
def tie_noise(theta: FloatArray, at: FloatArray, rounding: float) -> None:
    """Turn score and information in 1/g at known sigma into those at known ``sigma g``, in place.

    With ``v = log(a^2 w - r)``, r the variance of rounding where v leaves it out: ``dv/da = 2 k / a`` and
    ``d2v/da2 = (2 k - 4 k^2) / a^2`` with ``k = 1 + r exp(-v)``.
    """
    n = theta.size - px.N_BLOCK + 1
    a, step, noise = theta[n + px.STEP], 1 + px.STEP, 1 + px.LOG_VARIANCE
    k = 1.0 + rounding * math.exp(-theta[n + px.LOG_VARIANCE])
    slope, bend = 2.0 * k / a, (2.0 * k - 4.0 * k * k) / (a * a)
    for j in range(n):
        block = at[j]
        for first in (px.INFORMATION, px.DAMPING):
            corner, across = block[first + noise, noise], block[first + noise, step]
            block[first + step, 0] += slope * block[first + noise, 0]
            block[first + step, step] += slope * (2.0 * across + slope * corner)
            block[first + noise - 1, step] += slope * block[first + noise, noise - 1]
            block[first + noise, step] += slope * corner
            block[first + noise + 1, step] += slope * block[first + noise + 1, noise]
        block[px.INFORMATION + step, step] -= bend * block[px.SCORE, noise]
        block[px.SCORE, step] += slope * block[px.SCORE, noise]


@kernel(inline=True, borrows=True)
def _tie_of(theta: FloatArray, goal: Goal, flags: BoolArray, limits: Limits, rounding: float) -> float:
    """Return the variance of rounding with which sigma moves with 1/g; negative where it does not."""
    noise = theta.size - px.N_BLOCK + 1 + px.LOG_VARIANCE
    if flags[px.HELD, noise] and not flags[px.FIXED, noise]:  # at its floor, which moves with 1/g
        a = theta[noise - px.LOG_VARIANCE + px.STEP]
        moves = 2.0 * math.log(MIN_ELECTRON_NOISE * a) > MIN_LOG_VARIANCE
        if limits.cells:
            moves = LEAST_NOISE_E * a > LEAST_NOISE_DN
        return 0.0 if moves else -1.0
    return rounding if goal.tied else -1.0


@kernel(inline=True, borrows=True)
def _end_of(
    theta: FloatArray, known: FloatArray, loglik: float, rise: float, limits: Limits, goal: Goal
) -> int:
    """Return how a climb ends whose next step is Newton's own, or that it goes on."""
    if rise < limits.tolerance:
        return CONVERGED
    if rise < _SURELY_LOWER and loglik + 2.0 * _SURELY_LOWER < goal.known < math.inf:
        return CONVERGED
    if loglik + 2.0 * rise + 1.0 < goal.to_beat or loglik + 4.0 * rise + 3.0 < goal.to_pass:
        return FAR_BELOW
    if loglik + rise > goal.known - 1.0 and same_place(known, theta, limits.cells):
        return _AT_KNOWN
    return _GOING


@kernel(inline=True, borrows=True)
def _damping_after(risen: float, expected: float, rise: float, share: float) -> float:
    """Return the share of the damping matrix for the step after one that rose by so much."""
    if risen > 0.75 * expected:
        return 0.1 * share if share > 10.0 * _LEAST_SHARE else 0.0
    if risen < 0.25 * expected and rise > 1e-3:
        return max(4.0 * share, _LEAST_SHARE)
    return share


@kernel(borrows=True)
def ascend(
    pixel: Pixel,
    evaluate: Any,
    limits: Limits,
    goal: Goal,
    known: FloatArray,
    theta: FloatArray,
    scratch: Scratch,
) -> tuple[int, float, int, int]:
    """Climb, see `climb`; return also where the evaluation at the last theta is, `AT` or `AHEAD`."""
    trial, step = scratch.small[px.TRIAL], scratch.small[px.STEPS]
    rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
    flags, place = scratch.flags, px.AT
    keep_inside(theta, limits)
    if not sensible(theta, pixel.longest_step, limits.cells):
        return DEGENERATE, -math.inf, 0, place
    loglik = evaluate(pixel, theta, px.DERIVATIVES, scratch, scratch.evaluations[place])
    warm_up = limits.warm_up if goal.first else 0
    only_em = goal.first and limits.only_em
    used, damping, fresh = 1, 0.0, limits.most > 0
    least = _INDEFINITE_CELLS if limits.cells else _LEAST_SHARE
    while used < limits.most:
        at, ahead = scratch.evaluations[place], scratch.evaluations[px.AT + px.AHEAD - place]
        find_held(theta, at, flags[px.FIXED], limits, flags[px.HELD])
        tied = _tie_of(theta, goal, flags, limits, rounding)
        if tied >= 0.0 and fresh:
            tie_noise(theta, at, tied)
        fresh = False
        rise, share = newton_step(at, damping, least, scratch, step)
        if not rise >= 0.0:
            return NOT_CONVERGED, loglik, used, place
        if damping > 0.0 and rise < limits.tolerance:
            damping = 0.0  # only Newton's own step says that it has arrived
            continue
        end = _end_of(theta, known, loglik, rise, limits, goal) if share == 0.0 else _GOING
        if end == CONVERGED and not only_em:
            copy(theta, trial)
            _take_step(trial, step, tied, limits, theta)
            loglik += rise
        if end != _GOING:
            reached = goal.known if end == _AT_KNOWN else loglik + rise if end == FAR_BELOW else loglik
            return (CONVERGED if end == _AT_KNOWN else end), reached, used, place
        newton = limits.cells or goal.tied or (not only_em and used > warm_up and share <= _LARGEST_SHARE)
        factor = 1.0
        if newton:
            factor = _take_step(theta, step, tied, limits, trial)
        elif not em_step(pixel, theta, at, limits, trial):
            return NOT_CONVERGED, loglik, used, place
        risen = -math.inf
        # a step out of bounds counts, too: damped and not damped in turn it may be refused for ever
        used += 1
        if sensible(trial, pixel.longest_step, limits.cells):
            risen = evaluate(pixel, trial, px.DERIVATIVES, scratch, ahead)
        elif not limits.cells:
            return DEGENERATE, loglik, used - 1, place
        if newton and not risen >= loglik - 1e-11 * abs(loglik):
            damping = max(4.0 * share, _REFUSED_CELLS if limits.cells else _REFUSED)
            if damping > _MOST_SHARE:
                return NOT_CONVERGED, loglik, used, place
            continue
        if not math.isfinite(risen):
            return NOT_CONVERGED, loglik, used, place
        damping = _damping_after(risen - loglik, (2.0 * factor - factor * factor) * rise, rise, share)
        copy(trial, theta)
        place = px.AT + px.AHEAD - place
        loglik, fresh = risen, True
    return NOT_CONVERGED, loglik, used, place


def climb(
    pixel: Pixel,
    evaluate: Any,
    limits: Limits,
    goal: Goal,
    known: FloatArray,
    theta: FloatArray,
    scratch: Scratch,
) -> tuple[int, float]:
    """Climb to the maximum near ``theta``, which is updated in place.

    The parameters that stay are in the flags `FIXED` of the scratch; the evaluation at the last theta that
    was evaluated is left in `AT`. ``known`` is a maximum known already.

    Returns:
        Outcome, log-likelihood at the last theta (the rise expected from one more Newton step included, once
        that is trusted).
    """
    outcome, loglik, used, place = ascend(pixel, evaluate, limits, goal, known, theta, scratch)
    if place != px.AT:
        copy_evaluation(scratch.evaluations[place], scratch.evaluations[px.AT])
    scratch.used[0] += used
    return outcome, loglik
