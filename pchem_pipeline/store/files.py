"""Small files of a run, written so that a kill at any moment leaves the old or the new one, whole."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.store.remote_path import RemotePath

__all__ = ["canonical_json", "read_json", "storage_error", "write_atomic", "write_json"]

_CURES = {
    errno.ENOSPC: "the disk is full: free some space and run again, finished tiles are kept",
    errno.EDQUOT: "the disk quota is used up: free some space and run again, finished tiles are kept",
    errno.EROFS: "the file system is read-only: choose another place for the store",
    errno.EACCES: "no permission to write there: choose another place for the store",
    errno.EPERM: "no permission to write there: choose another place for the store",
}


def storage_error(error: OSError, path: object) -> StoreError:
    """Translate an error of the file system into one line with its cure; one that is such a line stays."""
    if isinstance(error, StoreError):
        return error
    cure = _CURES.get(error.errno or 0, "check the disk and the permissions")
    return StoreError(f"cannot use {path}: {error.strerror or error}; {cure}")


def is_fatal(error: BaseException) -> bool:
    """Tell whether an error will hit every other tile as well (disk full, no permission)."""
    return isinstance(error, OSError) and error.errno in _CURES


def write_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` beside ``path``, flush it to the disk, and rename it into place.

    An object of an object storage is put at once: it appears whole or not at all.

    Raises:
        StoreError: the file system, or the object storage, refused.
    """
    if isinstance(path, RemotePath):
        path.write_bytes(data)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
        temporary = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            # mkstemp makes private files; the rest of the store follows the user's umask
            temporary.chmod(0o666 & ~_umask())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise storage_error(error, path) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def canonical_json(value: Any) -> bytes:
    """Return the one JSON text of a value: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, atomically."""
    write_atomic(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any | None:
    """Return the value of a JSON file, or None where there is no file.

    Raises:
        StoreError: the file is not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise StoreError(f"{path} is damaged ({error}); delete it and run the stage again") from error
