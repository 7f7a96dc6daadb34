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

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE, SMALLEST_MASS
from pchem_pipeline.model.arithmetic.normal_numba import FARTHEST
from pchem_pipeline.model.arithmetic.simd_math_numba import simd_log, simd_tail
from pchem_pipeline.model.arithmetic.simd_numba import (
    SIMD_WIDTH,
    counting,
    fused,
    least,
    most,
    simd_load,
    simd_store,
    simd_sum,
)
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.electron_laws_numba import electron_number
from pchem_pipeline.model.law.pixel_numba import Pixel, Sample, Scratch, sample_of

# places in a sample's own parameters
_EXPOSURE, _STEP, _BIAS, _VARIANCE, _SATELLITE = range(px.N_BLOCK)
# how far out components are added, in three stages: standard deviations, probability below which an electron
# number is left out, and the mass of an occupied cell below which the next stage is called for
_REACH = (8.5, 15.0, FARTHEST)
_CUT = (1e-17, 1e-50, 1e-305)
_OUTLIER = (1e-9, 1e-40, 0.0)
#: Stages of :func:`fill_masses`: as far out as most samples lie, down to 1e-50, to the ends of the tails.
CORE, NEAR, EXACT = range(3)
_TO_ONE = 1e306  # makes 1 of a mass that counts
_NO_ELECTRONS = -60.0  # log H of a sample without electrons


class Law(NamedTuple):
    """The laws of J samples as the loops take them, see :mod:`pchem_pipeline.model.law.sample_law`.

    Attributes:
        numbers: see :data:`.pixel_numba.LAW`, shape (J, 1 or n, 1).
        peaks: weight, shifts (e-, DN, sigma) and width of the noise's levels, shape (J, 1 or n, 5, enough).
        n_peaks: levels in use, shape (J,).
        exposures: weights and factors of the exposures, shape (J, 1 or n, 2, enough).
        added: weights and values (e-) of added exposures, shape (J, 1 or n, 2, enough).
        edge_shift: shifts of the code edges from ``edge_first`` on, DN, shape (J, 1 or n, enough).
        pattern: shift, in units of the amplitude, and weight of free satellites, shape (enough, 2).
    """

    numbers: NDArray[np.void]
    peaks: FloatArray
    n_peaks: IntArray
    exposures: FloatArray
    added: FloatArray
    edge_shift: FloatArray
    pattern: FloatArray


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


@kernel(inline=True, borrows=True)
def _row(values: NDArray[np.generic], index: int) -> int:
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
                    peaks[px.SHIFT_E + i, count] = law.peaks[j, row, 1 + i, level]
                peaks[px.WIDTH, count] = law.peaks[j, row, 4, level]
                if side < 0:
                    peaks[px.SHARE, count] = weight
                    peaks[px.SHARE_SLOPE, count] = -weight if n_sides else 0.0
                else:
                    peaks[px.SHIFT_E, count] += amplitude * law.pattern[side, 0]
                    peaks[px.SHARE, count] = 0.0
                    peaks[px.SHARE_SLOPE, count] = weight * law.pattern[side, 1]
                count += 1
        pixel.facts[j].n_peaks = count


@kernel(borrows=True)
def resolve(law: Law, index: int, amplitude: float, pixel: Pixel) -> None:
    """Fill what the law says of a pixel: facts, mixtures, edges of the cells, levels of the noise.

    The amplitude is that of free satellites, e-; 0: none.
    """
    for j in range(pixel.facts.shape[0]):
        pixel.laws[j] = law.numbers[j, _row(law.numbers, index), 0]
        facts, own, edges = pixel.facts[j], pixel.laws[j], pixel.bins[j, px.EDGE]
        row = _row(law.exposures, index)
        for i in range(law.exposures.shape[3]):
            pixel.mixtures[j, px.EXPOSURE_WEIGHT, i] = law.exposures[j, row, 0, i]
            pixel.mixtures[j, px.EXPOSURE_FACTOR, i] = law.exposures[j, row, 1, i]
        for i in range(law.added.shape[3]):
            pixel.mixtures[j, px.ADDED_WEIGHT, i] = law.added[j, _row(law.added, index), 0, i]
            pixel.mixtures[j, px.ADDED_EXPOSURE, i] = law.added[j, _row(law.added, index), 1, i]
        n_bins, first = facts.n_bins, facts.first
        code = pixel.centre + int(facts.centre + first)
        margin = 0.0
        bottom, top = -1, n_bins + 1
        n_shifts, edge_first = law.edge_shift.shape[2], own.edge_first
        row = _row(law.edge_shift, index)
        for i in range(n_bins + 1):
            place = code + i - edge_first
            shift = law.edge_shift[j, row, place] if 0 <= place < n_shifts else 0.0
            margin = max(margin, abs(shift))
            edges[i] = first + i - 0.5 + shift
            if code + i <= own.clip_low:
                edges[i], bottom = -math.inf, i
            elif code + i > own.clip_high:
                edges[i], top = math.inf, min(top, i)
        for i in range(n_bins + 1, n_bins + 1 + SIMD_WIDTH):
            edges[i] = math.inf
        facts.bottom, facts.top, facts.margin = bottom, top, margin
    set_peaks(law, index, amplitude, pixel)


