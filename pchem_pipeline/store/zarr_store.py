"""Where zarr keeps the arrays of a run: files written by `disk`, or objects of an object storage.

Every chunk of every array is written, and every description (``zarr.json``) has a digest in its attributes.
So a chunk that is missing and a description that was changed are damage, and refused here, whoever reads.
Arrays without a digest are of version 0.2, which left out chunks of the fill value alone.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.store import disk
from pchem_pipeline.store.files import DESCRIPTION, checked, cure_of, with_digest, write_atomic
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
        # the root must not be lost, nor an older description with the new one; a new array may be
        described = path.name == DESCRIPTION and (key == DESCRIPTION or path.exists())
        write_atomic(path, value.as_numpy_array().data, sync=described)

    async def delete(self, key: str) -> None:
        """Remove a value."""
        await asyncio.to_thread(self.delete_sync, key)

    def delete_sync(self, key: str) -> None:
        """Remove a value, in a call of the caller's thread."""
        self._check_writable()
        path = self.root / key
        (disk.remove_tree if path.is_dir() else disk.remove)(path)

    async def delete_dir(self, prefix: str) -> None:
        """Remove all values below a name."""
        await self.delete(prefix)


class CheckedStore(WrapperStore[Store]):
    """A store of zarr that adds a digest to each description, and refuses what is missing or was changed."""

    def __init__(self, store: Store, path: Path, *, begins: bool = False) -> None:
        """Take a store and its path; ``begins`` where chunks are written, which zarr looks for before."""
        super().__init__(store)
        self._path, self._begins = path, begins

    def _with_store(self, store: Store) -> CheckedStore:
        return CheckedStore(store, self._path, begins=self._begins)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a value, None where there is none.

        Raises:
            StoreError: a chunk is missing, or a description was changed.
        """
        found = await self._store.get(key, prototype, byte_range)
        if key.endswith(DESCRIPTION) and found is not None:
            content, _ = self._description(key, found)
            return prototype.buffer.from_bytes(json.dumps(content).encode())
        array, chunk, _ = key.partition("/c/")
        if found is None and chunk and not self._begins:
            place = f"{array}/{DESCRIPTION}"
            description = await self._store.get(place, default_buffer_prototype())
            if description is not None and self._description(place, description)[1]:
                raise StoreError(
                    f"{self._path / key} is missing (deleted, or its tile was never done); "
                    f"{cure_of(self._path, array)}"
                )
        return found

    def _description(self, key: str, found: Buffer) -> tuple[dict[str, Any], bool]:
        """Return a description without its digest, and whether it had one."""
        path = self._path / key
        return checked(
            found.to_bytes(), path, cure_of(self._path, key.removesuffix(DESCRIPTION)), inside=True
        )

    async def set(self, key: str, value: Buffer) -> None:
        """Store a value, a description with its digest."""
        if key.endswith(DESCRIPTION):
            content = with_digest(json.loads(value.to_bytes()), inside=True)
            value = type(value).from_bytes(json.dumps(content, indent=2).encode())
        await self._store.set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Store a value where there is none; the run's lock lets only one process in."""
        if not await self.exists(key):
            await self.set(key, value)


def foreign_codecs(array: Any) -> list[str]:
    """Return the names of an array's codecs that may do more than turn bytes into numbers."""
    return sorted({n for n in codec_names(array) if n not in _PLAIN and not n.startswith("imagecodecs_")})


def codec_names(array: Any) -> list[str]:
    """Return the names of an array's codecs, those inside of shards, too."""
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
    return names


def zarr_store(path: Path, *, writable: bool, begins: bool = False) -> Store:
    """Return what zarr opens for a run; ``begins`` to write chunks."""
    store: Store
    if isinstance(path, RemotePath):
        options: dict[str, Any] = {"use_listings_cache": False}
        store = FsspecStore.from_url(str(path), storage_options=options, read_only=not writable)
    else:
        store = DiskStore(path, read_only=not writable)
    return CheckedStore(store, path, begins=begins)
