"""Loops of :mod:`.misplaced`: likelihood ratios of rows at other places."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel

#: Rows and columns from a pixel to that whose samples it may hold: the next line, that before, early, late.
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
#: Places that rows are compared with: wholly at those, and early or late from some sample on.
N_PLACES = 6


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
