"""One run on disk: a zarr (format 3) root that xarray can open, and the run's own files beside it.

```
run.zarr/
  zarr.json              schema version in the attributes
  frames/ histogram/ summary/ fit/ maps/ ensemble/ electrons/ truth/
  model/                 0001.json ...: versions of the model, their arrays in groups; current.json
  report.html, report.json, figures/
  .pchem/                config.yaml, stages/<stage>.json, done/<stage>/<fingerprint>/<unit>.json, lock,
                         progress.json while a command works on it
```

The same objects make a run on an object storage, whose path is a URL; there ``lock.json`` is the lock.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import PchEmError, StoreError, quoted
from pchem_pipeline.base.variables import VARIABLES, variable_at
from pchem_pipeline.store import disk
from pchem_pipeline.store.files import (
    DESCRIPTION,
    cure_of,
    link_out_of,
    remove_files,
    remove_folder,
    storage_error,
    write_atomic,
)
from pchem_pipeline.store.lock import locked
from pchem_pipeline.store.records import Records, check_work
from pchem_pipeline.store.remote_path import RemotePath, place_of, refused

if TYPE_CHECKING:
    import zarr

#: Version of the layout; another version is refused.
SCHEMA_VERSION = 1

_PRIVATE = ".pchem"
_DIGEST_LINE = "# sha256 of the rest: "
#: what zarr and its codecs raise over wrong content
_DAMAGE = (ValueError, RuntimeError, TypeError, AttributeError, AssertionError, IndexError)
_Region = tuple[slice | int, ...]
#: Pixels about each that is wanted which are rather read than left out.
_SPARSE = 16


class RunStore:
    """A run's arrays and files. Open it with :meth:`open` or make it with :meth:`create`."""

    def __init__(self, path: Path, root: zarr.Group) -> None:
        self.path = path
        self._root = root
        self.records = Records(path / _PRIVATE)

    # -- opening ------------------------------------------------------------------------------

    @classmethod
    def create(cls, path: Path) -> RunStore:
        """Open the store at ``path``, made new where there is none.

        Raises:
            StoreError: something else is at that path, or it cannot be written.
        """
        import zarr
        from zarr.errors import ContainsGroupError

        from pchem_pipeline.store.zarr_store import zarr_store

        path = place_of(path)
        # looked for first: another process may be making the same store
        others = _holds_other_files(path)
        if (path / DESCRIPTION).exists():
            return cls.open(path, writable=True)
        if others:
            raise StoreError(f"{path} exists and is not a run; choose another --store or remove it")
        with _one_line(path, path), suppress(ContainsGroupError):
            disk.make_folder(path)
            attributes = {"pchem_schema": SCHEMA_VERSION}
            zarr.create_group(zarr_store(path, writable=True), zarr_format=3, attributes=attributes)
            if not isinstance(path, RemotePath):
                disk.sync_folder(path.parent)  # or a power cut would take the whole run
        return cls.open(path, writable=True)

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> RunStore:
        """Open an existing store.

        Raises:
            StoreError: there is none, it is damaged, or it has another schema version.
        """
        import zarr

        from pchem_pipeline.store.zarr_store import zarr_store

        path = place_of(path)
        if not (path / DESCRIPTION).exists():
            if (path / _PRIVATE / "stages").is_dir():
                raise StoreError(f"{path / DESCRIPTION} is missing; run again to write it")
            raise StoreError(
                f"there is no run at {path}; make one with: pchem run FILES --store {quoted(path)}"
            )
        _refuse_links(path)
        try:
            with _one_line(path, path):
                root = zarr.open_group(zarr_store(path, writable=writable), mode="r+" if writable else "r")
                schema = root.attrs.get("pchem_schema")
        except (KeyError, *_DAMAGE) as error:
            raise StoreError(f"{path / DESCRIPTION} is damaged ({error}); {cure_of(path, '')}") from error
        if schema is None:
            raise StoreError(
                f"{path} is a zarr store, but not a run; to read its frames: pchem run {quoted(path)} "
                "--store run.zarr"
            )
        if schema != SCHEMA_VERSION:
            raise StoreError(
                f"{path} has schema version {schema}, this program needs {SCHEMA_VERSION}; use the program "
                "that made it, or start a new run"
            )
        return cls(path, root)

    # -- arrays -------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Return whether the array or group ``name`` exists."""
        with self._translated(name):
            return name in self._root

    def arrays(self, group: str) -> list[str]:
        """Return the names of the arrays of a group, sorted."""
        import zarr

        with self._translated(group):
            found = self._root[group]
            return sorted(found.array_keys()) if isinstance(found, zarr.Group) else []

    def create_array(
        self,
        name: str,
        shape: tuple[int, ...],
        *,
        chunks: tuple[int, ...],
        shards: tuple[int, ...] | None = None,
        dtype: Any = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Make the array of a variable in `VARIABLES` in place of an older one.

        One task must write whole chunks, or whole shards: multiples of the chunks that share a file (None:
        each chunk is a file). A type is given only for variables whose type the data decide.

        Raises:
            StoreError: the file system refused.
        """
        variable = variable_at(name)
        kind = np.dtype(variable.dtype if dtype is None else dtype)
        symbol = {"symbol": variable.symbol} if variable.symbol else {}
        attrs = {"units": variable.unit, "long_name": variable.long_name, **symbol, **(attributes or {})}
        with self._translated(name):
            self._root.create_array(
                name,
                shape=shape,
                chunks=tuple(max(1, min(c, s)) for c, s in zip(chunks, shape, strict=True)),
                shards=shards,
                dtype=kind,
                fill_value=np.nan if kind.kind == "f" else variable.fill,
                compressors=_compressors(name, kind),
                dimension_names=variable.dims,
                attributes=attrs,
                config={"write_empty_chunks": True},
                overwrite=True,
            )

    def write_array(self, name: str, data: NDArray[Any], attributes: Mapping[str, Any] | None = None) -> None:
        """Make a small array and write it whole, in one chunk."""
        dtype = data.dtype if variable_at(name).dtype == "*" else None
        self.create_array(name, data.shape, chunks=data.shape, dtype=dtype, attributes=attributes)
        self.write(name, None, data)

    @functools.cached_property
    def _writer(self) -> zarr.Group:
        """The root through which chunks are written: zarr looks for what is in their place before."""
        import zarr

        from pchem_pipeline.store.zarr_store import zarr_store

        return zarr.open_group(zarr_store(self.path, writable=True, begins=True), mode="r+")

    def array(self, name: str, *, to_write: bool = False) -> zarr.Array[Any]:
        """Return the zarr array ``name``, for its shape, chunks and attributes.

        Raises:
            StoreError: it is not in the store.
        """
        import zarr

        from pchem_pipeline.store.zarr_store import foreign_codecs

        with self._translated(name):
            found = (self._writer if to_write else self._root).get(name)
        if found is None:
            raise StoreError(f"{self.path} has no {name}; {self.cure(name)}")
        if not isinstance(found, zarr.Array):
            raise StoreError(f"{self.path}: {name} is not an array; {self.cure(name)}")
        if foreign := foreign_codecs(found):
            raise StoreError(
                f"{self.path}: {name} is encoded by {', '.join(foreign)}, which this program never uses and "
                "which may run code; do not use this store"
            )
        return found.with_config({"write_empty_chunks": True})

    def cure(self, name: str) -> str:
        """Return what to do where an array or a group is damaged."""
        return cure_of(self.path, name)

    def read(self, name: str, region: _Region | None = None) -> NDArray[Any]:
        """Return the array ``name``, or a region of it.

        Raises:
            StoreError: it is missing or a chunk is corrupt.
        """
        array = self.array(name)
        with self._translated(name, region):
            return np.asarray(array[region if region is not None else ...])

    def at(self, region: tuple[slice, slice] | None = None, group: str = "") -> Part:
        """Return the arrays of a region (y, x), or whole, by their paths or by their names in a group."""
        return Part(self, region, f"{group}/" if group else "")

    def file_shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of the parts of an array that are a file each, and that one task writes whole."""
        array = self.array(name)
        return array.shards or array.chunks

    def read_pixels(self, name: str, y: IntArray, x: IntArray) -> NDArray[Any]:
        """Return the elements of an array (y, x, ...) at rows y and columns x of n pixels, shape (n, ...).

        Raises:
            StoreError: it is missing or a chunk is corrupt.
        """
        array, (high, wide) = self.array(name), self.file_shape(name)[:2]
        found = np.empty((y.size, *array.shape[2:]), array.dtype)
        file = (y // high) * (array.shape[1] // wide + 1) + x // wide
        for each in np.unique(file):
            here = np.flatnonzero(file == each)
            with self._translated(name):
                found[here] = _pixels_of(array, y[here], x[here])
        return found

    def write(self, name: str, region: _Region | None, data: NDArray[Any]) -> None:
        """Write ``data`` into a region made of whole chunks; None: into the whole array.

        Raises:
            LockedError: the work of this thread was overtaken by a later command.
            StoreError: the file system refused.
        """
        check_work(self.path)
        with self._translated(name, region):
            self.array(name, to_write=True)[... if region is None else region] = data

    def fill(self, name: str) -> None:
        """Write the fill value wherever nothing was written: a chunk that is missing is damage.

        Raises:
            StoreError: it is missing, or the file system refused.
        """
        array, sizes = self.array(name, to_write=True), self.file_shape(name)
        for place in np.ndindex(*(-(-n // size) for n, size in zip(array.shape, sizes, strict=True))):
            if not self.path.joinpath(name, "c", *map(str, place)).exists():
                region = tuple(slice(i * size, (i + 1) * size) for i, size in zip(place, sizes, strict=True))
                with self._translated(name, region):
                    array[region] = array.fill_value

    def resize(self, name: str, length: int) -> None:
        """Make an array longer (or shorter) along its first axis; what it holds stays.

        Raises:
            StoreError: it is missing, or the file system refused.
        """
        array = self.array(name)
        with self._translated(name):
            array.resize((length, *array.shape[1:]))

    def delete(self, name: str) -> None:
        """Remove an array or a group, if it exists, also one whose description a power cut has lost."""
        remove_folder(self.path / name)

    def attributes(self, name: str = "") -> dict[str, Any]:
        """Return the attributes of a group or array (of the root by default); empty where there is none."""
        with self._translated(name):
            found = self._root.get(name) if name else self._root
            return {} if found is None else dict(found.attrs)

    def set_attributes(self, name: str, values: Mapping[str, Any]) -> None:
        """Add attributes (JSON) to a group; one that is not there is made with them, in one write."""
        with self._translated(name):
            if name in self._root:
                self._root[name].attrs.update(values)
            else:
                self._root.create_group(name, attributes=dict(values))

    # -- files --------------------------------------------------------------------------------

    def write_file(self, name: str, data: bytes) -> None:
        """Write a file of the run, atomically."""
        write_atomic(self.path / name, data)

    def write_config(self, text: str) -> None:
        """Keep the resolved YAML of the run, its digest before it: no cut file is without one."""
        write_atomic(self.path / _PRIVATE / "config.yaml", _digest_line(text.encode()) + text.encode())

    # -- housekeeping -------------------------------------------------------------------------

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run's lock, see :mod:`.lock`.

        Raises:
            LockedError: another process holds it.
            StoreError: the lock file cannot be written.
        """
        with locked(self.path, self.path / _PRIVATE):
            if not isinstance(self.path, RemotePath):  # where no killed process leaves half files
                found = (Path(folder) / name for folder, _, names in os.walk(self.path) for name in names)
                remove_files(*(path for path in found if path.name.endswith(".partial")))
            yield

    def free_bytes(self) -> int:
        """Return the free space of the disk that holds the store; an object storage is never full."""
        if isinstance(self.path, RemotePath):
            return sys.maxsize
        return shutil.disk_usage(self.path).free

    @contextmanager
    def _translated(self, name: str, region: _Region | None = None) -> Iterator[None]:
        where = f"{self.path}: {name}" + (f" {_words(region)}" if region else "")
        try:
            with _one_line(self.path, where):
                yield
        except _DAMAGE as error:
            raise StoreError(f"{where} is damaged ({error}); {self.cure(name)}") from error


def stored_config(path: Path) -> str | None:
    """Return the resolved YAML that made a run, or None.

    Raises:
        StoreError: it was changed since.
    """
    place = path / _PRIVATE / "config.yaml"
    try:
        content = place.read_bytes()
    except FileNotFoundError:
        return None
    if re.match(rb"[a-z_]+:", content):  # of version 0.2
        return content.decode(errors="replace")
    head, _, text = content.partition(b"\n")
    if head + b"\n" != _digest_line(text):
        raise StoreError(
            f"{place} is damaged (checksum mismatch); give the run's YAML file instead of its store"
        )
    return text.decode()


def _digest_line(text: bytes) -> bytes:
    return f"{_DIGEST_LINE}{hashlib.sha256(text).hexdigest()}\n".encode()


class Part(MutableMapping[str, NDArray[Any]]):
    """Arrays of a region of the sensor: each is read when it is asked for, and what is set is written.

    For the names see :meth:`RunStore.at`, for the errors :meth:`RunStore.read` and :meth:`RunStore.write`; an
    array that is missing is a StoreError, also for ``get``.
    """

    def __init__(self, store: RunStore, region: tuple[slice, slice] | None, prefix: str) -> None:
        self._store, self._region, self._prefix = store, region, prefix

    def _place(self, name: str) -> tuple[str, _Region | None]:
        path = self._prefix + name
        return path, None if self._region is None else variable_at(path).index(self._region)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._store.read(*self._place(name))

    def __setitem__(self, name: str, values: NDArray[Any]) -> None:
        self._store.write(*self._place(name), values)

    def __delitem__(self, name: str) -> None:
        self._store.delete(self._prefix + name)

    def __contains__(self, name: object) -> bool:
        return name != "" and self._store.has(f"{self._prefix}{name}")  # the prefix alone is the group

    def __iter__(self) -> Iterator[str]:
        paths = (path for path in VARIABLES if path.startswith(self._prefix) and self._store.has(path))
        return (path.removeprefix(self._prefix) for path in paths)

    def __len__(self) -> int:
        return sum(1 for _ in self)


@functools.lru_cache(maxsize=64)  # once in a process: it takes 20 ms in the largest stores
def _refuse_links(path: Path) -> None:
    """Raise StoreError where a link leads out of a store: to files that are to be read, or to be replaced."""
    if not isinstance(path, RemotePath) and (link := link_out_of(path)) is not None:
        raise StoreError(
            f"{path}: {link} is a link out of the store, which this program never makes; replace it by its "
            "files"
        )


def _holds_other_files(path: Path) -> bool:
    """Return whether there is more at a path than a store that has just begun, or is being made, or a run."""
    if not path.is_dir():
        return path.exists() and not path.is_dir()  # another process may make the folder meanwhile
    if (path / _PRIVATE).is_dir():  # its description was lost
        return False
    names = (each.name for each in path.iterdir())
    return any(name != DESCRIPTION and not name.startswith(f".{DESCRIPTION}.") for name in names)


@contextmanager
def _one_line(path: Path, where: object) -> Iterator[None]:
    """Make one line of what a file system, or an object storage, refuses."""
    try:
        yield
    except (PchEmError, ValueError, RuntimeError, KeyError, TypeError):  # ours, or a matter of the content
        raise
    except Exception as error:
        if isinstance(path, RemotePath):  # each kind of storage has errors of its own
            raise refused(where, error) from error
        if isinstance(error, OSError):
            raise storage_error(error, where) from error
        raise


def _pixels_of(array: zarr.Array[Any], y: IntArray, x: IntArray) -> NDArray[Any]:
    """Return the elements of an array (y, x, ...) at some pixels, read as what they lie in, or one by one."""
    (top, left), rest = (int(y.min()), int(x.min())), array.shape[2:]
    high, wide = int(y.max()) + 1 - top, int(x.max()) + 1 - left
    if high * wide <= _SPARSE * y.size:
        return np.asarray(array[top : top + high, left : left + wide])[y - top, x - left]
    inner = np.indices(rest).reshape(len(rest), math.prod(rest))
    places = [np.repeat(each, inner.shape[1]) for each in (y, x)] + [np.tile(each, y.size) for each in inner]
    return np.asarray(array.get_coordinate_selection(tuple(places))).reshape(y.size, *rest)


def _words(region: _Region) -> str:
    return "[" + ", ".join(f"{p.start}:{p.stop}" if isinstance(p, slice) else str(p) for p in region) + "]"


def _compressors(name: str, dtype: np.dtype[Any]) -> list[Any]:
    """Return the codecs of an array: fast for frames, small for the rest; a checksum finds corrupt chunks."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    cname: Literal["lz4", "zstd"] = "lz4" if name == "frames/dn" else "zstd"
    shuffle: Literal["bitshuffle", "shuffle"] = "bitshuffle" if name == "frames/dn" else "shuffle"
    return [BloscCodec(cname=cname, clevel=1, shuffle=shuffle, typesize=dtype.itemsize), Crc32cCodec()]
