"""The search for free lobes: levels of one amplitude, with a weight of its own in each pixel.

Strong lobes lead a fit without them astray: it takes a lobe for the peak of no electron, or the distance of
the lobes for that of the peaks. Where it describes the histogram badly, other starts are tried that have
the mean, the variance and the third cumulant of the histogram with the lobes in place: lobes on both sides
alike, and the read noise, add nothing to the third cumulant ``a^3 H``. The best amplitude is refined.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.grown_newton_numba import climb, find_held, newton_step, sensible
from pchem_pipeline.model.fit.grown_numba import (
    CLEAR_GAP,
    LOBE_RISE,
    MAX_EVALUATIONS,
    MIN_LOG_EXPOSURE,
    TOLERANCE,
    climb_neighbours,
    make_cells,
)
from pchem_pipeline.model.law.grown_cells_numba import glance, near_masses
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
from pchem_pipeline.model.law.workspace_numba import Histogram

_SCREEN = 0.2  # of the rise asked of free lobes, seen from the fit without them
#: steps of the other starts in units of that of a Poisson law without noise, third cumulant over variance
_SCALES = (1.04, 1.14, 1.24, 1.35, 1.47, 1.6, 1.75, 1.9, 2.1, 2.3, 2.55, 2.85, 3.3)
_NOISE_E = 0.29  # read noise there
_LEAST_WEIGHT, _MOST_WEIGHT = 0.02, 0.6  # of the lobes there
_LEAST_SKEWNESS = 0.15
_SHORTFALL = 0.25  # of the electrons, by which their variance may exceed that of the histogram
_N_ATTEMPTS = 4  # from the fit, one electron more and less, another comb
_FINER, _N_REFINED = 0.12, 4  # first step of log amplitude, and steps at most
_LEAST_MASS = 1e-9  # of a sample that must not decide between starts


@kernel
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


@kernel
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


@kernel
def _from_fit(
    theta: NDArray[np.float64], cells: Cells, law: Law, limits: NDArray[np.float64], room: Room
) -> tuple[float, int]:
    """Fit the weight of the free lobes of ``cells`` too, from the fit without; ``theta`` is updated.

    Returns:
        The log-likelihood, -inf where nothing speaks for these lobes; evaluations.
    """
    held, step = np.zeros(N_THETA, np.bool_), np.empty(N_THETA)
    bound = limits[MIN_LOG_EXPOSURE]
    glance(theta, cells, law, room)
    weight, rise = lobe_weight(cells, room)
    find_held(theta, room.score, bound, True, held)
    expected, _ = newton_step(room, held, 0.0, step)
    least = _SCREEN * limits[LOBE_RISE]
    if not (rise > least or expected > least):
        return -math.inf, 1
    theta[LOBE] = max(weight, 0.005)
    fine, loglik, used = _climb(theta, cells, law, limits, -math.inf, room)
    return loglik if fine else -math.inf, used + 1


@kernel
def _beside(direction: float, cells: Cells, law: Law, room: Room, theta: NDArray[np.float64]) -> float:
    """Move ``theta`` by one electron (H + direction, mu - direction/g); return the log-likelihood there.

    A lobe below the peak of no electron is taken for that peak by a fit without lobes. -inf where H would
    end.
    """
    exposure = math.exp(theta[LOG_EXPOSURE]) + direction
    if not exposure > 0.03:
        return -math.inf
    theta[LOG_EXPOSURE] = math.log(exposure)
    theta[BIAS] -= direction * theta[STEP]
    near_masses(theta, cells, law, room)
    weight, _ = lobe_weight(cells, room)
    theta[LOBE] = min(max(weight, 0.005), 0.5)
    loglik = 0.0
    for i in range(cells.n_bins):
        if cells.weights[i] > 0.0:
            mass = room.mass[i] + theta[LOBE] * room.slopes[LOBE, i]
            loglik += cells.weights[i] * math.log(max(mass, _LEAST_MASS))
    return loglik


@kernel
def third_cumulant(histogram: Histogram) -> float:
    """Return the third cumulant, DN^3, but at least that of a small skewness."""
    third = 0.0
    for i in range(histogram.n_bins):
        third += histogram.weights[i] * (histogram.first + i - histogram.mean) ** 3
    least = _LEAST_SKEWNESS * histogram.variance * math.sqrt(histogram.variance)
    return max(third / histogram.n, least)


@kernel
def _with_cumulants(
    a: float,
    noise: float,
    third: float,
    histogram: Histogram,
    moments: tuple[float, float, float],
    theta: NDArray[np.float64],
) -> bool:
    """Fill ``theta`` from the cumulants of the histogram, given step and read noise (e-).

    Args:
        a: DN per electron.
        noise: e-.
        third: third cumulant, DN^3.
        histogram: of the pixel.
        moments: first three moments of the levels beside the quiet one, e-.
        theta: out.

    Returns:
        Whether such lobes can have these cumulants, chance aside.
    """
    m1, m2, m3 = moments
    weight, exposure, spread = 0.1, 0.0, 0.0
    for _ in range(4 if m1 != 0.0 or m3 != 0.0 else 1):
        own = weight * (m3 - weight * m1 * (3.0 * m2 - 2.0 * weight * m1 * m1))
        exposure = third / a**3 - own
        spread = histogram.variance / (a * a) - exposure - noise * noise
        weight = min(max(spread / (m2 - weight * m1 * m1), _LEAST_WEIGHT), _MOST_WEIGHT)
    if not exposure > 0.03 or spread < -_SHORTFALL * exposure:
        return False
    theta[LOG_EXPOSURE] = math.log(exposure)
    theta[STEP] = a
    theta[BIAS] = histogram.mean - a * (exposure + weight * m1)
    theta[LOG_VARIANCE] = 2.0 * math.log(noise * a)
    theta[LOBE] = weight
    fine: bool = sensible(theta)
    return fine


@kernel
def _height(amplitude: float, theta: NDArray[np.float64], cells: Cells, law: Law, room: Room) -> float:
    """Return the log-likelihood with lobes: the masses without in ``room``, moved by whole and part DN."""
    n, weight = cells.n_bins, theta[LOBE]
    for i in range(n):
        room.ratio[i] = (1.0 - weight) * room.mass[i]
    for side in range(law.pattern.shape[0]):
        shift = amplitude * law.pattern[side, 0] * theta[STEP]
        whole = math.floor(shift)
        part, share = shift - whole, weight * law.pattern[side, 1]
        move = int(whole)
        for i in range(max(move, 0), min(n + move, n)):
            room.ratio[i] += share * (1.0 - part) * room.mass[i - move]
        for i in range(max(move + 1, 0), min(n + move + 1, n)):
            room.ratio[i] += share * part * room.mass[i - move - 1]
    loglik = 0.0
    for i in range(n):
        if cells.weights[i] > 0.0:
            loglik += cells.weights[i] * math.log(max(room.ratio[i], _LEAST_MASS))
    return loglik


@kernel
def _scan(
    histogram: Histogram,
    cells: Cells,
    law: Law,
    amplitudes: NDArray[np.float64],
    room: Room,
    starts: NDArray[np.float64],
) -> None:
    """Fill the likeliest of a row of starts of the histogram's mean, variance and third cumulant.

    Args:
        histogram: of the pixel.
        cells: of the pixel, without free lobes.
        law: grown model.
        amplitudes: of the lobes, e-.
        room: scratch.
        starts: out, theta for each amplitude, shape (amplitudes, N_THETA); NaN where there is none.

    """
    trial = np.empty(N_THETA)
    heights = np.full(amplitudes.size, -math.inf)
    third = third_cumulant(histogram)
    starts[:] = math.nan
    for scale in _SCALES:
        exposure = math.nan
        for place in range(amplitudes.size):
            amplitude = amplitudes[place]
            m1 = m2 = m3 = 0.0
            for side in range(law.pattern.shape[0]):
                shift = law.pattern[side, 0] * amplitude
                m1 += law.pattern[side, 1] * shift
                m2 += law.pattern[side, 1] * shift * shift
                m3 += law.pattern[side, 1] * shift * shift * shift
            if abs(m1) < 1e-9 * amplitude:
                m1 = m3 = 0.0
            a = scale * third / histogram.variance
            if not _with_cumulants(a, _NOISE_E, third, histogram, (m1, m2, m3), trial):
                continue
            if trial[LOG_EXPOSURE] != exposure:
                exposure = trial[LOG_EXPOSURE]
                near_masses(trial, cells, law, room)
            loglik = _height(amplitude, trial, cells, law, room)
            if loglik > heights[place]:
                heights[place] = loglik
                for i in range(N_THETA):
                    starts[place, i] = trial[i]


@kernel
def _refine(
    amplitude: float,
    theta: NDArray[np.float64],
    highest: float,
    cells: Cells,
    law: Law,
    place: tuple[int, int, int],
    limits: NDArray[np.float64],
    room: Room,
) -> tuple[float, float, int]:
    """Climb in the amplitude too; ``theta`` is updated.

    Returns:
        Amplitude, e-, log-likelihood there, evaluations.
    """
    trial = np.empty(N_THETA)
    pixel, first_code, centre = place
    space = cells.weights, cells.edges, cells.lobes
    heights = np.empty(2)
    used, step, target = 0, _FINER, 0.0
    for attempt in range(_N_REFINED):
        start = amplitude
        for side in range(3):
            if side == 2:
                # the vertex of the parabola through the three, where both sides are lower
                bend = heights[0] + heights[1] - 2.0 * highest
                if amplitude != start or not -math.inf < bend < 0.0:
                    break
                target = 0.5 * step * (heights[0] - heights[1]) / bend
            else:
                target = (2.0 * side - 1.0) * step
            tried = start * math.exp(target)
            own = make_cells(law, pixel, tried, first_code, centre, cells.n_bins, space)
            for i in range(N_THETA):
                trial[i] = theta[i]
            fine, found, count = _climb(trial, own, law, limits, -math.inf, room)
            used += count
            found = found if fine else -math.inf
            if side < 2:
                heights[side] = found
            if found > highest:
                amplitude, highest = tried, found
                for i in range(N_THETA):
                    theta[i] = trial[i]
        if amplitude == start or target not in (-step, step):
            step *= 0.3
        if attempt > 0 and step < 0.02:
            break
    return amplitude, highest, used


@kernel
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
        unsure: a start with one electron more is tried too; one with one less always is.
        thorough: both are however unlikely, and starts on other combs.
        limits: bounds and limits.
        room: scratch.

    Returns:
        The amplitude kept, e-, 0 without one; evaluations.
    """
    trial, best = np.empty(N_THETA), np.empty(N_THETA)
    kept, highest, used = 0.0, loglik + limits[LOBE_RISE], 0
    pixel, first_code, centre = place
    space = cells.weights, cells.edges, cells.lobes
    starts = np.empty((amplitudes.size, N_THETA))
    if thorough:
        _scan(histogram, cells, law, amplitudes, room, starts)
    for which in range(amplitudes.size):
        amplitude = amplitudes[which]
        own = make_cells(law, pixel, amplitude, first_code, centre, cells.n_bins, space)
        for attempt in range(_N_ATTEMPTS if thorough else _N_ATTEMPTS - 1):
            for i in range(N_THETA):
                trial[i] = theta[i]
            if attempt == 0:
                found, count = _from_fit(trial, own, law, limits, room)
            else:
                if attempt < _N_ATTEMPTS - 1:
                    # a lobe above the others is no one's peak of no electron: only an unsure fit may be below
                    likely = loglik - limits[CLEAR_GAP] if not thorough else -math.inf
                    usable = attempt > 1 or unsure or thorough
                    usable = usable and _beside(3.0 - 2.0 * attempt, own, law, room, trial) > likely
                else:
                    usable = math.isfinite(starts[which, 0])
                    for i in range(N_THETA):
                        trial[i] = starts[which, i]
                if not usable:
                    continue
                fine, found, count = _climb(trial, own, law, limits, highest, room)
                found = found if fine else -math.inf
            used += count
            if thorough and found > highest - limits[CLEAR_GAP]:
                found, _, count = climb_neighbours(trial, found, own, law, limits, True, room)
                used += count
            if found > highest:
                kept, highest = amplitude, found
                for i in range(N_THETA):
                    best[i] = trial[i]
    if kept > 0.0:
        for i in range(N_THETA):
            theta[i] = best[i]
        kept, highest, count = _refine(kept, theta, highest, cells, law, place, limits, room)
        used += count
    return kept, used
