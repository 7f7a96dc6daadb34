"""Loops of :mod:`pchem_pipeline.model.electrons.thresholds`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE, NEGLIGIBLE
from pchem_pipeline.model.arithmetic.normal_numba import NARROW, normal_mass, reach_of
from pchem_pipeline.model.arithmetic.simd_math_numba import simd_tail
from pchem_pipeline.model.arithmetic.simd_numba import SIMD_WIDTH, simd_load, simd_store
from pchem_pipeline.model.ensemble.ensemble_numba import (
    capacity,
    log_factorials,
    occupied,
    poisson_weights,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NEGLIGIBLE = 1e-13  # of what is expected of an electron number
_SURE = 0.02  # of a code: thresholds of densities and of masses are nearer to each other
_INFINITE, _LEAST_LOG = 1e300, -1e3
_EDGE, _TAIL = 0, 1


@kernel
def sum_by_thresholds(
    counts: NDArray[Any],
    origin: IntArray,
    parameters: FloatArray,
    largest: int,
    observed: IntArray,
    expected: FloatArray,
    errors: FloatArray,
) -> np.int64:
    """Add the electron numbers of histograms, and what is expected of them; return how many lie beyond.

    Args:
        counts: samples per bin, shape (n, n_bins).
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4); all known.
        largest: electron numbers above are cut to this.
        observed: in and out, samples of each number.
        expected: in and out, sum over pixels of the probability that the estimated number is k.
        errors: out, probability that it is wrong, shape (n,).
    """
    weights, logs, rows = _scratch(parameters)
    log_factorial, beyond = log_factorials(weights.size), np.int64(0)
    for p in range(origin.size):
        exposure, step, bias = parameters[p, 0], 1.0 / parameters[p, 1], parameters[p, 2]
        log_exposure = math.log(exposure) if exposure > 0.0 else -_INFINITE
        low, high, variance = _place_edges(parameters[p], logs, weights, rows)
        n, sd, right = high + 1 - low, math.sqrt(variance), 0.0
        for j in range(n):
            if weights[low + j] < _NEGLIGIBLE:  # all to its own number
                right += weights[low + j]
                if low + j < expected.size:
                    expected[low + j] += weights[low + j]
                continue
            log_weight = (low + j) * max(log_exposure, _LEAST_LOG) - exposure - log_factorial[low + j]
            reach = reach_of(log_weight) * sd
            level = bias + (low + j) * step, reach, weights[low + j]
            right += _spread(rows, j, n, sd, level, low, expected)
        errors[p] = 1.0 - right
        # farther from all levels than any sample of the law: the nearest
        ends = bias + low * step, bias + high * step
        likely = max(weights[low], NEGLIGIBLE), max(weights[high], NEGLIGIBLE)
        farthest = (
            max(reach_of(math.log(likely[0])) * sd, step),
            max(reach_of(math.log(likely[1])) * sd, step),
        )
        bottom, top = ends[0] - farthest[0] - 0.5, ends[1] + farthest[1] + 0.5
        begin, end = occupied(counts, p)
        if exposure > 0.0:
            while begin < end and origin[p] + begin < bottom:
                beyond += _add_nearest(counts[p, begin], origin[p] + begin, bias, step, largest, observed)
                begin += 1
            while begin < end and origin[p] + end - 1 > top:
                end -= 1
                beyond += _add_nearest(counts[p, end], origin[p] + end, bias, step, largest, observed)
        for j in range(n):
            stop = int(min(max(np.floor(rows[_EDGE, j + 1]) - origin[p] + 1.0, float(begin)), float(end)))
            samples = np.int64(0)
            for b in range(begin, stop):
                samples += np.int64(counts[p, b])
            beyond += _add(samples, low + j, largest, observed)
            begin = stop
    return beyond


@kernel
def fill_errors(deciding: FloatArray, data: FloatArray, errors: FloatArray) -> None:
    """Fill how often the numbers that some parameters decide are wrong in samples of others.

    Args:
        deciding: (H, g, mu, sigma), shape (n, 4); all known.
        data: what the samples follow, likewise.
        errors: out, probability that a number is wrong, shape (n,).
    """
    weights, logs, rows = _scratch(deciding)
    shares = np.zeros(capacity(data[:, 0]))
    for p in range(errors.size):
        first, last, _ = _place_edges(deciding[p], logs, weights, rows)
        low, high = poisson_weights(data[p, 0], shares)
        per_sd, right = 1.0 / math.sqrt(_analog_variance(data[p, 3])), 0.0
        for k in range(max(low, first), min(high, last) + 1):
            mean, j = data[p, 2] + k / data[p, 1], k - first
            below, above = (rows[_EDGE, j] - mean) * per_sd, (rows[_EDGE, j + 1] - mean) * per_sd
            right += shares[k] * normal_mass(below, above)
        errors[p] = 1.0 - right


@kernel
def _scratch(parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return memory for weights of the electron numbers, the logarithms of 1, 2, ..., memory for edges."""
    room = capacity(parameters[:, 0])
    return np.zeros(room), np.log(np.arange(1.0, room + 1.0)), np.empty((2, room + 1 + 2 * SIMD_WIDTH))


