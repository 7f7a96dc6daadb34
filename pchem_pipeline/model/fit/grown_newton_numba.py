"""From a starting point to the nearest maximum of a grown likelihood: damped Newton steps.

The matrix is the observed information where that is positive definite, else the empirical one (the sum of the
squares of the samples' scores), which always is; a share of its diagonal is added after a step that
disappoints (Levenberg and Marquardt). The likelihood never falls.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.grown_cells_numba import evaluate
from pchem_pipeline.model.law.grown_types_numba import (
    BIAS,
    LOBE,
    LOG_EXPOSURE,
    LOG_VARIANCE,
    N_THETA,
    STEP,
    Cells,
    Law,
    Room,
)

LEAST_STEP = 0.6  # DN per electron
LEAST_NOISE_DN, LEAST_NOISE_E = 0.05, 0.02  # of the analog read noise
MOST_NOISE = 3.0  # e-: above it there is one Gaussian to all intents
MOST_LOBE = 0.95
_SINGULAR = 1e-12  # of the diagonal element: what is left of it after the other parameters are taken out
_LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e9


@kernel
def factor(matrix: NDArray[np.float64], held: NDArray[np.bool_], lower: NDArray[np.float64]) -> bool:
    """Fill the Cholesky factor for the parameters that are not held; False unless positive definite."""
    for row in range(N_THETA):
        for column in range(row + 1):
            value = matrix[row, column]
            if held[row] or held[column]:
                value = 1.0 if row == column else 0.0
            for k in range(column):
                value -= lower[row, k] * lower[column, k]
            if row != column:
                lower[row, column] = value / lower[column, column]
            elif held[row]:
                lower[row, row] = 1.0
            elif value > _SINGULAR * abs(matrix[row, row]):
                lower[row, row] = math.sqrt(value)
            else:
                return False
    return True


@kernel
def solve(lower: NDArray[np.float64], vector: NDArray[np.float64]) -> float:
    """Solve ``L L' x = vector`` in place; return ``vector' x``, the squared decrement."""
    squared = 0.0
    for row in range(N_THETA):
        for k in range(row):
            vector[row] -= lower[row, k] * vector[k]
        vector[row] /= lower[row, row]
        squared += vector[row] * vector[row]
    for row in range(N_THETA - 1, -1, -1):
        for k in range(row + 1, N_THETA):
            vector[row] -= lower[k, row] * vector[k]
        vector[row] /= lower[row, row]
    return squared


@kernel
def least_log_variance(a: float) -> float:
    """Return the lower bound of log sigma_R^2 at a step a."""
    return 2.0 * math.log(max(LEAST_NOISE_DN, LEAST_NOISE_E * a))


@kernel
def keep_inside(theta: NDArray[np.float64], bound: float) -> None:
    """Move ``theta`` to the nearest allowed values."""
    theta[LOG_EXPOSURE] = max(theta[LOG_EXPOSURE], bound)
    theta[LOG_VARIANCE] = max(theta[LOG_VARIANCE], least_log_variance(theta[STEP]))
    theta[LOBE] = min(max(theta[LOBE], 0.0), MOST_LOBE)


@kernel
def find_held(
    theta: NDArray[np.float64],
    score: NDArray[np.float64],
    bound: float,
    lobe_free: bool,
    held: NDArray[np.bool_],
) -> None:
    """Tell which parameters stay: those at a bound that the likelihood pushes against."""
    for i in range(N_THETA):
        held[i] = False
    held[LOG_EXPOSURE] = theta[LOG_EXPOSURE] <= bound + 1e-12 and score[LOG_EXPOSURE] <= 0.0
    at_least = theta[LOG_VARIANCE] <= least_log_variance(theta[STEP]) + 1e-12
    held[LOG_VARIANCE] = at_least and score[LOG_VARIANCE] <= 0.0
    below = theta[LOBE] <= 0.0 and score[LOBE] <= 0.0
    held[LOBE] = not lobe_free or below or (theta[LOBE] >= MOST_LOBE and score[LOBE] >= 0.0)


@kernel
def newton_step(
    room: Room, held: NDArray[np.bool_], damping: float, step: NDArray[np.float64]
) -> tuple[float, bool]:
    """Fill the step; return the rise expected of it and whether it is Newton's own, undamped."""
    lower = np.zeros((N_THETA, N_THETA))
    matrix = room.information.copy()
    pure = damping == 0.0
    for i in range(N_THETA):
        step[i] = 0.0 if held[i] else room.score[i]
        matrix[i, i] += damping * room.empirical[i, i]
    if not factor(matrix, held, lower):
        pure = False
        for i in range(N_THETA):
            for j in range(N_THETA):
                matrix[i, j] = room.empirical[i, j]
            matrix[i, i] *= 1.0 + max(damping, _LEAST_DAMPING)
        if not factor(matrix, held, lower):
            return math.nan, False
    return 0.5 * solve(lower, step), pure


