"""The fit of the pixels of a tile under a grown model, and the masses that it predicts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.grown_newton_numba import climb, factor, find_held, solve
from pchem_pipeline.model.law.grown_types_numba import (
    BIAS,
    LOBE,
    LOG_EXPOSURE,
    LOG_VARIANCE,
    N_LOBE_ROWS,
    N_THETA,
    SHIFT_DN,
    SHIFT_E,
    SHIFT_SIGMA,
    STEP,
    WEIGHT,
    WEIGHT_SLOPE,
    WIDTH,
    Cells,
    Law,
    Room,
)

# places in `limits`
MIN_LOG_EXPOSURE, TOLERANCE, MAX_EVALUATIONS, CLEAR_GAP, LOBE_RISE, WARM, BESIDE = range(7)
N_LIMITS = 7

# columns of `out`
LOG_LIKELIHOOD, GAP, CHI2, AMPLITUDE, LOBE_WEIGHT = range(5)
N_OUT = 5

# columns of `words`
CONVERGED, EVALUATIONS, FREEDOM = range(3)
N_WORDS = 3

_ROUNDING = 1.0 / 12.0
_LEAST_VARIANCE = 1e-6  # DN^2
# of the variance and the exposure that the plain fit found, left to the pixel itself at the start
_LEAST_SHARE = 0.1


@kernel
def _row(values: NDArray[np.float64], pixel: int) -> int:
    """Return the row of a pixel in an array with one row for all, or one for each."""
    return pixel if values.shape[0] > 1 else 0


@kernel
def set_lobes(law: Law, pixel: int, amplitude: float, lobes: NDArray[np.float64]) -> int:
    """Fill the lobes of a pixel, those of an amplitude (e-; 0: none) beside each; return how many."""
    row, count = _row(law.lobe_weights, pixel), 0
    n_sides = law.pattern.shape[0] if amplitude != 0.0 else 0
    for lobe in range(law.lobe_weights.shape[1]):
        weight = law.lobe_weights[row, lobe]
        for side in range(-1, n_sides):
            lobes[SHIFT_E, count] = law.lobe_shift_e[row, lobe]
            lobes[SHIFT_DN, count] = law.lobe_shift_dn[row, lobe]
            lobes[SHIFT_SIGMA, count] = law.lobe_shift_sigma[row, lobe]
            lobes[WIDTH, count] = law.lobe_width[row, lobe]
            if side < 0:
                lobes[WEIGHT, count] = weight
                lobes[WEIGHT_SLOPE, count] = -weight if n_sides else 0.0
            else:
                lobes[SHIFT_E, count] += amplitude * law.pattern[side, 0]
                lobes[WEIGHT, count] = 0.0
                lobes[WEIGHT_SLOPE, count] = weight * law.pattern[side, 1]
            count += 1
    return count


@kernel
def make_lobes(law: Law) -> NDArray[np.float64]:
    """Return room for the lobes of a pixel."""
    return np.empty((N_LOBE_ROWS, law.lobe_weights.shape[1] * (1 + law.pattern.shape[0])))


@kernel
def make_cells(
    law: Law,
    pixel: int,
    amplitude: float,
    first_code: int,
    centre: int,
    n_bins: int,
    room: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> Cells:
    """Return the cells of a pixel.

    Args:
        law: grown model.
        pixel: its place in the arrays of the law.
        amplitude: of the free lobes, e-; 0: none.
        first_code: code of the first cell, DN.
        centre: code that all places are counted from, DN.
        n_bins: number of cells.
        room: counts, edges and lobes; the edges and lobes are filled.
    """
    weights, edges, lobes = room
    margin = 0.0
    bottom, top = -1, n_bins + 1
    n_shifts = law.edge_shift.shape[0]
    for i in range(n_bins + 1):
        place = first_code + i - law.edge_first
        shift = law.edge_shift[place] if 0 <= place < n_shifts else 0.0
        margin = max(margin, abs(shift))
        edges[i] = float(first_code + i - centre) - 0.5 + shift
        if first_code + i <= law.clip_low:
            edges[i], bottom = -math.inf, i
        elif first_code + i > law.clip_high:
            edges[i], top = math.inf, min(top, i)
    count = set_lobes(law, pixel, amplitude, lobes)
    return Cells(
        weights,
        edges,
        n_bins,
        bottom,
        top,
        margin,
        float(first_code - centre) - 0.5,
        lobes,
        count,
        law.added_exposure[_row(law.added_exposure, pixel)],
        law.added_weights[_row(law.added_weights, pixel)],
        law.level_scale[_row(law.level_scale, pixel)],
        law.level_shift_e[_row(law.level_shift_e, pixel)],
        law.extra_variance_e2[_row(law.extra_variance_e2, pixel)],
        law.extra_variance_dn2[_row(law.extra_variance_dn2, pixel)],
    )


@kernel
def to_theta(
    parameters: NDArray[np.float64],
    centre: int,
    cells: Cells,
    law: Law,
    warm: bool,
    theta: NDArray[np.float64],
) -> None:
    """Fill ``theta`` from (H, g, mu, sigma).

    Unless ``warm``, H and the read noise are those of a plain fit, which hold the mean exposure and all that
    widens the peaks: what the law adds is taken off, but for a tenth.
    """
    a = 1.0 / parameters[1]
    exposure = parameters[0]
    if not warm:
        for j in range(cells.added_exposure.size):
            exposure -= cells.added_weights[j] * cells.added_exposure[j]
        exposure = max(exposure, _LEAST_SHARE * parameters[0])
    theta[LOG_EXPOSURE] = math.log(exposure)
    theta[STEP] = a
    theta[BIAS] = parameters[2] - centre
    analog2 = max(parameters[3] * parameters[3] - _ROUNDING, _LEAST_VARIANCE)
    if not warm:
        k = parameters[0]
        spread = cells.extra_e2 + k * (law.variance_per_electron + k * law.variance_per_electron2)
        own = 0.0
        for lobe in range(cells.n_lobes):
            own += cells.lobes[WEIGHT, lobe] * cells.lobes[WIDTH, lobe] ** 2
        rest = (analog2 - a * a * spread - cells.extra_dn2) / own
        analog2 = max(rest, _LEAST_SHARE * analog2)
    theta[LOG_VARIANCE] = math.log(analog2)
    theta[LOBE] = 0.0


@kernel
def from_theta(
    theta: NDArray[np.float64],
    centre: int,
    bound: float,
    lobe_free: bool,
    room: Room,
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> bool:
    """Fill (H, g, mu, sigma) and the inverse of the observed information; NaN where at a bound."""
    slope = np.empty(4)
    analog2 = math.exp(theta[LOG_VARIANCE])
    parameters[0] = math.exp(theta[LOG_EXPOSURE])
    parameters[1] = 1.0 / theta[STEP]
    parameters[2] = centre + theta[BIAS]
    parameters[3] = math.sqrt(analog2 + _ROUNDING)
    slope[0] = parameters[0]
    slope[1] = -parameters[1] * parameters[1]
    slope[2] = 1.0
    slope[3] = 0.5 * analog2 / parameters[3]
    held = np.zeros(N_THETA, np.bool_)
    find_held(theta, room.score, bound, lobe_free, held)
    lower = np.zeros((N_THETA, N_THETA))
    column = np.empty(N_THETA)
    regular: bool = factor(room.information, held, lower)
    for i in range(4):
        for j in range(N_THETA):
            column[j] = 1.0 if j == i else 0.0
        if regular:
            solve(lower, column)
        for j in range(4):
            known = regular and not held[i] and not held[j]
            covariance[j, i] = column[j] * slope[i] * slope[j] if known else math.nan
    return regular


@kernel
def climb_neighbours(
    theta: NDArray[np.float64],
    loglik: float,
    cells: Cells,
    law: Law,
    limits: NDArray[np.float64],
    lobe_free: bool,
    room: Room,
) -> tuple[float, float, int]:
    """Move to a neighbour (H -+ 1, mu +- 1/g) while one is more likely.

    Returns:
        Log-likelihood of the best, that of the best other one (-inf without one), evaluations.
    """
    trial = np.empty(N_THETA)
    beside = -math.inf
    used = 0
    for direction in (-1.0, 1.0):
        moves = 0
        while moves < 20:
            exposure = math.exp(theta[LOG_EXPOSURE]) + direction
            if not exposure > 0.03:
                break
            for i in range(N_THETA):
                trial[i] = theta[i]
            trial[LOG_EXPOSURE] = math.log(exposure)
            trial[BIAS] -= direction * theta[STEP]
            fine, found, count = climb(
                trial,
                cells,
                law,
                limits[MIN_LOG_EXPOSURE],
                limits[TOLERANCE],
                int(limits[MAX_EVALUATIONS]),
                lobe_free,
                loglik - limits[CLEAR_GAP],
                room,
            )
            used += count
            if abs(trial[BIAS] - theta[BIAS]) < 0.3 * theta[STEP]:
                break
            if not (fine and found > loglik):
                beside = max(beside, found)
                break
            beside = max(beside, loglik)
            loglik = found
            for i in range(N_THETA):
                theta[i] = trial[i]
            moves += 1
    return loglik, beside, used
