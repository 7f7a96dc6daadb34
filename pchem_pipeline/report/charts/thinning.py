"""Fewer numbers that look the same, of what is longer than a screen is wide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pchem_pipeline.report.charts.chart import Points, Values


def thinned(x: Values, y: Values, columns: int) -> tuple[Values, Values]:
    """Return a curve with the least and the largest value of each of so many columns of the axis.

    It looks the same where it is drawn that wide or narrower; curves of up to two points a column are
    returned as they are, also those that do not go from left to right. Gaps (NaN) that fill a column stay.

    Args:
        x: places, (n,).
        y: values, (n,).
        columns: number of them.
    """
    if x.size <= 2 * columns or np.any(np.diff(x) < 0):
        return x, y
    starts = np.unique(np.linspace(0, x.size, columns + 1).astype(np.int64)[:-1])
    ends = np.append(starts[1:], x.size)
    known = np.isfinite(y)
    lowest = np.minimum.reduceat(np.where(known, y, np.inf), starts)
    highest = np.maximum.reduceat(np.where(known, y, -np.inf), starts)
    both = np.stack([lowest, highest], axis=1)
    both[~np.isfinite(both)] = np.nan
    places = np.stack([x[starts], x[ends - 1]], axis=1)
    return places.ravel(), both.ravel()


def fewer_steps(edges: Values, values: Values, most: int) -> tuple[Values, Values]:
    """Return a histogram of at most so many steps: the largest of neighbours where there are more."""
    together = -(-values.size // most) if values.size else 1
    if together <= 1:
        return edges, values
    starts = np.arange(0, values.size, together)
    return np.append(edges[starts], edges[-1]), np.fmax.reduceat(values, starts)


def some_points(mark: Points, most: int) -> Points:
    """Return points of which there are no more than so many: every k-th, and the lowest and the highest."""
    if mark.y.size <= most:
        return mark
    chosen = {*range(0, mark.y.size, -(-2 * mark.y.size // most))}
    for block in np.array_split(np.arange(mark.y.size), most // 4):
        known = block[np.isfinite(mark.y[block])]
        if known.size:
            chosen |= {int(known[np.argmin(mark.y[known])]), int(known[np.argmax(mark.y[known])])}
    kept = np.sort(np.fromiter(chosen, dtype=np.int64))
    error = None if mark.error is None else mark.error[:, kept]
    return replace(mark, x=mark.x[kept], y=mark.y[kept], error=error)
