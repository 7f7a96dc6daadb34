"""Loops of :mod:`pchem_pipeline.model.histogram.summaries`.

Exact integer sums; each inner loop over x touches few arrays, so that the compiler makes vector
instructions of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

_Array = NDArray[Any]


@kernel
def sum_lines(
    frames: _Array, group: int, row_sum: _Array, row_sum_square: _Array, column_sum: _Array
) -> None:
    """Sum each frame along its rows, (frame, y), and its columns by groups of rows, (frame, row_group, x)."""
    n_frames, ny, nx = frames.shape
    for t in range(n_frames):
        for y in range(ny):
            row, columns = frames[t, y], column_sum[t, y // group]
            total, squares = np.uint64(0), np.uint64(0)
            for x in range(nx):
                total += row[x]
                squares += np.uint32(row[x]) * np.uint32(row[x])
            row_sum[t, y] = total
            row_sum_square[t, y] = squares
            for x in range(nx):
                columns[x] += row[x]


@kernel
def add_products(
    frames: _Array, before: _Array, reference: _Array, group: int, chosen: _Array, work: _Array, sums: _Array
) -> None:
    """Add sums and products of ``d = DN - reference`` over the frames to the sums of a time block.

    Args:
        frames: (frame, y, x), all of one time block.
        before: the frame before them in the block, (y, x); the reference itself if there is none.
        reference: DN that is taken off each pixel, (y, x).
        group: rows in a group; products with the next row do not cross its border.
        chosen: rows to do, (y,).
        work: scratch, (7, x + 1), of the type that is wide enough for the sums over these frames.
        sums: updated, (5, y, x): d, d^2, d times the d of the frame before, of x + 1, of y + 1.
    """
    n_frames, ny, nx = frames.shape
    plain, square, lag, right, down = work[0], work[1], work[2], work[3], work[4]
    for y in range(ny):
        if not chosen[y]:
            continue
        work[:] = 0
        now, last = work[5], work[6]
        row_reference = reference[y]
        has_next = y + 1 < ny and (y + 1) % group != 0
        for x in range(nx):
            last[x] = np.int64(before[y, x]) - row_reference[x]
        for t in range(n_frames):
            row = frames[t, y]
            for x in range(nx):
                now[x] = np.int64(row[x]) - row_reference[x]
            for x in range(nx):
                plain[x] += now[x]
            for x in range(nx):
                square[x] += now[x] * now[x]
            for x in range(nx):
                lag[x] += now[x] * last[x]
            for x in range(nx):
                right[x] += now[x] * now[x + 1]
            if has_next:
                next_row, next_reference = frames[t, y + 1], reference[y + 1]
                for x in range(nx):
                    down[x] += now[x] * (np.int64(next_row[x]) - next_reference[x])
            now, last = last, now
        for i in range(5):
            for x in range(nx):
                sums[i, y, x] += work[i, x]
