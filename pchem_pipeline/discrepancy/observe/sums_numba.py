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
    frames: NDArray[Any], channels: Channels, y: int, at: int, size: int, samples: Float32Array
) -> None:
    """Turn the codes of a row into k and r; codes beyond the support count as its ends."""
    support, tables = channels.support, channels.tables
    for j in range(size):
        for x in range(frames.shape[2]):
            first = support[y, 0, x]
            code = min(max(np.int32(frames[at + j, y, x]), first), support[y, 1, x])
            row = support[y, 2, x] + (code - first)
            samples[0, LAGS + j, y, x] = tables[row, 0]
            samples[1, LAGS + j, y, x] = tables[row, 1]


@kernel
def _sum_half(
    samples: Float32Array, weights: Float32Array, j: int, y: int, begin: int, end: int
) -> tuple[Any, Any, Any]:
    """Return the sums of k, r and r (w_0 k + w_1) over part of a row.

    In single precision: over a row that costs a millionth of the spread of the sum. Two sums at a time, since
    each addition waits for the one before.
    """
    k0 = k1 = r0 = r1 = g0 = g1 = np.float32(0.0)
    x = begin
    while x < end - 1:
        k, r = samples[0, j, y, x], samples[1, j, y, x]
        k0 += k
        r0 += r
        g0 += r * (weights[0, y, x] * k + weights[1, y, x])
        k, r = samples[0, j, y, x + 1], samples[1, j, y, x + 1]
        k1 += k
        r1 += r
        g1 += r * (weights[0, y, x + 1] * k + weights[1, y, x + 1])
        x += 2
    if x < end:
        k, r = samples[0, j, y, x], samples[1, j, y, x]
        k0 += k
        r0 += r
        g0 += r * (weights[0, y, x] * k + weights[1, y, x])
    return k0 + k1, r0 + r1, g0 + g1


@kernel
def _sum_lines(
    samples: Float32Array,
    weights: Float32Array,
    y: int,
    at: int,
    size: int,
    block: FloatArray,
    sums: FrameSums,
) -> None:
    """Add a row of a chunk to the sums of rows and columns, frame by frame, and of pixels."""
    half, nx = samples.shape[3] // 2, samples.shape[3]
    for j in range(size):
        t = at + j
        left = _sum_half(samples, weights, LAGS + j, y, 0, half)
        right = _sum_half(samples, weights, LAGS + j, y, half, nx)
        for channel in range(2):
            sums.rows[2 * channel, t, y], sums.rows[2 * channel + 1, t, y] = left[channel], right[channel]
        sums.gain[t] += left[2] + right[2]
    for channel in range(2):
        for j in range(size):
            for x in range(nx):
                sums.columns[channel, at + j, x] += samples[channel, LAGS + j, y, x]
        for j in range(size):
            for x in range(nx):
                block[channel, y, x] += samples[channel, LAGS + j, y, x]
    for j in range(size):
        total = np.float32(0.0)
        for x in range(nx):
            square = weights[2, y, x] * samples[1, LAGS + j, y, x] * samples[1, LAGS + j, y, x]
            sums.column_noise[at + j, x] += square
            total += square
        sums.row_noise[at + j, y] = total


@kernel
def _subtract_modes(samples: Float32Array, channels: Channels, rows: FloatArray, t: int, j: int) -> None:
    """Subtract from a frame what is common to all pixels, by the sums of its half rows."""
    for channel in range(2):
        common = 0.0
        for y in range(samples.shape[2]):
            common += rows[2 * channel, t, y] + rows[2 * channel + 1, t, y]
        amount = np.float32(common / channels.norms[channel])
        for y in range(samples.shape[2]):
            for x in range(samples.shape[3]):
                samples[channel, j, y, x] -= amount * channels.modes[channel, y, x]


@kernel
def _add_lagged(
    samples: Float32Array, now: int, before: int, lag: int, y: int, done: int, size: int, total: FloatArray
) -> None:
    """Add products of frames ``lag`` apart; those before the block's first frame do not exist."""
    for j in range(max(0, lag - done), size):
        for x in range(samples.shape[3]):
            total[y, x] += samples[now, LAGS + j, y, x] * samples[before, LAGS + j - lag, y, x]


@kernel
def _add_neighbours(samples: Float32Array, y: int, dy: int, dx: int, size: int, total: FloatArray) -> None:
    """Add the products kk, rr, r k + k r of a row with the pixels ``dy`` rows and ``dx`` columns on."""
    for j in range(LAGS, LAGS + size):
        for channel in range(2):
            for x in range(samples.shape[3] - dx):
                total[channel, y, x] += samples[channel, j, y, x] * samples[channel, j, y + dy, x + dx]
        for x in range(samples.shape[3] - dx):
            one = samples[1, j, y, x] * samples[0, j, y + dy, x + dx]
            total[2, y, x] += one + samples[0, j, y, x] * samples[1, j, y + dy, x + dx]


@kernel
def _keep_last(samples: Float32Array, size: int) -> None:
    """Move the last frames of a chunk to where the next chunk looks for those before it."""
    for channel in range(2):
        for j in range(LAGS):
            for y in range(samples.shape[2]):
                for x in range(samples.shape[3]):
                    samples[channel, j, y, x] = samples[channel, size + j, y, x]


@kernel
def sum_block(
    frames: NDArray[Any],
    block: tuple[int, int, int],
    channels: Channels,
    samples: Float32Array,
    sums: FrameSums,
) -> None:
    """Add one block of consecutive frames to the sums.

    Args:
        frames: codes (frame, y, x).
        block: its number, its first frame, and the one behind its last.
        channels: of the pixels.
        samples: workspace for k and r, (2, LAGS + frames in a chunk, y, x).
        sums: to add to.
    """
    number, begin, end = block
    ny = frames.shape[1]
    chunk = samples.shape[1] - LAGS
    at = begin
    while at < end:
        size, done = min(chunk, end - at), at - begin
        for y in range(ny):
            _look_up(frames, channels, y, at, size, samples)
            _sum_lines(samples, channels.weights, y, at, size, sums.blocks[number], sums)
        for j in range(size):
            _subtract_modes(samples, channels, sums.rows, at + j, LAGS + j)
        for y in range(ny):
            for lag in range(1, LAGS + 1):
                for channel in range(2):
                    of_lag = sums.lags[LAGS * channel + lag - 1]
                    _add_lagged(samples, channel, channel, lag, y, done, size, of_lag)
            for channel in range(2):
                _add_lagged(samples, 1 - channel, channel, 1, y, done, size, sums.lags[2 * LAGS + channel])
            _add_neighbours(samples, y, 0, 1, size, sums.next_column)
            if y < ny - 1:
                _add_neighbours(samples, y, 1, 0, size, sums.next_row)
        at += size
        _keep_last(samples, size)