@kernel(inline=True, borrows=True)
def _level(k: float, cells: Sample) -> float:
    """Return the level of k electrons, e-."""
    law = cells.law
    return float(law.level_scale * k * (1.0 + 0.5 * law.curvature * (k - 1.0)) + law.level_shift)


@kernel(borrows=True)
def component(k: float, peak: int, theta: FloatArray, cells: Sample, reach: float) -> Component:
    """Return one electron number at one level; ``low >= high`` where it gives nothing to the cells."""
    a, analog2 = theta[_STEP], math.exp(theta[_VARIANCE])
    peaks, facts, law = cells.peaks, cells.facts, cells.law
    charge = _level(k, cells) + peaks[px.SHIFT_E, peak]
    by_sigma = peaks[px.SHIFT_SIGMA, peak] * math.sqrt(analog2)
    mean = theta[_BIAS] + a * charge + peaks[px.SHIFT_DN, peak] + by_sigma
    own = peaks[px.WIDTH, peak] * peaks[px.WIDTH, peak] * analog2
    spread = law.extra_e2 + k * (law.per_electron + k * law.per_electron2)
    variance = max(own + a * a * spread + law.extra_dn2, LEAST_VARIANCE)
    sd = math.sqrt(variance)
    place = mean - (facts.first - 0.5)
    n = float(facts.n_bins)
    low = int(min(max(place - reach * sd - facts.margin, 0.0), n))
    high = int(min(max(place + reach * sd + facts.margin + 1.0, 0.0), n))
    # what lies beyond the limits belongs to the first or last code that comes out
    high = min(max(high, facts.bottom + 1), facts.n_bins)
    low = max(min(low, facts.top - 1), 0)
    slope = peaks[px.SHARE_SLOPE, peak]
    if peaks[px.SHARE, peak] + theta[_SATELLITE] * slope == slope == 0.0:
        high = low
    return Component(mean, variance, sd, charge, 0.5 * by_sigma, 2.0 * a * spread, own, low, high)


@kernel(inline=True, borrows=True)
def _list_numbers(theta: FloatArray, cells: Sample, reach: float, cut: float, numbers: FloatArray) -> int:
    """Fill the electron numbers that reach the cells, with their probabilities; return how many."""
    a, analog2, exposure = theta[_STEP], math.exp(theta[_VARIANCE]), math.exp(theta[_EXPOSURE])
    facts, law = cells.facts, cells.law
    widest = farthest = 0.0
    for peak in range(cells.facts.n_peaks):
        widest = max(widest, cells.peaks[px.WIDTH, peak])
        shift = a * abs(cells.peaks[px.SHIFT_E, peak]) + abs(cells.peaks[px.SHIFT_DN, peak])
        farthest = max(farthest, shift + abs(cells.peaks[px.SHIFT_SIGMA, peak]) * math.sqrt(analog2))
    from_below, to_above = facts.bottom >= 0, facts.top <= facts.n_bins
    last = facts.first - 0.5 + facts.n_bins + facts.margin
    factor = added = 0.0
    for i in range(cells.mixtures.shape[1]):
        factor = max(factor, cells.mixtures[px.EXPOSURE_FACTOR, i])
        added = max(added, cells.mixtures[px.ADDED_EXPOSURE, i])
    most = exposure * factor + added
    count, previous = 0, -math.inf
    k = 0.0
    while count < numbers.shape[0]:
        level = _level(k, cells)
        spread = law.extra_e2 + k * (law.per_electron + k * law.per_electron2)
        around = farthest + reach * math.sqrt(widest * widest * analog2 + a * a * spread + law.extra_dn2)
        mean = theta[_BIAS] + a * level
        if level <= previous or (mean - around > last and not to_above):
            break
        previous = level
        if from_below or mean + around > facts.first - 0.5 - facts.margin:
            mass, slope, bend = electron_number(
                law.count_law, law.dispersion, int(k), exposure, cells.mixtures
            )
            if mass > cut:
                numbers[count, 0], numbers[count, 1] = k, mass
                numbers[count, 2], numbers[count, 3] = slope, bend
                count += 1
            elif k > most:
                break
        k += 1.0
    return count


