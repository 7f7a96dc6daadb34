"""Compiled loops of the ensemble: sums of PCDs over pixels and tallies of the data.

A component is a Gaussian of weight ``P(K = k)``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_EXPONENT, NEGLIGIBLE, SMALLEST_MASS
from pchem_pipeline.model.arithmetic.normal_numba import NARROW, REACH, add_mass, reach_of
from pchem_pipeline.model.arithmetic.simd_math_numba import PER_ROOT_2PI, simd_exp
from pchem_pipeline.model.arithmetic.simd_numba import (
    SIMD_WIDTH,
    counting,
    fused,
    most,
    simd_load,
    simd_store,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


_ERROR_SHARE = 1e-10  # of a pixel's highest component: less is not seen in an error
_ROOM = 2 * SIMD_WIDTH  # after the last place, for loops that write some places at a time
_SCANNED = 16  # bins that are looked at together
_GROUPS = 16  # of places that follow from the first


@kernel
def poisson_weights(mean: float, weights: FloatArray) -> tuple[int, int]:
    """Fill ``weights[k] = P(K = k)`` for the k that matter and return the first and the last of them.

    Entries outside are left as they were; a last k beyond the array is cut to its end.
    """
    top = weights.size - 1
    mode = min(int(mean), top)
    log_peak = -mean if mode == 0 else mode * math.log(mean) - mean - math.lgamma(mode + 1.0)
    peak = math.exp(log_peak)
    if peak == 0.0:  # the mean lies far beyond the array
        weights[top] = 0.0
        return top, top
    weights[mode] = peak
    low = mode
    while low > 0 and weights[low] > NEGLIGIBLE * peak:
        weights[low - 1] = weights[low] * (low / mean)
        low -= 1
    high = mode
    while high < top and weights[high] > NEGLIGIBLE * peak:
        weights[high + 1] = weights[high] * (mean / (high + 1.0))
        high += 1
    return low, high


@kernel
def capacity(exposure: FloatArray) -> int:
    """Return room for the electron numbers that matter at the largest of some exposures."""
    largest = 0.0
    for p in range(exposure.size):
        largest = max(largest, exposure[p])
    return int(largest + 12.0 * math.sqrt(largest) + 40.0)


@kernel
def log_factorials(n: int) -> FloatArray:
    """Return the logarithms of 0!, 1!, ... (n - 1)!."""
    found = np.zeros(n)
    for k in range(1, n):
        found[k] = found[k - 1] + math.log(k)
    return found


class AxisSums(NamedTuple):
    """What is added up along an axis, of DN or of NUCed values.

    Attributes:
        start: index of the first bin: of the raw axis its DN.
        width: of a bin, DN or e-; 0: nothing is added up.
        total: in and out, sums of the pixels' masses.
        square: in and out, sums of their squares.
    """

    start: int
    width: float
    total: FloatArray
    square: FloatArray


class AxisCounts(NamedTuple):
    """Samples counted along an axis; see :class:`AxisSums`."""

    start: int
    width: float
    counts: IntArray


@kernel
def sum_pcd_pixels(
    pixels: tuple[FloatArray, FloatArray, FloatArray, FloatArray], raw: AxisSums, nuced: AxisSums
) -> None:
    """Add every pixel's PCD, and its square, at the integers; and the same PCD sorted into NUCed bins.

    The NUCed value of DN ``x`` is ``(x - mu) g``, so each DN falls into one bin as a whole, exactly as the
    data do.

    Args:
        pixels: H, g, mu, sigma, shape (n,) each.
        raw: at the integers.
        nuced: in the NUCed bins.
    """
    exposure, gain, bias, sigma = pixels
    dn_start, total, total_square = raw.start, raw.total, raw.square
    weights = np.zeros(capacity(exposure))
    log_factorial = log_factorials(weights.size)
    row = np.zeros((1, total.size + _ROOM))
    places, held = np.zeros(total.size, np.int32), np.zeros(nuced.total.size + 2)
    for p in range(exposure.size):
        low, high = poisson_weights(exposure[p], weights)
        step, log_exposure = 1.0 / gain[p], math.log(max(exposure[p], SMALLEST_MASS))
        reach = (REACH + 1.0) * sigma[p] + 1.0
        first = max(0, math.floor(bias[p] + low * step - reach) - dn_start)
        last = min(total.size - 1, math.ceil(bias[p] + high * step + reach) - dn_start)
        if first > last:
            continue
        part = row[0, first : last + 1]
        part[:] = 0.0
        base = float(dn_start + first)
        decay = math.exp(-((SIMD_WIDTH / sigma[p]) ** 2)) if sigma[p] >= NARROW else 0.0
        for k in range(low, high + 1):
            centre = bias[p] + k * step
            if sigma[p] >= NARROW:
                within = reach_of(k * log_exposure - exposure[p] - log_factorial[k]) * sigma[p]
                _add_bell(row, centre - dn_start, sigma[p], weights[k], within, decay, total.size)
            else:
                _add_needle(part, base, weights[k], centre, sigma[p])
        for i in range(part.size):
            total[first + i] += part[i]
            total_square[first + i] += part[i] * part[i]
        if nuced.width > 0.0:
            _add_nuced(part, base, gain[p], bias[p], nuced, places, held)


@kernel(borrows=True)
def _add_bell(
    row: FloatArray, centre: float, sigma: float, weight: float, reach: float, decay: float, n: int
) -> None:
    """Add a component of the PCD at the places 0 ... n - 1 of a row; a few after these are written, too.

    From one group of w places to the next a Gaussian changes by a ratio, and the ratio by ``decay = exp(-(w /
    sigma)^2)``: two products instead of an exponential, begun anew before their roundings add up.
    """
    if weight <= 0.0:
        return
    inverse, end = 1.0 / sigma, min(n, math.floor(centre + reach) + 1)
    peak, pace = weight * PER_ROOT_2PI * inverse, SIMD_WIDTH * inverse
    for begin in range(max(0, math.ceil(centre - reach)), end, _GROUPS * SIMD_WIDTH):
        z = (counting() + (begin - centre)) * inverse
        value = peak * simd_exp(most(z * z * -0.5, LEAST_EXPONENT))
        ratio = simd_exp(most((z + 0.5 * pace) * -pace, LEAST_EXPONENT))
        for i in range(begin, min(end, begin + _GROUPS * SIMD_WIDTH), SIMD_WIDTH):
            simd_store(row, 0, i, value + simd_load(row, 0, i))
            value = value * ratio
            ratio = ratio * decay


@kernel(borrows=True)
def _add_needle(out: FloatArray, base: float, weight: float, centre: float, sigma: float) -> None:
    """Add a component so narrow that its density at the integers ``base + i`` is not its mass."""
    # sigma holds the 1/12 DN^2 of rounding, which the integration over the cell puts back
    add_mass(out, base, weight, centre, math.sqrt(max(sigma * sigma - QUANTISATION_VARIANCE, 1e-12)))


@kernel(borrows=True)
def _add_nuced(
    part: FloatArray,
    base: float,
    gain: float,
    bias: float,
    nuced: AxisSums,
    places: NDArray[np.int32],
    held: FloatArray,
) -> None:
    """Add one pixel's masses to the NUCed bins.

    Args:
        part: masses of successive DN.
        base: first of these.
        gain: g.
        bias: mu.
        nuced: the bins.
        places: working memory, as long as ``part``.
        held: working memory, all 0 before and after; one longer than the bins at either end.
    """
    total, square = nuced.total, nuced.square
    low, high, scale = nuced.start - 1.0, nuced.start + float(total.size), gain / nuced.width
    for i in range(part.size):
        value = np.floor((base + i - bias) * scale + 0.5)
        places[i] = np.int32(min(max(value, low), high) - low)
    for i in range(part.size):
        held[places[i]] += part[i]
    for j in range(max(places[0], 1), min(places[part.size - 1], total.size) + 1):
        total[j - 1] += held[j]
        square[j - 1] += held[j] * held[j]
    held[places[0] : places[part.size - 1] + 1] = 0.0


@kernel
def sort_masses(
    mass: FloatArray,
    first: IntArray,
    start: IntArray,
    gain: FloatArray,
    bias: FloatArray,
    raw: AxisSums,
    nuced: AxisSums,
    moments: FloatArray,
) -> None:
    """Add every pixel's masses, and their squares, at the integers and in the NUCed bins.

    Args:
        mass: of successive DN, one pixel after the other.
        first: first DN of each pixel, shape (n,).
        start: place of its mass, shape (n + 1,).
        gain: g, shape (n,).
        bias: mu, shape (n,).
        raw: at the integers.
        nuced: in the NUCed bins.
        moments: out, sums over pixels of the mean of the NUCed value and of its square.
    """
    dn_start, total, total_square = raw.start, raw.total, raw.square
    places, held = np.zeros(total.size, np.int32), np.zeros(nuced.total.size + 2)
    for p in range(first.size):
        begin = start[p] + max(0, dn_start - first[p])
        end = min(start[p + 1], start[p] + dn_start + total.size - first[p])
        if begin >= end:
            continue
        part, base = mass[begin:end], first[p] + begin - start[p]
        for i in range(part.size):
            value = (base + i - bias[p]) * gain[p]
            moments[0] += part[i] * value
            moments[1] += part[i] * value * value
            total[base + i - dn_start] += part[i]
            total_square[base + i - dn_start] += part[i] * part[i]
        _add_nuced(part, float(base), gain[p], bias[p], nuced, places, held)


@kernel
def curve_variance(
    parameters: FloatArray, covariance: NDArray[np.float64], x0: float, pitch: float, out: FloatArray
) -> None:
    """Add every pixel's variance of its density at ``x0 + i pitch`` by the delta method to ``out[i]``.

    ``d f = D' d theta`` with the slopes D of the density in (H, g, mu, sigma), so the variance is ``D' C D``.

    Args:
        parameters: (H, g, mu, sigma), shape (n, 4); all known.
        covariance: of the estimates, shape (n, 4, 4); entries that are NaN count as 0.
        x0: first place, in the unit of the bias.
        pitch: between places.
        out: in and out, shape (m,).
    """
    weights = np.zeros(capacity(parameters[:, 0]))
    slopes, total = np.zeros((4, out.size + _ROOM)), np.zeros((1, out.size + _ROOM))
    known = np.zeros((4, 4))
    for p in range(parameters.shape[0]):
        exposure, step = parameters[p, 0], 1.0 / parameters[p, 1]
        bias, sigma = parameters[p, 2], parameters[p, 3]
        for i in range(4):
            for j in range(4):
                entry = covariance[p, i, j]
                known[i, j] = entry if math.isfinite(entry) else 0.0
        low, high = poisson_weights(exposure, weights)
        least = _ERROR_SHARE * np.max(weights[low : high + 1])
        first, last = out.size, -1
        for k in range(low, high + 1):
            if weights[k] <= least:
                continue
            centre = bias + k * step
            reach = math.sqrt(2.0 * math.log(weights[k] / least)) * sigma
            begin = max(0, math.ceil((centre - reach - x0) / pitch))
            end = min(out.size, math.floor((centre + reach - x0) / pitch) + 1)
            if begin < end:
                rise = k / exposure - 1.0 if exposure > 0.0 else 0.0
                part = weights[k], rise, k * step * step, sigma
                _add_slopes(slopes, begin, end, (x0 - centre) / sigma, pitch / sigma, part)
                first, last = min(first, begin), max(last, end)
        _add_variance(slopes, known, first, last, total)
    for i in range(out.size):
        out[i] += total[0, i]


@kernel(borrows=True)
def _add_slopes(
    slopes: FloatArray, begin: int, end: int, z0: float, pitch: float, part: tuple[float, float, float, float]
) -> None:
    """Add a component's slopes in (H, g, mu, sigma) at some places.

    Args:
        slopes: in and out, shape (4, m).
        begin: first place; a few after the last are written, too.
        end: place after the last.
        z0: place 0 from the centre of the component, standard deviations.
        pitch: between places, likewise.
        part: weight of the component, rise of its logarithm with H, by how much the centre falls as g rises
            by one, standard deviation.
    """
    weight, rise, shift, sigma = part
    inverse = 1.0 / sigma
    peak = weight * PER_ROOT_2PI * inverse
    for i in range(begin, end, SIMD_WIDTH):
        z = fused(counting() + float(i), pitch, z0)
        square = z * z
        value = peak * simd_exp(most(square * -0.5, LEAST_EXPONENT))
        pull = value * z * inverse
        simd_store(slopes, 0, i, fused(value, rise, simd_load(slopes, 0, i)))
        simd_store(slopes, 1, i, fused(pull, -shift, simd_load(slopes, 1, i)))
        simd_store(slopes, 2, i, pull + simd_load(slopes, 2, i))
        simd_store(slopes, 3, i, fused(value * inverse, square - 1.0, simd_load(slopes, 3, i)))


@kernel(borrows=True)
def _add_variance(slopes: FloatArray, known: FloatArray, begin: int, end: int, total: FloatArray) -> None:
    """Add ``D' C D`` between two places, and set the slopes back to 0."""
    for i in range(begin, end, SIMD_WIDTH):
        variance = simd_load(total, 0, i)
        for row in range(4):
            product = counting() * 0.0
            for column in range(4):
                product = fused(simd_load(slopes, column, i), known[row, column], product)
            variance = fused(simd_load(slopes, row, i), product, variance)
        simd_store(total, 0, i, variance)
    for i in range(begin, end + SIMD_WIDTH, SIMD_WIDTH):
        for row in range(4):
            simd_store(slopes, row, i, counting() * 0.0)


