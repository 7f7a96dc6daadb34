"""Squares of four samples that are all equal: more than chance makes of the pixels' histograms.

Compression with losses, binning that is undone and repeated pixels make them; nothing analog does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws

FloatArray = NDArray[np.float64]
_MOST_CODES = 1 << 26  # of all pixels together


def equal_squares(frames: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.int64]:
    """Return how often all samples of 2 x 2 pixels of frames (frame, y, x) are equal, (y-1, x-1).

    Those at the highest DN of all do not count: a particle's cloud leaves all of its pixels at the limit.
    """
    top = frames.max(initial=0)
    found = np.zeros((max(frames.shape[1] - 1, 0), max(frames.shape[2] - 1, 0)), np.int64)
    for frame in frames:
        rows = frame[1:] == frame[:-1]
        equal = rows[:, 1:] & rows[:, :-1] & (frame[1:, 1:] == frame[1:, :-1])
        found += equal & (frame[1:, 1:] != top)
    return found


def square_statistics(
    found: NDArray[np.int64],
    counts: NDArray[Any],
    origin: NDArray[np.int64],
    usable: NDArray[np.bool_],
    top: int,
) -> dict[str, float]:
    """Return the statistic of squares of equal samples; none without squares of usable pixels.

    Given the histograms, frames without an effect are in random order.

    Args:
        found: how often the samples of each square are equal, (y-1, x-1).
        counts: histograms, (n, B).
        origin: DN of bin 0, (n,).
        usable: pixels that count, (y, x).
        top: the highest DN of all, which does not count.
    """
    good = usable[1:, 1:] & usable[1:, :-1] & usable[:-1, 1:] & usable[:-1, :-1]
    first = int(origin[usable.ravel()].min(initial=origin.max(initial=0)))
    length = int(np.where(usable.ravel(), origin, first).max(initial=first)) - first + counts.shape[1]
    if not good.any() or length * usable.size > _MOST_CODES:
        return {}
    aligned = np.zeros((usable.size, length), np.float32)
    inside = np.flatnonzero(usable)
    columns = (origin[inside] - first)[:, None] + np.arange(counts.shape[1])
    total = np.maximum(counts[inside].sum(axis=1, keepdims=True), 1)
    aligned[inside[:, None], columns] = counts[inside] / total
    aligned[:, top - first : top - first + 1] = 0.0
    chance = aligned.reshape(*usable.shape, length)
    down = chance[1:] * chance[:-1]
    alike = np.einsum("yxc,yxc->yx", down[:, 1:], down[:, :-1])
    expected = float(alike[good].sum()) * float(counts[inside].sum(axis=1).max())
    return {"space.equal.squares": laws.poisson(int(found[good].sum()), expected)}