@kernel(inline=True, borrows=True)
def _place_for(part: Component, place: int) -> tuple[int, int]:
    """Return where the edges of a component are kept, and where those of the next one; where only for now."""
    width = part.high - part.low + 1 + SIMD_WIDTH
    if place + width <= px.EDGES_KEPT:
        return place, place + width
    return px.EDGES_KEPT, px.EDGES_KEPT


@kernel(borrows=True)
def _fill_edges(bins: FloatArray, part: Component, edges: FloatArray, place: int) -> None:
    """Fill tail, density and z times density at the edges within reach from column ``place`` on."""
    mean, inverse = part.mean, 1.0 / part.sd
    behind = place
    for i in range(part.low, part.high + 1, SIMD_WIDTH):
        tail, density, by_z = simd_tail((simd_load(bins, px.EDGE, i) - mean) * inverse)
        simd_store(edges, px.TAIL, behind, tail)
        simd_store(edges, px.DENSITY, behind, density)
        simd_store(edges, px.Z_DENSITY, behind, by_z)
        behind += SIMD_WIDTH
    for row in range(3):  # the last cell of the last lanes has no other edge
        edges[row, behind] = edges[row, behind - 1]


@kernel(inline=True, borrows=True)
def cell_of(mean: float, cells: Sample, low: int, high: int) -> int:
    """Return the cell that holds a mean, if it is one of these, the end excluded, or one outside."""
    middle = int(min(max(mean - (cells.facts.first - 0.5), low - 1.0), float(high)))
    while middle < high and cells.bins[px.EDGE, middle + 1] <= mean:
        middle += 1
    while middle >= low and cells.bins[px.EDGE, middle] > mean:
        middle -= 1
    return middle


@kernel(inline=True, borrows=True)
def _add_component(
    row: FloatArray,
    peak: int,
    satellite: float,
    cells: Sample,
    part: Component,
    edges: FloatArray,
    place: int,
    what: int,
    room: FloatArray,
) -> None:
    """Add what an electron number gives at one level to mass and slopes of the cells within reach."""
    share_slope = cells.peaks[px.SHARE_SLOPE, peak]
    share = cells.peaks[px.SHARE, peak] + satellite * share_slope
    w, w_exposure, w_satellite = row[1] * share, row[2] * share, row[1] * share_slope
    by_mean, by_variance = -w / part.sd, -0.5 * w / part.variance
    step1, step2 = by_mean * part.mean_step, by_variance * part.variance_step
    log1, log2 = by_mean * part.mean_log, by_variance * part.variance_log
    for i in range(part.low, part.high, SIMD_WIDTH):
        c = place + i - part.low
        d0 = simd_load(edges, px.TAIL, c + 1) - simd_load(edges, px.TAIL, c)
        simd_store(room, px.MASS, i, fused(d0, w, simd_load(room, px.MASS, i)))
        if what == px.LOGLIK_ALONE:
            continue
        d1 = simd_load(edges, px.DENSITY, c + 1) - simd_load(edges, px.DENSITY, c)
        d2 = simd_load(edges, px.Z_DENSITY, c + 1) - simd_load(edges, px.Z_DENSITY, c)
        slope = fused(d0, w_exposure, simd_load(room, px.SLOPES + _EXPOSURE, i))
        simd_store(room, px.SLOPES + _EXPOSURE, i, slope)
        slope = fused(d1, step1, fused(d2, step2, simd_load(room, px.SLOPES + _STEP, i)))
        simd_store(room, px.SLOPES + _STEP, i, slope)
        slope = fused(d1, by_mean, simd_load(room, px.SLOPES + _BIAS, i))
        simd_store(room, px.SLOPES + _BIAS, i, slope)
        slope = fused(d1, log1, fused(d2, log2, simd_load(room, px.SLOPES + _VARIANCE, i)))
        simd_store(room, px.SLOPES + _VARIANCE, i, slope)
        if w_satellite != 0.0:
            slope = fused(d0, w_satellite, simd_load(room, px.SLOPES + _SATELLITE, i))
            simd_store(room, px.SLOPES + _SATELLITE, i, slope)
    middle = cell_of(part.mean, cells, part.low, part.high)
    if part.low <= middle < part.high:  # both tails are those beyond its edges
        room[px.MASS, middle] += w
        room[px.SLOPES + _EXPOSURE, middle] += w_exposure
        room[px.SLOPES + _SATELLITE, middle] += w_satellite


