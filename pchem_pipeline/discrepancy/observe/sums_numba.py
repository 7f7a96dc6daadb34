"""Loops of :mod:`pchem_pipeline.discrepancy.observe.sums`: one pass over the frames of a split.

The frames go through in chunks that stay in the cache. Every sample becomes (k, r) by its pixel's table; the
common mode of each frame is subtracted before products of different pixels or frames are summed. The inner
loops run over x with one sum each, over whole arrays by index, so that the compiler can use vector
instructions; views of the rows would cost more than the work on a short row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Float32Array = NDArray[np.float32]

LAGS = 3


class Channels(NamedTuple):
    """How samples become k and r, and how these are weighted.

    Attributes:
        support: first code, last code, row of the first one in ``tables``, (y, 3, x).
        tables: k and r, (rows, 2).
        modes: H, and 1, in usable pixels, else 0, (2, y, x).
        weights: of r k and of r in the gain, and of r^2 in the noise, (3, y, x).
        norms: sum of H, number of usable pixels.
    """

    support: NDArray[np.int32]
    tables: Float32Array
    modes: Float32Array
    weights: Float32Array
    norms: FloatArray


class FrameSums(NamedTuple):
    """Sums over a split of n frames in b blocks; as the loops leave them, and in brackets as they are used.

    Attributes:
        rows: k of the left and the right half, r of the left and the right half of each row, (4, n, y).
        columns: k and r of each column, (2, n, x).
        gain: weighted sums of r k and r of each frame (relative deviation of the gain), (n,).
        blocks: sums of k and r in each block, (b, 2, y, x).
        lags: products (their means) after removal of the frames' common modes: kk and rr at lags 1, 2, 3,
            then r with the k before, k with the r before, (8, y, x).
        row_noise: weighted sums of r^2 of each row (less their means), (n, y).
        column_noise: the same of each column, (n, x).
        next_column, next_row: products (their means) kk, rr, rk + kr with the next column or row, (3, y, x).
    """

    rows: FloatArray
    columns: Float32Array
    gain: FloatArray
    blocks: FloatArray
    lags: FloatArray
    row_noise: FloatArray
    column_noise: NDArray[Any]
    next_column: FloatArray
    next_row: FloatArray


@kernel
def _look_up(
    frames: NDArray[Any],
    support: NDArray[np.int32],
    tables: Float32Array,
    y: int,
    at: int,
    size: int,
    charge: Float32Array,
    readout: Float32Array,
) -> None:
    """Turn the codes of a row into k and r; codes beyond the support count as its ends."""
    for j in range(size):
        for x in range(frames.shape[2]):
            first = support[y, 0, x]
            code = min(max(np.int32(frames[at + j, y, x]), first), support[y, 1, x])
            row = support[y, 2, x] + (code - first)
            charge[LAGS + j, y, x] = tables[row, 0]
            readout[LAGS + j, y, x] = tables[row, 1]


@kernel
def _sum_half(
    charge: Float32Array, readout: Float32Array, weights: Float32Array, j: int, y: int, begin: int, end: int
) -> tuple[Any, Any, Any]:
    """Return the sums of k, r and r (w_0 k + w_1) over part of a row.

    In single precision: over a row that costs a millionth of the spread of the sum. Two sums at a time, since
    each addition waits for the one before.
    """
    k0 = k1 = r0 = r1 = g0 = g1 = np.float32(0.0)
    x = begin
    while x < end - 1:
        k, r = charge[j, y, x], readout[j, y, x]
        k0 += k
        r0 += r
        g0 += r * (weights[0, y, x] * k + weights[1, y, x])
        k, r = charge[j, y, x + 1], readout[j, y, x + 1]
        k1 += k
        r1 += r
        g1 += r * (weights[0, y, x + 1] * k + weights[1, y, x + 1])
        x += 2
    if x < end:
        k, r = charge[j, y, x], readout[j, y, x]
        k0 += k
        r0 += r
        g0 += r * (weights[0, y, x] * k + weights[1, y, x])
    return k0 + k1, r0 + r1, g0 + g1


@kernel
def _sum_rows(
    charge: Float32Array,
    readout: Float32Array,
    weights: Float32Array,
    y: int,
    at: int,
    size: int,
    rows: FloatArray,
    gain: FloatArray,
) -> None:
    half, nx = charge.shape[2] // 2, charge.shape[2]
    for j in range(size):
        t = at + j
        left = _sum_half(charge, readout, weights, LAGS + j, y, 0, half)
        right = _sum_half(charge, readout, weights, LAGS + j, y, half, nx)
        rows[0, t, y], rows[1, t, y] = left[0], right[0]
        rows[2, t, y], rows[3, t, y] = left[1], right[1]
        gain[t] += left[2] + right[2]


@kernel
def _add(
    values: Float32Array,
    channel: int,
    y: int,
    at: int,
    size: int,
    columns: Float32Array,
    block: FloatArray,
) -> None:
    """Add the rows of a chunk to the sums of columns, frame by frame, and of pixels."""
    for j in range(size):
        for x in range(values.shape[2]):
            columns[channel, at + j, x] += values[LAGS + j, y, x]
    for j in range(size):
        for x in range(values.shape[2]):
            block[channel, y, x] += values[LAGS + j, y, x]


@kernel
def _subtract(values: Float32Array, pattern: Float32Array, amount: np.float32, j: int) -> None:
    for y in range(pattern.shape[0]):
        for x in range(pattern.shape[1]):
            values[j, y, x] -= amount * pattern[y, x]


@kernel
def _add_lagged(
    now: Float32Array,
    before: Float32Array,
    lag: int,
    y: int,
    done: int,
    size: int,
    which: int,
    total: FloatArray,
) -> None:
    """Add products of frames ``lag`` apart; those before the block's first frame do not exist."""
    for j in range(max(0, lag - done), size):
        for x in range(now.shape[2]):
            total[which, y, x] += now[LAGS + j, y, x] * before[LAGS + j - lag, y, x]


