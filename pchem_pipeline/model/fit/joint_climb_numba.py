"""From a starting point to the nearest maximum of a joint likelihood: EM steps and a damped Newton finish.

EM, with the E-step sums of all samples together: ``H_j = A_j``, and ``1/g``, ``mu``, ``sigma^2`` by
eq. (update_eqns) of Hendrickson et al. 2023 from the sums over all samples (multi-sample PCH-EM,
Hendrickson and Haefner 2024).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.grown_newton_numba import LEAST_STEP, MOST_NOISE, least_log_variance
from pchem_pipeline.model.fit.joint_likelihood_numba import evaluate_joint, solve_arrow
from pchem_pipeline.model.fit.joint_types_numba import (
    N_BLOCK,
    N_FRAMES,
    VARIANCE,
    Answers,
    Bench,
    Samples,
    copy_joint,
    make_answers,
)
from pchem_pipeline.model.fit.polish_numba import (
    CONVERGED,
    DEGENERATE,
    FAR_BELOW,
    MAX_ELECTRON_NOISE,
    MAX_EVALUATIONS,
    MAX_LOG_EXPOSURE,
    MAX_STEP,
    MIN_LOG_EXPOSURE,
    NOT_CONVERGED,
    ONLY_EM,
    TOLERANCE,
    WARM_UP,
    em_step,
    min_log_variance,
)
from pchem_pipeline.model.law.estep_numba import LOG_2PI
from pchem_pipeline.model.law.workspace_numba import copy

_MIN_STEP = 1.2  # DN per electron, of the density
_LEAST_SHARE = 1e-5  # of the damping matrix in a damped step
_LARGEST_SHARE = 3.0  # beyond it an EM step is taken, where there is one
_MOST_SHARE = 1e6
_CLEAR_GAP = 30.0  # nats: a neighbour this far below is not polished to the end
_MOST_MOVES = 20
_N_BESIDE = 4  # neighbours of a maximum
_LEAST_BRIGHT = 3.0  # e-: a dimmer brightest sample does not tell neighbouring gains apart


@kernel
def floor_of(a: float, exact: bool) -> float:
    """Return the smallest v for a step a."""
    floor: float = least_log_variance(a) if exact else min_log_variance(a)
    return floor


@kernel
def keep_inside(theta: NDArray[np.float64], bound: float, exact: bool) -> None:
    """Move ``theta`` to the nearest allowed values."""
    n_samples = theta.size - 3
    for j in range(n_samples):
        theta[j] = max(bound, theta[j])
    theta[n_samples + 2] = max(theta[n_samples + 2], floor_of(theta[n_samples], exact))


@kernel
def sensible(theta: NDArray[np.float64], longest_step: float, exact: bool) -> bool:
    """Tell whether the parameters can be told from those of Gaussians of one width."""
    n_samples = theta.size - 3
    a = theta[n_samples]
    noise = math.exp(0.5 * theta[n_samples + 2]) / a
    most, least = (MOST_NOISE, LEAST_STEP) if exact else (MAX_ELECTRON_NOISE, _MIN_STEP)
    if not (noise < most and least < a < longest_step):
        return False
    brightest = theta[0]
    for j in range(1, n_samples):
        brightest = max(brightest, theta[j])
    fine: bool = brightest < MAX_LOG_EXPOSURE
    return fine


@kernel
def find_held(
    theta: NDArray[np.float64],
    dark: NDArray[np.bool_],
    answers: Answers,
    bound: float,
    exact: bool,
    held: NDArray[np.bool_],
) -> None:
    """Tell which parameters stay: at a bound that the likelihood pushes against, or without electrons."""
    n_samples = dark.size
    push = 0.0
    for j in range(n_samples):
        held[j] = dark[j] or (theta[j] <= bound + 1e-12 and answers.score[j, 0] <= 0.0)
        push += answers.score[j, 3]
    held[n_samples] = held[n_samples + 1] = False
    floor = floor_of(theta[n_samples], exact)
    held[n_samples + 2] = theta[n_samples + 2] <= floor + 1e-12 and push <= 0.0


@kernel
def joint_em_step(
    samples: Samples, theta: NDArray[np.float64], answers: Answers, bound: float, out: NDArray[np.float64]
) -> bool:
    """One EM update from the answers at ``theta`` (density); False where it is not defined."""
    n_samples = samples.dark.size
    n = 0.0
    for j in range(n_samples):
        n += samples.facts[j, N_FRAMES]
    own, new = np.empty(N_BLOCK), np.empty(N_BLOCK)
    own[0] = 0.0
    for i in range(3):
        own[i + 1] = theta[n_samples + i]
    if not em_step(n, own, answers.total, -math.inf, new):
        return False
    for j in range(n_samples):
        out[j] = bound
        if not samples.dark[j] and answers.electrons[j] > 0.0:
            out[j] = max(bound, math.log(answers.electrons[j]))
    for i in range(3):
        out[n_samples + i] = new[i + 1]
    return True


@kernel
def _newton_step(
    answers: Answers, held: NDArray[np.bool_], share: float, step: NDArray[np.float64]
) -> tuple[float, float]:
    """Fill the damped step; return the rise expected of it (NaN without one) and the share used."""
    lower = np.zeros((N_BLOCK, N_BLOCK))
    squared = solve_arrow(answers, share, held, step, lower)
    while not squared >= 0.0:
        share = max(_LEAST_SHARE, 3.0 * share)
        if share > _MOST_SHARE:
            return math.nan, share
        squared = solve_arrow(answers, share, held, step, lower)
    return 0.5 * squared, share


@kernel
def _take_step(
    theta: NDArray[np.float64], step: NDArray[np.float64], bound: float, exact: bool, out: NDArray[np.float64]
) -> float:
    """Fill ``out`` with ``theta`` after a step, shortened to where the quadratic can be trusted."""
    n_samples = theta.size - 3
    a = theta[n_samples]
    longest = max(abs(step[n_samples]) / (0.1 * a), abs(step[n_samples + 1]) / (0.4 * a))
    longest = max(longest, abs(step[n_samples + 2]) / 0.7)
    for j in range(n_samples):
        longest = max(longest, abs(step[j]))
    factor = 1.0 if longest <= 1.0 else 1.0 / longest
    for i in range(theta.size):
        out[i] = theta[i] + factor * step[i]
    keep_inside(out, bound, exact)
    return factor


@kernel
def same_place(left: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """Tell whether two points belong to one maximum: bias and mean of the brightest sample within 0.3 e-."""
    n = left.size - 3
    a = left[n]
    brightest = left[0]
    for j in range(1, n):
        brightest = max(brightest, left[j])
    most = max(math.exp(brightest), _LEAST_BRIGHT)
    same: bool = abs(left[n + 1] - right[n + 1]) < 0.3 * a and abs(a - right[n]) * most < 0.3 * a
    return same


@kernel
def climb_joint(
    samples: Samples,
    middle: int,
    theta: NDArray[np.float64],
    limits: NDArray[np.float64],
    exact: bool,
    to_beat: float,
    bench: Bench,
    answers: Answers,
) -> tuple[int, float, int]:
    """Climb to the maximum near ``theta``, which is updated in place.

    Args:
        samples: of the pixel.
        middle: its centre, DN.
        theta: start; out: the maximum.
        limits: as in :mod:`.polish_numba`.
        exact: integrate the cells; else take the density.
        to_beat: give up once twice the expected rise would leave the likelihood below; infinitely low for
            the climb from a start, which alone warms up by EM steps or takes nothing else.
        bench: scratch.
        answers: out, those at the last theta that was evaluated.

    Returns:
        Outcome as of :func:`.polish_numba.polish`, log-likelihood, evaluations.
    """
    bound = limits[MIN_LOG_EXPOSURE]
    trial, step = np.empty(theta.size), np.empty(theta.size)
    held = np.zeros(theta.size, np.bool_)
    ahead = make_answers(samples.dark.size)
    keep_inside(theta, bound, exact)
    if not sensible(theta, limits[MAX_STEP], exact):
        return DEGENERATE, -math.inf, 0
    loglik = evaluate_joint(samples, middle, theta, exact, bench, answers)
    first = to_beat == -math.inf and not exact
    warm_up = limits[WARM_UP] if first else 0.0
    only_em = first and limits[ONLY_EM] > 0.0
    used, damping = 1, 0.0
    while used < limits[MAX_EVALUATIONS]:
        find_held(theta, samples.dark, answers, bound, exact, held)
        rise, share = _newton_step(answers, held, damping, step)
        if not rise >= 0.0:
            return NOT_CONVERGED, loglik, used
        if share == 0.0 and rise < limits[TOLERANCE]:
            if not only_em:
                _take_step(theta, step, bound, exact, theta)
                loglik += rise
            return CONVERGED, loglik, used
        if share == 0.0 and loglik + 2.0 * rise + 1.0 < to_beat:
            return FAR_BELOW, loglik + rise, used
        newton = exact or (not only_em and used > warm_up and share <= _LARGEST_SHARE)
        factor = 1.0
        if newton:
            factor = _take_step(theta, step, bound, exact, trial)
        elif not joint_em_step(samples, theta, answers, bound, trial):
            return NOT_CONVERGED, loglik, used
        if not sensible(trial, limits[MAX_STEP], exact):
            return DEGENERATE, loglik, used
        risen = evaluate_joint(samples, middle, trial, exact, bench, ahead)
        used += 1
        if newton and not risen >= loglik - 1e-11 * abs(loglik):
            damping = max(5.0 * share, 3.0 * _LEAST_SHARE)
            if damping > _MOST_SHARE:
                return NOT_CONVERGED, loglik, used
            continue
        if not math.isfinite(risen):
            return NOT_CONVERGED, loglik, used
        expected = (2.0 * factor - factor * factor) * rise
        if risen - loglik > 0.75 * expected:
            damping = 0.1 * share if share > 10.0 * _LEAST_SHARE else 0.0
        elif risen - loglik < 0.25 * expected and rise > 1e-3:
            damping = max(4.0 * share, _LEAST_SHARE)
        else:
            damping = share
        copy(trial, theta)
        copy_joint(ahead, answers)
        loglik = risen
    return NOT_CONVERGED, loglik, used


@kernel
def _beside(which: int, samples: Samples, theta: NDArray[np.float64], out: NDArray[np.float64]) -> bool:
    """Fill ``out`` with a neighbour of ``theta``: one electron fewer or more (odd ``which``).

    The first two move the bias: all H_j -+ 1, mu +- 1/g. The others keep it and move the gain, so that the
    brightest sample alone has an electron less or more: the combs agree at the bias and there.
    """
    n_samples = samples.dark.size
    direction = 1.0 if which % 2 else -1.0
    brightest = -math.inf
    for j in range(n_samples):
        if not samples.dark[j]:
            brightest = max(brightest, theta[j])
    most = math.exp(brightest)
    if not most + direction > 0.03:
        return False
    for i in range(theta.size):
        out[i] = theta[i]
    if which < 2:
        for j in range(n_samples):
            out[j] = math.log(max(math.exp(theta[j]) + direction, 0.01))
        out[n_samples + 1] -= direction * theta[n_samples]
        return True
    factor = (most + direction) / most
    for j in range(n_samples):
        out[j] += math.log(factor)
    out[n_samples] /= factor
    return most > _LEAST_BRIGHT


@kernel
def climb_beside(
    samples: Samples,
    middle: int,
    best: NDArray[np.float64],
    best_loglik: float,
    limits: NDArray[np.float64],
    exact: bool,
    bench: Bench,
    answers: Answers,
) -> tuple[float, float, int]:
    """Move to a neighbour, see `_beside`, while one is more likely.

    Returns:
        Log-likelihood of the best, that of the best other one (-inf without one), evaluations.
    """
    trial = np.empty(best.size)
    runner_up = -math.inf
    used = moves = which = 0
    while which < _N_BESIDE:
        if not _beside(which, samples, best, trial):
            which += 1
            continue
        outcome, loglik, count = climb_joint(
            samples, middle, trial, limits, exact, best_loglik - _CLEAR_GAP, bench, answers
        )
        used += count
        higher = outcome == CONVERGED and loglik > best_loglik
        if outcome == DEGENERATE or same_place(best, trial):
            if higher:
                copy(trial, best)
                best_loglik = loglik
            which += 1
        elif higher and moves < _MOST_MOVES:
            runner_up = max(runner_up, best_loglik)
            copy(trial, best)
            best_loglik = loglik
            moves += 1
            which = which - which % 2  # on in both directions
        else:
            runner_up = max(runner_up, loglik)
            which += 1
    return best_loglik, runner_up, used


@kernel
def loglik_without_gain(samples: Samples) -> float:
    """Return the log-likelihood of Gaussians of one width, each at the mean of its sample: g to infinity."""
    n = square = 0.0
    for j in range(samples.dark.size):
        n += samples.facts[j, N_FRAMES]
        square += samples.facts[j, N_FRAMES] * samples.facts[j, VARIANCE]
    return -0.5 * n * (LOG_2PI + 1.0 + math.log(max(square / n, 1.0 / 12.0)))
