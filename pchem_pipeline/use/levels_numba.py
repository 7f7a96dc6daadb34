"""Loops over the codes of known pixels: what each electron number gives to them, exposure, and posterior.

With g, mu and sigma held, ``P(x) = sum_k P(k; H) W_k(x)`` under any law of the samples
(:mod:`pchem_pipeline.model.law.sample_law`), and only P(k; H) depends on the exposure. W is made once for a
pixel. A code may be a whole DN or a fraction of one (``1 / parts``) where an offset was taken from the
samples: the cell of a sample is still 1 DN wide.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.cells_numba import Cells, Component, Law, cells_of, component, resolve
from pchem_pipeline.model.law.electron_laws_numba import FARTHEST, electron_number, normal_tail
from pchem_pipeline.model.law.mass_numba import _make_room, _theta_of
from pchem_pipeline.model.law.pixel_numba import EDGE, FIRST, N_BINS, OWN, SHARE, SHARE_SLOPE, Pixel

__all__ = ["NO_PRIOR", "estimate_exposures", "fill_tables"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Exposure that stands for a prior in which all electron numbers are alike.
NO_PRIOR = -1.0

_REACH = 8.5  # standard deviations of a component that are integrated, and at least one step of the comb
_LEAST_EXPOSURE = 1e-7  # e-; less is none
_LEAST_MASS = 1e-300
_MOST_STEPS = 200
_PRECISION = 1e-9
_OUTSIDE = 0.05  # part of a standard error by which a parameter is moved to find its slope
_TOP_REACH = 12.0


class Codes(NamedTuple):
    """Codes of a pixel: ``first + i / parts`` DN after a whole code, i < n."""

    first: float
    parts: int
    n: int


class Levels(NamedTuple):
    """What electron numbers give to codes.

    Attributes:
        number: electron numbers that reach the codes, increasing, shape (m,).
        low, high: first code of each, and the one after its last.
        start: place of its first code in ``share``.
        share: P(code | electron number), one number after the other.
    """

    number: IntArray
    low: IntArray
    high: IntArray
    start: IntArray
    share: FloatArray


@kernel
def _span(k: int, theta: FloatArray, cells: Cells, codes: Codes) -> tuple[int, int, float]:
    """Return the codes that an electron number reaches, ends excluded, and how far up it lies at least."""
    low, high = codes.n, 0
    nearest = math.inf
    for peak in range(cells.n_peaks):
        if cells.peaks[SHARE, peak] == 0.0 and cells.peaks[SHARE_SLOPE, peak] == 0.0:
            continue
        part = component(float(k), peak, theta, cells, _REACH)
        reach = min(FARTHEST, max(_REACH, theta[1] / part.sd)) * part.sd + 0.5 + cells.margin
        bottom, top = part.mean - reach - codes.first, part.mean + reach - codes.first
        nearest = min(nearest, bottom + codes.first)
        low = min(low, int(min(max(math.ceil(bottom * codes.parts), 0.0), float(codes.n))))
        high = max(high, int(min(max(math.floor(top * codes.parts) + 1.0, 0.0), float(codes.n))))
    # beyond the limits of the ADC all is counted at the limit
    if cells.bottom >= 0:
        high = max(high, min(codes.n, (cells.bottom + 1) * codes.parts))
        low = 0 if high > 0 and nearest < codes.first else low
    if cells.top <= cells.n_bins:
        low = max(0, min(low, (cells.top - 1) * codes.parts - codes.parts // 2))
        high = codes.n
    return low, high, nearest


@kernel
def _tail_between(lower: float, upper: float, mean: float, sd: float, table: FloatArray) -> float:
    """Return the mass of a normal law between two values."""
    z0, z1 = (lower - mean) / sd, (upper - mean) / sd
    # `normal_tail` takes infinity as no tail
    below, _ = normal_tail(z0, table)
    above, _ = normal_tail(z1, table)
    inside: float = above - below
    return inside + 1.0 if z0 <= 0.0 < z1 else inside


@kernel
def _add_whole(cells: Cells, part: Component, weight: float, low: int, high: int, share: FloatArray) -> None:
    """Add the mass of whole codes, each of whose edges is that of the next one."""
    inverse = 1.0 / part.sd
    before = (cells.bins[EDGE, low] - part.mean) * inverse if low < high else 0.0
    below, _ = normal_tail(before, cells.table)
    for i in range(low, high):
        z = (cells.bins[EDGE, i + 1] - part.mean) * inverse
        above, _ = normal_tail(z, cells.table)
        inside = above - below
        if before <= 0.0 < z:
            inside += 1.0
        share[i - low] += weight * inside
        before, below = z, above


@kernel
def list_levels(theta: FloatArray, cells: Cells, codes: Codes) -> Levels:
    """Return what each electron number gives to the codes of a pixel."""
    last = codes.first + (codes.n - 1) / codes.parts
    to_top = cells.top <= cells.n_bins
    most = max((last - theta[2]) / theta[1], 0.0)
    most = most + _TOP_REACH * math.sqrt(most + 1.0) + _TOP_REACH
    first_k, n_k, total = -1, 0, 0
    k = 0
    while True:
        low, high, nearest = _span(k, theta, cells, codes)
        if (nearest > last + 1.0 and not to_top) or k > 4.0 * most + 1e3 or (to_top and k > most):
            break
        if low < high:
            first_k = k if first_k < 0 else first_k
            n_k = k - first_k + 1
            total += high - low
        k += 1
    number, lows = np.empty(n_k, np.int64), np.empty(n_k, np.int64)
    highs, start = np.empty(n_k, np.int64), np.empty(n_k, np.int64)
    share = np.zeros(total)
    place = 0
    for row in range(n_k):
        k = first_k + row
        low, high, _ = _span(k, theta, cells, codes)
        number[row], lows[row], highs[row], start[row] = k, low, max(low, high), place
        for peak in range(cells.n_peaks):
            weight = cells.peaks[SHARE, peak] + theta[4] * cells.peaks[SHARE_SLOPE, peak]
            if weight == 0.0:
                continue
            part = component(float(k), peak, theta, cells, _REACH)
            if codes.parts == 1:
                _add_whole(cells, part, weight, low, high, share[place:])
                continue
            for i in range(low, high):
                value = codes.first + i / codes.parts
                whole = math.floor(value + 0.5)
                aside = value - whole
                share[place + i - low] += weight * _tail_between(
                    cells.bins[EDGE, whole] + aside,
                    cells.bins[EDGE, whole + 1] + aside,
                    part.mean,
                    part.sd,
                    cells.table,
                )
        place += max(0, high - low)
    return Levels(number, lows, highs, start, share)


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
            if mass > _LEAST_MASS:
                ratio = rest * sums[1, i] / mass
                loglik += counts[i] * math.log(mass)
                score += counts[i] * ratio
                information += counts[i] * (ratio * ratio - rest * sums[2, i] / mass)
            else:
                loglik += counts[i] * math.log(_LEAST_MASS)
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
        if ahead < _LEAST_EXPOSURE:
            return 0.0
        if abs(ahead - here) < _PRECISION * here:
            return ahead
        here = ahead
    return best


@kernel
def _score_at(
    exposure: float,
    parameters: FloatArray,
    weight: float,
    codes: Codes,
    pixel: Pixel,
    theta: FloatArray,
    counts: FloatArray,
    sums: FloatArray,
) -> float:
    """Return the slope of the log-likelihood in H under other parameters."""
    _theta_of(parameters, pixel.centre, weight, theta)
    cells = cells_of(pixel, np.int64(0))
    levels = list_levels(theta, cells, codes)
    _, score, _ = _evaluate(exposure, cells, levels, counts, sums)
    slope: float = score / exposure
    return slope


@kernel
def _ready(
    index: int,
    first: int,
    n: int,
    parts: int,
    law: Law,
    satellites: FloatArray,
    pixel: Pixel,
) -> tuple[Pixel, Codes]:
    """Fill what the law says of a pixel whose codes are ``(first + i) / parts`` DN; return both."""
    value = first / parts
    whole = math.floor(value + 0.5)
    codes = Codes(value - whole, parts, n)
    n_whole = math.floor(codes.first + (n - 1) / parts + 0.5) + 1
    pixel.facts[0, N_BINS], pixel.facts[0, FIRST] = float(n_whole), 0.0
    found = Pixel(pixel.bins, pixel.facts, pixel.peaks, pixel.mixtures, pixel.table, whole, 0.0)
    resolve(law, index, satellites[index, 0], found)
    return found, codes


@kernel
def estimate_exposures(
    counts: NDArray[Any],
    first: IntArray,
    parts: int,
    parameters: FloatArray,
    covariance: FloatArray,
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
        satellites: amplitude (e-) and weight of free satellites, shape (n, 2).
        law: of the samples.
        out: out, H, its standard error by counting, and that from the calibration, shape (n, 3); comes as
            NaN.
    """
    n_codes = counts.shape[1]
    room, scratch = _make_room(n_codes + 2, law)
    theta, sums, weights = scratch.small[OWN], np.empty((3, n_codes)), np.empty(n_codes)
    moved = np.empty(4)
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
        pixel, codes = _ready(index, first[index] + low, n, parts, law, satellites, room)
        if not _theta_of(parameters[index], pixel.centre, satellites[index, 1], theta):
            continue
        cells = cells_of(pixel, np.int64(0))
        levels = list_levels(theta, cells, codes)
        seen = weights[:n]
        start = (codes.first + moment / total / parts - theta[2]) / theta[1]
        exposure = _climb(start, cells, levels, seen, sums)
        near = max(exposure, _LEAST_EXPOSURE)
        _, score, information = _evaluate(near, cells, levels, seen, sums)
        curvature = (information + score) / (near * near)
        out[index, 0] = exposure
        if not curvature > 0.0:
            continue
        out[index, 1] = 1.0 / math.sqrt(curvature)
        out[index, 2] = _from_calibration(
            near, score / near, curvature, parameters[index], covariance[index], satellites[index, 1],
            codes, pixel, theta, moved, seen, sums,
        )  # fmt: skip


