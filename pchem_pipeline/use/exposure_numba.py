"""Loops of :mod:`pchem_pipeline.use.exposure`: the exposure of largest likelihood of known pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.law.cells_numba import Cells, Law, cells_of
from pchem_pipeline.model.law.electron_laws_numba import electron_number
from pchem_pipeline.model.law.levels_numba import Codes, Levels, list_levels, place_codes
from pchem_pipeline.model.law.mass_numba import known_theta, pixel_scratch
from pchem_pipeline.model.law.pixel_numba import OWN, Pixel

LEAST_EXPOSURE = 1e-6  # e-; less is none
_LEAST_WEIGHT = 1e-6  # of a rival: less moves no standard error
_MOST_STEPS = 200
_PRECISION = 1e-9
_DEPTH = 12.0  # nats down to which a likelihood is summed
_OUTSIDE = 0.05  # part of a standard error by which a parameter is moved to find its slope


@kernel
def _evaluate(
    exposure: float, cells: Cells, levels: Levels, counts: FloatArray, sums: FloatArray
) -> tuple[float, float, float]:
    """Return log-likelihood, its slope in log H, and the information, of histograms at an exposure.

    Args:
        exposure: H, e-.
        cells: of the pixel.
        levels: of the pixel.
        counts: samples at each code.
        sums: room, shape (3, codes).
    """
    for i in range(counts.size):
        sums[0, i] = sums[1, i] = sums[2, i] = 0.0
    for row in range(levels.number.size):
        mass, slope, bend = electron_number(
            cells.count_law, cells.dispersion, levels.number[row], exposure, cells.mixtures
        )
        low, start = levels.low[row], levels.start[row]
        for i in range(low, levels.high[row]):
            share = levels.share[start + i - low]
            sums[0, i] += mass * share
            sums[1, i] += slope * share
            sums[2, i] += bend * share
    loglik = score = information = 0.0
    rest = 1.0 - cells.outlier_share
    for i in range(counts.size):
        if counts[i] > 0.0:
            mass = rest * sums[0, i] + cells.outlier_mass
            if mass > SMALLEST_MASS:
                ratio = rest * sums[1, i] / mass
                loglik += counts[i] * math.log(mass)
                score += counts[i] * ratio
                information += counts[i] * (ratio * ratio - rest * sums[2, i] / mass)
            else:
                loglik += counts[i] * math.log(SMALLEST_MASS)
    return loglik, score, information


@kernel
def _climb(start: float, cells: Cells, levels: Levels, counts: FloatArray, sums: FloatArray) -> float:
    """Return the exposure of largest likelihood; 0 where none is better than any."""
    total = 0.0
    for i in range(counts.size):
        total += counts[i]
    here = max(start, 1e-3)
    best, height = here, -math.inf
    for _ in range(_MOST_STEPS):
        loglik, score, information = _evaluate(here, cells, levels, counts, sums)
        if loglik < height - 1e-9 * abs(height):
            here = math.sqrt(here * best)
            if abs(here - best) < _PRECISION * best:
                break
            continue
        best, height = here, loglik
        if information > 0.0:
            step = min(max(score / information, -1.0), 1.0)
            ahead = here * math.exp(step)
        else:
            ahead = max(here + score / total, 0.1 * here)  # the EM step of a Poisson law
        if ahead < LEAST_EXPOSURE:
            return 0.0
        if abs(ahead - here) < _PRECISION * here:
            return ahead
        here = ahead
    return best


@kernel
def _at_border(
    height: float, total: float, cells: Cells, levels: Levels, counts: FloatArray, sums: FloatArray
) -> float:
    """Return one over the mean square of H over its likelihood, of which the maximum is at 0.

    The curvature there says nothing: the likelihood falls as an exponential does, or as half a normal law.

    Args:
        height: log-likelihood at 0.
        total: number of samples.
        cells: of the pixel.
        levels: of the pixel.
        counts: samples at each code.
        sums: room, shape (3, codes).
    """
    reach = _DEPTH / total  # it falls by one a sample and electron at most
    while reach < 1e4 and height - _evaluate(reach, cells, levels, counts, sums)[0] < _DEPTH:
        reach *= 2.0
    mass, square, nodes = 0.0, 0.0, 64
    for i in range(nodes):
        exposure = reach * (i + 0.5) / nodes
        weight = math.exp(min(_evaluate(exposure, cells, levels, counts, sums)[0] - height, 0.0))
        mass += weight
        square += weight * exposure * exposure
    return mass / square


@kernel
def _levels_of(
    parameters: FloatArray, pixel: Pixel, weight: float, codes: Codes, theta: FloatArray
) -> tuple[Cells, Levels]:
    """Return cells and levels of a pixel under other parameters, the weight of its satellites held."""
    known_theta(parameters, pixel.centre, weight, theta)
    cells = cells_of(pixel, 0)
    return cells, list_levels(theta, cells, codes)


@kernel
def estimate_exposures(
    counts: NDArray[Any],
    first: IntArray,
    parts: int,
    parameters: FloatArray,
    covariance: FloatArray,
    rivals: FloatArray,
    satellites: FloatArray,
    law: Law,
    out: FloatArray,
) -> None:
    """Fill the exposure of largest likelihood with g, mu and sigma held, and its two standard errors.

    Args:
        counts: histograms, shape (n, codes).
        first: code of bin 0, in parts of a DN, shape (n,).
        parts: codes in a DN.
        parameters: (H, g, mu, sigma), shape (n, 4); NaN where there are none.
        covariance: of (g, mu, sigma), shape (n, 3, 3).
        rivals: probability of other (g, mu, sigma) far away, and these, shape (n, 2, 4).
        satellites: amplitude (e-) and weight of free satellites, shape (n, 2).
        law: of the samples.
        out: out, H, its standard error by counting, and that from the calibration, shape (n, 3); comes as
            NaN.
    """
    n_codes = counts.shape[1]
    room, scratch = pixel_scratch(n_codes + 2, law)
    theta, sums, weights = scratch.small[OWN], np.empty((3, n_codes)), np.empty(n_codes)
    moved, slopes = np.empty(4), np.empty(3)
    for index in range(counts.shape[0]):
        low, high, total, moment = n_codes, 0, 0.0, 0.0
        for i in range(n_codes):
            weights[i] = 0.0
            if counts[index, i] > 0:
                low, high = min(low, i), i + 1
                total += counts[index, i]
        if total == 0.0:
            continue
        n = high - low
        for i in range(n):
            weights[i] = float(counts[index, low + i])
            moment += weights[i] * i
        pixel, codes = place_codes(index, first[index] + low, n, parts, law, satellites, room)
        if not known_theta(parameters[index], pixel.centre, satellites[index, 1], theta):
            continue
        cells = cells_of(pixel, 0)
        levels = list_levels(theta, cells, codes)
        seen = weights[:n]
        start = (codes.first + moment / total / parts - theta[2]) / theta[1]
        exposure = _climb(start, cells, levels, seen, sums)
        near = max(exposure, LEAST_EXPOSURE)
        height, score, information = _evaluate(near, cells, levels, seen, sums)
        curvature = (information + score) / (near * near)
        if exposure == 0.0:
            curvature = _at_border(height, total, cells, levels, seen, sums)
        out[index, 0] = exposure
        if not curvature > 0.0:
            continue
        out[index, 1] = 1.0 / math.sqrt(curvature)
        weight = satellites[index, 1]
        # errors of g, mu and sigma, by the implicit function theorem
        for j in range(3):
            step = _OUTSIDE * math.sqrt(covariance[index, j, j])
            slopes[j] = 0.0 * step  # NaN where the error is not known
            if step > 0.0:
                moved[:] = parameters[index]
                moved[1 + j] += step
                cells, levels = _levels_of(moved, pixel, weight, codes, theta)
                _, ahead, _ = _evaluate(near, cells, levels, seen, sums)
                slopes[j] = (ahead - score) / (near * step * curvature)
        variance = 0.0
        for i in range(3):
            for j in range(3):
                variance += slopes[i] * covariance[index, i, j] * slopes[j]
        variance = variance if math.isnan(variance) else max(variance, 0.0)
        for rival in rivals[index]:
            if rival[0] > _LEAST_WEIGHT:
                moved[1:] = rival[1:]
                cells, levels = _levels_of(moved, pixel, weight, codes, theta)
                there = _climb(near, cells, levels, seen, sums)
                variance += rival[0] * (there - exposure) ** 2
        out[index, 2] = math.sqrt(variance)