@kernel(borrows=True)
def _analog_variance(read_noise: float) -> float:
    """Return the variance of the samples of a level before rounding, DN^2."""
    return max(read_noise * read_noise - QUANTISATION_VARIANCE, LEAST_VARIANCE)


@kernel(borrows=True)
def _place_edges(
    theta: FloatArray, logs: FloatArray, weights: FloatArray, rows: FloatArray
) -> tuple[int, int, float]:
    """Fill the edges between the electron numbers that a pixel shows, DN, infinite at either end.

    Args:
        theta: (H, g, mu, sigma).
        logs: logarithms of 1, 2, ...
        weights: out, probabilities of the numbers.
        rows: out, in its row of edges that below the first number, then that above each.

    Returns:
        The first and the last number, and the variance of a level, DN^2.
    """
    exposure, step, bias = theta[0], 1.0 / theta[1], theta[2]
    variance = _analog_variance(theta[3])
    low, high = poisson_weights(exposure, weights)
    log_exposure = math.log(exposure) if exposure > 0.0 else -_INFINITE
    while low < high and weights[low] < NEGLIGIBLE:
        low += 1
    while high > low and weights[high] < NEGLIGIBLE:
        high -= 1
    rows[_EDGE, 0] = -_INFINITE
    for k in range(low, high):
        rows[_EDGE, k + 1 - low] = max(
            _last_code(k, logs[k] - log_exposure, step, bias, variance, weights) + 0.5,
            rows[_EDGE, k - low],
        )
    n = high + 1 - low
    rows[_EDGE, n : n + 1 + SIMD_WIDTH] = _INFINITE
    return low, high, variance


@kernel(borrows=True)
def _add(samples: int, k: int, largest: int, observed: IntArray) -> int:
    """Add samples of an electron number; return them where there is no place for it."""
    k = min(k, largest)
    if k >= observed.size:
        return samples
    observed[k] += samples
    return 0


@kernel(borrows=True)
def _add_nearest(samples: int, dn: int, bias: float, step: float, largest: int, observed: IntArray) -> int:
    """Add samples of a code to the electron number whose level is the nearest."""
    k = max(math.floor((dn - bias) / step + 0.5), 0)
    beyond: int = _add(np.int64(samples), k, largest, observed)
    return beyond


@kernel(borrows=True)
def _last_code(k: int, odds: float, step: float, bias: float, variance: float, weights: FloatArray) -> float:
    """Return the last code at which k is more probable than k + 1; ``odds`` is the logarithm of (k + 1) / H.

    Where the densities are equal (Hendrickson et al. 2023, eq. demarg_K_eqn); the masses of the code decide
    where that is too near to a whole code.
    """
    middle = bias + (k + 0.5) * step
    spread = variance + (QUANTISATION_VARIANCE if variance > NARROW else 0.0)
    shift = spread / step * odds if odds < _INFINITE else _INFINITE
    code = math.floor(min(middle + shift, _INFINITE))
    part = middle + shift - code
    near = _SURE * (1.0 + abs(shift))
    if shift >= _INFINITE or (variance > NARROW and near < part < 1.0 - near):
        return float(code)
    sd = math.sqrt(variance)
    for _ in range(4):  # codes that the masses may lie off
        at = code if part < 0.5 else code + 1
        below = (at - 0.5 - bias - k * step) / sd
        width, apart = 1.0 / sd, step / sd
        lower = weights[k] * normal_mass(below, below + width)
        upper = weights[k + 1] * normal_mass(below - apart, below - apart + width)
        if upper > lower:
            if at > code:
                break
            code -= 1
        elif lower > 0.0:
            if at == code:
                break
            code += 1
        else:
            break
    return float(code)


@kernel(borrows=True)
def _spread(
    rows: FloatArray, j: int, n: int, sd: float, level: tuple[float, float, float], low: int, out: FloatArray
) -> float:
    """Add the mass that a level gives to the codes of each number; return that of its own number.

    Args:
        rows: edges between the numbers, DN, and working memory for tails.
        j: place of the level among the n.
        n: number of levels.
        sd: standard deviation, DN.
        level: its mean, how far its samples are seen, both DN, and its weight.
        low: number of the first level.
        out: in and out, mass of each number.
    """
    mean, reach, weight = level
    first, end = j, j + 1
    while first > 0 and rows[_EDGE, first] > mean - reach:
        first -= 1
    while end < n and rows[_EDGE, end] < mean + reach:
        end += 1
    for i in range(first, end + 1, SIMD_WIDTH):
        tail, _, _ = simd_tail((simd_load(rows, _EDGE, i) - mean) * (1.0 / sd))
        simd_store(rows, _TAIL, i, tail)
    right = 0.0
    for i in range(first, end):
        mass = rows[_TAIL, i + 1] - rows[_TAIL, i]
        if rows[_EDGE, i] <= mean < rows[_EDGE, i + 1]:  # both tails are those beyond its edges
            mass += 1.0
        if low + i < out.size:
            out[low + i] += weight * mass
        if i == j:
            right = weight * mass
    return right
