"""The frames of a run as its stages read them: from the store (copy) or from the camera files (reference)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, StoreError, quoted
from pchem_pipeline.run.stage import StageContext, open_store

if TYPE_CHECKING:
    from pchem_pipeline.frames.stream import FrameSource


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
        StoreError: ``ingest`` has not finished, or its frames are damaged.
        InputError: the camera files are not those that were ingested, by their content.
    """
    from pchem_pipeline.frames.identity import digest_of
    from pchem_pipeline.frames.open import open_frames
    from pchem_pipeline.run.input_identity import known_identity

    sensor, store = context.sensor, context.store
    record = store.records.read("ingest")
    if record is None or not store.records.has_all(record):
        raise StoreError(f"{store.path}: the input is not complete; run: pchem ingest {quoted(store.path)}")
    expected = (sensor.n_frames, *sensor.shape)
    if sensor.mode == "copy":
        array = store.array("frames/dn")
        if array.shape != expected or array.dtype != np.dtype(sensor.dtype):
            raise StoreError(
                f"{store.path}: frames/dn differs from the ingested frames; {store.cure('frames/dn')}"
            )
        return StoredFrames(store.path, expected, np.dtype(sensor.dtype), array.chunks[1])
    reader = open_frames(context.config.input, context.base_dir, check_duplicates=False)
    files = known_identity(context)["files"]  # hashed again where names, sizes or times changed
    content = digest_of([file["xxh3_128"] for file in files])
    other = content != (record.content.get("input") or {}).get("content", content)
    if other or reader.shape != expected or reader.dtype != np.dtype(sensor.dtype):
        raise InputError(
            f"{reader.paths[0]}: the camera files changed since they were ingested (now {reader.shape} "
            f"{reader.dtype}, then {expected} {sensor.dtype}); run: pchem ingest {quoted(store.path)}"
        )
    return reader
