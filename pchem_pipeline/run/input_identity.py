"""What the input of a run is: a content hash taken once, and compared cheaply ever after."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import InputError, StoreError
from pchem_pipeline.frames.identity import content_identity, quick_identity
from pchem_pipeline.frames.resolve import input_paths
from pchem_pipeline.run.progress import whole_mebibytes
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.files import cure_of, read_record, write_record

LISTED_FILES = 64


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
        known = read_record(_place(context)) or {}
        held = ingested_identity(context) or {}
    same_files = known.get("files") == list(settings.files)
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
    if not same_files:
        inspect_input(context)
    with context.reporter.progress("ingest: hash", _mebibytes(quick["files"]), "MiB") as advance:
        told = whole_mebibytes(advance)

        def hear(count: int) -> None:
            context.stop.check()
            told(count)

        identity = content_identity(paths, hear)
    with suppress(StoreError):  # a store that cannot be written is a matter for those who write to it
        keep_identity(context, quick, identity)
    return identity


def identity_is_new(context: StageContext) -> bool:
    """Tell whether nothing is known of the input yet."""
    return not _place(context).exists()


def keep_ingested(context: StageContext) -> None:
    """Remember the input as known now as that which the run holds, whatever is found in its place later."""
    known = read_record(_place(context))
    if known is not None:
        write_record(_ingested(context), known)


def ingested_identity(context: StageContext) -> dict[str, Any] | None:
    """Return the input that the run holds, ``quick`` and ``identity``; None where that was not kept.

    Raises:
        StoreError: what was kept is damaged.
    """
    return read_record(_ingested(context), cure_of(context.store.path, "frames"))


def _ingested(context: StageContext) -> Path:
    return context.store.path / ".pchem" / "ingested.json"


def keep_identity(context: StageContext, quick: dict[str, Any], identity: dict[str, Any]) -> None:
    """Keep the content identity of the input, with names, sizes and times of change of its files.

    Raises:
        StoreError: the store cannot be written.
    """
    files = list(context.config.input.files)
    write_record(_place(context), {"files": files, "quick": quick, "identity": identity})


def _place(context: StageContext) -> Path:
    return context.store.path / ".pchem" / "input.json"


def inspect_input(context: StageContext) -> None:
    """Check the input for mistakes, without reading the frames.

    Raises:
        InputError: files are missing or bad.
    """
    from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
    from pchem_pipeline.frames.open import open_frames

    settings = context.config.input
    if is_histogram_input(settings, context.base_dir):
        read_histograms(settings, context.base_dir)
    else:
        open_frames(settings, context.base_dir).close()


def shortened(identity: dict[str, Any]) -> dict[str, Any]:
    """Return the identity with the first files only, for the attributes of the store."""
    files = identity["files"]
    return {**identity, "files": files[:LISTED_FILES], "n_files": len(files)}


def _mebibytes(files: list[dict[str, Any]]) -> int:
    return sum(int(file["size"]) for file in files) >> 20
