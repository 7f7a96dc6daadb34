"""The exact likelihood of one histogram under a grown model, with its first and second derivatives.

Parameters ``theta = (log H, 1/g, mu - centre, log sigma_R^2, q)``: DN per electron, DN, DN^2, and the weight
of free lobes. A component is one electron number k in one lobe l, a normal law of mean m and variance s^2;
what it gives to the cells are differences of ``Phi``, ``phi`` and ``z phi`` at the edges. Since a normal law
obeys the heat equation (``d/ds^2 = 1/2 d^2/dm^2``), the second derivatives of all cells together need only
four sums over the edges per component, with Hermite polynomials.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.electron_laws_numba import FARTHEST, electron_number, normal_tail
from pchem_pipeline.model.law.grown_types_numba import (
    BIAS,
    LOBE,
    LOG_EXPOSURE,
    LOG_VARIANCE,
    N_THETA,
    SHIFT_DN,
    SHIFT_E,
    SHIFT_SIGMA,
    STEP,
    WEIGHT,
    WEIGHT_SLOPE,
    WIDTH,
    Cells,
    Component,
    Law,
    Room,
)

# how far out components are added, in three stages: standard deviations, probability below which an electron
# number is left out, and the mass of an occupied cell below which the next stage is called for
_REACH = (8.5, 15.0, FARTHEST)
_CUT = (1e-17, 1e-50, 1e-305)
_OUTLIER = (1e-9, 1e-40, 0.0)
#: Stages that :func:`all_masses` goes to at once.
NEAR, EXACT = 1, 2
_LEAST_MASS = 1e-300
_LEAST_VARIANCE = 1e-6  # DN^2


@kernel(inline=True)
def _level(k: float, cells: Cells, law: Law) -> float:
    """Return the level of k electrons, e-."""
    return cells.level_scale * k * (1.0 + 0.5 * law.curvature * (k - 1.0)) + cells.level_shift


@kernel
def component(
    k: float, lobe: int, theta: NDArray[np.float64], cells: Cells, law: Law, reach: float
) -> Component:
    """Return one electron number in one lobe; ``low >= high`` where it does not reach the cells."""
    a, analog2 = theta[STEP], math.exp(theta[LOG_VARIANCE])
    lobes = cells.lobes
    charge = _level(k, cells, law) + lobes[SHIFT_E, lobe]
    by_sigma = lobes[SHIFT_SIGMA, lobe] * math.sqrt(analog2)
    mean = theta[BIAS] + a * charge + lobes[SHIFT_DN, lobe] + by_sigma
    own = lobes[WIDTH, lobe] * lobes[WIDTH, lobe] * analog2
    spread = cells.extra_e2 + k * (law.variance_per_electron + k * law.variance_per_electron2)
    variance = max(own + a * a * spread + cells.extra_dn2, _LEAST_VARIANCE)
    sd = math.sqrt(variance)
    place = mean - cells.first
    n = float(cells.n_bins)
    low = int(min(max(place - reach * sd - cells.margin, 0.0), n))
    high = int(min(max(place + reach * sd + cells.margin + 1.0, 0.0), n))
    # what lies beyond the limits belongs to the first or last code that comes out
    high = min(max(high, cells.bottom + 1), cells.n_bins)
    low = max(min(low, cells.top - 1), 0)
    return Component(mean, variance, sd, charge, 0.5 * by_sigma, 2.0 * a * spread, own, low, high)


@kernel
def _list_numbers(
    theta: NDArray[np.float64], cells: Cells, law: Law, reach: float, cut: float, numbers: NDArray[np.float64]
) -> int:
    """Fill the electron numbers that reach the cells, with their probabilities; return how many."""
    a, analog2, exposure = theta[STEP], math.exp(theta[LOG_VARIANCE]), math.exp(theta[LOG_EXPOSURE])
    widest = farthest = 0.0
    for lobe in range(cells.n_lobes):
        widest = max(widest, cells.lobes[WIDTH, lobe])
        shift = a * abs(cells.lobes[SHIFT_E, lobe]) + abs(cells.lobes[SHIFT_DN, lobe])
        farthest = max(farthest, shift + abs(cells.lobes[SHIFT_SIGMA, lobe]) * math.sqrt(analog2))
    from_below, to_above = cells.bottom >= 0, cells.top <= cells.n_bins
    last = cells.first + cells.n_bins + cells.margin
    most = exposure * np.max(law.exposure_factors) + np.max(cells.added_exposure)
    count, previous = 0, -math.inf
    k = 0.0
    while count < numbers.shape[0]:
        level = _level(k, cells, law)
        spread = cells.extra_e2 + k * (law.variance_per_electron + k * law.variance_per_electron2)
        around = farthest + reach * math.sqrt(widest * widest * analog2 + a * a * spread + cells.extra_dn2)
        mean = theta[BIAS] + a * level
        if level <= previous or (mean - around > last and not to_above):
            break
        previous = level
        if from_below or mean + around > cells.first - cells.margin:
            mass, slope, bend = electron_number(
                law.law,
                law.dispersion,
                int(k),
                exposure,
                law.exposure_weights,
                law.exposure_factors,
                cells.added_weights,
                cells.added_exposure,
            )
            if mass > cut:
                numbers[count, 0], numbers[count, 1] = k, mass
                numbers[count, 2], numbers[count, 3] = slope, bend
                count += 1
            elif k > most:
                break
        k += 1.0
    return count


@kernel
def _fill_edges(
    edges: NDArray[np.float64], part: Component, table: NDArray[np.float64], out: NDArray[np.float64]
) -> int:
    """Fill tail, density and z times density at the edges within reach; return the cell of the mean."""
    middle: int = part.low - 1
    inverse = 1.0 / part.sd
    for i in range(part.low, part.high + 1):
        z = (edges[i] - part.mean) * inverse
        tail, density = normal_tail(z, table)
        out[0, i] = tail
        out[1, i] = density
        out[2, i] = z * density if density > 0.0 else 0.0
        if z <= 0.0:
            middle = i
    return middle


@kernel
def _add_masses(
    theta: NDArray[np.float64], cells: Cells, law: Law, reach: float, cut: float, room: Room
) -> int:
    """Fill mass and slopes of all cells; return how many electron numbers there are."""
    mass, slopes, at = room.mass, room.slopes, room.at_edges
    for i in range(cells.n_bins):
        mass[i] = 0.0
        for j in range(N_THETA):
            slopes[j, i] = 0.0
    count: int = _list_numbers(theta, cells, law, reach, cut, room.numbers)
    lobe_weight = theta[LOBE]
    for row in range(count):
        k = room.numbers[row, 0]
        for lobe in range(cells.n_lobes):
            share_slope = cells.lobes[WEIGHT_SLOPE, lobe]
            share = cells.lobes[WEIGHT, lobe] + lobe_weight * share_slope
            part = component(k, lobe, theta, cells, law, reach)
            if part.low >= part.high or (share == 0.0 and share_slope == 0.0):
                continue
            middle = _fill_edges(cells.edges, part, law.table, at)
            w = room.numbers[row, 1] * share
            w_exposure = room.numbers[row, 2] * share
            w_lobe = room.numbers[row, 1] * share_slope
            by_mean, by_variance = -w / part.sd, -0.5 * w / part.variance
            step1, step2 = by_mean * part.mean_step, by_variance * part.variance_step
            log1, log2 = by_mean * part.mean_log, by_variance * part.variance_log
            for i in range(part.low, part.high):
                d0 = at[0, i + 1] - at[0, i]
                if i == middle:
                    d0 += 1.0
                d1 = at[1, i + 1] - at[1, i]
                d2 = at[2, i + 1] - at[2, i]
                mass[i] += w * d0
                slopes[LOG_EXPOSURE, i] += w_exposure * d0
                slopes[STEP, i] += step1 * d1 + step2 * d2
                slopes[BIAS, i] += by_mean * d1
                slopes[LOG_VARIANCE, i] += log1 * d1 + log2 * d2
                slopes[LOBE, i] += w_lobe * d0
    if law.outlier_share > 0.0:
        rest = 1.0 - law.outlier_share
        for i in range(cells.n_bins):
            mass[i] = rest * mass[i] + law.outlier_mass
            for j in range(N_THETA):
                slopes[j, i] *= rest
    return count


@kernel
def masses(theta: NDArray[np.float64], cells: Cells, law: Law, room: Room) -> tuple[int, float]:
    """Fill mass and slopes of the cells, exact also where an occupied one lies far out.

    Returns:
        Number of electron numbers in use, and how many standard deviations a component reaches.
    """
    count = stage = 0
    while stage < len(_REACH):
        count = _add_masses(theta, cells, law, _REACH[stage], _CUT[stage], room)
        lowest = 1.0
        for i in range(cells.n_bins):
            if cells.weights[i] > 0.0:
                lowest = min(lowest, room.mass[i])
        if lowest >= _OUTLIER[stage]:
            break
        stage += 1
    return count, _REACH[stage]


@kernel
def near_masses(theta: NDArray[np.float64], cells: Cells, law: Law, room: Room) -> None:
    """Fill mass and slopes of the cells, only as far out as most samples lie."""
    _add_masses(theta, cells, law, _REACH[0], _CUT[0], room)


@kernel
def all_masses(theta: NDArray[np.float64], cells: Cells, law: Law, room: Room, stage: int) -> None:
    """Fill mass and slopes of the cells, to the ends of the tails (stage 2) or as far as 1e-50 (stage 1)."""
    _add_masses(theta, cells, law, _REACH[stage], _CUT[stage], room)


@kernel
def _sum_up(cells: Cells, law: Law, room: Room) -> float:
    """Return the log-likelihood of the masses in ``room``; fill score, empirical information and ratio."""
    score, empirical, slopes = room.score, room.empirical, room.slopes
    for i in range(N_THETA):
        score[i] = 0.0
        for j in range(N_THETA):
            empirical[i, j] = 0.0
    loglik = 0.0
    for cell in range(cells.n_bins):
        weight, mass = cells.weights[cell], room.mass[cell]
        room.ratio[cell] = 0.0
        if weight > 0.0 and not mass > _LEAST_MASS:
            loglik += weight * math.log(_LEAST_MASS)
        elif weight > 0.0:
            loglik += weight * math.log(mass)
            ratio = weight / mass
            room.ratio[cell] = ratio * (1.0 - law.outlier_share)
            for i in range(N_THETA):
                score[i] += ratio * slopes[i, cell]
                for j in range(i + 1):
                    empirical[i, j] += ratio * slopes[i, cell] * (slopes[j, cell] / mass)
    for i in range(N_THETA):
        for j in range(i + 1):
            empirical[j, i] = empirical[i, j]
            room.information[i, j] = empirical[i, j]
            room.information[j, i] = empirical[i, j]
    return loglik


@kernel
def glance(theta: NDArray[np.float64], cells: Cells, law: Law, room: Room) -> float:
    """Return the log-likelihood; fill the score, and the empirical information also for the observed one."""
    masses(theta, cells, law, room)
    loglik: float = _sum_up(cells, law, room)
    return loglik


@kernel
def evaluate(theta: NDArray[np.float64], cells: Cells, law: Law, room: Room) -> float:
    """Return the log-likelihood at ``theta``; fill score, empirical and observed information."""
    count, reach = masses(theta, cells, law, room)
    loglik: float = _sum_up(cells, law, room)
    _subtract_curvature(theta, cells, law, reach, count, room)
    return loglik


@kernel
def _hermite_sums(
    cells: Cells, law: Law, part: Component, room: Room
) -> tuple[float, float, float, float, float]:
    """Return the sums over cells of ratio times the difference of Phi, phi, z phi, He2 phi, He3 phi."""
    at, ratio, edges = room.at_edges, room.ratio, cells.edges
    middle = _fill_edges(edges, part, law.table, at)
    s0 = s1 = s2 = s3 = s4 = 0.0
    before = 0.0
    inverse = 1.0 / part.sd
    for i in range(part.low, part.high + 1):
        here = ratio[i] if i < part.high else 0.0
        if i < part.high:
            s0 += here * (at[0, i + 1] - at[0, i])
            if i == middle:
                s0 += here
        change = before - here
        before = here
        density = at[1, i]
        if density > 0.0:
            z = (edges[i] - part.mean) * inverse
            s1 += change * density
            s2 += change * at[2, i]
            s3 += change * (z * z - 1.0) * density
            s4 += change * (z * z - 3.0) * at[2, i]
    return s0, s1, s2, s3, s4


@kernel
def _subtract_curvature(
    theta: NDArray[np.float64], cells: Cells, law: Law, reach: float, count: int, room: Room
) -> None:
    """Take the second derivatives of the masses, times counts over mass, off the information."""
    information = room.information
    lobe_weight = theta[LOBE]
    for row in range(count):
        k, p0 = room.numbers[row, 0], room.numbers[row, 1]
        p1, p2 = room.numbers[row, 2], room.numbers[row, 3]
        for lobe in range(cells.n_lobes):
            slope = cells.lobes[WEIGHT_SLOPE, lobe]
            share = cells.lobes[WEIGHT, lobe] + lobe_weight * slope
            part = component(k, lobe, theta, cells, law, reach)
            if part.low >= part.high or (share == 0.0 and slope == 0.0):
                continue
            s0, s1, s2, s3, s4 = _hermite_sums(cells, law, part, room)
            q, sd = part.variance, part.sd
            # derivatives in mean and variance, by the heat equation
            f_m, f_q, f_mm = -s1 / sd, -0.5 * s2 / q, -s2 / q
            f_mq, f_qq = -0.5 * s3 / (sd * q), -0.25 * s4 / (q * q)
            ma, mv, qa, qv = part.mean_step, part.mean_log, part.variance_step, part.variance_log
            d_a, d_v = f_m * ma + f_q * qa, f_m * mv + f_q * qv
            information[0, 0] -= p2 * share * s0
            information[1, 0] -= p1 * share * d_a
            information[2, 0] -= p1 * share * f_m
            information[3, 0] -= p1 * share * d_v
            information[4, 0] -= p1 * slope * s0
            information[4, 1] -= p0 * slope * d_a
            information[4, 2] -= p0 * slope * f_m
            information[4, 3] -= p0 * slope * d_v
            w = p0 * share
            q_aa = qa / theta[STEP]
            information[1, 1] -= w * (f_mm * ma * ma + 2.0 * f_mq * ma * qa + f_qq * qa * qa + f_q * q_aa)
            information[2, 1] -= w * (f_mm * ma + f_mq * qa)
            information[2, 2] -= w * f_mm
            information[3, 1] -= w * (f_mm * ma * mv + f_mq * (ma * qv + mv * qa) + f_qq * qa * qv)
            information[3, 2] -= w * (f_mm * mv + f_mq * qv)
            bend = f_m * 0.5 * mv + f_q * qv
            information[3, 3] -= w * (f_mm * mv * mv + 2.0 * f_mq * mv * qv + f_qq * qv * qv + bend)
    for i in range(N_THETA):
        for j in range(i):
            information[j, i] = information[i, j]
