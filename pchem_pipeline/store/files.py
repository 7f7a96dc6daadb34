"""Files that appear only when they are whole: a kill at any moment leaves the old one or the new one."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import StoreError, quoted
from pchem_pipeline.store import disk
from pchem_pipeline.store.remote_path import RemotePath

#: File with the description of a group or an array.
DESCRIPTION = "zarr.json"

_CURES = {
    errno.ENOSPC: "the disk is full: free space and run again, finished tiles are kept",
    errno.EDQUOT: "the disk quota is exhausted: free space and run again, finished tiles are kept",
    errno.EFBIG: "the file exceeds the size limit (see ulimit -f): raise it and run again",
    errno.EIO: "the disk reports an error: check it, then run again, finished tiles are kept",
    errno.EROFS: "the file system is read-only: choose another place",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "no permission to write there: choose another place"),
}

#: of one place, not of every other as well
_CURES_OF_A_PLACE = {
    errno.EEXIST: "a file is in place of the folder: choose another place",
    errno.ENOTDIR: "a file is in place of the folder: choose another place",
    errno.EISDIR: "a folder is in place of the file: choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    **dict.fromkeys(
        (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP),
        "the file system does not support file locks or similar: choose another place",
    ),
}


def storage_error(error: OSError, path: object) -> StoreError:
    """Translate an error of the file system into one line with its cure; one that is such a line stays."""
    if isinstance(error, StoreError):
        return error
    cures = _CURES | _CURES_OF_A_PLACE
    cure = cures.get(error.errno or 0, "check the disk: its free space, quota and permissions")
    return StoreError(f"cannot use {path}: {error.strerror or error}; {cure}")


@contextlib.contextmanager
def in_storage(path: object) -> Iterator[None]:
    """Turn what the file system refuses inside into the `storage_error` of a path."""
    try:
        yield
    except OSError as error:
        raise storage_error(error, path) from error


def is_fatal(error: BaseException) -> bool:
    """Return whether an error will hit every other tile as well (disk full, no permission)."""
    return isinstance(error, OSError) and error.errno in _CURES


def write_atomic(path: Path, data: disk.Data, *, sync: bool = True) -> None:
    """Write a small file, so that whoever reads it finds the old or the new one, whole; make its folders.

    A file that is there keeps its mode. With ``sync`` the file is on the disk before it takes its place, so
    that a power cut cannot leave it empty, and the place is on the disk on return. An object of an object
    storage is put at once.

    Raises:
        StoreError: the file system, or the object storage, refused.
    """
    if isinstance(path, RemotePath):
        path.write_bytes(data)
        return
    # a name that no other process uses; what a kill leaves there is removed later
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    with _put_in_place(path, aside, disk.sync_file if sync else None) as part:
        disk.write(part, data)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write a large file or a folder to, sync it, then rename it to ``path``.

    If something is raised inside, nothing is left of it. What a killed process left goes with the next
    writing, so only one process may write a file. The name aside keeps the suffix, since some libraries look
    at it.

    Raises:
        StoreError: the file system refused.
    """
    aside = path.with_name(f".partial-{path.name}")
    with _put_in_place(path, aside, disk.sync_all) as part:
        yield part