@kernel
def take_step(
    theta: NDArray[np.float64], step: NDArray[np.float64], bound: float, out: NDArray[np.float64]
) -> None:
    """Fill ``out`` with ``theta`` after a step, shortened to where a quadratic can be trusted."""
    a = theta[STEP]
    longest = max(abs(step[LOG_EXPOSURE]) / 0.5, abs(step[STEP]) / (0.1 * a))
    longest = max(longest, abs(step[BIAS]) / (0.4 * a), abs(step[LOG_VARIANCE]), abs(step[LOBE]) / 0.3)
    share = 1.0 if longest <= 1.0 else 1.0 / longest
    for i in range(N_THETA):
        out[i] = theta[i] + share * step[i]
    keep_inside(out, bound)


@kernel
def sensible(theta: NDArray[np.float64]) -> bool:
    """Tell whether the parameters can be told from those of one Gaussian."""
    noise = math.exp(0.5 * theta[LOG_VARIANCE]) / theta[STEP]
    fine: bool = theta[STEP] > LEAST_STEP and noise < MOST_NOISE and theta[LOG_EXPOSURE] < 12.0
    return fine


@kernel
def climb(
    theta: NDArray[np.float64],
    cells: Cells,
    law: Law,
    bound: float,
    tolerance: float,
    most: int,
    lobe_free: bool,
    to_beat: float,
    room: Room,
) -> tuple[bool, float, int]:
    """Climb to the maximum near ``theta``, which is updated in place; ``room`` holds the answers there.

    Args:
        theta: start; out: the maximum.
        cells: of the pixel.
        law: grown model.
        bound: smallest log H.
        tolerance: rise of the log-likelihood below which the climb ends, nats.
        most: evaluations allowed.
        lobe_free: whether the weight of the free lobes is fitted.
        to_beat: the climb is given up once twice the expected rise would leave it below.
        room: scratch.

    Returns:
        Whether it converged, log-likelihood, number of evaluations.
    """
    trial, step = np.empty(N_THETA), np.empty(N_THETA)
    held = np.zeros(N_THETA, np.bool_)
    keep_inside(theta, bound)
    loglik = evaluate(theta, cells, law, room)
    used, damping = 1, 0.0
    while used < most:
        find_held(theta, room.score, bound, lobe_free, held)
        rise, pure = newton_step(room, held, damping, step)
        if not rise >= 0.0 or damping > _MOST_DAMPING:
            return False, loglik, used
        if pure and rise < tolerance:
            take_step(theta, step, bound, theta)
            return True, loglik + rise, used
        if pure and loglik + 2.0 * rise + 1.0 < to_beat:
            return False, loglik + rise, used
        take_step(theta, step, bound, trial)
        risen = evaluate(trial, cells, law, room) if sensible(trial) else -math.inf
        used += 1
        if risen >= loglik - 1e-12 * abs(loglik):
            damping = 0.1 * damping if damping > 0.01 else 0.0
            if risen - loglik < 0.25 * rise and rise > 1e-3:
                damping = max(4.0 * damping, _LEAST_DAMPING)
            for i in range(N_THETA):
                theta[i] = trial[i]
            loglik = risen
        else:
            # the score and the information there are those of the step refused: fill them anew
            damping = max(10.0 * damping, 10.0 * _LEAST_DAMPING)
            loglik = evaluate(theta, cells, law, room)
            used += 1
    return False, loglik, used
