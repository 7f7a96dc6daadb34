"""Compiled loops of the ensemble: sums of masses over pixels and tallies of the data."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import NEGLIGIBLE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SCANNED = 16  # bins that are looked at together


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
