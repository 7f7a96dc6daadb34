"""Loops of :mod:`pchem_pipeline.model.histogram.count` and of :mod:`.summaries`: exact integer sums.

``frames`` is always (frame, y, x) of an unsigned type. The inner loops run over x, so that the compiler can
use vector instructions, and the histograms of one row stay in the cache while all frames pass.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

_Array = NDArray[Any]


@kernel
def update_range(frames: _Array, low: _Array, high: _Array) -> None:
    """Lower ``low`` and raise ``high`` (y, x) to the smallest and largest DN of each pixel."""
    n_frames, ny, nx = frames.shape
    for t in range(n_frames):
        for y in range(ny):
            row, row_low, row_high = frames[t, y], low[y], high[y]
            for x in range(nx):
                row_low[x] = min(row_low[x], row[x])
            for x in range(nx):
                row_high[x] = max(row_high[x], row[x])


@kernel
def update_extremes(frames: _Array, low: _Array, high: _Array) -> None:
    """Update the smallest and largest DN of each pixel, (depth, y, x), sorted, the most extreme first."""
    n_frames, ny, nx = frames.shape
    moved = np.empty(nx, frames.dtype)
    for t in range(n_frames):
        for y in range(ny):
            row = frames[t, y]
            for x in range(nx):
                moved[x] = row[x]
            for j in range(low.shape[0]):
                kept = low[j, y]
                for x in range(nx):
                    smaller, larger = min(kept[x], moved[x]), max(kept[x], moved[x])
                    kept[x] = smaller
                    moved[x] = larger
            for x in range(nx):
                moved[x] = row[x]
            for j in range(high.shape[0]):
                kept = high[j, y]
                for x in range(nx):
                    smaller, larger = min(kept[x], moved[x]), max(kept[x], moved[x])
                    kept[x] = larger
                    moved[x] = smaller


@kernel
def count_frames(frames: _Array, origin: _Array, counts: _Array, under: _Array, over: _Array) -> None:
    """Add frames to ``counts`` (y, x, bin), or to ``under`` or ``over`` if they lie outside of the window."""
    n_frames, ny, nx = frames.shape
    bins = np.uint32(counts.shape[2])
    for y in range(ny):
        row_counts, row_origin = counts[y], origin[y]
        for t in range(n_frames):
            row = frames[t, y]
            for x in range(nx):
                # a DN below the origin wraps round to a huge number: one comparison serves both ends
                k = np.uint32(row[x] - row_origin[x])
                if k < bins:
                    row_counts[x, k] += 1
                elif row[x] < row_origin[x]:
                    under[y, x] += 1
                else:
                    over[y, x] += 1


@kernel
def shift_counts(counts: _Array, shift: int) -> None:
    """Move the counts of one pixel (bin,) down by ``shift`` bins (up if negative); what falls off is zero."""
    bins = counts.shape[0]
    if shift > 0:
        for k in range(bins - shift):
            counts[k] = counts[k + shift]
        for k in range(max(0, bins - shift), bins):
            counts[k] = 0
    elif shift < 0:
        for k in range(bins - 1, -shift - 1, -1):
            counts[k] = counts[k + shift]
        for k in range(min(bins, -shift)):
            counts[k] = 0


@kernel
def _centred(low: int, high: int, bins: int) -> int:
    """Return the origin of the window of ``bins`` DN with ``low..high`` in its middle; not below 0."""
    return max(0, low - (bins - (high - low + 1)) // 2)


@kernel
def _sort(values: _Array) -> None:
    """Sort values in place, by Shell's method: numpy's sort takes a second to compile."""
    gap = 1
    while gap < values.size // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, values.size):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 3


@kernel
def densest_origin(values: _Array, bins: int) -> int:
    """Return the origin of a window of ``bins`` DN that holds most of the values, these in its middle."""
    ordered = np.empty(values.size, values.dtype)
    for i in range(values.size):
        ordered[i] = values[i]
    _sort(ordered)
    best, best_start, best_end = 0, 0, 0
    end = 0
    for start in range(ordered.size):
        while end < ordered.size and np.int64(ordered[end]) - np.int64(ordered[start]) < bins:
            end += 1
        if end - start > best:
            best, best_start, best_end = end - start, start, end
    origin: int = _centred(np.int64(ordered[best_start]), np.int64(ordered[best_end - 1]), bins)
    return origin


@kernel
def place_windows(
    frames: _Array,
    low: _Array,
    high: _Array,
    minimum: _Array,
    maximum: _Array,
    counts: _Array,
    origin: _Array,
    fixed: _Array,
    first: bool,
) -> None:
    """Put each pixel's window where it holds these frames and all before, before they are counted.

    A pixel whose range outgrows the window is ``fixed`` for good: its window stays in the middle of the range
    seen before the frame that was too much, or, on the first call, where it holds most of the frames.

    Args:
        frames: frames that come next, (frame, y, x).
        low: their smallest DN, (y, x).
        high: their largest DN, (y, x).
        minimum: smallest DN of all frames before, (y, x); updated.
        maximum: largest DN of all frames before, (y, x); updated.
        counts: histograms of all frames before, (y, x, bin); shifted with the window.
        origin: DN of bin 0, (y, x); updated.
        fixed: whether the window may no longer move, (y, x); updated.
        first: there were no frames before.
    """
    _, ny, nx = frames.shape
    bins = counts.shape[2]
    for y in range(ny):
        for x in range(nx):
            a, b = np.int64(minimum[y, x]), np.int64(maximum[y, x])
            new_a, new_b = min(a, np.int64(low[y, x])), max(b, np.int64(high[y, x]))
            minimum[y, x], maximum[y, x] = new_a, new_b
            start = np.int64(origin[y, x])
            if fixed[y, x] or (not first and start <= new_a and new_b < start + bins):
                continue
            if new_b - new_a < bins:
                target = _centred(new_a, new_b, bins)
            elif first:
                fixed[y, x] = True
                target = densest_origin(frames[:, y, x], bins)
            else:
                fixed[y, x] = True
                for t in range(frames.shape[0]):
                    value = np.int64(frames[t, y, x])
                    if max(b, value) - min(a, value) >= bins:
                        break
                    a, b = min(a, value), max(b, value)
                target = _centred(a, b, bins)
            if not first:
                shift_counts(counts[y, x], target - start)
            origin[y, x] = target


@kernel
def recentre(counts: _Array, origin: _Array, minimum: _Array, maximum: _Array, fixed: _Array) -> None:
    """Centre the windows of all pixels that fit, so that they do not depend on the way that led there."""
    ny, nx, bins = counts.shape
    for y in range(ny):
        for x in range(nx):
            if not fixed[y, x]:
                target = _centred(np.int64(minimum[y, x]), np.int64(maximum[y, x]), bins)
                shift_counts(counts[y, x], target - np.int64(origin[y, x]))
                origin[y, x] = target


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
