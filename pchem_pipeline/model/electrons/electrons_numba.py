"""Compiled loops of the electron numbers: conversion of frames, tallies, and cell probabilities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.ensemble.ensemble_numba import _capacity, poisson_weights

__all__ = ["convert_frames", "count_errors", "electron_of_dn", "sum_cell_probabilities", "tally_electrons"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Longest table from DN to electron number kept for a pixel; what lies above is computed one by one.
LONGEST_TABLE = 4096


@kernel
def _threshold(k: int, exposure: float, gain: float, bias: float, noise: float) -> float:
    """Return the boundary between k and k + 1; ``noise`` is g sigma^2."""
    if exposure == 0.0:
        return math.inf
    return bias + (k + 0.5) / gain + noise * math.log((k + 1.0) / exposure)


@kernel
def electron_of_dn(dn: float, exposure: float, gain: float, bias: float, noise: float, start: int) -> int:
    """Return the electron number of a DN: how many thresholds lie below it, tried from ``start``."""
    k = start
    while k > 0 and dn <= _threshold(k - 1, exposure, gain, bias, noise):
        k -= 1
    while dn > _threshold(k, exposure, gain, bias, noise):
        k += 1
    return k


@kernel
def _guess(dn: float, gain: float, bias: float) -> int:
    return max(0, int((dn - bias) * gain))


@kernel
def convert_frames(
    frames: NDArray[Any],
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    largest: int,
    missing: int,
    out: NDArray[np.uint16],
) -> None:
    """Turn DN into electron numbers, a row of pixels at a time so that its tables stay in the cache.

    Args:
        frames: DN, shape (n_frames, ny, nx).
        exposure: H, shape (ny, nx), as the other parameters; NaN in gain marks a pixel without value.
        gain: g.
        bias: mu.
        sigma: sigma.
        largest: electron numbers above are cut to this.
        missing: what pixels without value receive.
        out: electron numbers, shape of the frames.
    """
    n_frames, ny, nx = frames.shape
    table = np.empty((nx, LONGEST_TABLE), dtype=np.uint16)
    lowest = np.empty(nx, dtype=np.int64)
    highest = np.empty(nx, dtype=np.int64)
    length = np.empty(nx, dtype=np.int64)
    for y in range(ny):
        lowest[:] = frames[0, y]
        highest[:] = frames[0, y]
        for t in range(1, n_frames):
            for x in range(nx):
                dn = np.int64(frames[t, y, x])
                lowest[x] = min(lowest[x], dn)
                highest[x] = max(highest[x], dn)
        for x in range(nx):
            low = lowest[x]
            length[x] = min(highest[x] - low + 1, LONGEST_TABLE)
            if math.isnan(gain[y, x]):
                table[x, : length[x]] = missing
                continue
            noise = gain[y, x] * sigma[y, x] * sigma[y, x]
            k = _guess(float(low), gain[y, x], bias[y, x])
            for i in range(length[x]):
                k = electron_of_dn(float(low + i), exposure[y, x], gain[y, x], bias[y, x], noise, k)
                table[x, i] = min(k, largest)
        for t in range(n_frames):
            for x in range(nx):
                i = np.int64(frames[t, y, x]) - lowest[x]
                if i < length[x]:
                    out[t, y, x] = table[x, i]
                elif math.isnan(gain[y, x]):
                    out[t, y, x] = missing
                else:
                    value = float(frames[t, y, x])
                    start = _guess(value, gain[y, x], bias[y, x])
                    noise = gain[y, x] * sigma[y, x] * sigma[y, x]
                    k = electron_of_dn(value, exposure[y, x], gain[y, x], bias[y, x], noise, start)
                    out[t, y, x] = min(k, largest)


@kernel
def count_errors(
    estimated: NDArray[np.uint16], true: NDArray[np.uint16], missing: int, errors: IntArray
) -> tuple[np.int64, np.int64]:
    """Count how often estimated and true electron numbers differ.

    ``errors[min(|k - K|, last)]`` counts each difference.

    Returns:
        Samples compared, and the sum of (k - K).
    """
    compared = np.int64(0)
    signed = np.int64(0)
    last = errors.size - 1
    a, b = estimated.ravel(), true.ravel()
    for i in range(a.size):
        if a[i] == missing:
            continue
        difference = np.int64(a[i]) - np.int64(b[i])
        errors[abs(difference) if abs(difference) < last else last] += 1
        compared += 1
        signed += difference
    return compared, signed


@kernel
def tally_electrons(
    counts: NDArray[Any],
    origin: IntArray,
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    out: IntArray,
) -> np.int64:
    """Add the electron numbers of per-pixel histograms to ``out[k]``; return how many lie beyond it."""
    beyond = np.int64(0)
    for p in range(counts.shape[0]):
        noise = gain[p] * sigma[p] * sigma[p]
        k = _guess(float(origin[p]), gain[p], bias[p])
        for b in range(counts.shape[1]):
            c = np.int64(counts[p, b])
            if c == 0:
                continue
            k = electron_of_dn(float(origin[p] + b), exposure[p], gain[p], bias[p], noise, k)
            if k < out.size:
                out[k] += c
            else:
                beyond += c
    return beyond


@kernel
def _upper_edge(k: int, exposure: float, gain: float, bias: float, noise: float) -> float:
    """Return the end of cell k on the continuous axis before rounding: its last integer DN plus one half."""
    threshold = _threshold(k, exposure, gain, bias, noise)
    return math.floor(threshold) + 0.5 if threshold < math.inf else math.inf


@kernel
def sum_cell_probabilities(
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    used_exposure: FloatArray,
    used_gain: FloatArray,
    used_bias: FloatArray,
    used_sigma: FloatArray,
    out: FloatArray,
    errors: FloatArray,
) -> None:
    """Add, over pixels, the probability that the estimate is k; ``errors[p]`` is that of an error.

    ``exposure`` .. ``sigma`` make the data, ``used_*`` the thresholds. DN are rounded, so a cell ends
    half-way between two integers, and the Gaussian in front of the rounding is narrower by 1/12 DN^2.
    """
    weights = np.zeros(_capacity(exposure))
    for p in range(exposure.size):
        low, high = poisson_weights(exposure[p], weights)
        analog = math.sqrt(max(sigma[p] * sigma[p] - QUANTISATION_VARIANCE, 1e-12))
        noise = used_gain[p] * used_sigma[p] * used_sigma[p]
        correct = 0.0
        for k in range(low, high + 1):
            centre = bias[p] + k / gain[p]
            # the cells that this component reaches
            cell = electron_of_dn(
                math.floor(centre - 9.0 * analog + 0.5),
                used_exposure[p],
                used_gain[p],
                used_bias[p],
                noise,
                _guess(centre - 9.0 * analog, used_gain[p], used_bias[p]),
            )
            below = 0.0
            while below < 1.0:
                edge = _upper_edge(cell, used_exposure[p], used_gain[p], used_bias[p], noise)
                z = (edge - centre) / analog
                above = 1.0 if z > 8.3 else 0.5 * math.erfc(-z * 0.7071067811865476)
                if cell < out.size:
                    out[cell] += weights[k] * (above - below)
                if cell == k:
                    correct += weights[k] * (above - below)
                below = above
                cell += 1
        errors[p] = 1.0 - correct
