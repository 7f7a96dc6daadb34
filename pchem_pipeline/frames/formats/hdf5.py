"""HDF5 and NeXus: one dataset (frames, rows, columns), with any filter that h5py and hdf5plugin know.

Frames that lie plainly in the file (contiguous, or in chunks of whole frames without filters) are read from
their offsets. For others the file is opened for each call: handles of HDF5 must not cross processes, and h5py
itself lets one thread in at a time. For that lock, plain frames are not read through h5py: threads would
wait for each other, and the bytes would be read a second time for the hash of the file.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import InputError, quoted, require
from pchem_pipeline.frames.camera import FACT_NAMES, Stated, facts_from_names, text_of
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, even_offsets
from pchem_pipeline.frames.formats.hdf5_parts import (
    check_filters,
    check_links,
    check_sources,
    check_virtual,
    is_own,
    opened,
    virtual_files,
)
from pchem_pipeline.frames.formats.kinds import (
    check_coded,
    check_unpacked_size,
    choose_dataset,
    chosen_pieces,
    n_pieces,
    windows,
)
from pchem_pipeline.frames.reader import unwritten_notes
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts
from pchem_pipeline.store.files import whole_file

_LOCK = threading.Lock()
#: items of a file, and groups within each other
_MOST_ITEMS, _DEEPEST = 100_000, 64
_BITSHUFFLE = 32008
#: filters that compress, by number
_COMPRESSING = {
    1: "zlib",
    307: "bz2",
    32001: "blosc",
    32004: "lz4 in blocks",
    _BITSHUFFLE: "lz4 in blocks",
    32015: "zstd",
}


class Hdf5Reader(ContiguousReader):
    """One dataset of an HDF5 file."""

    format_name = "hdf5"
    library: ClassVar[str] = "h5py"
    order_by_habit = True
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5", ".hdf", ".nxs", ".nx5")
    magic: ClassVar[tuple[bytes, ...]] = (b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3 MAT-file")

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        _require()
        try:
            with _LOCK, opened(path) as file:
                self._inspect_file(path, file, settings)
        except OSError as error:
            words = "is open for writing or was not closed; wait for the writing program"
            if "already open for write" in str(error):
                raise InputError(f"{words}, or clear the flag: h5clear -s {quoted(path)}") from error
            if isinstance(error, BlockingIOError):
                raise InputError(f"{words}") from error
            raise

    def _inspect_file(self, path: Path, file: Any, settings: InputSettings) -> None:
        import h5py

        found: dict[str, tuple[int, ...]] = {}
        detectors: list[Any] = []

        def visit(name: str, item: Any) -> None:
            if len(found) > _MOST_ITEMS or name.count("/") > _DEEPEST:
                raise InputError(f"more than {_MOST_ITEMS} items, or too deeply nested groups; omit it")
            if isinstance(item, h5py.Dataset):
                if item.is_virtual and wanted in (None, name, f"/{name}"):
                    check_virtual(path, item)  # the library may look at its parts for the shape
                found[name] = item.shape or ()
            elif _is_detector(item):
                detectors.append(item)

        wanted = settings.dataset
        file.visititems(visit)
        if not any(len(shape) >= 3 for shape in found.values()) or wanted is not None:
            check_links(path, file, wanted)
        self._name = choose_dataset(found, settings.dataset)
        dataset = file[self._name]
        self.set_stack(dataset.shape, dataset.dtype, settings, f"dataset {self._name}")
        check_filters(dataset)
        if dataset.is_virtual:
            held = sum(part.stat().st_size for part in virtual_files(path, dataset))
            check_coded(self.shape, self.shape[1:], self.dtype.itemsize, self.size + held)
        self.notes = check_sources(path, dataset)
        if "MATLAB_class" in dataset.attrs:  # it writes axes in reverse order
            self.notes += ("written by MATLAB: last axis read as frames, columns as rows",)
        if dataset.chunks is not None:
            check_coded(self.shape, dataset.chunks, self.dtype.itemsize, self.size)
            _check_chunks(dataset)
        missing = _missing_chunks(path, dataset)
        self.notes += missing
        self.unwritten = bool(missing)
        offsets = _plain_offsets(path, file, dataset, self.shape)
        if offsets is not None:
            self.set_layout(Layout(offsets, *self.shape[1:], dataset.dtype, self._offset))
        elif dataset.chunks is not None:
            self.rows_per_read = min(self.shape[1], int(dataset.chunks[-2]))
        groups = [dataset.parent, *(detectors if len(detectors) == 1 else [])]
        self.take_facts(*_stated_facts(dataset, groups))

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        with _LOCK, opened(self.paths[0]) as file:
            dataset = file[self._name]
            for part, window in windows(buffer, self._full, t0, y0):
                if dataset.dtype == part.dtype:
                    dataset.read_direct(part, window)
                else:
                    part[...] = dataset[window]


def _chunks_of(dataset: Any) -> list[Any]:
    """Return place, filters that were left out, first byte and bytes of each chunk that was written."""
    chunks: list[Any] = []
    dataset.id.chunk_iter(chunks.append)
    return chunks


def _missing_chunks(path: Path, dataset: Any) -> tuple[str, ...]:
    """Say how many chunks were never written, and read as the fill value; refuse a dataset without any."""
    if dataset.chunks is None:
        plain = not (dataset.is_virtual or dataset.external) and dataset.id.get_storage_size() == 0
        return unwritten_notes(int(plain and dataset.size > 0), 1, "datasets")
    wanted = n_pieces(dataset.shape, dataset.chunks)
    return unwritten_notes(wanted - dataset.id.get_num_chunks(), wanted)


def _check_chunks(dataset: Any) -> None:
    """Refuse chunks that are not what their shape says, or were compressed twice.

    Beyond plain chunks that are too short the library reads on, and crashes.
    """
    record = dataset.id.get_create_plist()
    filters = [record.get_filter(number) for number in range(record.get_nfilters())]
    codecs = [_COMPRESSING.get(code, "") for code, *_ in filters]
    for number, (code, _, values, _) in enumerate(filters):
        if code == _BITSHUFFLE and not any(values[4:5]):
            codecs[number] = ""  # without compression
    if (filters and not any(codecs)) or not hasattr(dataset.id, "chunk_iter"):
        return
    chunks, size = _chunks_of(dataset), math.prod(dataset.chunks) * dataset.dtype.itemsize
    if not filters:
        if odd := {chunk.size for chunk in chunks} - {size}:
            raise InputError(f"damaged: a chunk of {min(odd)} bytes, {size} needed; copy it again")
        return
    coded = sum(1 << number for number, codec in enumerate(codecs) if codec)
    some = chosen_pieces(chunks, attrgetter("size"))
    read = (dataset.id.read_direct_chunk(chunk.chunk_offset) for chunk in some)
    pieces = (data for left_out, data in read if not left_out & coded)
    check_unpacked_size(pieces, 4 * size, codecs)


def _plain_offsets(path: Path, file: Any, dataset: Any, shape: tuple[int, int, int]) -> IntArray | None:
    """Return the byte offset of each frame that lies plainly in the file, or None where they do not all."""
    from h5py import h5t

    n_frames, rows, columns = shape
    frame_bytes = rows * columns * dataset.dtype.itemsize
    plain_type = dataset.id.get_type().equal(h5t.py_create(dataset.dtype))
    if file.userblock_size or not plain_type or not dataset.size:
        return None
    if dataset.chunks is None:  # None where it lies elsewhere, is virtual, or was never written
        start, size = dataset.id.get_offset(), path.stat().st_size
        return None if start is None else even_offsets(n_frames, frame_bytes, size, start=start)
    filters = dataset.id.get_create_plist().get_nfilters()
    whole = dataset.ndim == 3 and dataset.chunks[1:] == dataset.shape[1:]
    if filters or not whole or not hasattr(dataset.id, "chunk_iter"):
        return None
    starts = np.full(-(-n_frames // dataset.chunks[0]), -1, np.int64)
    for chunk in _chunks_of(dataset):
        starts[chunk.chunk_offset[0] // dataset.chunks[0]] = chunk.byte_offset
    number, inside = np.divmod(np.arange(n_frames, dtype=np.int64), dataset.chunks[0])
    offsets: IntArray = starts[number] + frame_bytes * inside
    return None if (starts < 0).any() else offsets


def _require() -> None:
    require("h5py", "hdf5", "HDF5 files")
    if find_spec("hdf5plugin") is not None:
        require("hdf5plugin", "hdf5", "compressed HDF5 files")  # its import registers the filters


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as the dataset ``frames``, stored plainly; see `frames.writing.write_frames`."""
    shape, dtype, *_ = stack
    _require()
    import h5py

    with whole_file(path) as part, h5py.File(part, "w") as file:
        dataset = file.create_dataset("frames", shape, dtype)
        start = 0
        for block in blocks:
            dataset[start : start + len(block)] = block
            start += len(block)
        dataset.attrs.update(stack.stated)
        if stack.integration_time is not None:
            dataset.attrs["integration_time_units"] = "s"


def _is_detector(group: Any) -> bool:
    return text_of(group.attrs.get("NX_class")) == "NXdetector"


def _stated_facts(dataset: Any, groups: list[Any]) -> Stated:
    """Return what the attributes of the dataset say, else values (count_time in NeXus) in some groups.

    These are that of the dataset, and the detector where the frames are in NXdata by a link.
    """
    values = {name: np.ravel(value)[0] for name, value in dataset.attrs.items() if np.size(value) == 1}
    beside: dict[str, Any] = {}
    units: dict[str, Any] = {}
    for group in groups:
        names = {name: name for name in FACT_NAMES}
        if _is_detector(group):
            names["description"] = "camera"  # so NeXus calls make and model
        for stored, name in names.items():
            other: Any = group.get(stored) if is_own(group, stored) else None
            if getattr(other, "size", 0) == 1 and name not in beside:
                beside[name] = np.ravel(other[()])[0]
                units[name] = other.attrs.get("units", other.attrs.get("unit"))
    return facts_from_names({**beside, **values}, units)
