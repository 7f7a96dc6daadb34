"""The one pass of ``pchem run`` over the camera files: hash, window, histogram, summaries, and the copy.

What the stages ``ingest`` and ``histogram`` do one after the other, with two or three readings of all bytes,
is done here in one sweep. The results are the same to the bit; both stages afterwards find their
arrays made and have but to mark them. It needs memory for the histograms of the whole sensor; where that is
not there, where something is known of the input already, or where the work is done on other machines, nothing
is done here and the stages run by themselves.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.compute.environment import cpu_seconds
from pchem_pipeline.frames.histogram_files import is_histogram_input
from pchem_pipeline.frames.identity import quick_identity
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.read_once import ReadOnce
from pchem_pipeline.frames.resolve import input_paths
from pchem_pipeline.model.histogram.count import RangeAccumulator, choose_bins
from pchem_pipeline.run.input_identity import identity_is_new, keep_identity
from pchem_pipeline.run.stage import StageContext, Swept, open_store
from pchem_pipeline.stages import ingest
from pchem_pipeline.stages.histogram import histogram
from pchem_pipeline.stages.histogram.counting import BandCounter
from pchem_pipeline.stages.histogram.dry_run import allowed_bytes, sweep_bytes, sweep_rows
from pchem_pipeline.stages.histogram.stream import Parts, Sweep, cut_rows
from pchem_pipeline.stages.table import STAGES

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence

__all__ = ["block_tasks", "do_all", "sweep_input", "whole_mebibytes"]

_STAGES = ("ingest", "histogram")


def sweep_input(context: StageContext) -> None:
    """Do the work of ``ingest`` and ``histogram`` in one reading, where that is possible; else nothing.

    Raises:
        InputError: the input is bad, vanished or changed; the message lists all bad files.
        InterruptedRunError: a signal asked for a stop; the sweep has to be done again.
        StoreError: the store refuses.
    """
    clock = time.perf_counter(), cpu_seconds()
    if not _is_wanted(context):
        return
    frames = open_frames(context.config.input, context.base_dir)
    if not _blocks_are_chunks(context, frames):
        return
    if sweep_bytes(context.config, frames.shape, frames.dtype, 0) > _allowed(context):
        return
    paths = input_paths(context.config.input, context.base_dir)
    quick = quick_identity(paths)
    workers = context.executor.workers
    total = sum(int(file["size"]) for file in quick["files"]) >> 20
    for name in _STAGES:
        context.store.records.forget(name)
    with context.reporter.progress("ingest and histogram", total, "MiB") as advance:
        once = ReadOnce(frames, paths, workers, whole_mebibytes(advance))
        if not _sweep(context, frames, once):
            return
        identity = once.identity()
    if quick_identity(paths) != quick:
        return  # the files changed meanwhile: the stages look at them again
    with suppress(StoreError):  # a store that cannot be written is a matter for those who write to it
        keep_identity(context, quick, identity)
        context.swept = Swept(_STAGES, frames, clock)


def _is_wanted(context: StageContext) -> bool:
    """Tell whether both stages are to be done from the start, by threads of this process."""
    options, config = context.options, context.config
    records = context.store.records
    return (
        config.compute.backend != "distributed"
        and options.tiles is None
        and options.roi is None
        and all(records.read(name) is None for name in _STAGES)
        and not is_histogram_input(config.input, context.base_dir)
        and identity_is_new(context)
    )


def _blocks_are_chunks(context: StageContext, frames: FrameSequence) -> bool:
    """Tell whether the blocks of a sweep are whole chunks of the copy, where there is one."""
    block = min(context.config.histogram.window_frames, frames.shape[0])
    chunk = ingest.chunk_shape(frames.shape, frames.dtype.itemsize)[0]
    return context.config.input.mode == "reference" or block == frames.shape[0] or block % chunk == 0


def _allowed(context: StageContext) -> int:
    return allowed_bytes(context.config, context.executor.workers)


def whole_mebibytes(advance: Callable[[int], None]) -> Callable[[int], None]:
    """Turn bytes into whole MiB of progress."""
    done = shown = 0

    def count(n_bytes: int) -> None:
        nonlocal done, shown
        done += n_bytes
        if (done >> 20) > shown:
            advance((done >> 20) - shown)
            shown = done >> 20

    return count


def _sweep(context: StageContext, frames: FrameSequence, once: ReadOnce) -> bool:
    """Read everything once; tell whether memory was enough."""
    settings = context.config.histogram
    shape = frames.shape
    bands = cut_rows(shape[1], sweep_rows(context.config, shape, frames.dtype), context.executor.workers)
    sweep = Sweep(once.read, shape, frames.dtype, bands, settings.window_frames)
    counters: list[BandCounter] = []
    workers = ThreadPoolExecutor(context.executor.workers, thread_name_prefix="count")
    with workers as pool, sweep.blocks() as blocks:
        for t0, parts in blocks:
            context.stop.check()
            if t0 == 0:
                bins = _choose_bins(context, pool, parts)
                if sweep_bytes(context.config, shape, frames.dtype, bins) > _allowed(context):
                    return False
                _create(context, frames, bins)
                counters = [BandCounter(context.store.path, rows, shape, bins, settings) for rows in bands]
            do_all(pool, block_tasks(context, counters, bands, t0, parts))
        do_all(pool, [counter.finish for counter in counters])
    return True


def do_all(pool: ThreadPoolExecutor, tasks: Sequence[Callable[[], None]]) -> None:
    """Do tasks at the same time; the first error is raised when all have ended."""
    futures = [pool.submit(task) for task in tasks]
    for error in [future.exception() for future in futures]:
        if error is not None:
            raise error


def _choose_bins(context: StageContext, pool: ThreadPoolExecutor, parts: Parts) -> int:
    """Return the number of bins of the sensor, from its first frames."""
    dtype = parts[0].dtype
    limit = min(context.config.histogram.max_bins, 1 << (8 * dtype.itemsize))

    def ranges(part: NDArray[Any]) -> NDArray[np.int64]:
        accumulator = RangeAccumulator(part.shape[1:], dtype, part.shape[0])
        accumulator.add(part)
        return accumulator.finish(limit)

    return choose_bins(np.sum(list(pool.map(ranges, parts)), axis=0), limit)


def _create(context: StageContext, frames: FrameSequence, bins: int) -> None:
    """Make the arrays of both stages anew."""
    context.fresh = True
    for name in (path for stage in _STAGES for path in STAGES[stage].writes):
        context.store.delete(name)
    ingest.sensor_of(frames, context, {}).write(context.store)
    if context.config.input.mode == "copy":
        ingest.create_frames(context, frames)
    histogram.create_arrays(context, frames.shape, bins)


def block_tasks(
    context: StageContext,
    counters: Sequence[BandCounter],
    bands: Sequence[tuple[int, int]],
    t0: int,
    parts: Parts,
) -> list[Callable[[], None]]:
    """Return what is to be done with a block of frames: count each band, and copy it where that is asked.

    Args:
        context: of the run.
        counters: of the bands.
        bands: first row and end of each.
        t0: first frame of the block.
        parts: frames (frame, y, x) of each band.
    """
    tasks: list[Callable[[], None]] = [
        functools.partial(counter.add, part) for counter, part in zip(counters, parts, strict=True)
    ]
    if context.config.input.mode == "copy":
        for rows, part in zip(bands, parts, strict=True):
            tasks.append(functools.partial(_copy, context, t0, rows, part))
    return tasks


def _copy(context: StageContext, t0: int, rows: tuple[int, int], part: NDArray[Any]) -> None:
    """Write a band of a block of frames, whole chunks, into the store."""
    region = (slice(t0, t0 + part.shape[0]), slice(*rows), slice(None))
    open_store(context.store.path).write("frames/dn", region, part)
