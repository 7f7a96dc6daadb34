"""What a file is: content hashes for the record, sizes and times for quick checks.

Names are recorded without folders, so that a run can be moved together with its files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import xxhash

from pchem_pipeline.errors import InputError

__all__ = ["content_identity", "digest_of", "file_size", "hash_file", "quick_identity", "sample_hash"]

_BLOCK = 1 << 22


def _parts(path: Path) -> list[Path]:
    """Return the files of a path: itself, or all files below a folder (a zarr store), sorted."""
    if path.is_dir():
        return sorted(part for part in path.rglob("*") if part.is_file())
    return [path]


def hash_file(path: Path, advance: Callable[[int], None] | None = None) -> str:
    """Return the xxh3_128 of a file's content, streamed; of a folder: names and contents of all its files.

    Args:
        path: the file or folder.
        advance: told of the number of bytes of each block, for a progress bar.

    Raises:
        InputError: the file cannot be read.
    """
    hasher = xxhash.xxh3_128()
    buffer = bytearray(_BLOCK)
    view = memoryview(buffer)
    try:
        for part in _parts(path):
            if part is not path:
                hasher.update(f"{part.relative_to(path).as_posix()}\0{part.stat().st_size}\0".encode())
            with part.open("rb", buffering=0) as stream:
                while count := stream.readinto(buffer):
                    hasher.update(view[:count])
                    if advance is not None:
                        advance(count)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error
    return hasher.hexdigest()


def sample_hash(path: Path) -> str:
    """Return a hash of the first, middle and last 64 KiB; where it is equal, look closer."""
    hasher = xxhash.xxh3_128()
    for part in _parts(path)[:64]:
        size = part.stat().st_size
        with part.open("rb") as stream:
            for start in sorted({0, max(0, size // 2 - 32768), max(0, size - 65536)}):
                stream.seek(start)
                hasher.update(stream.read(65536))
    return hasher.hexdigest()


def file_size(path: Path) -> int:
    """Return the size in bytes, of a folder that of all its files."""
    return sum(part.stat().st_size for part in _parts(path))


def digest_of(record: object) -> str:
    """Return the xxh3_128 of the canonical JSON of a record."""
    return xxhash.xxh3_128(json.dumps(record, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def content_identity(paths: Iterable[Path], advance: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Return ``{"files": [{"name", "size", "xxh3_128"}, ...], "digest"}``; reads every byte.

    Args:
        paths: the files, in reading order.
        advance: told of the number of bytes of each block, for a progress bar.

    Raises:
        InputError: a file cannot be read.
    """
    files = [{"name": path.name, "size": _size(path), "xxh3_128": hash_file(path, advance)} for path in paths]
    return {"files": files, "digest": digest_of(files)}


def quick_identity(paths: Iterable[Path]) -> dict[str, Any]:
    """Return ``{"files": [{"name", "size", "mtime_ns"}, ...]}`` without reading the files.

    Raises:
        InputError: a file is missing.
    """
    files = []
    for path in paths:
        size = _size(path)
        times = [part.stat().st_mtime_ns for part in _parts(path)]
        files.append({"name": path.name, "size": size, "mtime_ns": max(times, default=0)})
    return {"files": files}


def _size(path: Path) -> int:
    try:
        return file_size(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that it is still there"
        ) from error
