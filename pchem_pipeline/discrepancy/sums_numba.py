"""Loops of :mod:`pchem_pipeline.discrepancy.sums`: one pass over the frames of a split.

The frames go through in chunks that stay in the cache. Every sample becomes (k, r) by its pixel's table; the
common mode of each frame is subtracted before products of different pixels or frames are summed. The inner
loops run over x without sums across x where possible, so that the compiler can use vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["LAGS", "count_repeats", "find_hits", "sum_block"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Float32Array = NDArray[np.float32]

LAGS = 3


@njit(nogil=True, cache=True)
def _look_up(
    row: NDArray[Any],
    support: NDArray[np.int32],
    tables: Float32Array,
    charge: Float32Array,
    readout: Float32Array,
) -> None:
    """Turn the codes of a row into k and r; codes beyond the support count as its ends."""
    first, last, start = support[0], support[1], support[2]
    for x in range(row.size):
        code = min(max(np.int32(row[x]), first[x]), last[x])
        at = start[x] + (code - first[x])
        charge[x] = tables[at, 0]
        readout[x] = tables[at, 1]


@njit(nogil=True, cache=True)
def _sum_row(
    charge: Float32Array,
    readout: Float32Array,
    factor: Float32Array,
    shift: Float32Array,
    begin: int,
    end: int,
) -> tuple[float, float, float]:
    """Return the sums of k, r and r (factor k + shift) over part of a row."""
    k0 = k1 = r0 = r1 = g0 = g1 = 0.0
    x = begin
    while x < end - 1:
        k0 += charge[x]
        r0 += readout[x]
        g0 += readout[x] * (factor[x] * charge[x] + shift[x])
        k1 += charge[x + 1]
        r1 += readout[x + 1]
        g1 += readout[x + 1] * (factor[x + 1] * charge[x + 1] + shift[x + 1])
        x += 2
    if x < end:
        k0 += charge[x]
        r0 += readout[x]
        g0 += readout[x] * (factor[x] * charge[x] + shift[x])
    return k0 + k1, r0 + r1, g0 + g1


@njit(nogil=True, cache=True)
def _add(total: NDArray[Any], values: Float32Array) -> None:
    for x in range(values.size):
        total[x] += values[x]


@njit(nogil=True, cache=True)
def _add_product(total: FloatArray, first: Float32Array, second: Float32Array) -> None:
    for x in range(total.size):
        total[x] += first[x] * second[x]


@njit(nogil=True, cache=True)
def _add_both(
    total: FloatArray, r: Float32Array, k: Float32Array, other_r: Float32Array, other_k: Float32Array
) -> None:
    for x in range(total.size):
        total[x] += r[x] * other_k[x] + other_r[x] * k[x]


@njit(nogil=True, cache=True)
def _subtract(values: Float32Array, pattern: Float32Array, amount: np.float32) -> None:
    for x in range(values.size):
        values[x] -= amount * pattern[x]


@njit(nogil=True, cache=True)
def sum_block(
    frames: NDArray[Any],
    support: NDArray[np.int32],
    tables: Float32Array,
    exposure: Float32Array,
    mask: Float32Array,
    factor: Float32Array,
    shift: Float32Array,
    norms: FloatArray,
    half: int,
    charge: Float32Array,
    readout: Float32Array,
    rows: FloatArray,
    columns: Float32Array,
    gain: FloatArray,
    block: FloatArray,
    lags: FloatArray,
    beside: FloatArray,
    below: FloatArray,
) -> None:
    """Add one block of consecutive frames to the sums.

    Args:
        frames: codes (frame, y, x).
        support: first code, last code, row of the first one in ``tables``, (y, 3, x).
        tables: k and r, (rows, 2).
        exposure: H, 0 in unusable pixels, (y, x).
        mask: 1 in usable pixels, else 0, (y, x).
        factor: weights of r k in the gain, (y, x).
        shift: weights of r in the gain, (y, x).
        norms: sum of H, number of usable pixels.
        half: first column of the right half.
        charge: workspace (LAGS + frames in a chunk, y, x).
        readout: the same.
        rows: k left, k right, r left, r right of each row, (4, frame, y); to fill.
        columns: sums of k and r of each column, (2, frame, x); to add to.
        gain: sums of r (factor k + shift), (frame,); to add to.
        block: sums of k and r of each pixel, (2, y, x); to add to.
        lags: products kk and rr at lags 1 to 3, then r k(-1), k r(-1), (8, y, x); to add to.
        beside: products kk, rr, rk + kr with the next column, (3, y, x); to add to.
        below: the same with the next row.
    """
    n, ny, nx = frames.shape
    chunk = charge.shape[0] - LAGS
    done = 0
    while done < n:
        size = min(chunk, n - done)
        for y in range(ny):
            for j in range(size):
                t = done + j
                k, r = charge[LAGS + j, y], readout[LAGS + j, y]
                _look_up(frames[t, y], support[y], tables, k, r)
                left = _sum_row(k, r, factor[y], shift[y], 0, half)
                right = _sum_row(k, r, factor[y], shift[y], half, nx)
                rows[0, t, y], rows[2, t, y] = left[0], left[1]
                rows[1, t, y], rows[3, t, y] = right[0], right[1]
                gain[t] += left[2] + right[2]
                _add(columns[0, t], k)
                _add(columns[1, t], r)
                _add(block[0, y], k)
                _add(block[1, y], r)
        for j in range(size):
            t = done + j
            common_k = np.float32((rows[0, t].sum() + rows[1, t].sum()) / norms[0])
            common_r = np.float32((rows[2, t].sum() + rows[3, t].sum()) / norms[1])
            for y in range(ny):
                _subtract(charge[LAGS + j, y], exposure[y], common_k)
                _subtract(readout[LAGS + j, y], mask[y], common_r)
        for y in range(ny):
            for j in range(size):
                k, r = charge[LAGS + j, y], readout[LAGS + j, y]
                for lag in range(1, min(done + j, LAGS) + 1):
                    _add_product(lags[lag - 1, y], k, charge[LAGS + j - lag, y])
                    _add_product(lags[LAGS + lag - 1, y], r, readout[LAGS + j - lag, y])
                if done + j > 0:
                    _add_product(lags[2 * LAGS, y], r, charge[LAGS + j - 1, y])
                    _add_product(lags[2 * LAGS + 1, y], k, readout[LAGS + j - 1, y])
                if nx > 1:
                    _add_product(beside[0, y, :-1], k[:-1], k[1:])
                    _add_product(beside[1, y, :-1], r[:-1], r[1:])
                    _add_both(beside[2, y, :-1], r[:-1], k[:-1], r[1:], k[1:])
                if y > 0:
                    up_k, up_r = charge[LAGS + j, y - 1], readout[LAGS + j, y - 1]
                    _add_product(below[0, y - 1], up_k, k)
                    _add_product(below[1, y - 1], up_r, r)
                    _add_both(below[2, y - 1], up_r, up_k, r, k)
        done += size
        for j in range(LAGS):
            charge[j] = charge[size + j]
            readout[j] = readout[size + j]


@njit(nogil=True, cache=True)
def count_repeats(frames: NDArray[Any], consecutive: NDArray[np.bool_], repeated: NDArray[np.bool_]) -> int:
    """Mark frames equal to the one before, and return the number of such rows in the other frames.

    Args:
        frames: codes (frame, y, x).
        consecutive: whether a frame directly follows the one before it in the stack, (frame,).
        repeated: to fill, (frame,).
    """
    n, ny, nx = frames.shape
    found = 0
    for t in range(1, n):
        if not consecutive[t]:
            continue
        rows = 0
        for y in range(ny):
            x = 0
            while x < nx and frames[t, y, x] == frames[t - 1, y, x]:
                x += 1
            rows += x == nx
        if rows == ny:
            repeated[t] = True
        else:
            found += rows
    return found


@njit(nogil=True, cache=True)
def find_hits(frames: NDArray[Any], pixels: IntArray, last: IntArray, hits: IntArray) -> int:
    """Fill ``hits`` (frame, y, x, DN) with samples of pixels (m, 2) above ``last``; return how many."""
    found = 0
    for i in range(pixels.shape[0]):
        y, x = pixels[i]
        for t in range(frames.shape[0]):
            if np.int64(frames[t, y, x]) > last[i]:
                if found < hits.shape[0]:
                    hits[found, 0], hits[found, 1], hits[found, 2] = t, y, x
                    hits[found, 3] = np.int64(frames[t, y, x])
                found += 1
    return found
