"""Which reader is for which file: ours, and others' from the entry point group ``pchem_pipeline.readers``.

Nothing heavy is imported before a file needs it. The name of an entry point is the ``format_name`` of its
reader.
"""

from __future__ import annotations

import functools
import importlib
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, InputError, MissingDependencyError, install_hint
from pchem_pipeline.frames.reader import FrameReader

ENTRY_POINT_GROUP = "pchem_pipeline.readers"

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
    """Return others' readers by format name, not loaded; refuse doubles."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        other = found.get(point.name)
        if other is not None and other.value == point.value:
            continue  # the same distribution seen twice on the path
        if other is not None or point.name in _OURS or point.name in ("auto", "histogram"):
            first = other.value if other is not None else "pchem_pipeline itself"
            raise ConfigError(
                f"two readers are named {point.name!r}: {first} and {point.value}; uninstall or rename "
                "one of them"
            )
        found[point.name] = point
    return found


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
        found: type[FrameReader] = getattr(module, f"{name.capitalize()}Reader")
        return found
    plugins = _plugins()
    if name not in plugins:
        known = ", ".join([*_OURS, *plugins, "histogram"])
        raise ConfigError(f"unknown input.format {name!r}; choose one of: auto, {known}")
    return _load(plugins[name])


def _load(point: EntryPoint) -> type[FrameReader]:
    try:
        cls = point.load()
    except Exception as error:
        raise ConfigError(
            f"the reader {point.name!r} ({point.value}) cannot be loaded: {error}; repair or uninstall "
            "that package"
        ) from error
    if not (isinstance(cls, type) and issubclass(cls, FrameReader)) or cls.format_name != point.name:
        raise ConfigError(
            f"the reader {point.name!r} ({point.value}) must be a FrameReader with format_name = "
            f"{point.name!r}; repair or uninstall that package"
        )
    return cls


def frame_suffixes(name: str = "auto") -> dict[str, str]:
    """Return suffix -> format name, of one format or of all."""
    names = reversed(reader_names()) if name == "auto" else [name]  # of several readers the first counts
    return {suffix: each for each in names for suffix in reader_class(each).suffixes}


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
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error
    if not head and not path.is_dir():
        raise InputError(f"{path}: the file is empty; copy it again or omit it")
    names = reader_names()
    for name in names:
        if reader_class(name).recognises(path, head):
            return name
    by_suffix = frame_suffixes().get(path.suffix.lower())
    if by_suffix != "raw":  # raw samples may begin like anything
        check_unpacked(path, head)
    if by_suffix is None:
        raise InputError(
            f"{path}: unknown camera format (known: {', '.join(names)}); set input.format (raw needs "
            "input.shape and input.dtype, or a sidecar file)"
        )
    return by_suffix


def check_unpacked(path: Path, head: bytes) -> None:
    """Raise InputError for a packed file: libraries may unpack it, but its bytes are not where they say."""
    for magic, program in _PACKED.items():
        if head.startswith(magic):
            raise InputError(f"{path}: compressed with {program}; unpack it first")


def require(module: str, extra: str, what: str) -> None:
    """Check that an optional library can be imported.

    Raises:
        MissingDependencyError: it cannot; the message names the extra to install.
    """
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"reading and writing {what} needs {module}; install it: {install_hint(extra)}"
        ) from error