@kernel
def _add_squares(
    readout: Float32Array,
    weight: Float32Array,
    y: int,
    at: int,
    size: int,
    rows: FloatArray,
    columns: Float32Array,
) -> None:
    """Add the weighted squares of a row of a chunk to the sums of rows and columns, frame by frame."""
    for j in range(size):
        total = np.float32(0.0)
        for x in range(readout.shape[2]):
            square = weight[y, x] * readout[LAGS + j, y, x] * readout[LAGS + j, y, x]
            columns[at + j, x] += square
            total += square
        rows[at + j, y] = total


@kernel
def _add_neighbours(
    charge: Float32Array, readout: Float32Array, y: int, dy: int, dx: int, size: int, total: FloatArray
) -> None:
    """Add the products kk, rr, r k + k r of a row with the pixels ``dy`` rows and ``dx`` columns on."""
    for j in range(LAGS, LAGS + size):
        for x in range(charge.shape[2] - dx):
            total[0, y, x] += charge[j, y, x] * charge[j, y + dy, x + dx]
        for x in range(charge.shape[2] - dx):
            total[1, y, x] += readout[j, y, x] * readout[j, y + dy, x + dx]
        for x in range(charge.shape[2] - dx):
            one = readout[j, y, x] * charge[j, y + dy, x + dx]
            total[2, y, x] += one + charge[j, y, x] * readout[j, y + dy, x + dx]


@kernel
def _keep_last(values: Float32Array, size: int) -> None:
    """Move the last frames of a chunk to where the next chunk looks for those before it."""
    for j in range(LAGS):
        for y in range(values.shape[1]):
            for x in range(values.shape[2]):
                values[j, y, x] = values[size + j, y, x]


@kernel
def sum_block(
    frames: NDArray[Any],
    block: tuple[int, int, int],
    channels: Channels,
    charge: Float32Array,
    readout: Float32Array,
    sums: FrameSums,
) -> None:
    """Add one block of consecutive frames to the sums.

    Args:
        frames: codes (frame, y, x).
        block: its number, its first frame, and the one behind its last.
        channels: of the pixels.
        charge: workspace (LAGS + frames in a chunk, y, x).
        readout: the same.
        sums: to add to.
    """
    number, begin, end = block
    ny = frames.shape[1]
    chunk = charge.shape[0] - LAGS
    at = begin
    while at < end:
        size, done = min(chunk, end - at), at - begin
        for y in range(ny):
            _look_up(frames, channels.support, channels.tables, y, at, size, charge, readout)
            _sum_rows(charge, readout, channels.weights, y, at, size, sums.rows, sums.gain)
            _add(charge, 0, y, at, size, sums.columns, sums.blocks[number])
            _add(readout, 1, y, at, size, sums.columns, sums.blocks[number])
            _add_squares(readout, channels.weights[2], y, at, size, sums.row_noise, sums.column_noise)
        for j in range(size):
            common_k = common_r = 0.0
            for y in range(ny):
                common_k += sums.rows[0, at + j, y] + sums.rows[1, at + j, y]
                common_r += sums.rows[2, at + j, y] + sums.rows[3, at + j, y]
            _subtract(charge, channels.modes[0], np.float32(common_k / channels.norms[0]), LAGS + j)
            _subtract(readout, channels.modes[1], np.float32(common_r / channels.norms[1]), LAGS + j)
        for y in range(ny):
            for lag in range(1, LAGS + 1):
                _add_lagged(charge, charge, lag, y, done, size, lag - 1, sums.lags)
                _add_lagged(readout, readout, lag, y, done, size, LAGS + lag - 1, sums.lags)
            _add_lagged(readout, charge, 1, y, done, size, 2 * LAGS, sums.lags)
            _add_lagged(charge, readout, 1, y, done, size, 2 * LAGS + 1, sums.lags)
            _add_neighbours(charge, readout, y, 0, 1, size, sums.next_column)
            if y < ny - 1:
                _add_neighbours(charge, readout, y, 1, 0, size, sums.next_row)
        at += size
        _keep_last(charge, size)
        _keep_last(readout, size)


@kernel
def find_hits(frames: NDArray[Any], pixels: IntArray, ends: IntArray, hits: IntArray) -> int:
    """Fill ``hits`` (frame, y, x, DN) with samples of m pixels beyond ``ends``, (m, 2); return how many."""
    found = 0
    for i in range(pixels.shape[0]):
        y, x = pixels[i]
        for t in range(frames.shape[0]):
            code = np.int64(frames[t, y, x])
            if code < ends[i, 0] or code > ends[i, 1]:
                if found < hits.shape[0]:
                    hits[found, 0], hits[found, 1], hits[found, 2] = t, y, x
                    hits[found, 3] = code
                found += 1
    return found
