"""The few operations by which files of this machine change, so that tests can let each of them fail.

A file appears by its rename; that its content outlives a power cut is certain only after `sync_file`, and the
rename after `sync_folder`. Records and markers are synced, chunks are not: one that a power cut took is found
missing or without its checksum by whoever reads it.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

Data = bytes | bytearray | memoryview


def make_folder(path: Path) -> None:
    """Make a folder and those above it."""
    path.mkdir(parents=True, exist_ok=True)


def write(path: Path, data: Data) -> None:
    """Write a file that nobody looks at yet."""
    path.write_bytes(data)


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
    parts = [path, *(path.rglob("*") if path.is_dir() else ())]
    for part in sorted(parts, key=Path.is_dir):  # files come before folders
        (sync_folder if part.is_dir() else sync_file)(part)