@contextlib.contextmanager
def _put_in_place(path: Path, aside: Path, sync: Callable[[Path], None] | None) -> Iterator[Path]:
    """Yield ``aside`` to write to, then rename it to ``path``: the one place where files appear."""
    try:
        disk.make_folder(path.parent)
        _remove(aside)
        yield aside
        if sync is not None:
            sync(aside)
        if path.is_dir():
            disk.remove_tree(path)
        elif path.is_file() and aside.is_file():
            shutil.copymode(path, aside)
        disk.replace(aside, path)
        if sync is not None:
            disk.sync_folder(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    except RuntimeError as error:  # of HDF5, which hides the number in its words
        if (number := re.search(r"errno = (\d+)", str(error))) is None:
            raise
        raise storage_error(OSError(int(number[1]), os.strerror(int(number[1]))), path) from error
    finally:
        _remove(aside)


def _remove(aside: Path) -> None:
    if aside.is_dir():
        shutil.rmtree(aside, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            aside.unlink()


def remove_files(*paths: Path) -> None:
    """Remove files or objects, those that are there; no power cut brings them back later.

    Raises:
        StoreError: the file system, or the object storage, refused.
    """
    found = [path for path in paths if isinstance(path, RemotePath) or os.path.lexists(path)]
    for path in found:
        with in_storage(path):
            disk.remove(path)
    for folder in {path.parent for path in found if not isinstance(path, RemotePath)}:
        with in_storage(folder):
            disk.sync_folder(folder)


def remove_folder(path: Path) -> None:
    """Remove a folder with all that is in it, if it is there; see `remove_files`.

    Raises:
        StoreError: the file system, or the object storage, refused.
    """
    if isinstance(path, RemotePath):
        path.remove_folder()
        return
    with in_storage(path):
        if path.is_dir():
            disk.remove_tree(path)
            disk.sync_folder(path.parent)


def link_out_of(folder: Path) -> Path | None:
    """Return a link in a folder, or below it, that leads out of it; None where there is none."""
    home, folders = folder.resolve(), [os.fspath(folder)]
    while folders:
        # another process may be removing what is listed
        with contextlib.suppress(OSError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_symlink():
                    if home not in Path(entry.path).resolve().parents:
                        return Path(entry.path).relative_to(folder)
                elif entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
    return None


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, atomically; see `write_atomic`."""
    write_atomic(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path, cure: str = "delete it and run the stage again") -> Any | None:
    """Return the value of a JSON file, or None where there is no file.

    Raises:
        StoreError: the file is not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged ({error}); {cure}") from error


def digest_of(path: Path) -> str | None:
    """Return the SHA-256 of a file or an object, or of the chunks of an array; None where there is none.

    Of a chunk enter its place, its size and its last bytes, which are the checksum of its codecs (of several
    in a file their sizes and the checksum of these): chunks that are exchanged, cut or missing are found
    without reading them.
    """
    if not isinstance(path, RemotePath) and path.is_dir():
        # plain names and no buffers: a store may have 100,000 chunks
        chunks = (f"{folder}/{name}" for folder, _, names in os.walk(path / "c") for name in names)
        return hashlib.sha256(b"".join(_mark_of(each, f"{path}/") for each in sorted(chunks))).hexdigest()
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError:
        return None


def _mark_of(chunk: str, array: str) -> bytes:
    with open(chunk, "rb", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 4096, 0))  # the checksum of one chunk, or what a shard lists
        return f"{chunk.removeprefix(array)} {size} ".encode() + file.read()


# -- records of a run: JSON with a digest of itself ------------------------------------------------

_DIGEST = "digest_of_content"
#: the stage which writes a group of arrays
_STAGE_OF = {
    **{n: n for n in ("histogram", "fit", "maps", "ensemble", "electrons", "discrepancy", "methods")},
    "frames": "ingest",
    "summary": "histogram",
    "truth": "simulate",
    "samples": "fit",
    "ensemble_tiles": "ensemble",
}


def cure_of(run: Path, name: str) -> str:
    """Return what to do where an array or a group of a run is damaged."""
    group = name.partition("/")[0]
    if group in _STAGE_OF:
        return f"run it again: pchem {_STAGE_OF[group]} {quoted(run)} --force"
    if group == "model":
        return f"delete {run / group} and run again; the model is then taken from the configuration"
    return "run it again with --force" if group else "delete it and run again"


def write_record(path: Path, value: dict[str, Any]) -> None:
    """Write a record of a run as JSON with a digest of itself, atomically; see `write_atomic`."""
    write_json(path, with_digest(value))


def read_record(path: Path, cure: str = "delete it and run again") -> dict[str, Any] | None:
    """Return what `write_record` wrote, or None where there is no file.

    Raises:
        StoreError: it is damaged.
    """
    with in_storage(path), contextlib.suppress(FileNotFoundError):
        return checked(path.read_bytes(), path, cure)[0]
    return None


def with_digest(content: dict[str, Any], *, inside: bool = False) -> dict[str, Any]:
    """Return JSON data with a digest of it; ``inside`` its attributes, as zarr needs it."""
    content = json.loads(json.dumps(content))  # as it will be read: keys are text
    holder = content.setdefault("attributes", {}) if inside else content
    holder.pop(_DIGEST, None)
    holder[_DIGEST] = fingerprint_of(content)
    return content


def checked(data: bytes, path: Path, cure: str, *, inside: bool = False) -> tuple[dict[str, Any], bool]:
    """Return JSON data without their digest, and whether they had one; those of version 0.2 had none.

    Raises:
        StoreError: they are damaged.
    """
    try:
        content = json.loads(data)
        holder = content.get("attributes", {}) if inside else content
        digest = holder.pop(_DIGEST, None)
        same = digest is None or digest == fingerprint_of(content)
    except (ValueError, RecursionError, AttributeError, TypeError) as error:
        raise StoreError(f"{path} is damaged ({error}); {cure}") from error
    if not same:
        raise StoreError(f"{path} is damaged (checksum mismatch); {cure}")
    return content, digest is not None


def fingerprint_of(content: dict[str, Any]) -> str:
    """Return the SHA-256 of the one JSON text of ``content``: sorted keys, no spaces."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
