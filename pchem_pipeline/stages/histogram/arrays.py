"""The arrays of the histogram stage, how those along time are cut into chunks, and what counting takes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.compute.memory import BASE_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.histogram.count import counts_dtype
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, block_starts
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.store.run_store import RunStore

MAPS = ("origin", "under", "over", "minimum", "maximum")
COVARIANCES = ("lag1_covariance", "neighbour_covariance_x", "neighbour_covariance_y")

#: frames, or blocks, in a chunk of the arrays along time
_COLUMN_FRAMES = 1024
_ROW_FRAMES = 4096
_CHUNK_BLOCKS = 8


def row_frames(ny: int) -> int:
    """Return the frames in a chunk of row sums, fewer on tall sensors: one of all rows is read at once."""
    return max(_ROW_FRAMES // 16, _ROW_FRAMES // -(-ny // 2048))


def create_counts(context: StageContext, bins: int, dtype: Any) -> None:
    """Make the arrays of the histograms; counts are a file for each tile, of pieces that are read alone."""
    tile = tuple(min(size, length) for size, length in zip(context.tile, context.sensor.shape, strict=True))
    chunks, shards = {}, None
    if math.prod(tile) > 4096:  # else all are decoded to read the histogram of one
        chunks = {"y": _part(tile[0], 16), "x": _part(tile[1], 64)}
        shards = (*tile, bins)
    context.create("histogram/counts", lengths={"bin": bins}, chunks=chunks, shards=shards, dtype=dtype)
    context.create(*(f"histogram/{name}" for name in MAPS))


def _part(side: int, most: int) -> int:
    """Return the largest divisor of a length up to a number; the length itself where that is small."""
    found = next(part for part in range(min(side, most), 0, -1) if side % part == 0)
    return found if 2 * found > min(side, most) else side


def create_arrays(context: StageContext, shape: tuple[int, int, int], bins: int) -> None:
    """Make the arrays of the stage for a stack of some shape (frames, rows, columns)."""
    n_frames, ny, nx = shape
    settings = context.config.histogram
    create_counts(context, bins, counts_dtype(n_frames))
    if not settings.summaries:
        context.store.set_attributes("summary", {"missing": "histogram.summaries: false"})
        return
    length = settings.block_length(n_frames)
    starts = block_starts(n_frames, length)
    lengths = {"frame": n_frames, "block": starts.size, "row_group": -(-ny // ROW_GROUP), "sum": 7, "lag": 3}
    context.create(
        *(f"summary/{name}" for name in (*COVARIANCES, "open_sums", "open_covariances")), lengths=lengths
    )
    rows = max(context.tile[0], ROW_GROUP)
    chunks = {"frame": row_frames(ny), "block": _CHUNK_BLOCKS, "y": rows, "x": nx}
    names = ("block_sum", "block_sum_square", "row_sum", "row_sum_square")
    context.create(*(f"summary/{name}" for name in names), lengths=lengths, chunks=chunks)
    chunks |= {"frame": _COLUMN_FRAMES, "row_group": rows // ROW_GROUP}
    context.create("summary/column_sum", lengths=lengths, chunks=chunks, rows=ROW_GROUP)
    if context.fresh:
        context.store.write_array("summary/block_start", starts, {"frames": n_frames, "block": length})


def with_block_length(settings: HistogramSettings, store: RunStore) -> HistogramSettings:
    """Return the settings with the length of the time blocks that a run has, frames."""
    known = store.attributes("summary/block_start").get("block", settings.block_frames)
    return settings.model_copy(update={"block_frames": known})


def extend_arrays(context: StageContext, shape: tuple[int, int, int], bins: int) -> None:
    """Make the arrays along time longer, and the counts wide enough."""
    store, n_frames = context.store, shape[0]
    length = with_block_length(context.config.histogram, store).block_length(n_frames)
    open_store.cache_clear()
    if store.array("histogram/counts").dtype != counts_dtype(n_frames):
        store.delete("histogram/counts")
        create_counts(context, bins, counts_dtype(n_frames))
    if context.config.input.mode == "copy":
        store.resize("frames/dn", n_frames)
    if context.config.histogram.summaries:
        starts = block_starts(n_frames, length)
        for name in ("row_sum", "row_sum_square", "column_sum"):
            store.resize(f"summary/{name}", n_frames)
        for name in ("block_sum", "block_sum_square"):
            store.resize(f"summary/{name}", starts.size)
        store.write_array("summary/block_start", starts, {"frames": n_frames, "block": length})


def bytes_per_row(columns: int, n_frames: int, itemsize: int, bins: int, settings: HistogramSettings) -> int:
    """Return the memory that a worker needs for each row of its band."""
    block = 2 * min(settings.window_frames, n_frames) * itemsize
    pixel = block + bins * counts_dtype(n_frames).itemsize + 21 + 2 * itemsize
    row = 0
    if settings.summaries:
        # sums, covariances and their temporaries; then what waits for its chunk along time to be whole
        pixel += 170 + 2 * 2 * _CHUNK_BLOCKS * 8
        pixel += math.ceil(2 * min(_COLUMN_FRAMES, n_frames) * 4 / ROW_GROUP)
        row = 2 * 2 * min(_ROW_FRAMES, n_frames) * 8
    return columns * pixel + row


def single_pass_bytes(config: RunConfig, shape: tuple[int, int, int], dtype: np.dtype[Any], bins: int) -> int:
    """Return the memory of a single pass over frames (frame, y, x), the program included."""
    n_frames, ny, nx = shape
    return BASE_BYTES + ny * bytes_per_row(nx, n_frames, dtype.itemsize, bins, config.histogram)