@kernel(borrows=True)
def fill_masses(
    theta: FloatArray,
    cells: Sample,
    stage: int,
    what: int,
    numbers: FloatArray,
    edges: FloatArray,
    room: FloatArray,
) -> int:
    """Fill mass and slopes of all cells; return how many electron numbers there are.

    The stage says how far the tails go, see `CORE`; with `LOGLIK_ALONE` there are masses alone. They go to
    the ``room``, rows of a scratch's ``cells``; electron numbers in use and edges are left, too.
    """
    reach, cut = _REACH[stage], _CUT[stage]
    for row in range(1 if what == px.LOGLIK_ALONE else px.N_BLOCK + 1):
        for i in range(0, cells.facts.n_bins, SIMD_WIDTH):
            simd_store(room, px.MASS if row == 0 else px.SLOPES + row - 1, i, 0.0)
    count: int = _list_numbers(theta, cells, reach, cut, numbers)
    following = 0
    for row in range(count):
        for peak in range(cells.facts.n_peaks):
            part = component(numbers[row, 0], peak, theta, cells, reach)
            if part.low >= part.high:
                continue
            place, following = _place_for(part, following)
            _fill_edges(cells.bins, part, edges, place)
            _add_component(numbers[row], peak, theta[_SATELLITE], cells, part, edges, place, what, room)
    if cells.law.outlier_share > 0.0:
        rest = 1.0 - cells.law.outlier_share
        for i in range(cells.facts.n_bins):
            room[px.MASS, i] = rest * room[px.MASS, i] + cells.law.outlier_mass
            for j in range(px.N_BLOCK):
                room[px.SLOPES + j, i] *= rest
    return count


@kernel(borrows=True)
def fill_far_enough(
    theta: FloatArray, cells: Sample, what: int, numbers: FloatArray, edges: FloatArray, room: FloatArray
) -> tuple[int, float]:
    """Fill mass and slopes of the cells, exact also where an occupied one lies far out.

    Return how many electron numbers are in use, and how many standard deviations a component reaches.
    """
    count = 0
    for stage in range(len(_REACH)):  # the last one is taken whatever the masses are, NaN too
        count = fill_masses(theta, cells, stage, what, numbers, edges, room)
        lowest = 1.0
        for i in range(cells.facts.n_bins):
            if cells.bins[px.WEIGHT, i] > 0.0:
                lowest = min(lowest, room[px.MASS, i])
        if lowest >= _OUTLIER[stage]:
            break
    return count, _REACH[stage]


@kernel(inline=True, borrows=True)
def _log_mass(cells: Sample, room: FloatArray) -> float:
    """Return the log-likelihood of the masses in the room."""
    total, inside = counting() * 0.0, 1.0
    for i in range(0, cells.facts.n_bins, SIMD_WIDTH):
        weight, own = simd_load(cells.bins, px.WEIGHT, i), most(simd_load(room, px.MASS, i), SMALLEST_MASS)
        total = fused(weight, simd_log(own), total)
    if cells.facts.conditional:
        inside = 0.0
        for i in range(cells.facts.n_bins):
            inside += cells.bins[px.KEPT, i] * room[px.MASS, i]
    return float(simd_sum(total) - cells.facts.n_frames * math.log(max(inside, SMALLEST_MASS)))


