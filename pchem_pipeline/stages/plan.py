"""What a run is going to read, write and hold, said before it starts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pchem_pipeline.compute.environment import available_memory
from pchem_pipeline.model.summaries import ROW_GROUP
from pchem_pipeline.stages.bands import bytes_per_row
from pchem_pipeline.stages.ingest import chunk_shape

if TYPE_CHECKING:
    import numpy as np

    from pchem_pipeline.stages.base import StageContext

__all__ = ["allowed_bytes", "sweep_bytes", "sweep_rows"]

#: the program itself with its libraries and compiled kernels
BASE_BYTES = 240 << 20


def allowed_bytes(context: StageContext) -> int:
    """Return the memory that the run may take, in all: the setting, else half of what is free."""
    settings = context.config.compute
    if settings.max_memory is not None:
        return settings.max_memory << 20
    bands = BASE_BYTES + context.executor.workers * (context.config.histogram.band_memory << 20)
    return max(bands, (available_memory() or 0) // 2)


def sweep_rows(context: StageContext, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> int:
    """Return the rows that must stay together in a sweep: those of tiles, groups and chunks of the copy."""
    step = max(context.config.run.tile, ROW_GROUP)
    if context.config.input.mode == "copy":
        step = math.lcm(step, chunk_shape(shape, dtype.itemsize)[1])
    return step


def sweep_bytes(context: StageContext, shape: tuple[int, int, int], dtype: np.dtype[Any], bins: int) -> int:
    """Return the memory of the one pass over the input, the program included.

    Args:
        context: of the run.
        shape: frames, rows, columns.
        dtype: type of the samples.
        bins: bins of a pixel.
    """
    n_frames, ny, nx = shape
    row = bytes_per_row(nx, n_frames, dtype.itemsize, bins, context.config.histogram)
    return BASE_BYTES + ny * row
