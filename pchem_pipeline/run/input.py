"""The input of a run: a content hash taken once and compared cheaply ever after, and its frames."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, StoreError, quoted
from pchem_pipeline.frames.identity import content_identity, digest_of, quick_identity
from pchem_pipeline.frames.resolve import input_paths
from pchem_pipeline.run.progress import whole_mebibytes
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.store.files import cure_of, read_record, write_record

if TYPE_CHECKING:
    from pchem_pipeline.frames.stream import FrameSource

LISTED_FILES = 64
#: Files of a run with the input as known now, and as the run holds it.
_KNOWN, _HELD = ".pchem/input.json", ".pchem/ingested.json"


def known_identity(context: StageContext) -> dict[str, Any]:
    """Return the content identity of the input, see `content_identity`.

    It is kept in the store with names, sizes and times of change; where these are as they were, it is not
    taken again. Where the files cannot be found any more, it is that of those that were ingested, else the
    last one known. Before the files are hashed for the first time, they are looked at for mistakes.

    Raises:
        InputError: files are missing or bad, and nothing is known of them from before.
    """
    settings = context.config.input
    known: dict[str, Any] = {}
    held: dict[str, Any] = {}
    with suppress(StoreError):  # one that is damaged is as good as none: the files are hashed again
        known = read_record(context.store.path / _KNOWN) or {}
        held = ingested_identity(context) or {}
    try:
        paths = input_paths(settings, context.base_dir)
        quick = quick_identity(paths)
    except InputError:
        for last in (held, known):  # files that were refused in between are known, but not held
            if last.get("files") == list(settings.files):
                return dict(last["identity"])
        raise
    if known.get("quick") == quick:
        return dict(known["identity"])
    if known.get("files") != list(settings.files):
        _inspect_input(context)
    size = sum(int(file["size"]) for file in quick["files"])
    with context.reporter.progress("ingest: hash", size >> 20, "MiB") as advance:
        show = whole_mebibytes(advance)

        def on_bytes(count: int) -> None:
            context.stop.check()
            show(count)

        identity = content_identity(paths, on_bytes)
    with suppress(StoreError):  # a store that cannot be written is a matter for those who write to it
        keep_identity(context, quick, identity)
    return identity


def identity_is_new(context: StageContext) -> bool:
    """Return whether nothing is known of the input yet."""
    return not (context.store.path / _KNOWN).exists()


def keep_ingested(context: StageContext) -> None:
    """Remember the input as known now as that which the run holds, whatever is found in its place later."""
    known = read_record(context.store.path / _KNOWN)
    if known is not None:
        write_record(context.store.path / _HELD, known)


def ingested_identity(context: StageContext) -> dict[str, Any] | None:
    """Return the input that the run holds, ``quick`` and ``identity``; None where that was not kept.

    Raises:
        StoreError: what was kept is damaged.
    """
    return read_record(context.store.path / _HELD, cure_of(context.store.path, "frames"))


def keep_identity(context: StageContext, quick: dict[str, Any], identity: dict[str, Any]) -> None:
    """Keep the content identity of the input, with names, sizes and times of change of its files.

    Raises:
        StoreError: the store cannot be written.
    """
    content = {"files": list(context.config.input.files), "quick": quick, "identity": identity}
    write_record(context.store.path / _KNOWN, content)


def _inspect_input(context: StageContext) -> None:
    """Check the input for mistakes, without reading the frames."""
    from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
    from pchem_pipeline.frames.open import open_frames

    settings = context.config.input
    if is_histogram_input(settings, context.base_dir):
        read_histograms(settings, context.base_dir)
    else:
        open_frames(settings, context.base_dir)


def listed_identity(context: StageContext) -> dict[str, Any]:
    """Return the identity of the input with the first files only, for the attributes of the store."""
    identity = known_identity(context)
    files = identity["files"]
    return {**identity, "files": files[:LISTED_FILES], "n_files": len(files)}


@dataclass(frozen=True)
class StoredFrames:
    """The frames that ``ingest`` copied into a store, a `FrameSource`."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    rows_per_read: int

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
    from pchem_pipeline.frames.open import open_frames

    sensor, store = context.sensor, context.store
    record = store.records.read("ingest")
    if record is None or not store.records.has_all(record):
        raise StoreError(f"{store.path}: the input is not complete; run: pchem ingest {quoted(store.path)}")
    expected, dtype = (sensor.n_frames, *sensor.shape), np.dtype(sensor.dtype)
    if sensor.mode == "copy":
        array = store.array("frames/dn")
        if array.shape != expected or array.dtype != dtype:
            raise StoreError(
                f"{store.path}: frames/dn differs from the ingested frames; {store.cure('frames/dn')}"
            )
        return StoredFrames(store.path, expected, dtype, array.chunks[1])
    reader = open_frames(context.config.input, context.base_dir, check_duplicates=False)
    files = known_identity(context)["files"]  # hashed again where names, sizes or times changed
    content = digest_of([file["xxh3_128"] for file in files])
    other = content != (record.content.get("input") or {}).get("content", content)
    if other or reader.shape != expected or reader.dtype != dtype:
        raise InputError(
            f"{reader.paths[0]}: the camera files changed since they were ingested (now {reader.shape} "
            f"{reader.dtype}, then {expected} {sensor.dtype}); run: pchem ingest {quoted(store.path)}"
        )
    return reader
