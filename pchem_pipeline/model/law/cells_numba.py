"""The likelihood of whole DN, each component integrated over its cell, with first and second derivatives.

Parameters of a sample are (log H, 1/g, mu - centre, log sigma_R^2, q): DN per electron, DN, DN^2, and the
weight of free satellite peaks. A component is one electron number k at one level of the noise, a normal law
of mean m and variance s^2; what it gives to the cells are differences of ``Phi``, ``phi`` and ``z phi`` at
the edges. Since a normal law obeys the heat equation (``d/ds^2 = 1/2 d^2/dm^2``), the second derivatives of
all cells together need only four sums over the edges per component, with Hermite polynomials.

Where codes are set aside, the likelihood is that of the others given that a sample is one of them (a
truncated sample, Fisher 1931): what the law does not describe there bends nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.electron_laws_numba import FARTHEST, electron_number, normal_tail
from pchem_pipeline.model.law.pixel_numba import (
    ADDED_EXPOSURE,
    ADDED_WEIGHT,
    AT_EDGES,
    BIAS,
    BOTTOM,
    CENTRE,
    CLIP_HIGH,
    CLIP_LOW,
    CONDITIONAL,
    COUNT_LAW,
    CURVATURE,
    DAMPING,
    DARK,
    DISPERSION,
    EDGE,
    EDGE_FIRST,
    EXPECTED,
    EXPOSURE_FACTOR,
    EXPOSURE_WEIGHT,
    EXTRA_DN2,
    EXTRA_E2,
    FIRST,
    INFORMATION,
    KEPT,
    LEVEL_SCALE,
    LEVEL_SHIFT,
    LOG_VARIANCE,
    MARGIN,
    MASS,
    N_BINS,
    N_BLOCK,
    N_FRAMES,
    N_PEAKS,
    OUTLIER_MASS,
    OUTLIER_SHARE,
    OWN,
    PER_ELECTRON,
    PER_ELECTRON2,
    RATIO,
    RIGHT,
    SATELLITE,
    SCORE,
    SHARE,
    SHARE_SLOPE,
    SHIFT_DN,
    SHIFT_E,
    SHIFT_SIGMA,
    SLOPES,
    STEP,
    TOP,
    WEIGHT,
    WIDTH,
    Pixel,
    Scratch,
)

# places in a sample's own parameters
_EXPOSURE, _STEP, _BIAS, _VARIANCE, _SATELLITE = range(N_BLOCK)
# how far out components are added, in three stages: standard deviations, probability below which an electron
# number is left out, and the mass of an occupied cell below which the next stage is called for
_REACH = (8.5, 15.0, FARTHEST)
_CUT = (1e-17, 1e-50, 1e-305)
_OUTLIER = (1e-9, 1e-40, 0.0)
#: Stages of :func:`fill_masses`: as far out as most samples lie, down to 1e-50, to the ends of the tails.
CORE, NEAR, EXACT = range(3)
LEAST_MASS = 1e-300
_LEAST_VARIANCE = 1e-6  # DN^2
_NO_ELECTRONS = -60.0  # log H of a sample without electrons


class Law(NamedTuple):
    """The laws of J samples as the loops take them, see :mod:`pchem_pipeline.model.law.sample_law`.

    Attributes:
        numbers: columns ``COUNT_LAW`` ... ``EDGE_FIRST`` of a pixel's facts, shape (J, 1 or n, 10).
        own: level scale, level shift (e-), extra variance (e-^2, DN^2), shape (J, 1 or n, 4).
        peaks: weight, shifts (e-, DN, sigma) and width of the noise's levels, shape (J, 1 or n, 5, enough).
        n_peaks: levels in use, shape (J,).
        exposures: weights and factors of the exposures, shape (J, 1 or n, 2, enough).
        added: weights and values (e-) of added exposures, shape (J, 1 or n, 2, enough).
        edge_shift: shifts of the code edges from ``EDGE_FIRST`` on, DN, shape (J, 1 or n, enough).
        pattern: shift, in units of the amplitude, and weight of free satellites, shape (enough, 2).
        table: of the normal law.
    """

    numbers: NDArray[np.float64]
    own: NDArray[np.float64]
    peaks: NDArray[np.float64]
    n_peaks: NDArray[np.int64]
    exposures: NDArray[np.float64]
    added: NDArray[np.float64]
    edge_shift: NDArray[np.float64]
    pattern: NDArray[np.float64]
    table: NDArray[np.float64]


class Cells(NamedTuple):
    """One sample: its counts, the edges of its cells, and what the law says of it.

    Attributes:
        weights: counts, shape (at least n_bins,).
        kept: 1 for codes that are not set aside.
        edges: lower edges of the cells and the upper edge of the last one, less the centre; infinite where
            everything beyond is counted in the cell.
        n_bins: cells in use.
        bottom: last edge at minus infinity, -1 without one.
        top: first edge at infinity, n_bins + 1 without one.
        margin: largest distance of a finite edge from its place ``i`` after ``first``, DN.
        first: place of the first edge, less the centre, without any shift.
        frames: samples counted.
        conditional: whether codes are set aside.
        peaks: levels of the noise, shape (N_PEAK_ROWS, at least n_peaks).
        n_peaks: levels in use.
        mixtures: of exposures, see :class:`.pixel_numba.Pixel`.
        table: of the normal law.
        count_law, dispersion: of the electron number.
        level_scale, level_shift, curvature: of the comb; e-.
        extra_e2, extra_dn2, per_electron, per_electron2: variance, e-^2 and DN^2.
        outlier_share, outlier_mass: of samples that can be anything, and in each code.
    """

    weights: NDArray[np.float64]
    kept: NDArray[np.float64]
    edges: NDArray[np.float64]
    n_bins: int
    bottom: int
    top: int
    margin: float
    first: float
    frames: float
    conditional: bool
    peaks: NDArray[np.float64]
    n_peaks: int
    mixtures: NDArray[np.float64]
    table: NDArray[np.float64]
    count_law: int
    dispersion: float
    level_scale: float
    level_shift: float
    curvature: float
    extra_e2: float
    extra_dn2: float
    per_electron: float
    per_electron2: float
    outlier_share: float
    outlier_mass: float


class Component(NamedTuple):
    """One electron number at one level: mean, variance and sd, their derivatives in theta, and its reach.

    Attributes:
        mean, variance, sd: DN, DN^2, DN.
        mean_step, mean_log: derivative of the mean in the step and in log sigma_R^2.
        variance_step, variance_log: those of the variance.
        low, high: first and last edge within reach.
    """

    mean: float
    variance: float
    sd: float
    mean_step: float
    mean_log: float
    variance_step: float
    variance_log: float
    low: int
    high: int


@kernel(inline=True)
def _row(values: NDArray[np.float64], index: int) -> int:
    """Return the row of a pixel in an array with one row for all, or one for each."""
    return index if values.shape[1] > 1 else 0


@kernel(borrows=True)
def set_peaks(law: Law, index: int, amplitude: float, pixel: Pixel) -> None:
    """Fill the levels of the noise of a pixel, those of free satellites (e-; 0: none) beside each."""
    n_sides = law.pattern.shape[0] if amplitude != 0.0 else 0
    row = _row(law.peaks, index)
    for j in range(pixel.facts.shape[0]):
        peaks, count = pixel.peaks[j], 0
        for level in range(law.n_peaks[j]):
            weight = law.peaks[j, row, 0, level]
            for side in range(-1, n_sides):
                for i in range(3):
                    peaks[SHIFT_E + i, count] = law.peaks[j, row, 1 + i, level]
                peaks[WIDTH, count] = law.peaks[j, row, 4, level]
                if side < 0:
                    peaks[SHARE, count] = weight
                    peaks[SHARE_SLOPE, count] = -weight if n_sides else 0.0
                else:
                    peaks[SHIFT_E, count] += amplitude * law.pattern[side, 0]
                    peaks[SHARE, count] = 0.0
                    peaks[SHARE_SLOPE, count] = weight * law.pattern[side, 1]
                count += 1
        pixel.facts[j, N_PEAKS] = float(count)


@kernel(borrows=True)
def resolve(law: Law, index: int, amplitude: float, pixel: Pixel) -> None:
    """Fill what the law says of a pixel: facts, mixtures, edges of the cells, levels of the noise.

    Args:
        law: of all pixels.
        index: the pixel's place in it.
        amplitude: of free satellites, e-; 0: none.
        pixel: its histograms; out: the rest.
    """
    for j in range(pixel.facts.shape[0]):
        facts, edges = pixel.facts[j], pixel.bins[j, EDGE]
        row = _row(law.numbers, index)
        for i in range(law.numbers.shape[2]):
            facts[COUNT_LAW + i] = law.numbers[j, row, i]
        for i in range(4):
            facts[LEVEL_SCALE + i] = law.own[j, _row(law.own, index), i]
        row = _row(law.exposures, index)
        for i in range(law.exposures.shape[3]):
            pixel.mixtures[j, EXPOSURE_WEIGHT, i] = law.exposures[j, row, 0, i]
            pixel.mixtures[j, EXPOSURE_FACTOR, i] = law.exposures[j, row, 1, i]
        for i in range(law.added.shape[3]):
            pixel.mixtures[j, ADDED_WEIGHT, i] = law.added[j, _row(law.added, index), 0, i]
            pixel.mixtures[j, ADDED_EXPOSURE, i] = law.added[j, _row(law.added, index), 1, i]
        n_bins, first = int(facts[N_BINS]), facts[FIRST]
        code = pixel.centre + int(facts[CENTRE] + first)
        margin = 0.0
        bottom, top = -1, n_bins + 1
        n_shifts, edge_first = law.edge_shift.shape[2], int(facts[EDGE_FIRST])
        row = _row(law.edge_shift, index)
        for i in range(n_bins + 1):
            place = code + i - edge_first
            shift = law.edge_shift[j, row, place] if 0 <= place < n_shifts else 0.0
            margin = max(margin, abs(shift))
            edges[i] = first + i - 0.5 + shift
            if code + i <= facts[CLIP_LOW]:
                edges[i], bottom = -math.inf, i
            elif code + i > facts[CLIP_HIGH]:
                edges[i], top = math.inf, min(top, i)
        facts[BOTTOM], facts[TOP], facts[MARGIN] = float(bottom), float(top), margin
    set_peaks(law, index, amplitude, pixel)


@kernel(inline=True)
def cells_of(pixel: Pixel, j: int) -> Cells:
    """Return one sample as the loops below take it."""
    bins, facts = pixel.bins[j], pixel.facts[j]
    return Cells(
        bins[WEIGHT],
        bins[KEPT],
        bins[EDGE],
        int(facts[N_BINS]),
        int(facts[BOTTOM]),
        int(facts[TOP]),
        facts[MARGIN],
        facts[FIRST] - 0.5,
        facts[N_FRAMES],
        facts[CONDITIONAL] > 0.0,
        pixel.peaks[j],
        int(facts[N_PEAKS]),
        pixel.mixtures[j],
        pixel.table,
        int(facts[COUNT_LAW]),
        facts[DISPERSION],
        facts[LEVEL_SCALE],
        facts[LEVEL_SHIFT],
        facts[CURVATURE],
        facts[EXTRA_E2],
        facts[EXTRA_DN2],
        facts[PER_ELECTRON],
        facts[PER_ELECTRON2],
        facts[OUTLIER_SHARE],
        facts[OUTLIER_MASS],
    )


@kernel(inline=True)
def _level(k: float, cells: Cells) -> float:
    """Return the level of k electrons, e-."""
    return cells.level_scale * k * (1.0 + 0.5 * cells.curvature * (k - 1.0)) + cells.level_shift


@kernel(borrows=True)
def component(k: float, peak: int, theta: NDArray[np.float64], cells: Cells, reach: float) -> Component:
    """Return one electron number at one level; ``low >= high`` where it does not reach the cells."""
    a, analog2 = theta[_STEP], math.exp(theta[_VARIANCE])
    peaks = cells.peaks
    charge = _level(k, cells) + peaks[SHIFT_E, peak]
    by_sigma = peaks[SHIFT_SIGMA, peak] * math.sqrt(analog2)
    mean = theta[_BIAS] + a * charge + peaks[SHIFT_DN, peak] + by_sigma
    own = peaks[WIDTH, peak] * peaks[WIDTH, peak] * analog2
    spread = cells.extra_e2 + k * (cells.per_electron + k * cells.per_electron2)
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


@kernel(inline=True)
def _list_numbers(
    theta: NDArray[np.float64], cells: Cells, reach: float, cut: float, numbers: NDArray[np.float64]
) -> int:
    """Fill the electron numbers that reach the cells, with their probabilities; return how many."""
    a, analog2, exposure = theta[_STEP], math.exp(theta[_VARIANCE]), math.exp(theta[_EXPOSURE])
    widest = farthest = 0.0
    for peak in range(cells.n_peaks):
        widest = max(widest, cells.peaks[WIDTH, peak])
        shift = a * abs(cells.peaks[SHIFT_E, peak]) + abs(cells.peaks[SHIFT_DN, peak])
        farthest = max(farthest, shift + abs(cells.peaks[SHIFT_SIGMA, peak]) * math.sqrt(analog2))
    from_below, to_above = cells.bottom >= 0, cells.top <= cells.n_bins
    last = cells.first + cells.n_bins + cells.margin
    factor = added = 0.0
    for i in range(cells.mixtures.shape[1]):
        factor = max(factor, cells.mixtures[EXPOSURE_FACTOR, i])
        added = max(added, cells.mixtures[ADDED_EXPOSURE, i])
    most = exposure * factor + added
    count, previous = 0, -math.inf
    k = 0.0
    while count < numbers.shape[0]:
        level = _level(k, cells)
        spread = cells.extra_e2 + k * (cells.per_electron + k * cells.per_electron2)
        around = farthest + reach * math.sqrt(widest * widest * analog2 + a * a * spread + cells.extra_dn2)
        mean = theta[_BIAS] + a * level
        if level <= previous or (mean - around > last and not to_above):
            break
        previous = level
        if from_below or mean + around > cells.first - cells.margin:
            mass, slope, bend = electron_number(
                cells.count_law, cells.dispersion, int(k), exposure, cells.mixtures
            )
            if mass > cut:
                numbers[count, 0], numbers[count, 1] = k, mass
                numbers[count, 2], numbers[count, 3] = slope, bend
                count += 1
            elif k > most:
                break
        k += 1.0
    return count


@kernel(borrows=True)
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


@kernel(borrows=True)
def fill_masses(
    theta: NDArray[np.float64],
    cells: Cells,
    stage: int,
    numbers: NDArray[np.float64],
    room: NDArray[np.float64],
) -> int:
    """Fill mass and slopes of all cells; return how many electron numbers there are.

    Args:
        theta: the sample's own parameters.
        cells: of the sample.
        stage: how far the tails go, see `CORE`.
        numbers: out, electron numbers in use.
        room: rows of the sample in a scratch's ``cells``; out: masses and slopes.
    """
    reach, cut = _REACH[stage], _CUT[stage]
    mass, slopes, at = room[MASS], room[SLOPES:AT_EDGES], room[AT_EDGES:]
    for i in range(cells.n_bins):
        mass[i] = 0.0
        for j in range(N_BLOCK):
            slopes[j, i] = 0.0
    count: int = _list_numbers(theta, cells, reach, cut, numbers)
    for row in range(count):
        k = numbers[row, 0]
        for peak in range(cells.n_peaks):
            share_slope = cells.peaks[SHARE_SLOPE, peak]
            share = cells.peaks[SHARE, peak] + theta[_SATELLITE] * share_slope
            if share == 0.0 and share_slope == 0.0:
                continue
            part = component(k, peak, theta, cells, reach)
            if part.low >= part.high:
                continue
            middle = _fill_edges(cells.edges, part, cells.table, at)
            w = numbers[row, 1] * share
            w_exposure = numbers[row, 2] * share
            w_satellite = numbers[row, 1] * share_slope
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
                slopes[_EXPOSURE, i] += w_exposure * d0
                slopes[_STEP, i] += step1 * d1 + step2 * d2
                slopes[_BIAS, i] += by_mean * d1
                slopes[_VARIANCE, i] += log1 * d1 + log2 * d2
                slopes[_SATELLITE, i] += w_satellite * d0
    if cells.outlier_share > 0.0:
        rest = 1.0 - cells.outlier_share
        for i in range(cells.n_bins):
            mass[i] = rest * mass[i] + cells.outlier_mass
            for j in range(N_BLOCK):
                slopes[j, i] *= rest
    return count


@kernel(borrows=True)
def fill_far_enough(
    theta: NDArray[np.float64], cells: Cells, numbers: NDArray[np.float64], room: NDArray[np.float64]
) -> tuple[int, float]:
    """Fill mass and slopes of the cells, exact also where an occupied one lies far out.

    Returns:
        Number of electron numbers in use, and how many standard deviations a component reaches.
    """
    count = stage = np.int64(0)
    while stage < len(_REACH):
        count = fill_masses(theta, cells, stage, numbers, room)
        lowest = 1.0
        for i in range(cells.n_bins):
            if cells.weights[i] > 0.0:
                lowest = min(lowest, room[MASS, i])
        if lowest >= _OUTLIER[stage]:
            break
        stage += 1
    return int(count), _REACH[stage]


@kernel(inline=True)
def _sum_up(
    cells: Cells, room: NDArray[np.float64], change: NDArray[np.float64], out: NDArray[np.float64]
) -> float:
    """Return the log-likelihood of the masses in the room; fill score, squared scores and ratios.

    Given that a sample is in a code that is not set aside, its score is less by that of their whole mass.
    """
    mass, slopes, ratios = room[MASS], room[SLOPES:AT_EDGES], room[RATIO]
    for row in range(DAMPING + N_BLOCK):
        for column in range(N_BLOCK):
            out[row, column] = 0.0
    loglik, rest = 0.0, 1.0 - cells.outlier_share
    for cell in range(cells.n_bins):
        weight, own = cells.weights[cell], mass[cell]
        ratios[cell] = 0.0
        if weight > 0.0 and not own > LEAST_MASS:
            loglik += weight * math.log(LEAST_MASS)
        elif weight > 0.0:
            loglik += weight * math.log(own)
            ratio = weight / own
            ratios[cell] = ratio * rest
            for i in range(N_BLOCK):
                out[SCORE, i] += ratio * slopes[i, cell]
                for j in range(i + 1):
                    out[DAMPING + i, j] += ratio * slopes[i, cell] * (slopes[j, cell] / own)
    if cells.conditional:
        loglik += _condition(cells, room, change, out)
    for i in range(N_BLOCK):
        for j in range(i + 1):
            out[INFORMATION + i, j] += out[DAMPING + i, j]
    return loglik


@kernel(inline=True)
def _condition(
    cells: Cells, room: NDArray[np.float64], change: NDArray[np.float64], out: NDArray[np.float64]
) -> float:
    """Take off what all kept codes together give; return the change of the log-likelihood.

    With their mass M the log-likelihood is less by ``n log M``; the squared scores are about their mean,
    which is that of the law at the maximum.
    """
    mass, slopes, ratios = room[MASS], room[SLOPES:AT_EDGES], room[RATIO]
    n, rest = cells.frames, 1.0 - cells.outlier_share
    inside = 0.0
    for i in range(N_BLOCK):
        change[i] = 0.0
    for cell in range(cells.n_bins):
        inside += cells.kept[cell] * mass[cell]
        for i in range(N_BLOCK):
            change[i] += cells.kept[cell] * slopes[i, cell]
    inside = max(inside, LEAST_MASS)
    for i in range(N_BLOCK):
        change[i] /= inside
    for i in range(N_BLOCK):
        for j in range(i + 1):
            # the observed information of -n log M is n (d2 M / M - dM dM' / M^2); the first part comes by
            # the ratios
            out[INFORMATION + i, j] -= n * change[i] * change[j]
            shared = n * change[i] * change[j] - out[SCORE, i] * change[j] - change[i] * out[SCORE, j]
            out[DAMPING + i, j] += shared
            out[INFORMATION + i, j] -= shared
    for i in range(N_BLOCK):
        out[SCORE, i] -= n * change[i]
    for cell in range(cells.n_bins):
        ratios[cell] -= cells.kept[cell] * n / inside * rest
    return -n * math.log(inside)


@kernel(inline=True)
def _hermite_sums(
    cells: Cells, part: Component, room: NDArray[np.float64]
) -> tuple[float, float, float, float, float]:
    """Return the sums over cells of ratio times the difference of Phi, phi, z phi, He2 phi, He3 phi."""
    at, ratio, edges = room[AT_EDGES:], room[RATIO], cells.edges
    middle = _fill_edges(edges, part, cells.table, at)
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


@kernel(inline=True)
def _subtract_curvature(
    theta: NDArray[np.float64],
    cells: Cells,
    reach: float,
    numbers: NDArray[np.float64],
    room: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Take the second derivatives of the masses, times counts over mass, off the information."""
    information = out[INFORMATION:DAMPING]
    for row in range(numbers.shape[0]):
        k, p0, p1, p2 = numbers[row, 0], numbers[row, 1], numbers[row, 2], numbers[row, 3]
        for peak in range(cells.n_peaks):
            slope = cells.peaks[SHARE_SLOPE, peak]
            share = cells.peaks[SHARE, peak] + theta[_SATELLITE] * slope
            if share == 0.0 and slope == 0.0:
                continue
            part = component(k, peak, theta, cells, reach)
            if part.low >= part.high:
                continue
            s0, s1, s2, s3, s4 = _hermite_sums(cells, part, room)
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
            q_aa = qa / theta[_STEP]
            information[1, 1] -= w * (f_mm * ma * ma + 2.0 * f_mq * ma * qa + f_qq * qa * qa + f_q * q_aa)
            information[2, 1] -= w * (f_mm * ma + f_mq * qa)
            information[2, 2] -= w * f_mm
            information[3, 1] -= w * (f_mm * ma * mv + f_mq * (ma * qv + mv * qa) + f_qq * qa * qv)
            information[3, 2] -= w * (f_mm * mv + f_mq * qv)
            bend = f_m * 0.5 * mv + f_q * qv
            information[3, 3] -= w * (f_mm * mv * mv + 2.0 * f_mq * mv * qv + f_qq * qv * qv + bend)


