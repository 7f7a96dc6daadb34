"""The search for the highest maximum of one pixel's joint likelihood."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.goodness_numba import normal_score
from pchem_pipeline.model.fit.joint_climb_numba import (
    climb_beside,
    climb_joint,
    loglik_without_gain,
    same_place,
    sensible,
)
from pchem_pipeline.model.fit.joint_goodness_numba import joint_goodness, joint_side_lobe
from pchem_pipeline.model.fit.joint_likelihood_numba import evaluate_joint
from pchem_pipeline.model.fit.joint_start_numba import (
    N_LINE,
    N_NOISES,
    N_SCAN,
    N_SINGLE,
    line_start,
    scan_start,
    single_start,
    variance_line,
)
from pchem_pipeline.model.fit.joint_types_numba import Answers, Bench, Samples
from pchem_pipeline.model.fit.polish_numba import CONVERGED, DEGENERATE, MAX_STEP, N_POLISH_LIMITS
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.workspace_numba import copy

# places in `limits`, after those of `polish`
GAP_THRESHOLD, EXACT = N_POLISH_LIMITS, N_POLISH_LIMITS + 1
N_LIMITS = N_POLISH_LIMITS + 2

# columns of `out`
LOG_LIKELIHOOD, GAP, CHI2 = range(3)
N_OUT = 3

FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED = int(FitStatus.NOT_CONVERGED), int(FitStatus.GAIN_NOT_IDENTIFIED)
BIAS_AMBIGUOUS = int(FitStatus.BIAS_AMBIGUOUS)

_SUSPICIOUS = 3.0  # standard normal: a goodness of fit that calls for other starts
_CLEAR_LOBE = 3.0  # standard errors: a side lobe that settles the gain
_N_KEPT = 4  # of the starts, ranked by likelihood, from which to climb where no side lobe is clear
_BY_CELLS = 2.0  # DN per electron, below which the density is no way to the exact maximum
_ROUNDING = 1.0 / 12.0
_LEAST_VARIANCE = 0.01  # DN^2, of the analog read noise at a start


@kernel
def _keep(
    trial: NDArray[np.float64], loglik: float, kept: NDArray[np.float64], heights: NDArray[np.float64]
) -> None:
    """Put a start among the likeliest, which lie apart from each other."""
    place = -1
    for i in range(heights.size):
        if heights[i] > -math.inf and same_place(kept[i], trial):
            if loglik <= heights[i]:
                return
            place = i
            break
    if place < 0:
        place = 0
        for i in range(1, heights.size):
            if heights[i] < heights[place]:
                place = i
        if loglik <= heights[place]:
            return
    heights[place] = loglik
    copy(trial, kept[place])


@kernel
def _rank_starts(
    samples: Samples,
    middle: int,
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    all_of_them: bool,
    bench: Bench,
    answers: Answers,
    kept: NDArray[np.float64],
    heights: NDArray[np.float64],
) -> tuple[bool, int]:
    """Fill ``kept`` with the likeliest starts; return whether a side lobe was clear, and evaluations."""
    trial = np.empty(kept.shape[1])
    n_samples = samples.dark.size
    exact = limits[EXACT] > 0.0
    any_clear = False
    used = 0
    for i in range(heights.size):
        heights[i] = -math.inf
    for which in range(N_SINGLE if all_of_them else 1):
        for j in range(n_samples):
            found, clear = single_start(which, j, samples, basis, bench.space.rows, trial)
            any_clear = any_clear or (found and clear)
            if found and sensible(trial, limits[MAX_STEP], False):
                used += 1
                _keep(trial, evaluate_joint(samples, middle, trial, False, bench, answers), kept, heights)
    if all_of_them or not any_clear:
        line = variance_line(samples)
        for which in range(N_LINE if all_of_them else N_NOISES):
            by_cells = exact and line[0] < 2.0
            found = line_start(which, samples, line, by_cells, trial)
            if found and sensible(trial, limits[MAX_STEP], by_cells):
                used += 1
                _keep(trial, evaluate_joint(samples, middle, trial, by_cells, bench, answers), kept, heights)
    if exact and n_samples == 1:
        for which in range(N_SCAN):
            if scan_start(which, samples, trial) and sensible(trial, limits[MAX_STEP], True):
                used += 1
                _keep(trial, evaluate_joint(samples, middle, trial, True, bench, answers), kept, heights)
        return False, used
    return any_clear, used


@kernel
def _climb_from(
    samples: Samples,
    middle: int,
    limits: NDArray[np.float64],
    bench: Bench,
    answers: Answers,
    theta: NDArray[np.float64],
) -> tuple[int, float, int]:
    """Climb from a start: the density first, then, where asked for, the exact likelihood from its maximum."""
    exact = limits[EXACT] > 0.0
    used = 0
    if not exact or theta[samples.dark.size] > _BY_CELLS:
        outcome, loglik, used = climb_joint(samples, middle, theta, limits, False, -math.inf, bench, answers)
        if not exact or outcome == DEGENERATE:
            return outcome, loglik, used
        place = theta.size - 1
        theta[place] = math.log(max(math.exp(theta[place]) - _ROUNDING, _LEAST_VARIANCE))
    outcome, loglik, count = climb_joint(samples, middle, theta, limits, True, -math.inf, bench, answers)
    return outcome, loglik, used + count


@kernel
def _climb_kept(
    samples: Samples,
    middle: int,
    limits: NDArray[np.float64],
    most: int,
    kept: NDArray[np.float64],
    heights: NDArray[np.float64],
    bench: Bench,
    answers: Answers,
    best: NDArray[np.float64],
    height: tuple[float, float],
) -> tuple[float, float, int, bool]:
    """Climb from the likeliest starts and their neighbours; ``best`` is updated.

    Returns:
        Log-likelihood of the best and of the runner-up, evaluations, whether a climb ran towards Gaussians.
    """
    n_samples = samples.dark.size
    best_loglik, runner_up = height
    trial = np.empty(best.size)
    used, degenerate = 0, False
    for _ in range(most):
        i = int(np.argmax(heights))
        if heights[i] == -math.inf:
            break
        heights[i] = -math.inf
        copy(kept[i], trial)
        if best[n_samples] > 0.0 and same_place(best, trial):
            continue
        outcome, loglik, count = _climb_from(samples, middle, limits, bench, answers, trial)
        used += count
        degenerate = degenerate or outcome == DEGENERATE
        if best[n_samples] > 0.0 and same_place(best, trial):
            continue
        if outcome != CONVERGED or loglik <= best_loglik:
            runner_up = max(runner_up, loglik)
            continue
        runner_up = max(runner_up, best_loglik)
        copy(trial, best)
        best_loglik, beside, count = climb_beside(
            samples, middle, best, loglik, limits, limits[EXACT] > 0.0, bench, answers
        )
        used += count
        runner_up = max(runner_up, beside)
    return best_loglik, runner_up, used, degenerate


@kernel
def fit_joint_pixel(
    samples: Samples,
    middle: int,
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    bench: Bench,
    answers: Answers,
    best: NDArray[np.float64],
    out: NDArray[np.float64],
) -> tuple[int, int, int]:
    """Find the most likely parameters of the samples of one pixel.

    Args:
        samples: the histograms.
        middle: centre of the pixel, DN.
        basis: of the regression on the characteristic function.
        limits: bounds and limits.
        bench: scratch.
        answers: out, those at the maximum.
        best: out, theta at the maximum; its step is 0 where there is none.
        out: out, a row of results.

    Returns:
        Status word, evaluations, degrees of freedom of the goodness of fit.
    """
    n_samples = samples.dark.size
    exact = limits[EXACT] > 0.0
    kept, heights = np.empty((_N_KEPT, best.size)), np.empty(_N_KEPT)
    height = -math.inf, -math.inf
    used = freedom = 0
    degenerate = False
    best[n_samples] = 0.0
    for attempt in range(2):
        clear, count = _rank_starts(
            samples, middle, basis, limits, attempt > 0, bench, answers, kept, heights
        )
        most = 1 if clear and attempt == 0 else _N_KEPT
        highest, beside, more, flat = _climb_kept(
            samples, middle, limits, most, kept, heights, bench, answers, best, height
        )
        height = highest, beside
        used += count + more
        degenerate = degenerate or flat
        if best[n_samples] > 0.0:
            out[CHI2], freedom = joint_goodness(samples, middle, best, exact, bench)
            settled = not clear or joint_side_lobe(samples, best) > _CLEAR_LOBE
            if settled and normal_score(out[CHI2], freedom) < _SUSPICIOUS:
                break
    if not best[n_samples] > 0.0:
        return GAIN_NOT_IDENTIFIED if degenerate else FIT_NOT_CONVERGED, used, 0
    loglik = evaluate_joint(samples, middle, best, exact, bench, answers)
    null = loglik_without_gain(samples)
    out[LOG_LIKELIHOOD], out[GAP] = loglik, loglik - max(height[1], null)
    status = 0
    if loglik - null < limits[GAP_THRESHOLD]:
        status |= GAIN_NOT_IDENTIFIED
    if loglik - height[1] < limits[GAP_THRESHOLD]:
        status |= BIAS_AMBIGUOUS
    return status, used + 1, freedom