@kernel
def sum_pcd_cells(
    share: FloatArray,
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    dn_start: int,
    out: FloatArray,
) -> None:
    """Add ``share`` times the PCD of each cell of a 4-D histogram at the integers."""
    weights, row = np.zeros(capacity(exposure)), np.zeros((1, out.size + _ROOM))
    for c in range(exposure.size):
        low, high = poisson_weights(exposure[c], weights)
        decay = math.exp(-((SIMD_WIDTH / sigma[c]) ** 2))
        for k in range(low, high + 1):
            weight, centre = share[c] * weights[k], bias[c] + k / gain[c]
            if sigma[c] >= NARROW:
                _add_bell(row, centre - dn_start, sigma[c], weight, REACH * sigma[c], decay, out.size)
            else:
                _add_needle(out, float(dn_start), weight, centre, sigma[c])
    for i in range(out.size):
        out[i] += row[0, i]


@kernel
def sum_nuced_cells(
    share: FloatArray,
    exposure: FloatArray,
    sigma_e: FloatArray,
    width: float,
    nuced_start: int,
    out: FloatArray,
) -> None:
    """Add the mass of ``share`` PCD(H, 1, 0, sigma_e^2) in each bin of the NUCed axis."""
    weights = np.zeros(capacity(exposure))
    for c in range(exposure.size):
        low, high = poisson_weights(exposure[c], weights)
        for k in range(low, high + 1):
            add_mass(out, float(nuced_start), share[c] * weights[k], k / width, sigma_e[c] / width)