@kernel(borrows=True)
def own_theta(pixel: Pixel, j: int, theta: NDArray[np.float64], own: NDArray[np.float64]) -> None:
    """Fill a sample's own parameters from those of its pixel."""
    n = pixel.facts.shape[0]
    own[_EXPOSURE] = theta[j] if pixel.facts[j, DARK] == 0.0 else _NO_ELECTRONS
    own[_STEP] = theta[n + STEP]
    own[_BIAS] = theta[n + BIAS] - pixel.facts[j, CENTRE]
    own[_VARIANCE] = theta[n + LOG_VARIANCE]
    own[_SATELLITE] = theta[n + SATELLITE]


@kernel(inline=True)
def _expect(pixel: Pixel, j: int, cells: Cells, room: NDArray[np.float64]) -> None:
    """Fill the counts expected of the codes that are not set aside."""
    inside = 1.0
    if cells.conditional:
        inside = 0.0
        for i in range(cells.n_bins):
            inside += cells.kept[i] * room[MASS, i]
    for i in range(cells.n_bins):
        pixel.bins[j, EXPECTED, i] = cells.frames * cells.kept[i] * room[MASS, i] / inside


def evaluate_cells(
    pixel: Pixel, theta: NDArray[np.float64], expect: bool, scratch: Scratch, out: NDArray[np.float64]
) -> float:
    """Evaluate log-likelihood, score, squared scores and observed information of all samples of a pixel.

    Args:
        pixel: histograms and law.
        theta: parameters, shape (J + N_SHARED,).
        expect: leave the counts expected of each DN in the pixel's ``bins``.
        scratch: room to work in; its ``cells`` keep the masses and their slopes.
        out: out, the evaluation; lower triangles of the matrices.

    Returns:
        The log-likelihood, nats.
    """
    own = scratch.small[OWN]
    loglik = 0.0
    for j in range(pixel.facts.shape[0]):
        own_theta(pixel, j, theta, own)
        cells, room = cells_of(pixel, j), scratch.cells[j]
        count, reach = fill_far_enough(own, cells, scratch.numbers, room)
        loglik += _sum_up(cells, room, scratch.small[RIGHT], out[j])
        _subtract_curvature(own, cells, reach, scratch.numbers[:count], room, out[j])
        if expect:
            _expect(pixel, j, cells, room)
        if pixel.facts[j, DARK] > 0.0:
            out[j, SCORE, 0] = 0.0
            for i in range(N_BLOCK):
                out[j, INFORMATION + i, 0] = out[j, DAMPING + i, 0] = 0.0
    return loglik
