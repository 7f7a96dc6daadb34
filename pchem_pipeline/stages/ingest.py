"""Stage ``ingest``: look at the camera files, record what they are, and copy their frames into the store.

With ``input.mode: copy`` the frames go into ``frames/dn``, by units of whole chunks. With ``reference``, and
with ready-made histograms, nothing is copied: the next stage reads the files themselves.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.first_look import limits_in
from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
from pchem_pipeline.frames.identity import file_size
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.reader import FrameReader
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.input import keep_ingested, listed_identity
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import WHOLE, Named, StageContext, Task
from pchem_pipeline.stages.overscan import write_overscan
from pchem_pipeline.stages.samples import check_samples, sample_sensor
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import equal_rows

#: frames, rows, columns: streams in the order of time and by tile alike
_CHUNK = (256, 128, 128)
#: files of frames beyond which several chunks share one
_MANY_FILES = 1500
#: bytes of frames that a worker holds at once
_UNIT_BYTES = 128 << 20
#: Frames and rows, first and end each: whole chunks of ``frames/dn``.
_Copied = tuple[int, int, int, int]


def run(context: StageContext) -> None:
    """Record the input, and copy the frames if ``input.mode`` says so.

    Raises:
        InputError: the input is bad, vanished or changed; the message lists all bad files.
        StoreError: the store refuses.
    """
    if context.config.input.samples:
        samples = check_samples(context.config, context.base_dir)
        context.begin()
        sample_sensor(context.config, samples).write(context.store)
        context.run_units([WHOLE])
        return
    if is_histogram_input(context.config.input, context.base_dir):
        _record_histograms(context)
        return
    settings = context.config.input
    done = context.prepared if context.is_prepared else None
    reader = open_frames(settings, context.base_dir) if done is None else done.frames
    context.begin()
    files = f"{len(reader.paths)} file{'s' * (len(reader.paths) != 1)}"
    context.reporter.info(f"ingest: {files} read as {reader.formats}; {disk_words(context.config, reader)}")
    if reader.time_words:
        (context.note if reader.integration_time is None else context.reporter.info)(reader.time_words)
    if message := reader.report.message():
        context.note(message)
    sensor_of(reader, context, listed_identity(context)).write(context.store)
    if reader.excluded is not None:
        context.store.write_array("frames/excluded", reader.excluded)
        number = np.count_nonzero(reader.excluded)
        context.note(f"{number} of {reader.excluded.size} pixels excluded: {', '.join(reader.exclusions)}")
    write_overscan(context.store, reader)
    keep_ingested(context)
    if settings.mode == "reference":
        context.run_units([WHOLE])
        return
    chunk = chunk_shape(reader.shape, reader.dtype.itemsize)
    units = list(copy_units(reader.shape, reader.dtype.itemsize, chunk))
    task: Task[Named[_Copied]] | None = None
    if done is None:
        create_frames(context, reader)
        task = functools.partial(_copy, reader=reader)
    # the frames of a row of chunks, those that the reader holds, and the compressed ones
    held = 0 if done else 3 * chunk[0] * chunk[1] * reader.shape[2] * reader.dtype.itemsize
    context.run_units(units, task, unit_name="block", unit_bytes=held)


def sensor_of(reader: FrameSequence, context: StageContext, identity: dict[str, Any]) -> SensorInfo:
    """Return what the run is to know of the stack of camera files."""
    n_frames, ny, nx = reader.shape
    return SensorInfo(
        kind="frames",
        n_frames=n_frames,
        ny=ny,
        nx=nx,
        dtype=reader.dtype.name,
        bit_depth=reader.bit_depth,
        seen_limits=reader.seen_limits,
        integration_time=reader.stated_integration_time,
        mode=context.config.input.mode,
        identity=identity,
        camera=reader.camera,
        whole=reader.whole_shape,
        reader=reader.formats,
    )


def create_frames(context: StageContext, reader: FrameSequence) -> None:
    """Make the array that the frames are copied to; say so where the disk may be too small."""
    chunk = chunk_shape(reader.shape, reader.dtype.itemsize)
    shard = shard_shape(reader.shape, chunk)
    lengths, chunks = (dict(zip(("frame", "y", "x"), each, strict=True)) for each in (reader.shape, chunk))
    context.create("frames/dn", lengths=lengths, chunks=chunks, shards=shard, dtype=reader.dtype)
    free = context.store.free_bytes()
    if context.fresh and math.prod(reader.shape) * reader.dtype.itemsize > free:  # if they compress badly
        words = disk_words(context.config, reader)
        context.note(f"{words}, {free / 1e9:.1f} GB free; if this does not fit, set input.mode: reference")


def disk_words(config: RunConfig, frames: FrameSequence) -> str:
    """Return where the frames are to be, and about how much disk the store takes."""
    n, ny, nx = frames.shape
    held: float = 420 * ny * nx  # histograms, fit and maps
    if config.histogram.summaries:
        blocks = n / config.histogram.block_length(n)
        series = 16 * (n * ny + blocks * ny * nx) + 4 * n * math.ceil(ny / ROW_GROUP) * nx
        held += 0.3 * series  # as they compress
    how = "stay in"
    if config.input.mode == "copy":
        how = "are copied from"
        held += n * ny * nx * frames.dtype.itemsize / 1.77  # as they compress
    return (
        f"frames {how} their files ({sum(map(file_size, frames.paths)) / 1e9:.2g} GB); "
        f"the store will hold about {held / 1e9:.2g} GB"
    )


def chunk_shape(shape: tuple[int, int, int], itemsize: int) -> tuple[int, int, int]:
    """Return the chunks of ``frames/dn``: fewer frames where a row of chunks would not fit into memory."""
    frames, rows, columns = _CHUNK
    while frames > 16 and frames * min(rows, shape[1]) * shape[2] * itemsize > _UNIT_BYTES:
        frames //= 2
    return min(frames, shape[0]), min(rows, shape[1]), min(columns, shape[2])


def shard_shape(shape: tuple[int, int, int], chunk: tuple[int, int, int]) -> tuple[int, int, int] | None:
    """Return how many of the chunks share a file, along the columns; None where each has its own.

    A unit of the copy is whole rows, so wider files cost no memory, and a pixel is still read by its chunk.
    """
    frames, rows, columns = chunk
    bands = math.ceil(shape[0] / frames) * math.ceil(shape[1] / rows)
    wide = columns
    while bands * math.ceil(shape[2] / wide) > _MANY_FILES and wide < shape[2]:
        wide *= 2
    return None if wide == columns else (frames, rows, wide)


def copy_units(
    shape: tuple[int, int, int], itemsize: int, chunk: tuple[int, int, int]
) -> Iterator[Named[_Copied]]:
    """Yield units of whole chunks over the full width, in the order of time."""
    n_frames, ny, nx = shape
    band = chunk[0] * chunk[1] * nx * itemsize
    rows = chunk[1] * max(1, _UNIT_BYTES // band)
    for t0, t1 in equal_rows(n_frames, chunk[0]):
        for y0, y1 in equal_rows(ny, rows):
            yield Named(f"frames-{t0}-{t1 - 1}-rows-{y0}-{y1 - 1}", (t0, t1, y0, y1))


def _copy(unit: Named[_Copied], store: RunStore, *, reader: FrameReader) -> None:
    rows, (t0, t1, y0, y1) = store.array("frames/dn").chunks[1], unit.content
    for y in range(y0, y1, rows):
        end = min(y + rows, y1)
        store.write("frames/dn", (slice(t0, t1), slice(y, end), slice(None)), reader.read(t0, t1, y, end))


# -- ready-made histograms ----------------------------------------------------------------------


def _record_histograms(context: StageContext) -> None:
    """Record ready-made histograms: each channel is a pixel of a sensor of one row."""
    given = read_histograms(context.config.input, context.base_dir)
    context.begin()
    for note in given.notes:
        context.note(note)
    highest = int(given.origin.max()) + given.counts.shape[2] - 1
    SensorInfo(
        kind="histograms",
        n_frames=int(given.counts.sum(axis=2).max()),
        ny=1,
        nx=len(given.names),
        dtype="int32" if given.origin.min() < 0 else np.min_scalar_type(highest).name,
        bit_depth=context.config.input.bit_depth,
        seen_limits=limits_in(given.counts, given.origin),
        integration_time=None,
        mode="reference",
        identity=listed_identity(context),
        names=given.names,
        reader="histogram",
    ).write(context.store)
    keep_ingested(context)
    context.run_units([WHOLE])
