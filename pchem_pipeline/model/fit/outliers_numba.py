"""The tail guard of the fit: samples that the model does not expect at all leave the likelihood.

The guarded log-likelihood of a pixel is ``sum_i c_i max(log f(x_i), log(floor / N))``: where fewer than
``floor`` frames per DN are expected, a sample costs the same wherever it lies, so it moves nothing. At a
maximum that is the likelihood of the other samples, found by leaving these out and fitting again until the
set of them stays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.workspace_numba import Histogram

_CORE_TAIL = 0.02  # share of the frames beyond either end of the core
_FAR = 0.6  # widths of the core: a wider gap beyond it makes a sample far
_FEW_DN = 4.0


@kernel
def outlying(
    weights: NDArray[np.float64], expectations: NDArray[np.float64], n_bins: int, floor: float
) -> float:
    """Return how many samples lie at DN of which fewer than ``floor`` are expected."""
    found = 0.0
    for i in range(n_bins):
        if expectations[i] < floor:
            found += weights[i]
    return found


@kernel
def core_ends(histogram: Histogram) -> tuple[int, int]:
    """Return first and end of the bins that no gap cuts off from the core, which holds 96 % of the frames.

    The model has no say here: far samples would otherwise lead the search for its parameters astray, where
    peaks hundreds of DN apart explain them.
    """
    weights, cumulative, n_bins, n = histogram.weights, histogram.cumulative, histogram.n_bins, histogram.n
    low = 0
    while low < n_bins - 1 and cumulative[low + 1] < _CORE_TAIL * n:
        low += 1
    high = n_bins - 1
    while high > low and n - cumulative[high] < _CORE_TAIL * n:
        high -= 1
    gap = _FAR * (high - low + 1.0) + _FEW_DN
    first, last = low, high
    for i in range(low - 1, -1, -1):
        if weights[i] > 0.0:
            if first - i > gap:
                break
            first = i
    for i in range(high + 1, n_bins):
        if weights[i] > 0.0:
            if i - last > gap:
                break
            last = i
    return first, last + 1


@kernel
def inner_ends(histogram: Histogram, share: float) -> tuple[int, int]:
    """Return first and end of the bins left when a share of the frames is cut off, half at each end."""
    cumulative, n_bins, n = histogram.cumulative, histogram.n_bins, histogram.n
    low, high = 0, n_bins
    while low < n_bins - 1 and cumulative[low + 1] <= 0.5 * share * n:
        low += 1
    while high > low + 1 and n - cumulative[high - 1] <= 0.5 * share * n:
        high -= 1
    return low, high


@kernel
def cut(row: NDArray[np.generic], first: int, end: int, kept: NDArray[np.generic]) -> None:
    """Copy a histogram between two bins to ``kept``, 0 elsewhere."""
    for i in range(row.size):
        kept[i] = row[i] if first <= i < end else 0


@kernel
def leave_out(
    row: NDArray[np.generic],
    expectations: NDArray[np.float64],
    first: int,
    n_bins: int,
    floor: float,
    kept: NDArray[np.generic],
) -> bool:
    """Copy to ``kept`` what is expected at all; tell whether that changed it.

    Args:
        row: the whole histogram.
        expectations: frames expected at the ``n_bins`` DN from bin ``first`` on; the others are empty.
        first: first occupied bin.
        n_bins: bins up to the last occupied one.
        floor: frames per DN.
        kept: out, the samples that stay.

    Returns:
        Whether ``kept`` is another than it was.
    """
    changed = False
    for i in range(n_bins):
        bin_ = first + i
        stays = expectations[i] >= floor or not math.isfinite(expectations[i])
        before = kept[bin_]
        kept[bin_] = row[bin_] if stays else 0
        changed = changed or kept[bin_] != before
    return changed


@kernel
def total(row: NDArray[np.generic]) -> float:
    """Return the number of frames in a histogram."""
    found = 0.0
    for i in range(row.size):
        found += float(row[i])
    return found
