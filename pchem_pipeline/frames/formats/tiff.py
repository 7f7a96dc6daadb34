"""TIFF, BigTIFF, ImageJ and OME-TIFF stacks, and sequences of single-frame files.

Pages are frames whenever all pages share shape and type, whatever the metadata say about series. Uncompressed
pages are read straight from their offsets; others are decoded strip by strip by tifffile, only
the strips that the wanted rows need.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.contiguous import (
    ContiguousReader,
    Layout,
    OpenedFile,
    even_offsets,
    unsigned_type,
)
from pchem_pipeline.frames.formats.kinds import check_coded, check_samples
from pchem_pipeline.frames.formats.tiff_facts import (
    check_chain,
    images_behind_one_page,
    stated_channels,
    stated_facts,
)
from pchem_pipeline.frames.reader import sound, unwritten_notes
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts
from pchem_pipeline.store.files import whole_file

_QUIET = logging.NullHandler()
#: parts of the names of compressions that keep no exact samples, or need not
_LOSSY = ("JPEG", "LERC", "WEBP")


@dataclass(frozen=True)
class _Segments:
    """Strips or tiles of the pages of one kind, to be decoded by the library.

    Attributes:
        offsets: byte offset of each segment, (pages of the file, segments); 0 where there is none.
        counts: bytes of each segment, likewise.
        model: for each page, the number of a page that is coded alike.
        per_row: for each page, segments side by side.
        height: for each page, rows of a segment.
    """

    offsets: NDArray[np.int64]
    counts: NDArray[np.int64]
    model: NDArray[np.int64]
    per_row: NDArray[np.int64]
    height: NDArray[np.int64]


class TiffReader(ContiguousReader):
    """Pages of a TIFF file as frames."""

    format_name = "tiff"
    suffixes: ClassVar[tuple[str, ...]] = (".tif", ".tiff", ".btf", ".tf8", ".stk")
    magic: ClassVar[tuple[bytes, ...]] = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    _segments: _Segments | None = None

    @classmethod
    def open(cls, path: Path, settings: InputSettings) -> Self:
        """See `FrameReader.open`."""
        import tifffile

        logging.getLogger("tifffile").addHandler(_QUIET)  # what it would warn of is said in our errors
        reader = cls()
        with sound(path, "TIFF file"):
            size = path.stat().st_size
            check_chain(path, size)
            with tifffile.TiffFile(path) as file:
                reader._inspect(path, file, size, settings)
        return reader

    def _inspect(self, path: Path, file: Any, size: int, settings: InputSettings) -> None:
        pages = [page for page in file.pages if not page.is_reduced]
        reduced = len(file.pages) - len(pages)
        if not pages:
            raise InputError(f"{path}: not a valid TIFF file, or truncated (no pages); copy it again")
        notes = [f"{path.name}: {reduced} reduced pages (previews) are ignored"] if reduced else []
        first = pages[0]
        _check_pages(path, pages)
        offset = check_samples(path, np.dtype(first.dtype), settings)
        count = len(pages) if len(pages) > 1 else images_behind_one_page(file)
        notes += _channel_notes(path, *stated_channels(file), count) + _value_notes(path, pages)
        self.notes = tuple(notes)
        stored = np.dtype(first.dtype).newbyteorder(file.byteorder)
        offsets = _contiguous_offsets(path, file, pages, size)
        rows, columns = first.shape[-2:]
        if offsets is not None:
            self.set_layout(path, Layout(offsets, rows, columns, stored, offset), size)
        else:
            self._set_segments(path, pages, size, offset)
        self.take_facts(stated_facts(file, first))

    def _set_segments(self, path: Path, pages: Sequence[Any], size: int, offset: int | None) -> None:
        """Remember where the coded strips or tiles of each page are."""
        most = max(len(page.dataoffsets) for page in pages)
        offsets = np.zeros((len(pages), most), np.int64)
        counts = np.zeros((len(pages), most), np.int64)
        model = np.zeros(len(pages), np.int64)
        alike: dict[Any, int] = {}
        for i, page in enumerate(pages):
            offsets[i, : len(page.dataoffsets)] = page.dataoffsets
            counts[i, : len(page.databytecounts)] = page.databytecounts
            model[i] = alike.setdefault(_coding(page), page.index)
        outside = (offsets < 0) | (counts < 0) | (offsets > size) | (counts > size - offsets)
        broken = np.flatnonzero(outside.any(axis=1))
        if broken.size:
            raise InputError(
                f"{path}: truncated: {broken.size} of {len(pages)} pages extend beyond the end of the file "
                f"({size} bytes); copy the file again"
            )
        first = pages[0]
        rows, columns = first.shape
        piece = max((page.chunks for page in pages), key=math.prod)
        itemsize = np.dtype(first.dtype).itemsize
        check_coded(path, (len(pages), rows, columns), piece, itemsize, size)
        height = np.array([page.chunks[0] for page in pages], np.int64)
        width = np.array([page.chunks[1] for page in pages], np.int64)
        self.paths = (path,)
        self.shape = (len(pages), rows, columns)
        self.dtype = unsigned_type(np.dtype(first.dtype))
        self._size = size
        self._offset = offset
        self.rows_per_read = min(rows, int(height.max()))
        self._segments = _Segments(offsets, counts, model, -(-columns // width), height)

    def decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        """See `ContiguousReader.decode_into`."""
        import tifffile

        table, path = self._segments, self.paths[0]
        assert table is not None
        with OpenedFile(path, self._size) as file, tifffile.TiffFile(path) as known:
            for t in range(t0, t1):
                page = known.pages[int(table.model[t])]
                self._decode(file, page, buffer[t - t0], t, y0, y1)

    def _decode(self, file: OpenedFile, page: Any, frame: NDArray[Any], t: int, y0: int, y1: int) -> None:
        """Decode the segments of page t in rows y0..y1 into ``frame``, by a page that is coded alike."""
        table = self._segments
        assert table is not None
        per_row, rows = int(table.per_row[t]), int(table.height[t])
        for row in range(y0 // rows, (y1 - 1) // rows + 1):
            for number in range(row * per_row, (row + 1) * per_row):
                count = int(table.counts[t, number])
                data = file.read_bytes(int(table.offsets[t, number]), count) if count else None
                try:
                    segment, (_, _, top, left, _), (_, height, width, _) = page.decode(
                        data, number, jpegtables=page.jpegtables
                    )
                except Exception as error:
                    raise InputError(
                        f"{self.paths[0]}: page {t} cannot be decoded ({error}); copy the file again"
                    ) from error
                low, high = max(y0, top), min(y1, top + height)
                target = frame[low - y0 : high - y0, left : left + width]
                if segment is None:
                    target[...] = page.nodata
                else:
                    target[...] = segment[0, low - top : high - top, : target.shape[1], 0]


def _coding(page: Any) -> tuple[Any, ...]:
    """Return what two pages must share to be decoded alike."""
    return (
        int(page.compression),
        int(page.predictor),
        int(page.fillorder),
        page.chunks,
        page.bitspersample,
        page.rowsperstrip,
        page.jpegtables,
    )


def _channel_notes(path: Path, channels: int, images: int, pages: int) -> list[str]:
    """Say that pages called channels are read as frames; refuse those that have another axis, too."""
    if channels < 2 or pages < 2:
        return []
    if images == pages > channels:
        raise InputError(
            f"{path}: its metadata describe the {pages} pages as {channels} channels of {pages // channels} "
            "images; write one file per channel"
        )
    return [f"{path.name}: its metadata describe the pages as {channels} channels; read as frames"]


def _value_notes(path: Path, pages: Sequence[Any]) -> list[str]:
    """Say where samples may not be what the camera delivered: planes, lost in coding, unwritten, inverted."""
    notes = []
    if (planes := pages[0].samplesperpixel) > 1:
        notes.append(f"{path.name}: the {planes} planes of its page are read as frames")
    names = {getattr(page.compression, "name", "") for page in pages}
    lossy = [name for name in names if any(word in name for word in _LOSSY)]
    if lossy:
        notes.append(
            f"{path.name}: {', '.join(sorted(lossy))} compression can be lossy; noise and histograms may be "
            "altered"
        )
    counts = [count for page in pages for count in page.databytecounts]
    notes += unwritten_notes(path, counts.count(0), len(counts), "strips or tiles")
    if getattr(pages[0].photometric, "name", "") == "MINISWHITE":
        notes.append(
            f"{path.name}: its tags declare 0 as white; samples are read as stored: if more light lowers "
            "them, invert them first"
        )
    return notes


def _check_pages(path: Path, pages: Sequence[Any]) -> None:
    """Refuse colour, pages of different shape or type, and pages that were not written to their end."""
    first = pages[0]
    for number, page in enumerate(pages):
        if page.dtype is None or not all(isinstance(length, int) for length in page.shape):
            raise InputError(
                f"{path}: page {number}: unknown sample type or damaged header; write it as uint8 or uint16"
            )
        if (page.shape, page.dtype) != (first.shape, first.dtype):
            raise InputError(
                f"{path}: page {number} is {_words(page)}, page 0 is {_words(first)}; all frames must have "
                "the same shape and type"
            )
    photometric = first.photometric.name if hasattr(first.photometric, "name") else str(first.photometric)
    planes = first.samplesperpixel
    separate = planes > 1 and int(first.planarconfig) == 2 and photometric.startswith("MINIS")
    if photometric not in ("MINISBLACK", "MINISWHITE") or (planes > 1 and not separate):
        raise InputError(
            f"{path}: colour or multi-channel images ({photometric}, {planes} samples per pixel); monochrome "
            "raw frames are needed"
        )
    if len(first.shape) > (2 if planes == 1 else 3):
        raise InputError(f"{path}: pages of {_words(first)} are volumes; write one frame per page")
    if planes > 1 and len(pages) > 1:
        raise InputError(f"{path}: {len(pages)} pages of {planes} planes each; write one frame per page")
    if planes > 1 and int(first.compression) != 1:
        raise InputError(f"{path}: one page of {planes} compressed planes; write one frame per page")
    for number, page in enumerate(pages):
        offsets, counts = len(page.dataoffsets), len(page.databytecounts)
        if offsets != counts or offsets < math.prod(page.chunked):
            raise InputError(
                f"{path}: page {number} has {offsets} strips or tiles and {counts} sizes, "
                f"{math.prod(page.chunked)} needed: incomplete file; copy or write it again"
            )


def _words(page: Any) -> str:
    return f"{' x '.join(str(size) for size in page.shape)} {page.dtype.name}"


def _contiguous_offsets(path: Path, file: Any, pages: Sequence[Any], size: int) -> NDArray[np.int64] | None:
    """Return the offset of each frame if all are stored plainly, else None."""
    first = pages[0]
    dtype = np.dtype(first.dtype)
    if any(int(page.compression) != 1 or int(page.fillorder) != 1 for page in pages):
        return None
    if any(
        page.bitspersample != 8 * dtype.itemsize or page.is_tiled or page.predictor != 1 for page in pages
    ):
        return None
    if any(0 in page.databytecounts for page in pages):  # never written: nothing lies at their offsets
        return None
    rows, columns = first.shape[-2:]
    frame = rows * columns * dtype.itemsize
    planes = first.samplesperpixel
    if len(pages) == 1 and planes == 1 and (first.is_contiguous or _adjoining(first, frame)):
        start = int(first.dataoffsets[0])
        return even_offsets(path, images_behind_one_page(file), frame, size, start=start)
    offsets = []
    for page in pages:
        if not page.is_contiguous and not _adjoining(page, frame * planes):
            return None
        start = int(page.dataoffsets[0])
        offsets += [start + plane * frame for plane in range(planes)]
    return np.asarray(offsets, np.int64)


def _adjoining(page: Any, total: int) -> bool:
    """Tell whether the strips of a page follow each other without a gap and make up the whole page."""
    offsets, counts = page.dataoffsets, page.databytecounts
    ends = [offset + count for offset, count in zip(offsets, counts, strict=True)]
    return bool(sum(counts) == total and list(offsets[1:]) == ends[:-1])


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as pages of one file, BigTIFF above 2 GiB; see `frames.writing.write_frames`."""
    shape, dtype, *_ = stack
    import tifffile

    with whole_file(path) as part:
        tifffile.imwrite(
            part,
            (frame for block in blocks for frame in np.ascontiguousarray(block, dtype)),
            shape=shape,
            dtype=dtype,
            bigtiff=int(np.prod(shape)) * dtype.itemsize > 1 << 31,
            photometric="minisblack",
            metadata=stack.stated,
        )
