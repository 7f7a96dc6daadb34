"""Where zarr keeps the arrays of a run: files written by `disk`, or objects of an object storage."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import FsspecStore, LocalStore

from pchem_pipeline.store import disk
from pchem_pipeline.store.remote_path import RemotePath

#: codecs that only turn bytes into numbers; others (pickle, ...) may run code of whoever wrote them
_PLAIN = frozenset(
    {
        *("bytes", "transpose", "sharding_indexed"),
        *("blosc", "bz2", "gzip", "lz4", "lzma", "zlib", "zstd"),
        *("crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"),
        *("delta", "shuffle", "bitround", "fixedscaleoffset", "quantize", "packbits", "astype"),
    }
)


class DiskStore(LocalStore):
    """zarr's store of files, which writes and removes as all of the run's files are written and removed."""

    async def set(self, key: str, value: Buffer) -> None:
        """Store a value."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Store a value, in a call of the caller's thread."""
        self._check_writable()
        path = self.root / key
        # an older description must not be lost with the new one; a new array may be, before its first marker
        described = path.name == "zarr.json" and path.exists()
        folders = disk.put(path, value.as_numpy_array().data, sync=described)
        disk.unsynced(self.root).note(path, folders)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Store a value where there is none; the run's lock lets only one process in."""
        if not await self.exists(key):
            await self.set(key, value)

    async def delete(self, key: str) -> None:
        """Remove a value."""
        await asyncio.to_thread(self.delete_sync, key)

    def delete_sync(self, key: str) -> None:
        """Remove a value, in a call of the caller's thread."""
        self._check_writable()
        path = self.root / key
        (disk.remove_tree if path.is_dir() else disk.remove)(path)
        disk.unsynced(self.root).note(None, [path.parent])

    async def delete_dir(self, prefix: str) -> None:
        """Remove all values below a name."""
        await self.delete(prefix)


def foreign_codecs(array: Any) -> list[str]:
    """Return the names of an array's codecs that may do more than turn bytes into numbers."""
    content = array.metadata.to_dict()
    coded = [content.get("compressor"), *(content.get("filters") or ()), *(content.get("codecs") or ())]
    names: list[str] = []
    while coded:
        codec = coded.pop()
        if isinstance(codec, Mapping):
            names.append(str(codec.get("name", codec.get("id"))).removeprefix("numcodecs."))
            inside = codec.get("configuration") or {}
            coded += [*inside.get("codecs", ()), *inside.get("index_codecs", ())]
        elif codec is not None:  # an object of the library, with its own description
            coded.append(codec.get_config() if hasattr(codec, "get_config") else codec.to_dict())
    return sorted(set(names) - _PLAIN - {name for name in names if name.startswith("imagecodecs_")})


def zarr_store(path: Path, *, writable: bool) -> Store:
    """Return what zarr opens for a run."""
    if not isinstance(path, RemotePath):
        return DiskStore(path, read_only=not writable)
    options: dict[str, Any] = {"use_listings_cache": False}
    return FsspecStore.from_url(str(path), storage_options=options, read_only=not writable)
