"""The memory that counting takes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.compute.memory import BASE_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.histogram.count import counts_dtype
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.stages.histogram.arrays import CHUNK_BLOCKS, COLUMN_FRAMES, ROW_FRAMES


def bytes_per_row(columns: int, n_frames: int, itemsize: int, bins: int, settings: HistogramSettings) -> int:
    """Return the memory that a worker needs for each row of its band."""
    block = 2 * min(settings.window_frames, n_frames) * itemsize
    pixel = block + bins * counts_dtype(n_frames).itemsize + 21 + 2 * itemsize
    row = 0
    if settings.summaries:
        # sums, covariances and their temporaries; then what waits for its chunk along time to be whole
        pixel += 170 + 2 * 2 * CHUNK_BLOCKS * 8
        pixel += math.ceil(2 * min(COLUMN_FRAMES, n_frames) * 4 / ROW_GROUP)
        row = 2 * 2 * min(ROW_FRAMES, n_frames) * 8
    return columns * pixel + row


def single_pass_bytes(config: RunConfig, shape: tuple[int, int, int], dtype: np.dtype[Any], bins: int) -> int:
    """Return the memory of a single pass over frames (frame, y, x), the program included."""
    n_frames, ny, nx = shape
    return BASE_BYTES + ny * bytes_per_row(nx, n_frames, dtype.itemsize, bins, config.histogram)