@kernel
def sum_nuced_product(
    electron_mass: FloatArray,
    sigma_share: FloatArray,
    sigma_e: FloatArray,
    width: float,
    nuced_start: int,
    out: FloatArray,
) -> None:
    """Add the mass of the NUCed EPCD of independent H and sigma_e in each bin."""
    base = float(nuced_start)
    for m in range(sigma_e.size):
        for k in range(electron_mass.size):
            if electron_mass[k] > NEGLIGIBLE:
                add_mass(out, base, sigma_share[m] * electron_mass[k], k / width, sigma_e[m] / width)


@kernel
def sum_poisson(share: FloatArray, exposure: FloatArray, out: FloatArray) -> None:
    """Add ``share`` times the Poisson mass of each exposure at k = 0, 1, ... up to the end of ``out``."""
    weights = np.zeros(max(out.size, capacity(exposure)))
    for c in range(exposure.size):
        low, high = poisson_weights(exposure[c], weights)
        for k in range(low, min(high, out.size - 1) + 1):
            out[k] += share[c] * weights[k]


@kernel
def sum_moments(exposure: FloatArray, moments: FloatArray, weights: FloatArray, out: FloatArray) -> None:
    """Add moments of pixels weighted by their probability of k electrons.

    Args:
        exposure: H, shape (n,).
        moments: of each pixel, shape (n, m).
        weights: working memory, at least as long as ``out``.
        out: in and out, the sums of the weights, then of the weighted moments, shape (n_k, m + 1).
    """
    for p in range(exposure.size):
        low, high = poisson_weights(exposure[p], weights)
        for k in range(low, min(high, out.shape[0] - 1) + 1):
            out[k, 0] += weights[k]
            for i in range(moments.shape[1]):
                out[k, 1 + i] += weights[k] * moments[p, i]