@kernel(inline=True, borrows=True)
def _sum_up(cells: Sample, room: FloatArray, change: FloatArray, out: FloatArray) -> float:
    """Return the log-likelihood of the masses in the room; add score and squared scores, fill ratios."""
    total = counting() * 0.0
    for i in range(0, cells.facts.n_bins, SIMD_WIDTH):
        weight, own = simd_load(cells.bins, px.WEIGHT, i), most(simd_load(room, px.MASS, i), SMALLEST_MASS)
        total = fused(weight, simd_log(own), total)
        # a mass that is hardly one has no slope
        per_mass = least((own - SMALLEST_MASS) * _TO_ONE, 1.0) / own
        simd_store(room, px.PER_MASS, i, per_mass)
        simd_store(room, px.RATIO, i, weight * per_mass)
    simd_store(room, px.RATIO, cells.facts.n_bins, 0.0)
    loglik = float(simd_sum(total))
    for row in range(px.N_BLOCK):
        score = counting() * 0.0
        for i in range(0, cells.facts.n_bins, SIMD_WIDTH):
            score = fused(simd_load(room, px.RATIO, i), simd_load(room, px.SLOPES + row, i), score)
        out[px.SCORE, row] += simd_sum(score)
        for column in range(row + 1):
            square = counting() * 0.0
            for i in range(0, cells.facts.n_bins, SIMD_WIDTH):
                here = simd_load(room, px.RATIO, i) * simd_load(room, px.SLOPES + row, i)
                other = simd_load(room, px.PER_MASS, i) * simd_load(room, px.SLOPES + column, i)
                square = fused(here, other, square)
            both = simd_sum(square)
            out[px.DAMPING + row, column] += both
            out[px.INFORMATION + row, column] += both
    if cells.law.outlier_share > 0.0:
        for i in range(cells.facts.n_bins):
            room[px.RATIO, i] *= 1.0 - cells.law.outlier_share
    if cells.facts.conditional:
        loglik += _condition(cells, room, change, out)
    return loglik


@kernel(inline=True, borrows=True)
def _condition(cells: Sample, room: FloatArray, change: FloatArray, out: FloatArray) -> float:
    """Take off what all kept codes together give; return the change of the log-likelihood.

    With their mass M the log-likelihood is less by ``n log M``; the squared scores are about their mean.
    """
    mass, slopes, ratios = room[px.MASS], room[px.SLOPES :], room[px.RATIO]
    n, rest = cells.facts.n_frames, 1.0 - cells.law.outlier_share
    inside = 0.0
    for i in range(px.N_BLOCK):
        change[i] = 0.0
    for cell in range(cells.facts.n_bins):
        inside += cells.bins[px.KEPT, cell] * mass[cell]
        for i in range(px.N_BLOCK):
            change[i] += cells.bins[px.KEPT, cell] * slopes[i, cell]
    inside = max(inside, SMALLEST_MASS)
    for i in range(px.N_BLOCK):
        change[i] /= inside
    for i in range(px.N_BLOCK):
        for j in range(i + 1):
            # the observed information of -n log M is n (d2 M / M - dM dM' / M^2); the first part comes by
            # the ratios
            out[px.INFORMATION + i, j] -= n * change[i] * change[j]
            shared = n * change[i] * change[j] - out[px.SCORE, i] * change[j] - change[i] * out[px.SCORE, j]
            out[px.DAMPING + i, j] += shared
    for i in range(px.N_BLOCK):
        out[px.SCORE, i] -= n * change[i]
    for cell in range(cells.facts.n_bins):
        ratios[cell] -= cells.bins[px.KEPT, cell] * n / inside * rest
    return float(-n * math.log(inside))


@kernel(inline=True, borrows=True)
def _hermite_sums(
    cells: Sample, part: Component, room: FloatArray, edges: FloatArray, place: int
) -> tuple[float, float, float, float, float]:
    """Return the sums over cells of ratio times the difference of Phi, phi, z phi, He2 phi, He3 phi."""
    mean, inverse = part.mean, 1.0 / part.sd
    s0 = s1 = s2 = s3 = s4 = counting() * 0.0
    for i in range(part.low, part.high, SIMD_WIDTH):
        c, ratio = place + i - part.low, simd_load(room, px.RATIO, i)
        s0 = fused(ratio, simd_load(edges, px.TAIL, c + 1) - simd_load(edges, px.TAIL, c), s0)
        density0, density1 = simd_load(edges, px.DENSITY, c), simd_load(edges, px.DENSITY, c + 1)
        by_z0, by_z1 = simd_load(edges, px.Z_DENSITY, c), simd_load(edges, px.Z_DENSITY, c + 1)
        s1 = fused(ratio, density1 - density0, s1)
        s2 = fused(ratio, by_z1 - by_z0, s2)
        # where an edge is infinite, both are 0
        z0 = most(least((simd_load(cells.bins, px.EDGE, i) - mean) * inverse, FARTHEST), -FARTHEST)
        z1 = most(least((simd_load(cells.bins, px.EDGE, i + 1) - mean) * inverse, FARTHEST), -FARTHEST)
        s3 = fused(ratio, z1 * by_z1 - density1 - (z0 * by_z0 - density0), s3)
        s4 = fused(ratio, (z1 * z1 - 3.0) * by_z1 - (z0 * z0 - 3.0) * by_z0, s4)
    whole = float(simd_sum(s0))
    middle = cell_of(part.mean, cells, part.low, part.high)
    if part.low <= middle < part.high:
        whole += room[px.RATIO, middle]
    return whole, float(simd_sum(s1)), float(simd_sum(s2)), float(simd_sum(s3)), float(simd_sum(s4))


