"""TIFF, BigTIFF, ImageJ and OME-TIFF stacks, DNG, and sequences of single-frame files.

Pages are frames whenever all pages share shape and type, whatever the metadata say about series. Uncompressed
pages are read straight from their offsets; others are decoded strip by strip by tifffile, only
the strips that the wanted rows need.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, OpenedFile, even_offsets
from pchem_pipeline.frames.formats.kinds import channel_notes, check_coded, mosaic_note
from pchem_pipeline.frames.formats.tiff_facts import (
    active_area,
    check_chain,
    images_behind_one_page,
    mosaic,
    stated_channels,
    stated_facts,
)
from pchem_pipeline.frames.reader import unwritten_notes
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts
from pchem_pipeline.store.files import whole_file

_QUIET = logging.NullHandler()
#: photometric interpretations with one sample per pixel
_MONOCHROME = ("MINISBLACK", "MINISWHITE", "CFA", "LINEAR_RAW")
#: parts of the names of compressions that keep no exact samples, or need not
_LOSSY = ("JPEG", "LERC", "WEBP")


class TiffReader(ContiguousReader):
    """Pages of a TIFF file as frames."""

    format_name = "tiff"
    library: ClassVar[str] = "tifffile"
    suffixes: ClassVar[tuple[str, ...]] = (".tif", ".tiff", ".btf", ".tf8", ".stk", ".dng")
    magic: ClassVar[tuple[bytes, ...]] = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        import tifffile

        logging.getLogger("tifffile").addHandler(_QUIET)  # what it would warn of is said in our errors
        check_chain(path, self.size)
        with tifffile.TiffFile(path) as file:
            every = [*file.pages]
            pages = [page for page in every if not page.is_reduced]
            if not pages:  # in DNG the frame may be behind a preview
                every += [below for page in file.pages for below in page.pages or ()]
                pages = [page for page in every if not page.is_reduced]
            reduced = len(every) - len(pages)
            if not pages:
                raise ValueError("no pages")
            notes = [f"{reduced} reduced pages (previews) are ignored"] if reduced else []
            first = pages[0]
            _check_pages(pages)
            self.set_stack((len(pages), *first.shape[-2:]), np.dtype(first.dtype), settings, "pages")
            count = len(pages) if len(pages) > 1 else images_behind_one_page(file)
            channels, images = stated_channels(file)
            notes += channel_notes(channels, images if images == count else min(count, channels))
            notes += _value_notes(pages)
            self.notes = tuple(notes)
            stored = np.dtype(first.dtype).newbyteorder(file.byteorder)
            offsets = _contiguous_offsets(file, pages, self.size)
            rows, columns = first.shape[-2:]
            if offsets is not None:
                self.set_layout(Layout(offsets, rows, columns, stored, self._offset))
            else:
                self._set_coded(pages)
            self.take_facts(*stated_facts(file, first))
            self.active = active_area(first)

    def _set_coded(self, pages: Sequence[Any]) -> None:
        """Remember where the pages are, after a look at where their strips or tiles are."""
        broken = [page for page in pages if _reaches_beyond(page, self.size)]
        if broken:
            raise InputError(
                f"truncated: {len(broken)} of {len(pages)} pages extend beyond the end of the file "
                f"({self.size} bytes); copy the file again"
            )
        piece = max((page.chunks for page in pages), key=math.prod)
        check_coded(self.shape, piece, self.dtype.itemsize, self.size)
        self.rows_per_read = min(self.shape[1], max(page.chunks[0] for page in pages))
        self._places = np.array([page.offset for page in pages], np.int64)

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        import tifffile

        path = self.paths[0]
        with OpenedFile(path, self.size) as file, tifffile.TiffFile(path) as known:
            for t in range(t0, t1):
                known.filehandle.seek(int(self._places[t]))
                page = tifffile.TiffPage(known, t)
                try:
                    _decode(page, file, buffer[t - t0], y0, y1)
                except InputError:
                    raise
                except Exception as error:
                    raise InputError(f"page {t} cannot be decoded ({error}); copy the file again") from error


def _reaches_beyond(page: Any, size: int) -> bool:
    """Return whether a strip or tile of a page is not within the file."""
    offsets, counts = (np.array(each, np.int64) for each in (page.dataoffsets, page.databytecounts))
    return bool(((offsets < 0) | (counts < 0) | (counts > size - offsets)).any())


def _decode(page: Any, file: OpenedFile, frame: NDArray[Any], y0: int, y1: int) -> None:
    """Decode the strips or tiles of a page that touch rows y0..y1 into ``frame``."""
    rows, per_row = page.chunks[0], page.chunked[1]
    for number in range(y0 // rows * per_row, ((y1 - 1) // rows + 1) * per_row):
        count = page.databytecounts[number]
        data = file.read_bytes(page.dataoffsets[number], count) if count else None
        segment, (_, _, top, left, _), (_, height, _, _) = page.decode(
            data, number, jpegtables=page.jpegtables
        )
        low, high = max(y0, top), min(y1, top + height)
        target = frame[low - y0 : high - y0, left : left + page.chunks[1]]
        if segment is None:
            target[...] = page.nodata
        else:
            target[...] = segment[0, low - top : high - top, : target.shape[1], 0]


def _value_notes(pages: Sequence[Any]) -> list[str]:
    """Say where samples may not be what the camera delivered: planes, lost in coding, unwritten, inverted."""
    notes = []
    if (planes := pages[0].samplesperpixel) > 1:
        notes.append(f"the {planes} planes of its page are read as frames")
    names = {getattr(page.compression, "name", "") for page in pages}
    lossy = [name for name in names if any(word in name for word in _LOSSY)]
    if lossy:
        notes.append(
            f"{', '.join(sorted(lossy))} compression can be lossy; noise and histograms may be altered"
        )
    counts = [count for page in pages for count in page.databytecounts]
    notes += unwritten_notes(counts.count(0), len(counts), "strips or tiles")
    if pattern := mosaic(pages[0]):
        notes.append(mosaic_note(pattern))
    if "LinearizationTable" in pages[0].tags:
        notes.append(
            "its samples are codes of a table (LinearizationTable), not proportional to light; read as stored"
        )
    if getattr(pages[0].photometric, "name", "") == "MINISWHITE":
        notes.append(
            "its tags declare 0 as white; samples are read as stored: if more light lowers them, invert them "
            "first"
        )
    return notes


def _check_pages(pages: Sequence[Any]) -> None:
    """Refuse colour, pages of different shape or type, and pages that were not written to their end."""
    first = pages[0]
    for number, page in enumerate(pages):
        if page.dtype is None or not all(isinstance(length, int) for length in page.shape):
            raise InputError(
                f"page {number}: unknown sample type or damaged header; write it as uint8 or uint16"
            )
        if (page.shape, page.dtype) != (first.shape, first.dtype):
            raise InputError(
                f"page {number} is {_words(page)}, page 0 is {_words(first)}; all frames must have the same "
                "shape and type"
            )
    photometric = first.photometric.name if hasattr(first.photometric, "name") else str(first.photometric)
    planes = first.samplesperpixel
    separate = planes > 1 and int(first.planarconfig) == 2 and photometric.startswith("MINIS")
    if photometric not in _MONOCHROME or (planes > 1 and not separate):
        raise InputError(
            f"colour or multi-channel images ({photometric}, {planes} samples per pixel); monochrome raw "
            "frames are needed"
        )
    if len(first.shape) > (2 if planes == 1 else 3):
        raise InputError(f"pages of {_words(first)} are volumes; write one frame per page")
    if planes > 1 and len(pages) > 1:
        raise InputError(f"{len(pages)} pages of {planes} planes each; write one frame per page")
    if planes > 1 and int(first.compression) != 1:
        raise InputError(f"one page of {planes} compressed planes; write one frame per page")
    for number, page in enumerate(pages):
        offsets, counts = len(page.dataoffsets), len(page.databytecounts)
        if offsets != counts or offsets < math.prod(page.chunked):
            raise InputError(
                f"page {number} has {offsets} strips or tiles and {counts} sizes, {math.prod(page.chunked)} "
                "needed: incomplete file; copy or write it again"
            )


def _words(page: Any) -> str:
    return f"{' x '.join(str(size) for size in page.shape)} {page.dtype.name}"


def _contiguous_offsets(file: Any, pages: Sequence[Any], size: int) -> IntArray | None:
    """Return the offset of each frame if all are stored plainly, else None."""
    itemsize, planes = np.dtype(pages[0].dtype).itemsize, pages[0].samplesperpixel
    frame = math.prod(pages[0].shape[-2:]) * itemsize
    for page in pages:
        codings = int(page.compression), int(page.fillorder), page.predictor
        if codings != (1, 1, 1) or page.bitspersample != 8 * itemsize or page.is_tiled:
            return None
        if 0 in page.databytecounts:  # never written: nothing lies at their offsets
            return None
        if not page.is_contiguous and not _adjoining(page, frame * planes):
            return None
    starts = np.array([page.dataoffsets[0] for page in pages], np.int64)
    if len(pages) == 1 and planes == 1:
        return even_offsets(images_behind_one_page(file), frame, size, start=int(starts[0]))
    offsets: IntArray = np.add.outer(starts, frame * np.arange(planes)).ravel()
    return offsets


def _adjoining(page: Any, total: int) -> bool:
    """Return whether the strips of a page follow each other without a gap and make up the whole page."""
    offsets, counts = page.dataoffsets, page.databytecounts
    ends = [offset + count for offset, count in zip(offsets, counts, strict=True)]
    return bool(sum(counts) == total and list(offsets[1:]) == ends[:-1])


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as pages of one file, BigTIFF above 2 GiB; see `frames.writing.write_frames`."""
    shape, dtype, *_ = stack
    import tifffile

    large = int(np.prod(shape)) * dtype.itemsize > 1 << 31
    # frame by frame: the last axis of a stack whose frames have one column is taken for samples of a pixel
    with whole_file(path) as part, tifffile.TiffWriter(part, bigtiff=large) as file:
        for frame in (frame for block in blocks for frame in np.ascontiguousarray(block, dtype)):
            file.write(frame, photometric="minisblack", contiguous=True, metadata=stack.stated)
