"""Frames that lie uncompressed in a file: read straight from their offsets into the caller's memory.

Raw files, npy, SER, DCIMG, uncompressed TIFF and uncompressed FITS all come down to a table of byte offsets.
Each call opens the file, reads by ``preadv`` and closes it: so threads do not disturb each other, a reader
can be pickled, and thousands of files do not exhaust the file descriptors. The libraries of the formats read
into arrays of their own.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.kinds import axes_notes, check_samples, stack_shape
from pchem_pipeline.frames.formats.packing import Packing
from pchem_pipeline.frames.reader import FrameReader, changed, check_window, sound
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.store.files import whole_file

_MOST_FRAMES = 1 << 26


@dataclass(frozen=True)
class Layout:
    """Where the frames lie in a file, and how their samples are stored.

    Attributes:
        offsets: byte offset of each frame, (frames,).
        rows, columns: of a frame.
        stored: numpy type of a stored sample with its byte order.
        offset: what is added to signed samples, DN; sums must not be negative. None: they are unsigned.
        packing: how samples are packed, in frames of whole groups; None: they are not.
    """

    offsets: IntArray
    rows: int
    columns: int
    stored: np.dtype[Any]
    offset: int | None = None
    packing: Packing | None = None

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        pixels = self.rows * self.columns
        return pixels * self.stored.itemsize if self.packing is None else self.packing.span(0, pixels)[1]

    def frame(self, data: bytes, start: int) -> NDArray[Any]:
        """Return a frame (y, x) as it is stored, from its bytes, which begin at ``start``."""
        shape = self.rows, self.columns
        if self.packing is None:
            return np.frombuffer(data, unsigned_type(self.stored), shape[0] * shape[1], start).reshape(shape)
        return self.packing.unpacked(np.frombuffer(data, np.uint8, self.frame_bytes, start)).reshape(shape)

    @property
    def end(self) -> int:
        """Byte behind the last frame."""
        return int(self.offsets.max()) + self.frame_bytes if self.offsets.size else 0


def unsigned_type(stored: np.dtype[Any]) -> np.dtype[Any]:
    """Return the native unsigned type of the same size."""
    return np.dtype(f"=u{stored.itemsize}")


def even_offsets(
    n_frames: int, frame_bytes: int, size: int, *, start: int = 0, step: int | None = None
) -> IntArray:
    """Return the byte offsets of frames that lie evenly in a file of ``size`` bytes, the first at ``start``.

    From one frame to the next there are ``step`` bytes; None: they follow each other.

    Raises:
        InputError: they do not fit into the file. The numbers of a damaged header must not take memory.
    """
    step = frame_bytes if step is None else step
    if n_frames and frame_bytes < 1:
        raise InputError("no frames; omit it")
    end = start + step * (n_frames - 1) + frame_bytes
    if n_frames and end > size:
        raise _truncated(n_frames, end, size, max(0, (size - start - frame_bytes) // step + 1))
    if n_frames > _MOST_FRAMES:
        raise InputError(f"{n_frames} frames, more than {_MOST_FRAMES}; correct the header or input.shape")
    return start + step * np.arange(n_frames, dtype=np.int64)


def _truncated(n_frames: int, needed: int, size: int, whole: int) -> InputError:
    return InputError(
        f"truncated: {n_frames} frames need {needed} bytes, the file has {size} ({whole} complete frames); "
        "copy the file again"
    )


class OpenedFile:
    """A file open for one call; InputError if it vanished, or became shorter since it was inspected."""

    def __init__(self, path: Path, size: int) -> None:
        try:
            self._handle = os.open(path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise changed("the file disappeared") from error
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror}); check its permissions") from error
        if os.fstat(self._handle).st_size < size:
            os.close(self._handle)
            raise changed("the file was truncated")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *unused: object) -> None:
        os.close(self._handle)

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill the target (bytes) from the offset."""
        done = 0
        while done < len(target):
            try:
                count = os.preadv(self._handle, [target[done : done + (1 << 30)]], offset + done)
            except OSError as error:
                raise InputError(f"read error ({error.strerror}); check the disk") from error
            if count == 0:
                raise changed("the file was truncated")
            done += count

    def read_bytes(self, offset: int, count: int) -> bytes:
        """Return bytes from the offset."""
        data = bytearray(count)
        self.read_into(memoryview(data), offset)
        return bytes(data)


