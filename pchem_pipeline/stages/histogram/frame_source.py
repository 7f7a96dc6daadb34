"""Where the later stages get frames from: the store (copy) or the camera files (reference)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, StoreError, quoted
from pchem_pipeline.run.stage import StageContext, open_store

__all__ = ["FrameSource", "StoredFrames", "open_source", "read_ahead"]


class FrameSource(Protocol):
    """Frames that can be read by blocks of frames and bands of rows, from any thread or process."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the samples."""
        ...

    @property
    def rows_per_read(self) -> int:
        """Rows that are decoded together, and so come at no more cost than one."""
        ...

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """Fill ``buffer`` (frame, y, x) with frames t0..t1 and rows y0..y1, ends excluded."""
        ...


@dataclass(frozen=True)
class StoredFrames:
    """The frames that ``ingest`` copied into the store.

    Attributes:
        path: the store.
        shape: frames, rows, columns.
        dtype: type of the samples.
        rows_per_read: rows that are decoded together.
    """

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    rows_per_read: int = 1

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """See `FrameSource.read_into`.

        Raises:
            StoreError: a chunk is missing or corrupt.
        """
        rows = slice(y0, self.shape[1] if y1 is None else y1)
        buffer[...] = open_store(self.path).read("frames/dn", (slice(t0, t1), rows, slice(None)))


def open_source(context: StageContext) -> FrameSource:
    """Return the frames of the run.

    Raises:
        StoreError: ``ingest`` has not finished.
        InputError: the camera files are not those that were ingested.
    """
    from pchem_pipeline.frames.open import open_frames

    sensor, store = context.sensor, context.store
    record = store.records.read("ingest")
    if record is None or len(context.tiles_done("ingest")) < record.keys:
        raise StoreError(f"{store.path}: the input is not complete; run: pchem ingest {quoted(store.path)}")
    expected = (sensor.n_frames, *sensor.shape)
    if sensor.mode == "copy":
        array = store.array("frames/dn")
        return StoredFrames(store.path, expected, np.dtype(sensor.dtype), array.chunks[1])
    reader = open_frames(context.config.input, context.base_dir, check_duplicates=False)
    if reader.shape != expected or reader.dtype != np.dtype(sensor.dtype):
        raise InputError(
            f"{reader.paths[0]}: the camera files changed since they were ingested (now {reader.shape} "
            f"{reader.dtype}, then {expected} {sensor.dtype}); run: pchem ingest {quoted(store.path)}"
        )
    return reader


def read_ahead(
    source: FrameSource, rows: tuple[int, int], step: int, threads: int = 1
) -> Iterator[NDArray[Any]]:
    """Yield all frames by blocks, while the next block is read in the background.

    Args:
        source: the frames.
        rows: first row, and end of the rows.
        step: frames in a block; the last one may be shorter.
        threads: how many threads share the reading of a block (for coded files, which cost time to decode).

    Yields:
        Blocks (frame, y, x); each is overwritten after the next one was asked for.
    """
    n_frames, _, columns = source.shape
    y0, y1 = rows
    buffers = np.empty((2, min(step, n_frames), y1 - y0, columns), source.dtype)
    starts = range(0, n_frames, step)

    with ThreadPoolExecutor(threads, thread_name_prefix="read") as pool:

        def request(number: int) -> tuple[NDArray[Any], list[Future[None]]]:
            start = starts[number]
            block = buffers[number % 2][: min(step, n_frames - start)]
            cuts = np.linspace(0, block.shape[0], threads + 1).astype(int).tolist()
            return block, [
                pool.submit(source.read_into, block[a:b], start + a, start + b, y0, y1)
                for a, b in itertools.pairwise(cuts)
                if a < b
            ]

        pending = request(0)
        for number in range(len(starts)):
            block, futures = pending
            for future in futures:
                future.result()
            if number + 1 < len(starts):
                pending = request(number + 1)
            yield block
