"""Loops over the codes of pixels and over the samples of frames.

Sums over samples are in single precision: over a row that costs a millionth of the spread of the sum.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.cell_scores_numba import N_NUISANCE, REACH, electron_range, fill_law

#: Rows and columns from a pixel to that whose samples it may hold: the next line, that before, early, late.
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
#: Places that rows are compared with: wholly at those, and early or late from some sample on.
N_PLACES = 6


# -- laws of pixels ----------------------------------------------------------------------------------


@kernel
def supports(parameters: FloatArray, log_negligible: float, electrons: IntArray, codes: IntArray) -> None:
    """Fill the ranges of electron numbers and of codes (n, 2) that the law of each pixel covers.

    Args:
        parameters: H, 1/g, mu, analog read noise in DN, (n, 4).
        log_negligible: logarithm of the probability of electron numbers that are left out.
        electrons: to fill.
        codes: to fill.
    """
    for p in range(parameters.shape[0]):
        exposure, step, bias, width = parameters[p]
        first, last = electron_range(exposure, log_negligible)
        electrons[p, 0], electrons[p, 1] = first, last
        codes[p, 0] = math.floor(bias + first * step - REACH * width)
        codes[p, 1] = math.ceil(bias + last * step + REACH * width)


@kernel
def _support(law: FloatArray, samples: float, allowed: float) -> tuple[int, int, float, float]:
    """Return the first and last code of the support, and what is expected below and above it."""
    low, below = 0, 0.0
    while low < law.shape[0] - 1 and samples * (below + law[low, 0]) < allowed:
        below += law[low, 0]
        low += 1
    high, above = law.shape[0] - 1, 0.0
    while high > low and samples * (above + law[high, 0]) < allowed:
        above += law[high, 0]
        high -= 1
    return low, high, samples * below, samples * above


@kernel
def fill_laws(
    parameters: FloatArray,
    electrons: IntArray,
    codes: IntArray,
    samples: FloatArray,
    allowed: tuple[float, float],
    expected: FloatArray,
    law: FloatArray,
    ends: IntArray,
    beyond: FloatArray,
) -> None:
    """Fill the laws of n pixels from the first code of their support on.

    Args:
        parameters: H, 1/g, mu, analog read noise in DN, (n, 4).
        electrons: ranges of electron numbers, (n, 2).
        codes: ranges of codes, DN, (n, 2).
        samples: of each pixel, (n,).
        allowed: samples expected beyond the support on either side, and far beyond it, at most.
        expected: to fill with the samples expected of all codes, (n, code).
        law: to fill, (n, code, column); both stay as they are behind the last code of a pixel.
        ends: to fill with the first and last code of the support, and those that are not far beyond it, DN,
            (n, 4).
        beyond: to fill with the samples expected below and above these, (n, 4).
    """
    for p in range(law.shape[0]):
        exposure, step, bias, width = parameters[p]
        full = np.empty((codes[p, 1] - codes[p, 0] + 1, law.shape[2]))
        fill_law(exposure, step, bias - codes[p, 0], width, electrons[p, 0], electrons[p, 1], full)
        for which in range(2):
            low, high, below, above = _support(full, samples[p], allowed[which])
            ends[p, 2 * which], ends[p, 2 * which + 1] = codes[p, 0] + low, codes[p, 0] + high
            beyond[p, 2 * which], beyond[p, 2 * which + 1] = below, above
        first = ends[p, 0] - codes[p, 0]
        for x in range(full.shape[0]):
            expected[p, x] = samples[p] * full[x, 0]
        for x in range(ends[p, 1] - ends[p, 0] + 1):
            for column in range(law.shape[2]):
                law[p, x, column] = full[first + x, column]


@kernel
def goodness(
    law: FloatArray,
    seen: FloatArray,
    expected: FloatArray,
    size: IntArray,
    smallest: float,
    shortest: FloatArray,
    out: FloatArray,
) -> None:
    """Fill Pearson's chi-square of merged codes, its mean and variance with the parameters fitted, (n, 3).

    Args:
        law: its columns of the parameters, whitened, (N_NUISANCE, n, code).
        seen: samples of each code, (n, code).
        expected: those expected.
        size: codes of the support, which come first, (n,).
        smallest: samples expected of a group, at least.
        shortest: codes in a group of each pixel, at least, (n,).
        out: to fill.
    """
    taken = np.zeros(N_NUISANCE)
    for p in range(seen.shape[0]):
        n = 0.0
        for x in range(size[p]):
            n += seen[p, x]
        chi2 = mean = inverse = 0.0
        groups = merged = 0
        observed = wanted = 0.0
        remaining = n
        for i in range(N_NUISANCE):
            taken[i] = 0.0
        for x in range(size[p]):
            merged += 1
            observed += seen[p, x]
            wanted += expected[p, x]
            for i in range(N_NUISANCE):
                taken[i] += law[i, p, x]
            full = wanted >= smallest and merged >= shortest[p]
            if (full and remaining - wanted >= smallest) or x == size[p] - 1:
                if wanted <= 0.0:
                    break
                chi2 += (observed - wanted) ** 2 / wanted
                used = 0.0
                for i in range(N_NUISANCE):
                    used += taken[i] * taken[i]
                    taken[i] = 0.0
                mean += max(0.0, 1.0 - used * n / wanted)
                inverse += 1.0 / wanted
                groups += 1
                remaining -= wanted
                observed = wanted = 0.0
                merged = 0
        variance = 2.0 * mean + max(0.0, inverse - (groups * groups + 2.0 * groups - 2.0) / n)
        out[p, 0], out[p, 1], out[p, 2] = chi2, mean, variance


# -- channels and their sums -------------------------------------------------------------------------


@kernel
def look_up(
    codes: NDArray[Any],
    first: NDArray[np.int32],
    last: NDArray[np.int32],
    start: NDArray[np.int32],
    tables: Float32Array,
    weight: Float32Array,
    values: Float32Array,
) -> None:
    """Fill values (2, t, y, x) with k and r of codes; codes beyond the support count as its ends.

    Args:
        codes: of frames, DN, (t, y, x).
        first: first code of each pixel, (y, x).
        last: its last one.
        start: row of its first code in ``tables``.
        tables: of all pixels, (rows, 2).
        weight: of each pixel, (y, x).
        values: to fill.
    """
    # row by row, whose tables stay in the cache
    for y in range(codes.shape[1]):
        for t in range(codes.shape[0]):
            for x in range(codes.shape[2]):
                code = min(max(np.int32(codes[t, y, x]), first[y, x]), last[y, x])
                row = start[y, x] + (code - first[y, x])
                values[0, t, y, x] = tables[row, 0] * weight[y, x]
                values[1, t, y, x] = tables[row, 1] * weight[y, x]


@kernel
def _sum_every_second(
    samples: Float32Array, weights: Float32Array, t: int, y: int, begin: int, end: int
) -> tuple[Any, Any, Any]:
    """Return the sums of k, r and r (w_0 k + w_1) over every second sample of a part of a row."""
    sum_k = sum_r = sum_gain = np.float32(0.0)
    for x in range(begin, end, 2):
        k, r = samples[0, t, y, x], samples[1, t, y, x]
        sum_k += k
        sum_r += r
        sum_gain += r * (weights[0, y, x] * k + weights[1, y, x])
    return sum_k, sum_r, sum_gain


@kernel
def sum_rows(
    samples: Float32Array, weights: Float32Array, halves: FloatArray, gain: FloatArray, noise: FloatArray
) -> None:
    """Sum over the rows of some frames.

    Args:
        samples: k and r, (2, t, y, x).
        weights: of r k and of r in the gain, and of r^2 in the noise, (3, y, x).
        halves: k and r of the left and the right half of each row, to fill, (2, 2, t, y).
        gain: weighted sums of r k and r of each frame, to add to, (t,).
        noise: weighted sums of r^2 of each row, to fill, (t, y).
    """
    nx = samples.shape[3]
    for t in range(samples.shape[1]):
        for y in range(samples.shape[2]):
            of_gain = np.float32(0.0)
            for side in range(2):
                begin, end = side * (nx // 2), nx // 2 if side == 0 else nx
                # each addition waits for the one before: two sums at a time
                even = _sum_every_second(samples, weights, t, y, begin, end)
                odd = _sum_every_second(samples, weights, t, y, begin + 1, end)
                halves[0, side, t, y], halves[1, side, t, y] = even[0] + odd[0], even[1] + odd[1]
                of_gain += even[2] + odd[2]
            gain[t] += of_gain
            total = np.float32(0.0)
            for x in range(nx):
                total += weights[2, y, x] * samples[1, t, y, x] * samples[1, t, y, x]
            noise[t, y] = total


@kernel
def add_frames(values: Float32Array, total: FloatArray) -> None:
    """Add values (t, pixel) to the sums of each pixel, (pixel,)."""
    for t in range(values.shape[0]):
        for pixel in range(values.shape[1]):
            total[pixel] += values[t, pixel]


# -- rows at other places ----------------------------------------------------------------------------


@kernel
def _log_mean(values: FloatArray) -> float:
    """Return the log of the mean of numbers given as logs."""
    largest = values.max()
    total = 0.0
    for value in values:
        total += math.exp(value - largest)
    return float(largest + math.log(total / values.size))


@kernel
def compare_rows(
    frames: NDArray[Any],
    first: IntArray,
    table: Float32Array,
    stride: int,
    share: float,
    whole: bool,
    ratios: Float32Array,
    gains: FloatArray,
) -> None:
    """Compare rows at other places with them at their own.

    Args:
        frames: codes (frame, y, x), DN.
        first: DN of the first code of ``table``, (y, x).
        table: logarithms of the probabilities of codes at the pixels :data:`STEPS` away over that at their
            own, the first and last code for all beyond, (y, x, B, 4).
        stride: frames between the samples of neighbours, modulo their number; 0: rows as they are.
        share: of rows that come from elsewhere.
        whole: likelihoods of rows that come early or late from some sample on are means over that, else the
            largest one in the place of all, which takes a third of the time.
        ratios: logarithms of the likelihood ratios, to fill, (frame, y, N_PLACES).
        gains: of the log likelihood with that share, to fill, (frame, y).
    """
    n, ny, nx = frames.shape
    last = table.shape[2] - 1
    since_early, since_late = np.empty(nx), np.empty(nx)
    for y in range(ny):
        for t in range(n):
            following = preceding = early = late = from_early = from_late = 0.0
            for x in range(nx - 1, -1, -1):
                of_frame = t + stride * x
                if stride:
                    of_frame %= n
                code = np.int64(frames[of_frame, y, x])
                entry = table[y, x, min(max(code - first[y, x], 0), last)]
                following += entry[0]
                preceding += entry[1]
                early += entry[2]
                late += entry[3]
                if whole:
                    since_early[x], since_late[x] = early, late
                else:
                    from_early, from_late = max(from_early, early), max(from_late, late)
            of = ratios[t, y]
            of[0], of[1], of[2], of[3] = following, preceding, early, late
            if whole:
                of[4], of[5] = _log_mean(since_early), _log_mean(since_late)
            else:
                of[4], of[5] = from_early - math.log(nx), from_late - math.log(nx)
            largest = max(max(max(of[0], of[1]), max(of[2], of[3])), max(of[4], of[5]))
            total = 0.0
            for j in range(N_PLACES):
                total += math.exp(of[j] - largest)
            likelier = largest + math.log(share * total / N_PLACES)
            gains[t, y] = likelier if likelier > 30.0 else math.log1p(math.exp(likelier) - share)
