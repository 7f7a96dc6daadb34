"""The search for free lobes: levels of one amplitude, with a weight of its own in each pixel.

Strong lobes lead a fit without them astray: it takes a lobe for the peak of no electron, or the distance of
the lobes for that of the peaks. Where it describes the histogram badly, other starts are tried that have
the mean and the variance of the histogram with the lobes in place.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.grown_cells_numba import evaluate, near_masses
from pchem_pipeline.model.grown_newton_numba import climb, find_held, newton_step, sensible
from pchem_pipeline.model.grown_numba import (
    LOBE_RISE,
    MAX_EVALUATIONS,
    MIN_LOG_EXPOSURE,
    TOLERANCE,
    climb_neighbours,
    make_cells,
)
from pchem_pipeline.model.grown_types_numba import (
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
from pchem_pipeline.model.workspace_numba import Histogram

_SCREEN = 0.2  # of the rise asked of free lobes, seen from the fit without them
#: steps of the other starts in units of that of the fit without lobes, and the weights of the lobes there
_SCALES = (0.25, 0.33, 0.42, 0.5, 0.6, 0.7, 0.82, 0.9, 1.0, 1.1, 1.22, 1.4, 1.65, 2.0, 3.0)
_WEIGHTS = (0.1,)
_NOISE_E = 0.3
_N_ATTEMPTS = 4  # from the fit, one electron more and less, other steps
_LEAST_MASS = 1e-12  # of a sample that must not decide between starts


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _climb(
    theta: NDArray[np.float64],
    cells: Cells,
    law: Law,
    limits: NDArray[np.float64],
    to_beat: float,
    room: Room,
) -> tuple[bool, float, int]:
    """Climb with the weight of the lobes free."""
    bound, most = limits[MIN_LOG_EXPOSURE], int(limits[MAX_EVALUATIONS])
    fine, loglik, used = climb(theta, cells, law, bound, limits[TOLERANCE], most, True, to_beat, room)
    return fine, loglik, used


@nb.njit(nogil=True, cache=True, error_model="numpy")
def lobe_weight(cells: Cells, room: Room) -> tuple[float, float]:
    """Return the likeliest weight of the free lobes, all else as it is, and the rise of the log-likelihood.

    The masses are linear in the weight, so the log-likelihood is concave: Newton steps, halved inside 0..1.
    """
    weight, low, high = 0.02, 0.0, 1.0
    for _ in range(30):
        slope = bend = 0.0
        for i in range(cells.n_bins):
            if cells.weights[i] > 0.0 and room.mass[i] > 0.0:
                ratio = room.slopes[LOBE, i] / (room.mass[i] + weight * room.slopes[LOBE, i])
                slope += cells.weights[i] * ratio
                bend += cells.weights[i] * ratio * ratio
        if slope > 0.0:
            low = weight
        else:
            high = weight
        following = weight + slope / bend if bend > 0.0 else 0.5 * (low + high)
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - weight) < 1e-4 * weight + 1e-7:
            break
        weight = following
    rise = 0.0
    for i in range(cells.n_bins):
        if cells.weights[i] > 0.0 and room.mass[i] > 0.0:
            rise += cells.weights[i] * math.log1p(weight * room.slopes[LOBE, i] / room.mass[i])
    return weight, rise


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _from_fit(
    theta: NDArray[np.float64], cells: Cells, law: Law, limits: NDArray[np.float64], room: Room
) -> tuple[float, int]:
    """Fit the weight of the free lobes of ``cells`` too, from the fit without; ``theta`` is updated.

    Returns:
        The log-likelihood, -inf where nothing speaks for these lobes; evaluations.
    """
    held, step = np.zeros(N_THETA, np.bool_), np.empty(N_THETA)
    bound = limits[MIN_LOG_EXPOSURE]
    evaluate(theta, cells, law, room)
    weight, rise = lobe_weight(cells, room)
    find_held(theta, room.score, bound, True, held)
    expected, _ = newton_step(room, held, 0.0, step)
    least = _SCREEN * limits[LOBE_RISE]
    if not (rise > least or expected > least):
        return -math.inf, 1
    theta[LOBE] = max(weight, 0.005)
    fine, loglik, used = _climb(theta, cells, law, limits, -math.inf, room)
    return loglik if fine else -math.inf, used + 1


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _beside(direction: float, cells: Cells, law: Law, room: Room, theta: NDArray[np.float64]) -> bool:
    """Move ``theta`` by one electron (H + direction, mu - direction/g); False where H would end.

    A lobe below the peak of no electron is taken for that peak by a fit without lobes.
    """
    exposure = math.exp(theta[LOG_EXPOSURE]) + direction
    if not exposure > 0.03:
        return False
    theta[LOG_EXPOSURE] = math.log(exposure)
    theta[BIAS] -= direction * theta[STEP]
    near_masses(theta, cells, law, room)
    weight, _ = lobe_weight(cells, room)
    theta[LOBE] = min(max(weight, 0.005), 0.5)
    return True


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _likeliest_start(
    a: float,
    amplitude: float,
    histogram: Histogram,
    cells: Cells,
    law: Law,
    room: Room,
    theta: NDArray[np.float64],
) -> bool:
    """Fill ``theta`` with the likeliest of a row of starts of the histogram's mean and variance.

    Args:
        a: step around which steps are tried, DN per electron.
        amplitude: of the lobes, e-.
        histogram: of the pixel.
        cells: of the pixel, lobes in place.
        law: grown model.
        room: scratch.
        theta: out.

    Returns:
        Whether there is one.
    """
    trial = np.empty(N_THETA)
    mean_shift = square_shift = 0.0
    for side in range(law.pattern.shape[0]):
        mean_shift += law.pattern[side, 1] * law.pattern[side, 0] * amplitude
        square_shift += law.pattern[side, 1] * (law.pattern[side, 0] * amplitude) ** 2
    best = -math.inf
    for scale in _SCALES:
        for weight in _WEIGHTS:
            step = a * scale
            spread = weight * square_shift - (weight * mean_shift) ** 2
            exposure = histogram.variance / (step * step) - _NOISE_E * _NOISE_E - spread
            if not exposure > 0.05:
                continue
            trial[LOG_EXPOSURE] = math.log(exposure)
            trial[STEP] = step
            trial[BIAS] = histogram.mean - step * (exposure + weight * mean_shift)
            trial[LOG_VARIANCE] = 2.0 * math.log(_NOISE_E * step)
            trial[LOBE] = weight
            if not sensible(trial):
                continue
            near_masses(trial, cells, law, room)
            loglik = 0.0
            for i in range(cells.n_bins):
                if cells.weights[i] > 0.0:
                    loglik += cells.weights[i] * math.log(max(room.mass[i], _LEAST_MASS))
            if loglik > best:
                best = loglik
                for i in range(N_THETA):
                    theta[i] = trial[i]
    return best > -math.inf


@nb.njit(nogil=True, cache=True, error_model="numpy")
def search_lobes(
    theta: NDArray[np.float64],
    loglik: float,
    histogram: Histogram,
    cells: Cells,
    law: Law,
    place: tuple[int, int, int],
    amplitudes: NDArray[np.float64],
    unsure: bool,
    thorough: bool,
    limits: NDArray[np.float64],
    room: Room,
) -> tuple[float, int]:
    """Try free lobes of each amplitude; keep the best in ``theta`` where the likelihood rises by enough.

    Args:
        theta: the fit without lobes; out: that with them.
        loglik: its log-likelihood.
        histogram: of the pixel.
        cells: of the pixel; the lobes are overwritten.
        law: grown model.
        place: the pixel's place in the arrays of the law, the code of the first cell, the centre.
        amplitudes: e-.
        unsure: starts one electron beside the fit are tried too.
        thorough: those are, and starts with other steps.
        limits: bounds and limits.
        room: scratch.

    Returns:
        The amplitude kept, e-, 0 without one; evaluations.
    """
    trial, best = np.empty(N_THETA), np.empty(N_THETA)
    kept, highest, used = 0.0, loglik + limits[LOBE_RISE], 0
    pixel, first_code, centre = place
    space = cells.weights, cells.edges, cells.lobes
    for amplitude in amplitudes:
        own = make_cells(law, pixel, amplitude, first_code, centre, cells.n_bins, space)
        for attempt in range(_N_ATTEMPTS if thorough else (_N_ATTEMPTS - 1 if unsure else 1)):
            for i in range(N_THETA):
                trial[i] = theta[i]
            if attempt == 0:
                found, count = _from_fit(trial, own, law, limits, room)
            else:
                if attempt < _N_ATTEMPTS - 1:
                    usable = _beside(3.0 - 2.0 * attempt, own, law, room, trial)
                else:
                    usable = _likeliest_start(theta[STEP], amplitude, histogram, own, law, room, trial)
                if not usable:
                    continue
                fine, found, count = _climb(trial, own, law, limits, highest, room)
                found = found if fine else -math.inf
            used += count
            if thorough and found > -math.inf:
                found, _, count = climb_neighbours(trial, found, own, law, limits, True, room)
                used += count
            if found > highest:
                kept, highest = amplitude, found
                for i in range(N_THETA):
                    best[i] = trial[i]
    if kept > 0.0:
        for i in range(N_THETA):
            theta[i] = best[i]
    return kept, used
