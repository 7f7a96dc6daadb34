"""The few operations by which files of this machine change, and what a power cut leaves of them.

All writing goes through here, so that tests can let each operation fail, and replay what was not yet synced
in other orders. A file appears by its rename; that its content outlives a power cut is certain only after
`sync_file`, and the rename after `sync_folder`.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import shutil
import threading
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

Data = bytes | bytearray | memoryview

_SYNCS_AT_ONCE = 8


def aside(path: Path) -> Path:
    """Return a name beside ``path`` that no other process uses; what a kill leaves there is removed later."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")


def make_folder(path: Path) -> None:
    """Make a folder and those above it."""
    path.mkdir(parents=True, exist_ok=True)


def write(path: Path, data: Data) -> None:
    """Write a file that nobody looks at yet."""
    with path.open("wb", buffering=0) as file:
        rest = memoryview(data).cast("B")
        while rest:
            rest = rest[file.write(rest) :]


def replace(source: Path, target: Path) -> None:
    """Give a file or folder its name, in place of an older one."""
    source.replace(target)


def remove(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)


def remove_tree(path: Path) -> None:
    """Remove a folder with all that is in it, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_all(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk."""
    below = list(path.rglob("*")) if path.is_dir() else []
    _each(sync_file, [part for part in (path, *below) if part.is_file()])
    _each(sync_folder, [part for part in (path, *below) if part.is_dir()])


def put(path: Path, data: Data, *, sync: bool = False) -> list[Path]:
    """Write a file, so that whoever reads it finds the old or the new one, whole.

    Returns:
        The folders in which names changed: its own, and those above it that were not there.
    """
    part = aside(path)
    folders = [path.parent]
    while not folders[-1].exists():
        folders.append(folders[-1].parent)
    make_folder(path.parent)
    try:
        write(part, data)
        if sync:
            sync_file(part)
        replace(part, path)
    except BaseException:
        remove(part)
        raise
    return folders


class Unsynced:
    """What this process has changed below a folder since it was last synced: files, and folders of names."""

    def __init__(self) -> None:
        self._files: set[Path] = set()
        self._folders: set[Path] = set()
        self._lock = threading.Lock()
        self._waiting = threading.Lock()

    def note(self, file: Path | None, folders: Iterable[Path]) -> None:
        """Remember a file that was written, if any, and folders in which names changed."""
        with self._lock:
            self._files |= set() if file is None else {file}
            self._folders |= set(folders)

    def sync(self, part: Path | None = None) -> None:
        """Wait until all that was noted, and one more file, is on the disk; nothing else is waited for.

        Files come before folders. Several at once: the journal of a file system takes them together, in the
        time of a few. Threads that come meanwhile wait, since what they noted may be on its way.
        """
        with self._waiting:
            with self._lock:
                files, folders = self._files, self._folders
                self._files, self._folders = set(), set()
            try:
                _each(sync_file, [*files, *([part] if part is not None else [])])
                _each(sync_folder, folders)
            except BaseException:
                with self._lock:
                    self._files |= files
                    self._folders |= folders
                raise


def _each(sync: Callable[[Path], None], paths: Collection[Path]) -> None:
    """Sync files or folders, but for those that were removed since."""

    def one(path: Path) -> None:
        with contextlib.suppress(FileNotFoundError):
            sync(path)

    if len(paths) < 2:
        for path in paths:
            one(path)
        return
    with ThreadPoolExecutor(min(_SYNCS_AT_ONCE, len(paths)), thread_name_prefix="sync") as pool:
        for _ in pool.map(one, paths):
            pass


@functools.cache
def unsynced(folder: Path) -> Unsynced:
    """Return what is known of a folder, the same object for all that write to it."""
    return Unsynced()