@kernel
def _from_calibration(
    exposure: float,
    score: float,
    curvature: float,
    parameters: FloatArray,
    covariance: FloatArray,
    weight: float,
    codes: Codes,
    pixel: Pixel,
    theta: FloatArray,
    moved: FloatArray,
    counts: FloatArray,
    sums: FloatArray,
) -> float:
    """Return the standard error of H from those of g, mu and sigma, by the implicit function theorem."""
    slopes = np.zeros(3)
    for j in range(3):
        step = _OUTSIDE * math.sqrt(covariance[j, j])
        if not step > 0.0:
            if step == 0.0:
                continue
            return math.nan
        for i in range(4):
            moved[i] = parameters[i]
        moved[1 + j] += step
        ahead = _score_at(exposure, moved, weight, codes, pixel, theta, counts, sums)
        slopes[j] = (ahead - score) / (step * curvature)
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += slopes[i] * covariance[i, j] * slopes[j]
    return math.sqrt(max(variance, 0.0))


@kernel
def fill_tables(
    first: IntArray,
    start: IntArray,
    parts: int,
    prior: FloatArray,
    parameters: FloatArray,
    satellites: FloatArray,
    law: Law,
    largest: int,
    missing: int,
    number: NDArray[np.uint16],
    probability: NDArray[np.float32],
    expected: NDArray[np.float32],
) -> None:
    """Fill, for each code of each pixel, the most probable electron number, its probability, and the mean.

    Args:
        first: first code of each pixel, in parts of a DN, shape (n,).
        start: place of its first code in the tables; the last element is their length, shape (n + 1,).
        parts: codes in a DN.
        prior: exposure to expect, e-; ``NO_PRIOR``: all numbers alike; shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        satellites: amplitude (e-) and weight of free satellites, shape (n, 2).
        law: of the samples.
        largest: electron numbers above are cut to this.
        missing: what codes of pixels without parameters get.
        number: out.
        probability: out, that the number is right; NaN where the law expects no such code.
        expected: out, E[k | x], e-.
    """
    most = 1
    for p in range(first.size):
        most = max(most, start[p + 1] - start[p])
    room, scratch = _make_room(most + 2, law)
    theta, sums = scratch.small[OWN], np.empty((3, most))
    for p in range(first.size):
        at, n = start[p], start[p + 1] - start[p]
        for i in range(n):
            number[at + i] = missing
            probability[at + i] = expected[at + i] = np.float32(math.nan)
        if n == 0 or math.isnan(prior[p]):
            continue
        pixel, codes = _ready(p, first[p], n, parts, law, satellites, room)
        if not _theta_of(parameters[p], pixel.centre, satellites[p, 1], theta):
            continue
        cells = cells_of(pixel, np.int64(0))
        levels = list_levels(theta, cells, codes)
        for i in range(n):
            sums[0, i] = sums[1, i] = sums[2, i] = 0.0
            number[at + i] = 0
        for row in range(levels.number.size):
            k = levels.number[row]
            mass = 1.0
            if prior[p] == 0.0:
                mass = 1.0 if k == 0 else 0.0
            if prior[p] > 0.0:
                mass, _, _ = electron_number(cells.count_law, cells.dispersion, k, prior[p], cells.mixtures)
            low, begin = levels.low[row], levels.start[row]
            for i in range(low, levels.high[row]):
                joint = mass * levels.share[begin + i - low]
                sums[0, i] += joint
                sums[1, i] += k * joint
                if joint > sums[2, i]:
                    sums[2, i] = joint
                    number[at + i] = min(k, largest)
        rest = 1.0 - cells.outlier_share
        for i in range(n):
            if sums[0, i] > _LEAST_MASS:
                whole = rest * sums[0, i] + cells.outlier_mass
                probability[at + i] = np.float32(rest * sums[2, i] / whole)
                expected[at + i] = np.float32(sums[1, i] / sums[0, i])
            else:  # farther from all levels than any sample of the law: the nearest
                value = (codes.first + i / parts - theta[2]) / theta[1]
                number[at + i] = min(max(math.floor(value + 0.5), 0), largest)


@kernel
def convert_frames(
    frames: NDArray[Any],
    first: IntArray,
    start: IntArray,
    number: NDArray[Any],
    probability: NDArray[np.float32],
    expected: NDArray[np.float32],
    wanted: bool,
    out_number: NDArray[Any],
    out_probability: NDArray[np.float32],
    out_expected: NDArray[np.float32],
) -> None:
    """Look every sample up in the table of its pixel.

    Args:
        frames: codes, shape (frame, n).
        first: first code of each pixel, shape (n,).
        start: place of its first code in the tables, shape (n + 1,).
        number: the table of the numbers.
        probability: that of their probabilities.
        expected: that of the means.
        wanted: whether the mean is wanted, too.
        out_number: out, shape of the frames.
        out_probability: out, likewise.
        out_expected: out, likewise where it is wanted.
    """
    for t in range(frames.shape[0]):
        for p in range(frames.shape[1]):
            i = start[p] + np.int64(frames[t, p]) - first[p]
            out_number[t, p] = number[i]
            out_probability[t, p] = probability[i]
            if wanted:
                out_expected[t, p] = expected[i]
