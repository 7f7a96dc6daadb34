"""Stage ``histogram``: per-pixel histograms, and summaries of what they lose, in one pass over the frames.

The unit of work is a band of rows over the full width: its frames are read once, by blocks, the next block
being read while one is counted. How high the bands are depends on the memory allowed, the result does not.
Where a single pass over the camera files has counted already, the tiles have but to be marked.
"""

from __future__ import annotations

import functools
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.frames.histogram_files import HistogramInput, read_histograms
from pchem_pipeline.frames.stream import FrameSource, FrameStream
from pchem_pipeline.model.histogram.count import choose_bins, most_bins, pixels_by_range
from pchem_pipeline.model.histogram.odd_frames import FAR_CHANCE, chance_of_copies, frame_scores, odd_frames
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, frame_statistics
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.stage import StageContext, Task
from pchem_pipeline.stages.bands import Band, plan_bands
from pchem_pipeline.stages.histogram.arrays import bytes_per_row, create_arrays, create_counts, row_frames
from pchem_pipeline.stages.histogram.counting import CountJob, StackCounter
from pchem_pipeline.stages.histogram.odd_frames import leave_out_odd_frames
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile, equal_rows

# -- the stage ----------------------------------------------------------------------------------


def run(context: StageContext) -> None:
    """Make histograms and summaries of all chosen tiles.

    Raises:
        InputError: the camera files vanished or changed.
        StoreError: the input is not complete, or the store refuses.
    """
    if context.sensor.kind != "frames":
        _copy_histograms(context)
        return
    if context.is_prepared:
        context.run_units(context.tiles())
        _end(context)
        return
    source = open_source(context)
    if context.fresh or not context.store.has("histogram/counts"):
        bins = _decide_bins(context, source)
    else:
        bins = context.store.array("histogram/counts").shape[2]
    create_arrays(context, source.shape, bins)
    settings, tiles = context.config.histogram, context.tiles()
    n_frames, _, columns = source.shape
    row = bytes_per_row(columns, n_frames, source.dtype.itemsize, bins, settings)
    most = context.band_bytes // row
    pending = {tile.key for tile in context.pending(tiles)}
    bands = plan_bands(tiles, pending, most, context.executor.workers, source.rows_per_read)
    highest = max(band.y1 - band.y0 for band in bands)
    if highest > most:
        context.note(
            f"{highest} rows of {columns} pixels, the minimum for a worker, need "
            f"{math.ceil(highest * row / 2**20)} MiB, more than histogram.band_memory or compute.max_memory "
            "allow; lower histogram.window_frames, or --workers"
        )
    job = CountJob(context.store.path, source.shape, bins, settings)
    threads = max(1, context.executor.workers // max(1, len(context.pending(bands))))
    task = functools.partial(_do_band, job=job, source=source, threads=threads)
    done = context.run_units(bands, task, unit_name="band", unit_bytes=highest * row)
    if len(done) == context.n_keys:
        _end(context)


def _end(context: StageContext) -> None:
    if context.config.histogram.summaries:
        _write_frame_statistics(context)
    number = 0
    for tile in context.tiles():
        histogram = context.store.at(tile.region, "histogram")
        number += int(np.count_nonzero(histogram["under"] | histogram["over"]))
    if number:
        bins = context.store.array("histogram/counts").shape[2]
        words = "pixels have samples outside their" if number > 1 else "pixel has samples outside its"
        context.note(f"{number} {words} histogram of {bins} bins")


def _decide_bins(context: StageContext, source: FrameSource) -> int:
    settings, (n_frames, ny, columns) = context.config.histogram, source.shape
    row = bytes_per_row(columns, n_frames, source.dtype.itemsize, 0, settings)
    most, together = max(ROW_GROUP, context.band_bytes // row), min(source.rows_per_read, ny)
    context.stop.check()
    limit = most_bins(settings.max_bins, source.dtype)
    return bins_of(source, settings.window_frames, limit, most // together * together or most)


def bins_of(source: FrameSource, frames: int, most: int, rows: int) -> int:
    """Return the number of bins, at most ``most``, that the first frames need; ``rows`` are read at once."""
    n_frames, ny, columns = source.shape
    ranges = np.zeros(most + 2, np.int64)
    for y0, y1 in equal_rows(ny, rows):
        block = np.empty((min(frames, n_frames), y1 - y0, columns), source.dtype)
        source.read_into(block, 0, block.shape[0], y0, y1)
        ranges += pixels_by_range(block, most)
    return choose_bins(ranges, most)


def _do_band(band: Band, store: RunStore, *, job: CountJob, source: FrameSource, threads: int) -> None:
    rows = [(band.y0, band.y1)]
    with FrameStream(source, rows, job.settings.window_frames, threads=threads) as stream:
        StackCounter(job, rows).count(stream)


def _write_frame_statistics(context: StageContext) -> None:
    """Derive the statistics of whole frames from the row sums of all bands; leave out odd frames."""
    n_frames, (ny, nx) = context.sensor.n_frames, context.sensor.shape
    mean, variance, level = np.empty((3, n_frames))
    weights = np.random.default_rng(1).integers(1 << 62, size=(2, ny))
    digest, usual, scores, chance = np.empty(n_frames, np.int64), None, [], 1.0
    # parts of about the same length: a frame is ranked among those of its part
    ends = np.linspace(0, n_frames, -(-n_frames // row_frames(ny)) + 1).astype(int).tolist()
    for part in (slice(*each) for each in pairwise(ends)):
        sums = context.store.read("summary/row_sum", (part, slice(None)))
        squares = context.store.read("summary/row_sum_square", (part, slice(None)))
        mean[part], variance[part] = frame_statistics(sums, squares, nx)
        if usual is None:
            usual, chance = np.median(sums, axis=0), chance_of_copies(sums.var(axis=0), n_frames)
        # of most rows: the track of a particle moves the mean, too
        level[part] = np.median(sums - usual, axis=1) / nx
        digest[part] = sums @ weights[0] + squares @ weights[1]
        scores.append(frame_scores(sums, squares, nx))
    context.store.write_array("summary/frame_mean", mean)
    context.store.write_array("summary/frame_variance", variance)
    odd = odd_frames(
        level,
        variance,
        digest,
        ny * nx,
        scores=np.concatenate(scores, axis=1),
        copies=chance < n_frames * FAR_CHANCE,
        moved=context.store.attributes("summary").get("moved_frames", {}),
    )
    leave_out_odd_frames(context, odd, mean, variance)


# -- ready-made histograms ----------------------------------------------------------------------


def _copy_histograms(context: StageContext) -> None:
    """Copy ready-made histograms, without order in time and neighbours, or those of the shown sample.

    So report and ensemble need no run of a sample; the fit reads the histograms of all in their own runs.
    """
    counts: Any
    task: Task[Tile]
    if context.sensor.samples:
        place = sample_targets(context.config, context.base_dir)[context.sensor.shown].store
        counts, missing = RunStore.open(place).array("histogram/counts"), "in the runs of the samples"
        task = functools.partial(_copy_sample_tile, sample=place)
    else:
        given = read_histograms(context.config.input, context.base_dir)
        counts, missing = given.counts, "input is histograms, without order in time"
        task = functools.partial(_copy_tile, given=given)
    create_counts(context, counts.shape[2], counts.dtype)
    context.store.set_attributes("summary", {"missing": missing})
    context.run_units(context.tiles(), task)


def _copy_sample_tile(tile: Tile, store: RunStore, *, sample: Path) -> None:
    store.at(tile.region, "histogram").update(RunStore.open(sample).at(tile.region, "histogram"))


def _copy_tile(tile: Tile, store: RunStore, *, given: HistogramInput) -> None:
    counts, origin = given.counts[tile.region], given.origin[tile.region]
    occupied = counts > 0
    last = counts.shape[2] - 1
    store.at(tile.region, "histogram").update(
        counts=counts,
        origin=origin,
        under=np.zeros(origin.shape, np.uint32),
        over=np.zeros(origin.shape, np.uint32),
        minimum=(origin + occupied.argmax(axis=2)).astype(np.int32),
        maximum=(origin + last - occupied[:, :, ::-1].argmax(axis=2)).astype(np.int32),
    )
