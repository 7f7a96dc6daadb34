"""From a starting point to the nearest maximum of the likelihood: EM steps and a safeguarded Newton finish.

Parameters ``theta`` as in :mod:`pchem_pipeline.model.law.estep_numba`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.fisher_numba import back_substitute, cholesky
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.workspace_numba import (
    SUM_E,
    SUM_EE,
    SUM_K,
    SUM_KE,
    SUM_KK,
    Histogram,
    Workspace,
    copy,
    copy_answers,
    make_rows,
    make_workspace,
    share_workspace,
)

# outcomes of `polish`
CONVERGED = 0
NOT_CONVERGED = 1
DEGENERATE = 2  # ran towards one Gaussian: g to infinity, or an empty second peak
FAR_BELOW = 3  # given up: too far below the likelihood to beat

# places in `limits`
MIN_LOG_EXPOSURE, MAX_STEP, TOLERANCE, WARM_UP, MAX_EVALUATIONS, ONLY_EM = range(6)
N_POLISH_LIMITS = 6

MIN_LOG_VARIANCE = math.log(1.0 / 12.0)  # rounding alone
MIN_ELECTRON_NOISE = 0.03  # below it the polynomials of the E-step overflow
MAX_ELECTRON_NOISE = 3.0  # above it there is one Gaussian to all intents
_MIN_STEP = 1.2  # DN per electron: a comb with a tooth at each DN would fit any whole numbers
MAX_LOG_EXPOSURE = math.log(1e5)
_LEAST_SHARE = 1e-5  # of the complete-data information in a damped step
_LARGEST_SHARE = 3.0  # beyond it an EM step is taken


@kernel
def min_log_variance(a: float) -> float:
    """Return the lower bound of log sigma^2 for a step a: rounding, and a floor in e-."""
    return max(MIN_LOG_VARIANCE, 2.0 * math.log(MIN_ELECTRON_NOISE * a))


@kernel
def em_step(
    n: float, theta: NDArray[np.float64], total: NDArray[np.float64], bound: float, out: NDArray[np.float64]
) -> bool:
    """One EM update, eq. (update_eqns), from the E-step sums at ``theta``; False where it is not defined.

    Written in the residuals e = x - mu - k/g of the present parameters, which is the same update without
    cancellation.
    """
    exposure = total[SUM_K] / n
    spread = total[SUM_KK] / n - exposure * exposure
    if not (exposure > 0.0 and spread > 0.0):
        return False
    mean_e = total[SUM_E] / n
    # C - xbar A = a (B - A^2) + (sum of k e - A sum of e) / N
    change = (total[SUM_KE] / n - exposure * mean_e) / spread
    a = theta[1] + change
    residual = total[SUM_EE] / n - mean_e * mean_e - change * change * spread
    if not (a > 0.0 and math.isfinite(a)):
        return False
    out[0] = max(bound, math.log(exposure))
    out[1] = a
    out[2] = theta[2] + mean_e - change * exposure
    out[3] = max(min_log_variance(a), math.log(max(residual, 1e-3)))
    return True


@kernel
def add_complete(
    n: float,
    theta: NDArray[np.float64],
    total: NDArray[np.float64],
    share: float,
    matrix: NDArray[np.float64],
) -> None:
    """Add a share of the complete-data information, positive definite everywhere, to the lower triangle."""
    s2 = math.exp(theta[3])
    matrix[0, 0] += share * n * math.exp(theta[0])
    matrix[1, 1] += share * total[SUM_KK] / s2
    matrix[2, 1] += share * total[SUM_K] / s2
    matrix[2, 2] += share * n / s2
    matrix[3, 1] += share * total[SUM_KE] / s2
    matrix[3, 2] += share * total[SUM_E] / s2
    matrix[3, 3] += share * 0.5 * total[SUM_EE] / s2


@kernel
def newton_step(
    n: float,
    theta: NDArray[np.float64],
    space: Workspace,
    bound: float,
    share: float,
    step: NDArray[np.float64],
) -> tuple[float, float]:
    """Solve for the damped Newton step; parameters held by a bound stay.

    A share of the complete-data information is added to the observed information, more of it where that is
    not positive definite: the step turns from Newton's into a shortened EM step.

    Returns:
        Half the squared Newton decrement, the expected rise of the log-likelihood, and the share used. Only
        with a share of 0 does the former say how far the maximum is.
    """
    total, score, information = space.total, space.score, space.information
    held, lower, matrix = space.held, space.small[:4], space.small[4:8]
    held[1] = held[2] = False
    held[0] = theta[0] <= bound + 1e-12 and score[0] <= 0.0
    held[3] = theta[3] <= min_log_variance(theta[1]) + 1e-12 and score[3] <= 0.0
    for i in range(4):
        copy(information[i], matrix[i])
    if share > 0.0:
        add_complete(n, theta, total, share, matrix)
    while not cholesky(matrix, held, lower):
        more = max(_LEAST_SHARE, 2.0 * share)
        add_complete(n, theta, total, more, matrix)
        share += more
        if share > 3.0 * _LARGEST_SHARE:
            return 0.0, share
    for i in range(4):
        step[i] = 0.0 if held[i] else score[i]
    return 0.5 * back_substitute(lower, step), share


@kernel
def _bounded(
    theta: NDArray[np.float64], step: NDArray[np.float64], bound: float, out: NDArray[np.float64]
) -> float:
    """Take a Newton step, shortened to stay where the quadratic can be trusted; return the factor."""
    a = theta[1]
    longest = max(abs(step[0]) / 0.5, abs(step[1]) / (0.1 * a), abs(step[2]) / (0.4 * a), abs(step[3]) / 0.5)
    factor = 1.0 if longest <= 1.0 else 1.0 / longest
    for i in range(4):
        out[i] = theta[i] + factor * step[i]
    out[0] = max(bound, out[0])
    out[3] = max(min_log_variance(out[1]), out[3])
    return factor


@kernel
def degenerate(theta: NDArray[np.float64], longest_step: float) -> bool:
    """Tell whether the parameters left the range in which a PCD can be told from one Gaussian."""
    noise = math.exp(0.5 * theta[3]) / theta[1]
    return not (
        noise < MAX_ELECTRON_NOISE and _MIN_STEP < theta[1] < longest_step and theta[0] < MAX_LOG_EXPOSURE
    )


@kernel
def same_maximum(left: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """Tell whether two points belong to one maximum: bias within 0.3 e-, step within 10 %."""
    same: bool = abs(left[2] - right[2]) < 0.3 * left[1] and abs(left[1] - right[1]) < 0.1 * left[1]
    return same


@kernel
def polish(
    histogram: Histogram,
    theta: NDArray[np.float64],
    limits: NDArray[np.float64],
    to_beat: float,
    known: NDArray[np.float64],
    known_loglik: float,
    space: Workspace,
) -> tuple[int, float, int]:
    """Climb to the maximum near ``theta``, which is updated in place.

    Args:
        histogram: of the pixel.
        theta: start; out: the maximum.
        limits: bounds and limits, see the names at the top of this module.
        to_beat: give up once the log-likelihood cannot rise to this value, judged by twice the expected rise.
        known: a maximum known already; the climb ends where it heads for that one.
        known_loglik: its log-likelihood; infinite where there is none, as for the climb from a start, which
            alone warms up by EM steps, or takes nothing else where the limits say so.
        space: scratch.

    Returns:
        Outcome, log-likelihood at the last theta (the rise expected from one more Newton step included, once
        that is trusted), number of evaluations.
    """
    bound, tolerance = limits[MIN_LOG_EXPOSURE], limits[TOLERANCE]
    n = histogram.n
    trial, step = space.small[8], space.small[9]
    ahead = share_workspace(space)
    theta[0] = max(bound, theta[0])
    theta[3] = max(min_log_variance(theta[1]), theta[3])
    if degenerate(theta, limits[MAX_STEP]):
        return DEGENERATE, -math.inf, 0
    loglik = evaluate(histogram, theta, space, 0.0)
    used, damping = 1, 0.0
    warm_up = limits[WARM_UP] if known_loglik == math.inf else 0.0
    only_em = limits[ONLY_EM] > 0.0 and known_loglik == math.inf
    while used < limits[MAX_EVALUATIONS]:
        rise, share = newton_step(n, theta, space, bound, damping, step)
        if share == 0.0 and rise < tolerance:
            if not only_em:
                _bounded(theta, step, bound, theta)
                loglik += rise
            return CONVERGED, loglik, used
        if share == 0.0 and loglik + 2.0 * rise + 1.0 < to_beat:
            return FAR_BELOW, loglik + rise, used
        if share == 0.0 and loglik + rise > known_loglik - 1.0 and same_maximum(known, theta):
            return CONVERGED, known_loglik, used
        newton = not only_em and used > warm_up and share <= _LARGEST_SHARE
        factor = 1.0
        if newton:
            factor = _bounded(theta, step, bound, trial)
        elif not em_step(n, theta, space.total, bound, trial):
            return NOT_CONVERGED, loglik, used
        if degenerate(trial, limits[MAX_STEP]):
            return DEGENERATE, loglik, used
        risen = evaluate(histogram, trial, ahead, 0.0)
        used += 1
        expected = (2.0 * factor - factor * factor) * rise
        if newton and not risen >= loglik - 1e-11 * abs(loglik):
            damping = max(4.0 * share, 3.0 * _LEAST_SHARE)
            continue
        if not math.isfinite(risen):
            return NOT_CONVERGED, loglik, used
        if risen - loglik > 0.75 * expected:
            damping = 0.1 * share if share > 10.0 * _LEAST_SHARE else 0.0
        elif risen - loglik < 0.25 * expected and rise > 1e-3:
            damping = max(4.0 * share, _LEAST_SHARE)
        else:
            damping = share
        copy(trial, theta)
        copy_answers(ahead, space)
        loglik = risen
    return NOT_CONVERGED, loglik, used


@kernel
def em_path(
    histogram: Histogram,
    theta: NDArray[np.float64],
    bound: float,
    path: NDArray[np.float64],
    logliks: NDArray[np.float64],
) -> None:
    """Fill ``path`` (iterations + 1, 4) and ``logliks`` with the iterates of plain EM from ``theta``."""
    space = make_workspace(make_rows(histogram.n_bins))
    present = theta.copy()
    following = theta.copy()
    for row in range(logliks.size):
        copy(following, present)
        copy(present, path[row])
        logliks[row] = evaluate(histogram, present, space, 0.0)
        if not em_step(histogram.n, present, space.total, bound, following):
            copy(present, following)