@kernel(borrows=True)
def occupied(counts: NDArray[Any], p: int) -> tuple[int, int]:
    """Return a first bin of a pixel's histogram and an end between which all of its samples lie."""
    begin, end = 0, counts.shape[1]
    while begin + _SCANNED <= end and _samples_of(counts, p, begin) == 0:
        begin += _SCANNED
    while begin + _SCANNED <= end and _samples_of(counts, p, end - _SCANNED) == 0:
        end -= _SCANNED
    return begin, end


@kernel(borrows=True)
def _samples_of(counts: NDArray[Any], p: int, first: int) -> np.int64:
    """Return the samples of some successive bins."""
    total = np.int64(0)
    for b in range(_SCANNED):
        total += np.int64(counts[p, first + b])
    return total


@kernel
def tally_counts(
    counts: NDArray[Any],
    origin: IntArray,
    gain: FloatArray,
    bias: FloatArray,
    raw: AxisCounts,
    nuced: AxisCounts,
    nuced_sums: FloatArray,
) -> tuple[np.int64, np.int64]:
    """Sort per-pixel histograms onto the DN axis and onto the NUCed axis.

    ``nuced_sums[p]`` receives the sums of the NUCed value and of its square over the pixel's samples, exact
    before any binning; where the NUCed axis has no width it receives nothing.

    Returns:
        How many samples fell outside of the DN axis, and outside of the NUCed axis.
    """
    outside, nuced_outside = np.int64(0), np.int64(0)
    n_raw, n_nuced = raw.counts.size, nuced.counts.size
    places, held = np.zeros(counts.shape[1], np.int32), np.zeros(n_nuced + 2, np.int64)
    low, high = nuced.start - 1.0, nuced.start + float(n_nuced)
    for p in range(counts.shape[0]):
        begin, end = occupied(counts, p)
        offset, total = origin[p] - bias[p], np.int64(0)
        first, second = np.int64(0), np.int64(0)
        for b in range(begin, end):
            c = np.int64(counts[p, b])
            total += c
            first += c * b
            second += c * b * b
        mean = first + offset * total
        shift = origin[p] - raw.start
        inside = min(max(begin, -shift), end), max(min(end, n_raw - shift), begin)
        for b in range(inside[0], inside[1]):
            c = np.int64(counts[p, b])
            raw.counts[b + shift] += c
            total -= c
        outside += total
        if nuced.width <= 0.0:
            continue
        nuced_sums[p, 0] = gain[p] * mean
        nuced_sums[p, 1] = gain[p] * gain[p] * (second + offset * (first + mean))
        scale = gain[p] / nuced.width
        for b in range(begin, end):
            value = np.floor((origin[p] + b - bias[p]) * scale + 0.5)
            places[b] = np.int32(min(max(value, low), high) - low)
        for b in range(begin, end):
            held[places[b]] += np.int64(counts[p, b])
    for j in range(n_nuced):
        nuced.counts[j] += held[j + 1]
    nuced_outside += held[0] + held[n_nuced + 1]
    return outside, nuced_outside