@kernel(inline=True, borrows=True)
def _subtract_curvature(
    theta: FloatArray,
    cells: Sample,
    reach: float,
    numbers: FloatArray,
    edges: FloatArray,
    room: FloatArray,
    out: FloatArray,
) -> None:
    """Take the second derivatives of the masses, times counts over mass, off the information."""
    information = out[px.INFORMATION : px.DAMPING]
    following = 0
    for row in range(numbers.shape[0]):
        k, p0, p1, p2 = numbers[row, 0], numbers[row, 1], numbers[row, 2], numbers[row, 3]
        for peak in range(cells.facts.n_peaks):
            slope = cells.peaks[px.SHARE_SLOPE, peak]
            share = cells.peaks[px.SHARE, peak] + theta[_SATELLITE] * slope
            part = component(k, peak, theta, cells, reach)
            if part.low >= part.high:
                continue
            place, following = _place_for(part, following)
            if place == px.EDGES_KEPT:
                _fill_edges(cells.bins, part, edges, place)
            s0, s1, s2, s3, s4 = _hermite_sums(cells, part, room, edges, place)
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


@kernel(inline=True, borrows=True)
def _expect(cells: Sample, room: FloatArray) -> None:
    """Fill the counts expected of the codes that are not set aside."""
    inside = 1.0
    if cells.facts.conditional:
        inside = 0.0
        for i in range(cells.facts.n_bins):
            inside += cells.bins[px.KEPT, i] * room[px.MASS, i]
    for i in range(cells.facts.n_bins):
        cells.bins[px.EXPECTED, i] = cells.facts.n_frames * cells.bins[px.KEPT, i] * room[px.MASS, i] / inside


def evaluate_cells(pixel: Pixel, theta: FloatArray, what: int, scratch: Scratch, out: FloatArray) -> float:
    """Evaluate log-likelihood, score, squared scores and observed information of all samples of a pixel.

    See :func:`.density_numba.evaluate_density`; of fewer exposures in theta than samples, the last is that of
    all others. The ``cells`` of the scratch keep the masses and their slopes.
    """
    own, n, loglik = scratch.small[px.OWN], theta.size - px.N_BLOCK + 1, 0.0
    own[_STEP], own[_VARIANCE] = theta[n + px.STEP], theta[n + px.LOG_VARIANCE]
    own[_SATELLITE] = theta[n + px.SATELLITE]
    for place in range(n if what != px.LOGLIK_ALONE else 0):
        for row in range(px.DAMPING + px.N_BLOCK):
            for column in range(px.N_BLOCK):
                out[place, row, column] = 0.0
    for j in range(pixel.facts.shape[0]):
        place = min(j, n - 1)
        own[_EXPOSURE] = theta[place] if not pixel.facts[j].dark else _NO_ELECTRONS
        own[_BIAS] = theta[n + px.BIAS] - pixel.facts[j].centre
        cells, room = sample_of(pixel, j), scratch.cells[place]
        count, reach = fill_far_enough(own, cells, what, scratch.numbers, scratch.edges, room)
        if what == px.LOGLIK_ALONE:
            loglik += _log_mass(cells, room)
            continue
        loglik += _sum_up(cells, room, scratch.small[px.RIGHT], out[place])
        _subtract_curvature(own, cells, reach, scratch.numbers[:count], scratch.edges, room, out[place])
        if what == px.EXPECTATIONS:
            _expect(cells, room)
        if pixel.facts[j].dark:
            out[place, px.SCORE, 0] = 0.0
            for i in range(px.N_BLOCK):
                out[place, px.INFORMATION + i, 0] = out[place, px.DAMPING + i, 0] = 0.0
    return loglik