class ContiguousReader(FrameReader):
    """A reader that needs nothing but a `Layout`; of files without one it decodes by `_decode_into`."""

    size: int  # of the file, bytes
    _offset: int | None = None
    _full: tuple[int, ...] = ()

    @classmethod
    def open(cls, path: Path, settings: InputSettings) -> Self:
        """See `FrameReader.open`."""
        reader = cls()
        with sound(path, cls.format_name, cls.magic):
            reader.paths, reader.size = (path,), path.stat().st_size
            reader._inspect(path, settings)
        reader.notes += axes_notes(reader._full)
        return reader

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        """Take from a file all that a reader says of it; any error becomes one line."""
        raise NotImplementedError

    def set_layout(self, layout: Layout) -> None:
        """Take the layout; InputError: the file is shorter than the layout says."""
        if layout.end > self.size:
            whole = int(np.count_nonzero(layout.offsets + layout.frame_bytes <= self.size))
            raise _truncated(layout.offsets.size, layout.end, self.size, whole)
        self.shape = (layout.offsets.size, layout.rows, layout.columns)
        self.dtype = unsigned_type(layout.stored)
        self._layout = layout

    def set_stack(
        self, full: Sequence[int], stored: np.dtype[Any], settings: InputSettings | None, what: str
    ) -> None:
        """Set the stack's shape and type from those of the stored array; InputError: these are no frames.

        Without settings, the file says itself what its signed samples mean. Messages call the array ``what``.
        """
        self._offset = None if settings is None else check_samples(stored, settings)
        self.shape = stack_shape(full, what)
        self.dtype, self._full = unsigned_type(stored), tuple(full)

    @property
    def layout(self) -> Layout | None:
        """Where the frames lie, or None where they have to be decoded."""
        return getattr(self, "_layout", None)

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """See `FrameReader.read_into`."""
        y0, y1 = check_window(self, buffer, t0, t1, y0, y1)
        if buffer.size == 0:
            return
        layout, path = self.layout, self.paths[0]
        if layout is None:
            try:
                if not path.is_dir() and path.stat().st_size != self.size:
                    raise changed("the size of the file changed")
                self._decode_into(buffer, t0, t1, y0, y1)
            except FileNotFoundError as error:
                raise changed("the file disappeared") from error
            except InputError:
                raise
            except Exception as error:
                raise InputError(f"cannot be decoded ({error}); copy it again") from error
            unstore(buffer, self.dtype, self._offset)
            return
        if layout.packing is not None:
            self._read_packed(layout.packing, buffer, layout.offsets[t0:t1], y0 * layout.columns)
            return
        skip = y0 * layout.columns * layout.stored.itemsize
        target = buffer.data.cast("B")
        band = len(target) // (t1 - t0)
        with OpenedFile(path, self.size) as file:
            for first, count in _runs(layout.offsets[t0:t1], band if band == layout.frame_bytes else -1):
                start = int(layout.offsets[t0 + first]) + skip
                file.read_into(target[first * band : (first + count) * band], start)
        unstore(buffer, layout.stored, layout.offset)
        self.put_right(buffer, t0, y0)

    def _read_packed(
        self, packing: Packing, buffer: NDArray[Any], offsets: IntArray, first_sample: int
    ) -> None:
        """Fill the buffer from frames whose samples are packed, from one of their samples on."""
        n_samples = buffer[0].size
        start, end, before = packing.span(first_sample, first_sample + n_samples)
        with OpenedFile(self.paths[0], self.size) as file:
            for frame, offset in zip(buffer, offsets.tolist(), strict=True):
                data = np.frombuffer(file.read_bytes(offset + start, end - start), np.uint8)
                frame.ravel()[:] = packing.unpacked(data)[before : before + n_samples]

    def put_right(self, buffer: NDArray[Any], t0: int, y0: int) -> None:
        """Put samples right that are not where the layout says, in frames from t0 and rows from y0 on."""

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        """Fill the buffer from a file without a layout, with samples as they are stored."""
        raise NotImplementedError


def _runs(offsets: IntArray, frame_bytes: int) -> list[tuple[int, int]]:
    """Return (first, count) of frames that follow each other without a gap; -1 bytes: each alone."""
    breaks = np.flatnonzero(np.diff(offsets) != frame_bytes) + 1
    edges = [0, *breaks.tolist(), len(offsets)]
    return [(a, b - a) for a, b in pairwise(edges)]


def unstore(buffer: NDArray[Any], stored: np.dtype[Any], offset: int | None) -> None:
    """Turn stored bytes in a buffer of unsigned samples into these, in place.

    Floats hold whole numbers; an offset, 0 to 2**(bits - 1), is added to signed samples; None: unsigned.

    Raises:
        InputError: a sample is negative, with the offset, or no whole number.
    """
    if not stored.isnative:
        buffer.byteswap(inplace=True)
    if stored.kind == "f":
        values = buffer.view(f"f{stored.itemsize}")
        # larger ones are not exact
        whole = (values >= 0) & (values <= 1 << 24) & (values == np.floor(values))
        if not whole.all():
            raise InputError(
                f"samples such as {values[~whole][0]:g}, raw whole numbers are needed; record them without a "
                "correction, background or averaging"
            )
        buffer[...] = values
        return
    if offset is None or not buffer.size:
        return
    top = 1 << (8 * stored.itemsize - 1)
    if offset < top:
        lowest = int(buffer.view(f"i{stored.itemsize}").min()) + offset
        if lowest < 0:
            raise InputError(
                f"negative samples (down to {lowest} "
                f"DN{f', with the offset of {offset}' if offset else ''}), 0 or more needed; set "
                f"input.offset: {top} (--offset {top}) if 0 DN is stored as -{top}"
            )
    if offset:
        np.add(buffer, buffer.dtype.type(offset), out=buffer)  # modulo 2**bits: right for signed ones


def write_plain(path: Path, head: bytes, blocks: Iterable[NDArray[Any]], stored: np.dtype[Any]) -> None:
    """Write a header and the frames behind it, as samples of the stored type."""
    with whole_file(path) as part, part.open("wb") as stream:
        stream.write(head)
        for block in blocks:
            stream.write(np.ascontiguousarray(block, stored).data)
