"""Loops over the samples of frames.

Sums over samples are in single precision: over a row that costs a millionth of the spread of the sum.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel

#: Rows and columns from a pixel to that whose samples it may hold: the next line, that before, early, late.
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
#: Places that rows are compared with: wholly at those, and early or late from some sample on.
N_PLACES = 6


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
    """Fill values (2, t, y, x) with k and r of codes (t, y, x), DN, times a weight of each pixel, (y, x).

    Codes beyond the first and last one of a pixel, (y, x), count as these; ``start``: row of the first one in
    the tables of all pixels, (rows, 2).
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
def compare_codes(own: Float32Array, first: IntArray, usable: BoolArray, ratios: Float32Array) -> None:
    """Fill ratios (y, x, B, 4): log probabilities (y, x, B) of codes at pixels :data:`STEPS` away, less own.

    ``first``: DN of the first code of each pixel. Where one of two pixels does not count, it tells nothing.
    """
    ny, nx, last = own.shape[0], own.shape[1], own.shape[2] - 1
    for y in range(ny):
        for x in range(nx):
            for j in range(len(STEPS)):
                v, u = y + STEPS[j][0], x + STEPS[j][1]
                known = 0 <= v < ny and 0 <= u < nx and usable[y, x] and usable[v, u]
                shift = first[y, x] - first[v, u] if known else 0
                for code in range(last + 1):
                    other = own[v, u, min(max(code + shift, 0), last)] if known else own[y, x, code]
                    ratios[y, x, code, j] = other - own[y, x, code]


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
