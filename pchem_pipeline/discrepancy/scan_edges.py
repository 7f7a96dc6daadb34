"""The edges of a place whose pixels share noise, line by line.

The scan of :mod:`.scan_pairs` knows boxes of cells, each of several rows or columns of a large sensor. How
much a single line shares with the inside of a box is told by far more samples than where a box of many is
best: a line near an edge belongs to it where it shares half as much as those inside.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.pairs import Samples

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

#: Standard errors of a line's share that the share of the lines inside must exceed; where pairs count twice,
#: so much over the square root of two.
_CERTAIN = 6.0
_HALF = 0.5


class Side(NamedTuple):
    """A box of cells along one axis.

    Attributes:
        first, last: line that it begins with, and behind its last one.
        low, high: the same with the cells beside it.
        inner: the same without the cells at its ends, where it has others.
        sure: whether it has, so that all of these lines are inside.
    """

    first: int
    last: int
    low: int
    high: int
    inner: tuple[int, int]
    sure: bool

    @classmethod
    def of(cls, edges: IntArray, cells: tuple[int, int]) -> Side:
        """Return that of cells from one to before another, given the edges of all."""
        a, b = cells
        low, high = int(edges[max(a - 1, 0)]), int(edges[min(b + 1, edges.size - 1)])
        first, last = int(edges[a]), int(edges[b])
        inner = (int(edges[a + 1]), int(edges[b - 1])) if b - a > 2 else (first, last)
        # what ends with the sensor has its end there
        inner = first if a == 0 else inner[0], last if b == edges.size - 1 else inner[1]
        return cls(first, last, low, high, inner, b - a > 2)

    @property
    def exact(self) -> bool:
        """Whether the cells beside it are single lines, of which the scan knows as much."""
        return self.first - self.low <= 1 and self.high - self.last <= 1


def sharpened(
    samples: Samples, channel: int, mode: str, lines: Side, across: Side
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first line of a box and the one behind its last, and the same across the lines.

    Where too little is known of single lines, the ends stay.

    Args:
        samples: standardised frames.
        channel: 0 for electron numbers, 1 for residuals.
        mode: what pixels share: "row", "column", "frame".
        lines: rows of the box, for "column" its columns.
        across: the other axis.
    """
    turned = mode == "column"
    rows, columns = (across, lines) if turned else (lines, across)
    box = slice(rows.low, rows.high), slice(columns.low, columns.high)
    sums: list[Any] = [0.0, 0.0]
    for (u,) in samples.chunks((channel,), *box):
        values = u.transpose(0, 2, 1) if turned else u
        sums = [a + b for a, b in zip(sums, _products(values, mode, lines, across), strict=True)]
    mask = samples.usable[box].astype(np.float32)[None]
    pairs = _products(mask.transpose(0, 2, 1) if turned else mask, mode, lines, across)
    found = (
        _ends(side, total, samples.n_frames * number)
        for side, total, number in zip((lines, across), sums, pairs, strict=True)
    )
    first, second = found
    return first, second


def _products(u: NDArray[np.float32], mode: str, lines: Side, across: Side) -> list[FloatArray]:
    """Return how much each line, and each across, shares with the inside: sums of products of pairs.

    Args:
        u: (frame, line, across), of the box and the cells beside it.
        mode: "frame", or any other for what pixels share in a line.
        lines: of the box.
        across: of the box, likewise.
    """
    of_lines, of_across = (_within(side, (side.first, side.last)) for side in (lines, across))
    if mode == "frame":
        return [
            _with_inner(u[:, :, of_across].sum(axis=2, dtype=np.float64), lines),
            _with_inner(u[:, of_lines].sum(axis=1, dtype=np.float64), across),
        ]
    band, rows = u[:, :, of_across], u[:, of_lines]
    own = band.sum(axis=2, dtype=np.float64) ** 2 - np.einsum("tyx,tyx->ty", band, band, dtype=np.float64)
    return [own.sum(axis=0), _with_inner(rows.reshape(-1, rows.shape[2]).astype(np.float64), across)]


def _within(side: Side, span: tuple[int, int]) -> slice:
    """Return lines of the sensor as those of the box and the cells beside it."""
    return slice(span[0] - side.low, span[1] - side.low)


def _with_inner(values: FloatArray, side: Side) -> FloatArray:
    """Return sums over the products of each line with the others inside, of values (n, line)."""
    inner = np.zeros(values.shape[1], np.bool_)
    inner[_within(side, side.inner)] = True
    together = values[:, inner].sum(axis=1)
    return np.asarray(together @ values - inner * np.einsum("nl,nl->l", values, values))


def _ends(side: Side, sums: FloatArray, pairs: FloatArray) -> tuple[int, int]:
    """Return the first of the lines that share as much as those inside, and the one behind the last."""
    inner = _within(side, side.inner)
    total, number = float(sums[inner].sum()), float(pairs[inner].sum())
    known = pairs > 0
    share = np.where(known, sums / np.where(known, pairs, 1.0), 0.0)
    inside = total / max(number, 1.0)
    if side.exact or not known.any() or inside < _CERTAIN / float(np.median(pairs[known])) ** 0.5:
        return side.first, side.last
    apart = np.flatnonzero(known & (share <= _HALF * inside))
    most = inner.start + int(np.argmax(share[inner]))
    begin, end = (inner.start, inner.stop) if side.sure else (most, most + 1)
    first = int(max(apart[apart < begin], default=-1)) + 1
    last = int(min(apart[apart >= end], default=known.size))
    # of lines without samples nothing is known
    those = first + np.flatnonzero(known[first:last])
    return int(those[0]) + side.low, int(those[-1]) + 1 + side.low
