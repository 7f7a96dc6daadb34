"""A single pass of ``pchem run`` over the camera files: hash, window, histogram, summaries, and the copy.

What the stages ``ingest`` and ``histogram`` do one after the other, with two or three readings of all bytes,
is done here in one, to the same bit; both stages then find their arrays made and have but to mark them. It
needs memory for the histograms of the whole sensor; where that is not there, or where something is known of
the input already, nothing is done here and the stages run by themselves. Also a command whose tiles go to
other machines counts here: it reads all bytes for the hash.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.compute.environment import cpu_seconds
from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.frames.histogram_files import is_histogram_input
from pchem_pipeline.frames.identity import file_size, quick_identity
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.resolve import input_paths
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.stream import HashedFrameStream
from pchem_pipeline.model.histogram.count import choose_bins, most_bins, pixels_by_range
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.input import identity_is_new, keep_identity
from pchem_pipeline.run.progress import whole_mebibytes
from pchem_pipeline.run.stage import Prepared, StageContext, allowed_bytes
from pchem_pipeline.stages import ingest
from pchem_pipeline.stages.bands import cut_rows
from pchem_pipeline.stages.histogram.arrays import create_arrays, single_pass_bytes
from pchem_pipeline.stages.histogram.counting import CountJob, StackCounter
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.tiles import tile_shape

#: the stages whose arrays one pass makes
PREPARED = ("ingest", "histogram")


def count_in_one_pass(context: StageContext) -> None:
    """Do the work of ``ingest`` and ``histogram`` in one reading, where that is possible; else nothing.

    Raises:
        InputError: the input is bad, vanished or changed; the message lists all bad files.
        InterruptedRunError: a signal asked for a stop; the pass has to be done again.
        StoreError: the store refuses.
    """
    clock = time.perf_counter(), cpu_seconds()
    if not _is_wanted(context):
        return
    frames = open_frames(context.config.input, context.base_dir)
    n_frames, block = frames.shape[0], context.config.histogram.window_frames
    chunk = ingest.chunk_shape(frames.shape, frames.dtype.itemsize)[0]
    # blocks of the stream are whole chunks of the copy, where there is one
    chunked = context.config.input.mode == "reference" or block >= n_frames or block % chunk == 0
    if not chunked or not _fits(context, frames, 0):
        return
    paths = input_paths(context.config.input, context.base_dir)
    quick = quick_identity(paths)
    for name in PREPARED:
        context.store.records.forget(name)
    with hashed_frames(context, frames, context.config.histogram.window_frames, paths) as stream:
        if not _count(context, frames, stream):
            return
        identity = stream.identity()
    if quick_identity(paths) != quick:
        return  # the files changed meanwhile: the stages look at them again
    with suppress(StoreError):  # a store that cannot be written is a matter for those who write to it
        keep_identity(context, quick, identity)
        context.prepared = Prepared(PREPARED, frames, clock)


@contextmanager
def hashed_frames(
    context: StageContext, frames: FrameSequence, step: int, files: Sequence[Path], first: int = 0
) -> Iterator[HashedFrameStream]:
    """Open the stream of frames, ``step`` in a block, whose files are hashed as they are read.

    Workers share its bands. Of all frames, those from ``first`` on are read, and lie in ``files``.
    """
    workers = context.config.compute.count()
    # rows that stay together: of a tile, of a group, of a chunk of the copy
    rows = max(tile_shape(context.config.run.tile, frames.shape[1:])[0], ROW_GROUP)
    if context.config.input.mode == "copy":
        rows = math.lcm(rows, ingest.chunk_shape(frames.shape, frames.dtype.itemsize)[1])
    total = sum(file_size(path) for path in files) >> 20
    with (
        context.reporter.progress("ingest and histogram", total, "MiB") as advance,
        HashedFrameStream(
            frames,
            cut_rows(frames.shape[1], rows, workers),
            step,
            files=files,
            first=first,
            threads=workers,
            advance=whole_mebibytes(advance),
        ) as stream,
    ):
        yield stream


def _is_wanted(context: StageContext) -> bool:
    """Return whether both stages are to be done from the start."""
    config, records = context.config, context.store.records
    return (
        context.command.roi is None
        and all(records.read(name) is None for name in PREPARED)
        and not is_histogram_input(config.input, context.base_dir)
        and identity_is_new(context)
    )


def _fits(context: StageContext, frames: FrameSequence, bins: int) -> bool:
    need = single_pass_bytes(context.config, frames.shape, frames.dtype, bins)
    return need <= allowed_bytes(context.config, context.config.compute.count())


def _count(context: StageContext, frames: FrameSequence, stream: HashedFrameStream) -> bool:
    """Count all frames; return whether memory was enough for the bins that the first ones need."""
    config, workers = context.config, context.config.compute.count()
    blocks = iter(stream)
    first = next(blocks)
    context.stop.check()
    limit = most_bins(config.histogram.max_bins, frames.dtype)
    found = call_all([functools.partial(pixels_by_range, part, limit) for part in first[1]], workers)
    bins = choose_bins(np.sum(found, axis=0), limit)
    if not _fits(context, frames, bins):
        return False
    _create(context, frames, bins)
    copies = config.input.mode == "copy"
    job = CountJob(context.store.path, frames.shape, bins, config.histogram, copies)
    everything = itertools.chain([first], blocks)
    del first  # so that nothing holds the frames when they are counted
    StackCounter(job, stream.bands, workers).count(everything, context.stop.check)
    return True


def _create(context: StageContext, frames: FrameSequence, bins: int) -> None:
    context.fresh = True
    for name in (path for stage in PREPARED for path in STAGES[stage].writes):
        context.store.delete(name)
    ingest.sensor_of(frames, context, {}).write(context.store)
    if context.config.input.mode == "copy":
        ingest.create_frames(context, frames)
    create_arrays(context, frames.shape, bins)
