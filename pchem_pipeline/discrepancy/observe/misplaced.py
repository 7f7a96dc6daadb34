"""Rows and columns of single frames whose samples belong to other pixels.

Lines that change places, come a sample early or late, or lose one on the way: every sample is then one of
another pixel, by whose histogram it is likely and by its own less so. A line's likelihood at another place
over that at its own tells, for every place, and the sum of what a small share of such lines gains is the
statistic. Lines put together of samples of different frames show what chance makes of it, whatever the
histograms are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.misplaced_numba import N_PLACES, STEPS, compare_rows, fill_ratios

FloatArray = NDArray[np.float64]

_MOST_SAMPLES = 1 << 19
_SHARE = 1e-3  # of the lines, for which the statistic is the best one
_CHANCE = 4.0  # variance of the sum where hardly a line is likely anywhere else: one or two of them
_CLEAR = 4.0  # standard deviations beyond which shares are looked for
_STEPS = 40
_FARTHEST = 60.0  # logarithm of a ratio: beyond it nothing changes


def misplaced_lines(
    frames: NDArray[np.unsignedinteger[Any]],
    counts: NDArray[Any],
    origin: NDArray[np.int64],
    usable: NDArray[np.bool_],
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return the statistics of misplaced rows and columns, and their shares by place.

    Args:
        frames: codes (frame, y, x), DN.
        counts: histograms of the pixels over all frames, (y * x, B).
        origin: DN of their bin 0, (y * x,).
        usable: pixels that count, (y, x).

    Returns:
        By ``space.misplaced.rows`` and ``.columns`` how many standard deviations lines are likelier elsewhere
        than chance makes them; by "rows" and "columns", where these stand out, the likeliest share of lines
        from each of :data:`~.evidence.PLACES`, the share by chance taken off, shape (6,).
    """
    z: dict[str, float] = {}
    shares: dict[str, FloatArray] = {}
    if min(usable.shape) < 2:
        return z, shares
    chosen = frames[:: max(1, -(-frames.size // _MOST_SAMPLES))]
    some = np.flatnonzero((counts > 0).any(axis=0))
    # one more on either side stands for all codes beyond
    real = np.pad(counts[:, some[0] : some[-1] + 1], ((0, 0), (1, 1))) + np.float32(0.5)
    logs = np.log(real / real.sum(axis=1, keepdims=True)).astype(np.float32).reshape(*usable.shape, -1)
    first = (origin + some[0] - 1).reshape(usable.shape)
    for axis, name in ((0, "rows"), (1, "columns")):
        own, begin, count = (np.ascontiguousarray(a.swapaxes(0, axis)) for a in (logs, first, usable))
        table = np.empty((*own.shape, len(STEPS)), np.float32)
        fill_ratios(own, begin, count, table)
        lines = np.ascontiguousarray(chosen.swapaxes(1, 1 + axis))
        strides = 0, max(1, len(lines) // lines.shape[2])
        gain, chance = (_compared(lines, begin, table, each, whole=False)[0] for each in strides)
        beyond = float((gain.sum() - chance.sum()) / np.sqrt(2.0 * (chance**2).sum() + _CHANCE))
        z[f"space.misplaced.{name}"] = beyond
        if beyond > _CLEAR:
            seen, mixed = (_shares(_compared(lines, begin, table, each, whole=True)[1]) for each in strides)
            shares[name] = np.maximum(seen - mixed, 0.0)
    return z, shares


def _compared(
    lines: NDArray[Any], first: NDArray[np.int64], table: NDArray[np.float32], stride: int, *, whole: bool
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return what a share of misplaced rows gains each, and likelihood ratios (frame, y, N_PLACES)."""
    ratios = np.empty((*lines.shape[:2], N_PLACES), np.float32)
    gains = np.empty(lines.shape[:2])
    compare_rows(lines, first, table, stride, _SHARE, whole, ratios, gains)
    return gains, ratios


def _shares(ratios: NDArray[np.float32]) -> FloatArray:
    """Return the likeliest shares of lines that come from each place, by expectation and maximisation."""
    likelihood = np.exp(np.minimum(ratios.reshape(-1, N_PLACES).astype(np.float64), _FARTHEST))
    share = np.full(N_PLACES, _SHARE)
    for _ in range(_STEPS):
        weighted = likelihood * share
        share = (weighted / (1.0 - share.sum() + weighted.sum(axis=1, keepdims=True))).mean(axis=0)
    return np.asarray(share)
