"""Which reader is for which file: ours, and others' from the entry point group ``pchem_pipeline.readers``.

Nothing heavy is imported before a file needs it. The name of an entry point is the ``format_name`` of its
reader.
"""

from __future__ import annotations

import functools
import importlib
import logging
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import ConfigError, InputError, error_words, unreadable
from pchem_pipeline.frames.reader import FrameReader

ENTRY_POINT_GROUP = "pchem_pipeline.readers"

_log = logging.getLogger(__name__)

#: our formats: ``formats/npy.py`` has the class ``NpyReader``; raw comes last since any bytes could be raw
_OURS = ("npy", "tiff", "fits", "hdf5", "zarr", "ser", "dcimg", "spe", "sif", "nd2", "raw")
#: first bytes of files that hold others -> what made them
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"PK\x03\x04": "zip",
    b"7z\xbc\xaf\x27\x1c": "7-Zip",
}


@functools.cache
def _plugins() -> dict[str, EntryPoint]:
    """Return others' readers by format name, not loaded; of doubles the first, or ours."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        ours = point.name in (*_OURS, "auto", "histogram")
        first = "pchem_pipeline" if ours else found.setdefault(point.name, point).value
        if first != point.value:
            _warn(f"the reader {point.name!r} ({point.value}) is left out: {first} has that name")
    return found


@functools.cache  # once
def _warn(words: str) -> None:
    _log.warning(words)


def readers() -> Iterator[type[FrameReader]]:
    """Yield the readers of all formats, ours first; a plug-in that cannot be loaded is left out."""
    for name in reader_names():
        try:
            yield reader_class(name)
        except ConfigError as error:
            _warn(str(error))


def reader_names() -> list[str]:
    """Return the names of all formats, ours first."""
    return [*_OURS, *_plugins()]


def reader_class(name: str) -> type[FrameReader]:
    """Return the reader of a format, importing it only now.

    Raises:
        ConfigError: no such format, or a plug-in that is not a reader.
    """
    if name in _OURS:
        module = importlib.import_module(f"pchem_pipeline.frames.formats.{name}")
        ours: type[FrameReader] = getattr(module, f"{name.capitalize()}Reader")
        return ours
    plugins = _plugins()
    if name not in plugins:
        known = ", ".join([*_OURS, *plugins, "histogram"])
        raise ConfigError(f"unknown input.format {name!r}; choose one of: auto, {known}")
    try:
        found: Any = plugins[name].load()
        if not (isinstance(found, type) and issubclass(found, FrameReader)) or found.format_name != name:
            raise ConfigError(f"it must be a FrameReader with format_name = {name!r}")
    except Exception as error:
        raise ConfigError(
            f"the reader {name!r} ({plugins[name].value}) cannot be loaded: {error_words(error)}; repair or "
            "uninstall that package"
        ) from error
    return found


def frame_suffixes(name: str = "auto") -> dict[str, str]:
    """Return suffix -> format name, of one format or of all."""
    found = list(readers())[::-1] if name == "auto" else [reader_class(name)]  # of several the first counts
    return {suffix: each.format_name for each in found for suffix in each.suffixes}


def detect_format(path: Path) -> str:
    """Return the format of a file: from its first bytes, then from its suffix.

    Raises:
        InputError: the file is missing, empty, or of no known format.
    """
    head = b""
    try:
        if not path.is_dir():
            with path.open("rb") as stream:
                head = stream.read(64)
    except OSError as error:
        raise unreadable(path, error) from error
    if not head and not path.is_dir():
        raise InputError(f"{path}: the file is empty; copy it again or omit it")
    for reader in readers():
        try:
            if reader.recognises(path, head):
                return reader.format_name
        except Exception as error:  # a plug-in may raise anything
            name = f"{reader.format_name!r} ({reader.__module__})"
            _warn(f"the reader {name} failed: {error_words(error)}; repair or uninstall that package")
    by_suffix = frame_suffixes().get(path.suffix.lower())
    if by_suffix != "raw":  # raw samples may begin like anything
        check_unpacked(path, head)
    if by_suffix is None:
        raise InputError(
            f"{path}: unknown camera format (known: {', '.join(reader_names())}); set input.format (raw "
            "needs input.shape and input.dtype, or a sidecar file)"
        )
    return by_suffix


def check_unpacked(path: Path, head: bytes) -> None:
    """Raise InputError for a packed file: libraries may unpack it, but its bytes are not where they say."""
    for magic, program in _PACKED.items():
        if head.startswith(magic):
            raise InputError(f"{path}: compressed with {program}; unpack it first")
