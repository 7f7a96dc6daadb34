"""The few operations by which files of this machine change, and what a power cut leaves of them.

All writing goes through here, so that tests can let each operation fail, and replay what was not yet synced
in other orders. A file appears by its rename; that its content, and the rename, outlive a power cut is
certain only after `sync_file` or `sync_all`.
"""

from __future__ import annotations

import ctypes
import functools
import os
import secrets
import shutil
import threading
from pathlib import Path
from typing import Any

__all__ = [
    "aside",
    "make_folder",
    "put",
    "remove",
    "remove_tree",
    "replace",
    "sync_all",
    "sync_file",
    "sync_folder",
    "unsynced",
    "write",
]

Data = bytes | bytearray | memoryview


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
    """Wait until everything that was done on the file system of ``path`` is on the disk.

    One call for the 25 chunks of a tile takes 7 ms, where syncing each of them takes 50, and leaves out the
    folders (ext4 on a virtual disk).
    """
    syncfs = _syncfs()
    if syncfs is None:
        os.sync()
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        if syncfs(handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
    finally:
        os.close(handle)


@functools.cache
def _syncfs() -> Any:
    return getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)  # of Linux


def put(path: Path, data: Data, *, sync: bool = False) -> None:
    """Write a file, so that whoever reads it finds the old or the new one, whole."""
    part = aside(path)
    make_folder(path.parent)
    try:
        write(part, data)
        if sync:
            sync_file(part)
        replace(part, path)
    except BaseException:
        remove(part)
        raise


class Unsynced:
    """Whether anything was written below a folder since it was last synced, by this process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._dirty = False
        self._lock = threading.Lock()

    def note(self) -> None:
        """Remember that something was written."""
        self._dirty = True

    def sync(self) -> None:
        """Wait until all that was written is on the disk; threads that come meanwhile wait for the same."""
        with self._lock:
            if self._dirty:
                self._dirty = False  # before, so that what is written meanwhile counts as new
                try:
                    sync_all(self._folder)
                except BaseException:
                    self._dirty = True
                    raise


@functools.cache
def unsynced(folder: Path) -> Unsynced:
    """Return what is known of a folder, the same object for all that write to it."""
    return Unsynced(folder)
