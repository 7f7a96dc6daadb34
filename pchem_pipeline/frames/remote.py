"""Camera files on object storage (``s3://`` and what else fsspec knows): fetched once, then read as files.

What was fetched is kept in the user's cache folder, and fetched again only when the storage says that it
changed. Not the file cache of fsspec: it writes into the place of the copy that another process may be
reading, and asks for the state of the object after fetching it, so that a change in between is never seen.
"""

from __future__ import annotations

import glob
import hashlib
import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

from pchem_pipeline.base.errors import InputError, MissingDependencyError, install_hint
from pchem_pipeline.frames.formats.raw import SIDECARS, RawReader
from pchem_pipeline.store.files import whole_file, write_atomic

_URL = re.compile(r"^[a-z][a-z0-9+-]+://")


def is_remote(entry: str) -> bool:
    """Return whether an entry of ``input.files`` is a URL."""
    return bool(_URL.match(entry))


def fetch(url: str) -> list[Path]:
    """Return the files behind a URL, a glob or a folder, fetched to this machine.

    Keys and the address of the server come from where the storage's library looks for them (for S3: the
    environment variables ``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY`` and ``AWS_ENDPOINT_URL``, or
    ``~/.aws``).

    Raises:
        InputError: nothing is there, or the storage refuses.
        MissingDependencyError: the library of that kind of storage is not installed.
    """
    import fsspec

    try:
        storage, path = fsspec.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise MissingDependencyError(
            f"{url}: this address needs another package ({error}); install it: {install_hint('s3')}"
        ) from error
    try:
        storage.invalidate_cache()
        names = _names(storage, path)
        found = [_fetched(storage, name) for name in names if not name.endswith(SIDECARS)]
        for name in names:
            _fetch_sidecars(storage, name)
    except InputError:
        raise
    except Exception as error:  # each kind of storage has errors of its own
        raise InputError(
            f"{url}: cannot be read ({' '.join(str(error).split())}); check address, keys and network"
        ) from error
    if not found:
        raise InputError(f"{url}: no such file; correct the address (input.files)")
    return found


def _names(storage: Any, path: str) -> list[str]:
    if glob.has_magic(path):
        return [str(name) for name in storage.glob(path)]
    if storage.isdir(path):
        return [str(each["name"]) for each in storage.ls(path, detail=True) if each["type"] == "file"]
    return [path] if storage.exists(path) else []


def _folder(storage: Any, parent: str) -> Path:
    from platformdirs import user_cache_path

    protocol = storage.protocol if isinstance(storage.protocol, str) else storage.protocol[0]
    where = f"{protocol}://{parent} {getattr(storage, 'endpoint_url', '')}"
    digest = hashlib.sha256(where.encode()).hexdigest()[:16]
    return user_cache_path("pchem_pipeline") / "remote" / digest


def _fetched(storage: Any, name: str) -> Path:
    """Return the local copy of a file, fetching it where there is none of this state."""
    place = PurePosixPath(name)
    target = _folder(storage, str(place.parent)) / place.name
    stamp = target.with_name(f".{place.name}.stamp")
    state = json.dumps([str(storage.ukey(name)), int(storage.size(name) or 0)])
    if target.exists() and stamp.exists() and stamp.read_text() == state:
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(target) as part:
        storage.get_file(name, str(part))
    write_atomic(stamp, state.encode())
    return target


def _fetch_sidecars(storage: Any, name: str) -> None:
    """Fetch what describes a raw file, under its own name or that of the file."""
    place = PurePosixPath(name)
    if place.suffix.lower() not in RawReader.suffixes:
        return
    for suffix in SIDECARS:
        for beside in (f"{name}{suffix}", str(place.with_suffix(suffix))):
            if storage.exists(beside):
                _fetched(storage, beside)
