"""Zarr arrays (formats 2 and 3) and OME-Zarr images."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import facts_from_names
from pchem_pipeline.frames.formats.contiguous import ContiguousReader
from pchem_pipeline.frames.formats.kinds import (
    channel_notes,
    check_coded,
    check_unpacked_size,
    choose_dataset,
    chosen_pieces,
    n_pieces,
    windows,
)
from pchem_pipeline.frames.identity import file_size
from pchem_pipeline.frames.reader import unwritten_notes
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts
from pchem_pipeline.store.files import link_out_of, whole_file

#: folders within each other, and chunks of a shard
_DEEPEST, _MOST_IN_A_SHARD = 64, 1 << 16
_DESCRIBED = ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata")


def is_zarr(path: Path) -> bool:
    """Return whether a path is a folder with the metadata of a zarr store."""
    return path.is_dir() and any((path / name).exists() for name in ("zarr.json", ".zarray", ".zgroup"))


class ZarrReader(ContiguousReader):
    """A zarr array, the only stack of a zarr group, or the full resolution of an OME-Zarr image."""

    format_name = "zarr"
    library: ClassVar[str] = "zarr"
    suffixes: ClassVar[tuple[str, ...]] = (".zarr",)

    @classmethod
    def recognises(cls, path: Path, head: bytes) -> bool:
        """See `FrameReader.recognises`: a zarr store is a folder with metadata."""
        return is_zarr(path)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        import zarr

        if link := link_out_of(path):
            raise InputError(f"{link} is a link out of the store; copy its files into the store")
        parts = [*path.rglob("*")]
        if special := next((part for part in parts if not (part.is_file() or part.is_dir())), None):
            raise InputError(f"{special.relative_to(path)} is not a regular file; copy the store again")
        if max((len(part.relative_to(path).parts) for part in parts), default=0) > _DEEPEST:
            raise InputError(f"groups nested more than {_DEEPEST} deep; copy the array out of them")
        node = zarr.open(path, mode="r")
        if isinstance(node, zarr.Array):
            array: Any = node
            self._name, attributes = "", dict(node.attrs)
        else:
            scales = _scales(node) if settings.dataset is None else None
            full = scales and str(scales[0]["datasets"][0]["path"])  # the first level (0.5 and before)
            self._name = full or choose_dataset(_shapes(node), settings.dataset)
            array = node[self._name]
            attributes = {**node.attrs, **array.attrs}
        from pchem_pipeline.store.zarr_store import foreign_codecs

        if foreign := foreign_codecs(array):
            raise InputError(
                f"{self._name or 'the array'} is encoded by {', '.join(foreign)}, which may run code; write "
                "it again with blosc, gzip or zstd"
            )
        self.set_stack(array.shape, np.dtype(array.dtype), settings, f"array {self._name}".strip())
        self.rows_per_read = min(self.shape[1], int(array.chunks[-2]))
        piece = getattr(array, "shards", None) or array.chunks
        check_coded(self.shape, piece, self.dtype.itemsize, file_size(path))
        self.take_facts(*facts_from_names(attributes))
        self.notes = (*channel_notes(_channels(node, self._full), self.shape[0]),)
        missing = _check_chunks(path / self._name, array, parts)
        self.notes += missing
        self.unwritten = bool(missing)

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        import zarr

        node: Any = zarr.open(self.paths[0], mode="r")
        array = node[self._name] if self._name else node
        for part, window in windows(buffer, self._full, t0, y0):
            part[...] = np.asarray(array[window])


def _check_chunks(folder: Path, array: Any, parts: Sequence[Path]) -> tuple[str, ...]:
    """Refuse chunks that hold more than their shape; say how many are missing, and read as the fill value.

    The time of the library's ``nchunks_initialized`` would grow as the square of their number.
    """
    from pchem_pipeline.store.zarr_store import codec_names

    shards, size = getattr(array, "shards", None), math.prod(array.chunks)
    files = [p for p in parts if folder in p.parents and p.is_file() and p.name not in _DESCRIBED]
    if shards is not None and math.prod(shards) > _MOST_IN_A_SHARD * size:
        raise InputError(f"shards of more than {_MOST_IN_A_SHARD} chunks; write larger chunks")
    places = chosen_pieces(((part, 0, part.stat().st_size) for part in files), itemgetter(2))
    codecs = codec_names(array)
    if shards is not None:
        sharding = array.metadata.codecs[-1]
        if codecs.count("sharding_indexed") > 1 or not hasattr(sharding, "index_location"):
            raise InputError("shards within shards, or compressed as a whole; write single shards")
        chunks = (
            place for part, _, _ in places for place in _places(part, sharding, math.prod(shards) // size)
        )
        places = chosen_pieces(chunks, itemgetter(2))
    check_unpacked_size(itertools.starmap(_read, places), 4 * size * array.dtype.itemsize, codecs)
    wanted = n_pieces(array.shape, shards or array.chunks)
    return unwritten_notes(wanted - len(files), wanted)


def _places(part: Path, sharding: Any, chunks: int) -> Iterator[tuple[Path, int, int]]:
    """Yield where the chunks of a shard are: file, first byte and bytes, by the index of the shard."""
    whole, length = part.stat().st_size, 16 * chunks
    checksum = 4 * (len(sharding.index_codecs) - 1)
    # as the file has it: the attribute is a text in some versions of zarr, a member of an Enum in others
    at_start = sharding.to_dict()["configuration"]["index_location"] == "start"
    first = 0 if at_start else max(0, whole - length - checksum)
    index = np.frombuffer(_read(part, first, length)[: length // 16 * 16], "<u8")
    for start, size in index[: len(index) // 2 * 2].reshape(-1, 2).tolist():
        if start + size <= whole:  # not those that were never written
            yield part, start, size


def _read(part: Path, start: int, length: int) -> bytes:
    """Return bytes of a file."""
    with part.open("rb") as stream:
        stream.seek(start)
        return stream.read(length)


def _scales(group: Any) -> Any:
    """Return the record of the levels of an OME-Zarr image; None where there is none."""
    record = group.attrs.get("ome", group.attrs)
    return record.get("multiscales") if hasattr(record, "get") else None


def _channels(node: Any, shape: Sequence[int]) -> int:
    """Return the length of the axis of channels of an OME-Zarr image of some shape; 1 where it has none."""
    scales = _scales(node)
    axes = scales[0].get("axes", "tczyx") if scales else []  # of versions before 0.3 always the same
    names = [axis.get("name", "") if hasattr(axis, "get") else axis for axis in axes]
    return shape[names.index("c")] if "c" in names and len(names) == len(shape) else 1


def _shapes(group: Any) -> dict[str, tuple[int, ...]]:
    with warnings.catch_warnings(action="ignore"):  # of other files among the arrays
        members = list(group.members(max_depth=None))
    return {name: tuple(node.shape) for name, node in members if hasattr(node, "shape")}


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as one zarr array (format 3) in chunks along time; see `frames.writing.write_frames`."""
    shape, dtype, *_ = stack
    import zarr
    from zarr.codecs import BloscCodec

    n, rows, columns = shape
    depth = min(256, n)
    with whole_file(path) as part:
        array = zarr.create_array(
            part,
            shape=shape,
            dtype=dtype,
            chunks=(depth, min(128, rows), min(128, columns)),
            compressors=BloscCodec(cname="lz4", shuffle="bitshuffle", typesize=dtype.itemsize),
            dimension_names=("frame", "y", "x"),
            attributes={"units": "DN", "long_name": "raw frames", **stack.stated},
        )
        frames = (frame.copy() for block in blocks for frame in block)
        for start in range(0, n, depth):  # each chunk is written once
            array[start : start + depth] = np.stack([*itertools.islice(frames, depth)])
