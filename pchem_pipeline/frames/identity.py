"""What a file is: content hashes for the record, sizes and times for quick checks.

Names are recorded without folders, so that a run can be moved together with its files.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import xxhash

from pchem_pipeline.base.errors import unreadable

#: bytes that a thread reads or decodes at a time: they are still in its cache when they are hashed and copied
SCRATCH_BYTES = 1 << 20


def _parts(path: Path) -> list[Path]:
    """Return the files of a path: itself, or all files below a folder (a zarr store), sorted."""
    if path.is_dir():
        return sorted(part for part in path.rglob("*") if part.is_file())
    return [path]


class FileHasher:
    """The hash of `hash_file`, piece by piece in the order of the bytes, of which ``done`` are hashed."""

    def __init__(self, path: Path, advance: Callable[[int], None] | None = None) -> None:
        self.path = path
        self.done = 0
        self._hasher = xxhash.xxh3_128()
        self._advance = advance
        self._parts: list[Path] | None = None
        self._offset = 0

    @functools.cached_property
    def size(self) -> int:
        """Bytes of the file when it was first asked; see `file_size`."""
        return file_size(self.path)

    def read_to(self, count: int | None = None) -> None:
        """Read and hash until ``count`` bytes are hashed in all, or everything.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            if self._parts is None:
                self._parts = _parts(self.path)
            while self._parts and (count is None or self.done < count):
                if self._read_part(self._parts[0], count):
                    del self._parts[0]
                    self._offset = 0
        except OSError as error:
            raise unreadable(self.path, error) from error

    def take(self, count: int) -> bytes:
        """Read and hash the next bytes of a file (no folder) and return them, fewer at its end.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            with self.path.open("rb", buffering=0) as stream:
                stream.seek(self._offset)
                data = stream.read(count)
        except OSError as error:
            raise unreadable(self.path, error) from error
        self._add(data)
        return data

    def hexdigest(self) -> str:
        """Hash the rest, and return the hash of all."""
        self.read_to()
        return self._hasher.hexdigest()

    def _read_part(self, part: Path, count: int | None) -> bool:
        """Hash one file from where it was left; tell whether it came to its end."""
        size = part.stat().st_size
        if part is not self.path and not self._offset:
            self._hasher.update(f"{part.relative_to(self.path).as_posix()}\0{size}\0".encode())
        view = memoryview(bytearray(max(1, min(SCRATCH_BYTES, size - self._offset))))
        with part.open("rb", buffering=0) as stream:
            stream.seek(self._offset)
            while count is None or self.done < count:
                got = stream.readinto(view if count is None else view[: count - self.done])
                if not got:
                    return True
                self._add(view[:got])
        return False

    def _add(self, data: bytes | memoryview) -> None:
        self._hasher.update(data)
        self.done += len(data)
        self._offset += len(data)
        if self._advance is not None:
            self._advance(len(data))


def hash_file(path: Path, advance: Callable[[int], None] | None = None) -> str:
    """Return the xxh3_128 of a file's content, streamed; of a folder: names and contents of all its files.

    Raises:
        InputError: the file cannot be read.
    """
    return FileHasher(path, advance).hexdigest()


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
    """Return the size in bytes, of a folder that of all its files.

    Raises:
        InputError: the file is missing.
    """
    try:
        return sum(part.stat().st_size for part in _parts(path))
    except OSError as error:
        raise unreadable(path, error) from error


def digest_of(record: object) -> str:
    """Return the xxh3_128 of the canonical JSON of a record."""
    return xxhash.xxh3_128(json.dumps(record, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def content_identity(paths: Iterable[Path], advance: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Return ``{"files": [{"name", "size", "xxh3_128"}, ...], "digest"}``; reads every byte.

    After each block, ``advance`` is called with its number of bytes.

    Raises:
        InputError: a file cannot be read.
    """
    return identity_of_hashes({path: hash_file(path, advance) for path in paths})


def identity_of_hashes(hashes: Mapping[Path, str]) -> dict[str, Any]:
    """Return the identity of `content_identity` from the hash of each file, in reading order."""
    files = [{"name": path.name, "size": file_size(path), "xxh3_128": text} for path, text in hashes.items()]
    return {"files": files, "digest": digest_of(files)}


def quick_identity(paths: Iterable[Path]) -> dict[str, Any]:
    """Return ``{"files": [{"name", "size", "mtime_ns"}, ...]}`` without reading the files.

    Raises:
        InputError: a file is missing.
    """
    files = []
    for path in paths:
        size = file_size(path)
        times = [part.stat().st_mtime_ns for part in _parts(path)]
        files.append({"name": path.name, "size": size, "mtime_ns": max(times, default=0)})
    return {"files": files}
