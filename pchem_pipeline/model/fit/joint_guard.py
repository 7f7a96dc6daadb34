"""The tail guard of the joint fit: samples that no exposure of the pixel expects leave its likelihood."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.fit.start import kernel_counts

__all__ = ["guarded", "without_extremes"]

_TAIL = 0.02  # share of the frames beyond either end of the core
_REACH = 12.0  # standard deviations of the core: nothing of the pixel lies beyond, whatever its law
_CORE = 4.1  # standard deviations between the ends of the core of a normal law
_NO_ELECTRONS = 1e-9  # e-: H of a sample without electrons


def without_extremes(counts: Sequence[NDArray[np.integer]]) -> list[NDArray[np.integer]]:
    """Return the histograms without what lies far beyond their core, for a first fit.

    Args:
        counts: histograms of each sample, shape (n, B_j) each.
    """
    return [_without_extremes(kernel_counts(sample)) for sample in counts]


def _without_extremes(counts: NDArray[np.integer]) -> NDArray[np.integer]:
    total = counts.sum(axis=1, keepdims=True, dtype=np.float64)
    below = np.cumsum(counts, axis=1, dtype=np.float64)
    low = (below <= _TAIL * total).sum(axis=1)
    high = (below < (1.0 - _TAIL) * total).sum(axis=1)
    reach = np.maximum(_REACH * (high - low) / _CORE, _REACH)
    place = np.arange(counts.shape[1])
    outside = (place < (low - reach)[:, None]) | (place > (high + reach)[:, None])
    if not (outside & (counts > 0)).any():
        return counts
    return np.where(outside, 0, counts).astype(counts.dtype)


def guarded(
    counts: Sequence[NDArray[np.integer]],
    origins: Sequence[NDArray[np.integer]],
    parameters: NDArray[np.float64],
    floor: float,
    largest_share: float,
) -> tuple[list[NDArray[np.integer]], NDArray[np.float64]]:
    """Return the histograms without samples of which the fit expects fewer than ``floor`` frames a DN.

    Args:
        counts: histograms of each sample, shape (n, B_j) each.
        origins: DN of bin 0 of each sample, shape (n,) each.
        parameters: fitted (H_1 ... H_J, g, mu, sigma), shape (n, J + 3); NaN: all samples are kept.
        floor: expected frames per DN.
        largest_share: of a pixel's frames; where more would go, all are kept.

    Returns:
        The histograms, and the share of each pixel's frames that was left out, shape (n,).
    """
    n = parameters.shape[0]
    kept, gone, total = [], np.zeros(n), np.zeros(n)
    for j, (sample, origin) in enumerate(zip(counts, origins, strict=True)):
        own = np.ascontiguousarray(parameters[:, [j, -3, -2, -1]])
        own[:, 0] = np.maximum(own[:, 0], _NO_ELECTRONS)
        rows = kernel_counts(sample)
        trimmed = np.empty_like(rows)
        information_numba.trim_tile(rows, np.ascontiguousarray(origin, np.int64), own, floor, trimmed)
        frames = rows.sum(axis=1, dtype=np.float64)
        total += frames
        gone += frames - trimmed.sum(axis=1, dtype=np.float64)
        kept.append(trimmed)
    share = gone / np.maximum(total, 1.0)
    too_many = share > largest_share
    for sample, trimmed in zip(counts, kept, strict=True):
        trimmed[too_many] = sample[too_many]
    return kept, np.where(too_many, 0.0, share)
