"""Frames as standardised deviations, without a sensor."""

from typing import Any

import numpy as np

from pchem_pipeline.discrepancy.observe.sums import FrameBlocks, Samples

Floats = np.ndarray[Any, np.dtype[np.float64]]


def samples_of(values: Floats, usable: np.ndarray[Any, np.dtype[np.bool_]] | None = None) -> Samples:
    """Return deviations (frame, y, x) as samples of both channels, to a hundredth of a standard deviation."""
    shape = values.shape[1:]
    zero = np.zeros(shape, np.int32)
    table = np.tile(((np.arange(1201) - 600) / 100.0).astype(np.float32)[:, None], (1, 2))
    codes = np.rint(100.0 * np.clip(values, -6.0, 6.0) + 600.0).astype(np.uint16)
    every = np.ones(shape, np.bool_) if usable is None else usable
    return Samples(FrameBlocks.of(codes), zero, zero + 1200, zero, table, every)
