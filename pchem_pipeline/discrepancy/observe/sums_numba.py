"""Loops over the samples of frames: the channels of their codes, and sums over rows, short for numpy.

Sums are in single precision: over a row that costs a millionth of the spread of the sum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray
from pchem_pipeline.base.kernel import kernel


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
