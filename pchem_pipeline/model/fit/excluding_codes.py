"""Codes that a fit leaves out: what the model does not describe there bends nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray

#: Limits on a pixel's comb, e-; None: no limit.
Interval = tuple[float | None, float | None]


def electrons_of(origin: NDArray[np.integer], width: int, gain: FloatArray, bias: FloatArray) -> FloatArray:
    """Return the place ``(x - mu) g`` of every code on its pixel's comb, e-, shape (n, width)."""
    codes = np.asarray(origin, np.int64)[:, None] + np.arange(width)
    return np.asarray((codes - bias[:, None]) * gain[:, None])


def inside(intervals: Sequence[Interval], electrons: FloatArray) -> BoolArray:
    """Return which places on the comb lie in one of the intervals."""
    found = np.zeros(electrons.shape, np.bool_)
    for low, high in intervals:
        within = np.ones(electrons.shape, np.bool_)
        if low is not None:
            within &= electrons >= low
        if high is not None:
            within &= electrons < high
        found |= within
    return found
