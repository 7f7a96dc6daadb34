"""The arrays of the histogram stage, and how those along time are cut into chunks."""

from __future__ import annotations

from pchem_pipeline.model.histogram.count import counts_dtype
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, block_starts
from pchem_pipeline.run.stage import StageContext, open_store

MAPS = ("origin", "under", "over", "minimum", "maximum")
COVARIANCES = ("lag1_covariance", "neighbour_covariance_x", "neighbour_covariance_y")

#: frames, or blocks, in a chunk of the arrays along time
COLUMN_FRAMES = 1024
ROW_FRAMES = 4096
CHUNK_BLOCKS = 8
#: a chunk of row sums of all rows is read at once in the end: fewer frames on tall sensors
_ROWS_AT_ONCE = 2048


def row_frames(ny: int) -> int:
    """Return the frames in a chunk of row sums."""
    return max(ROW_FRAMES // 16, ROW_FRAMES // -(-ny // _ROWS_AT_ONCE))


def create_arrays(context: StageContext, shape: tuple[int, int, int], bins: int) -> None:
    """Make the arrays of the stage for a stack of some shape (frames, rows, columns)."""
    n_frames, ny, nx = shape
    settings, tile = context.config.histogram, context.tile
    context.create("histogram/counts", (ny, nx, bins), chunks=(*tile, bins), dtype=counts_dtype(n_frames))
    context.create_maps([f"histogram/{name}" for name in MAPS])
    if not settings.summaries:
        context.store.set_attributes("summary", {"missing": "histogram.summaries is off"})
        return
    context.create_maps([f"summary/{name}" for name in COVARIANCES])
    for name, length in (("open_sums", 7), ("open_covariances", 3)):
        context.create(f"summary/{name}", (length, ny, nx), chunks=(length, *tile))
    starts = block_starts(n_frames, settings.block_frames)
    rows = max(tile[0], ROW_GROUP)
    for name in ("block_sum", "block_sum_square"):
        context.create(f"summary/{name}", (starts.size, ny, nx), chunks=(CHUNK_BLOCKS, rows, nx))
    for name in ("row_sum", "row_sum_square"):
        context.create(f"summary/{name}", (n_frames, ny), chunks=(row_frames(ny), rows))
    context.create(
        "summary/column_sum",
        (n_frames, -(-ny // ROW_GROUP), nx),
        chunks=(COLUMN_FRAMES, rows // ROW_GROUP, nx),
        rows=ROW_GROUP,
    )
    if context.fresh:
        context.store.write_array("summary/block_start", starts, {"frames": n_frames})


def extend_arrays(context: StageContext, shape: tuple[int, int, int], bins: int) -> None:
    """Make the arrays along time longer, and the counts wide enough."""
    store, n_frames = context.store, shape[0]
    tile, length = context.tile, context.config.histogram.block_frames
    open_store.cache_clear()
    if store.array("histogram/counts").dtype != counts_dtype(n_frames):
        counts = (*shape[1:], bins)
        store.create_array("histogram/counts", counts, chunks=(*tile, bins), dtype=counts_dtype(n_frames))
    if context.config.input.mode == "copy":
        store.resize("frames/dn", n_frames)
    if context.config.histogram.summaries:
        starts = block_starts(n_frames, length)
        for name in ("row_sum", "row_sum_square", "column_sum"):
            store.resize(f"summary/{name}", n_frames)
        for name in ("block_sum", "block_sum_square"):
            store.resize(f"summary/{name}", starts.size)
        store.write_array("summary/block_start", starts, {"frames": n_frames})
