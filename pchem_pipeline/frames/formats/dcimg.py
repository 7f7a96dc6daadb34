"""DCIMG, recordings of Hamamatsu's cameras: headers of file and session, frames, stamps of the frames.

The format has no public specification. What is used is what at least two readers of such files agree on
(dcimg of lens-biophotonics and its forks, python-microscopy, StuartLittlefair/dcimg, Bio-Formats, DCIMG.jl):

- Version 7: the frames follow each other; a footer behind them has their stamps and times. From version
  0x1000000 on a footer follows each frame: its stamp, then seconds since 1970 and microseconds.
- The first eight bytes of one row are overwritten with 0, 65535, 0, 65535. The samples that belong there are
  in the footer: of version 7 with their place in a frame, else behind the time, where it has 32 bytes, or
  512 and more (16 over USB). Readers differ on which row it is in the newer versions; it is found by these
  numbers.
- Rows may be longer than the header says. Readers differ on which samples are the additional ones; all are
  read.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, OpenedFile, even_offsets
from pchem_pipeline.frames.settings import InputSettings

_MAGIC = b"DCIMG"
_OLD, _NEW = 7, 0x1000000
#: version, sessions, offset of the first
_FILE = struct.Struct("<8x I 20x I 4x I")
#: frames, bytes of a sample, columns, bytes of a row and rows (the newer versions: rows, bytes of a row),
#: bytes of a frame, offset of the frames; of version 7 offset of the footer, else bytes of each
_SESSION = {_OLD: struct.Struct("<32x 2I 4x 4I 8x I Q"), _NEW: struct.Struct("<60x 2I 4x 4I 8x Q 20x I")}
#: footer of version 7: offset of a table; in it offset, place in a frame and bytes of samples stored apart
_FOOTER, _TABLE = struct.Struct("<8x Q"), struct.Struct("<88x Q 4x I Q")
#: bytes before the stamps of this footer; bytes of a stamp and a time
_BEFORE_STAMPS, _STAMP = 272, 12
_MARKER = np.array([0, 65535, 0, 65535], "<u2").tobytes()


class DcimgReader(ContiguousReader):
    """DCIMG files with monochrome frames of 8 or 16 bits."""

    format_name = "dcimg"
    suffixes: ClassVar[tuple[str, ...]] = (".dcimg",)
    magic: ClassVar[tuple[bytes, ...]] = (_MAGIC,)
    #: of samples that are stored apart: byte of those of the first frame, bytes to the next, row, columns
    _apart: tuple[int, int, int, slice] | None = None

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        with path.open("rb") as stream:
            head = stream.read(_FILE.size)
            if not head.startswith(_MAGIC):
                raise ValueError
            version, sessions, session = _FILE.unpack(head)
            if version != _OLD and version < _NEW:
                raise InputError(f"DCIMG of unknown version {version:#x}; export it as TIFF")
            parts = _SESSION[min(version, _NEW)]
            stream.seek(session)
            fields = parts.unpack(stream.read(parts.size))
        n, depth, columns, row_bytes, rows, frame_bytes, start, footer = fields
        if version != _OLD:
            row_bytes, rows = rows, row_bytes
        if depth not in (1, 2):
            raise InputError(f"pixel type {depth}; record monochrome frames of 8 or 16 bits")
        if not 0 < columns * depth <= row_bytes or row_bytes % depth or row_bytes * rows != frame_bytes:
            raise InputError(
                f"damaged header ({rows} x {columns} samples, {row_bytes} bytes a row, {frame_bytes} a "
                "frame); copy it again"
            )
        behind = 0 if version == _OLD else footer
        step, wide = frame_bytes + behind, row_bytes // depth
        offsets = even_offsets(n, frame_bytes, self.size, start=session + start, step=step)
        self.set_layout(Layout(offsets, rows, wide, np.dtype(f"<u{depth}")))
        if sessions > 1:
            self.notes += (f"{sessions} sessions, the first is read",)
        if wide > columns:
            self.notes += (
                f"rows of {wide} samples, {columns} by the header; all are read; choose with input.roi: [0, "
                f"{rows}, 0, {columns}] or [0, {rows}, {wide - columns}, {wide}] (--roi)",
            )
        if n and version == _OLD:
            self._take_footer(session + footer)
        elif n and footer >= _STAMP:
            self._take_footers(footer)

    def _take_footer(self, start: int) -> None:
        """Take what the footer of version 7 says, which begins at ``start``."""
        n, stamps = self.shape[0], start + _BEFORE_STAMPS
        self._check_end(stamps + _STAMP * n)
        with OpenedFile(self.paths[0], self.size) as file:
            (table,) = _FOOTER.unpack(file.read_bytes(start, _FOOTER.size))
            self._check_end(start + table + _TABLE.size)
            at, place, n_bytes = _TABLE.unpack(file.read_bytes(start + table, _TABLE.size))
            numbers = np.frombuffer(file.read_bytes(stamps, _STAMP * n), "<u4")
        self._take_stamps(numbers[:n], numbers[n:].reshape(n, 2))
        if n_bytes:
            row, column = divmod(place // self.dtype.itemsize, self.shape[2])
            self._set_apart(start + at, n_bytes, n_bytes, row, column)

    def _take_footers(self, n_bytes: int) -> None:
        """Take what the footers behind the frames say, each of ``n_bytes``."""
        frame_bytes = self._layout.frame_bytes
        starts = (self._layout.offsets + frame_bytes).tolist()
        self._check_end(starts[-1] + n_bytes)
        numbers = np.empty((len(starts), 3), "<u4")
        with OpenedFile(self.paths[0], self.size) as file:
            for line, start in zip(numbers, starts, strict=True):
                file.read_into(line.data.cast("B"), start)
            n_apart = len(_MARKER) if n_bytes == 32 or n_bytes >= 512 else 0
            apart = file.read_bytes(starts[0] + _STAMP, n_apart)
        self._take_stamps(numbers[:, 0], numbers[:, 1:])
        row = self._marked_row() if apart else None
        if row is not None:
            self._set_apart(starts[0] + _STAMP, frame_bytes + n_bytes, len(apart), row, 0)
        elif any(apart):
            self.notes += (
                f"the first {len(apart) // self.dtype.itemsize} samples of a row are stored apart, and no "
                "row is marked as theirs; if pixels at the left edge stand out, exclude them (input.mask)",
            )

    def _take_stamps(self, numbers: NDArray[Any], times: NDArray[Any]) -> None:
        """Take the number of each frame, (n,), and its time, (n, 2), in s since 1970 and microseconds."""
        self.frame_stamps = numbers.astype(np.int64)
        seconds, microseconds = times.T
        if seconds.all() and (microseconds < 1_000_000).all():
            self.timestamps = seconds + 1e-6 * microseconds
            self.camera = CameraFacts(taken=float(self.timestamps[0]))

    def _marked_row(self) -> int | None:
        """Return the row that begins with the marker in the first and the last frame; None: no or several."""
        stored = self._layout.stored
        ends = [self.read(t, t + 1)[0].astype(stored) for t in (0, self.shape[0] - 1)]
        marked = [y for y, rows in enumerate(zip(*ends, strict=True)) if all(map(_is_marked, rows))]
        return marked[0] if len(marked) == 1 else None

    def _set_apart(self, start: int, step: int, n_bytes: int, row: int, column: int) -> None:
        """Set which samples are stored apart; refuse those outside of the file, or for none of its rows."""
        n, rows, columns = self.shape
        end = column + n_bytes // self.dtype.itemsize
        if row >= rows or end > columns or n_bytes % self.dtype.itemsize:
            raise InputError(
                f"damaged footer ({n_bytes} bytes for row {row}, column {column}); copy it again"
            )
        self._check_end(start + step * (n - 1) + n_bytes)
        self._apart = start, step, row, slice(column, end)

    def _check_end(self, end: int) -> None:
        if end > self.size:
            raise InputError("truncated in its footer; copy the file again")

    def put_right(self, buffer: NDArray[Any], t0: int, y0: int) -> None:
        """See `ContiguousReader.put_right`."""
        if self._apart is None or not y0 <= self._apart[2] < y0 + buffer.shape[1]:
            return
        start, step, row, columns = self._apart
        stored = self._layout.stored
        n_bytes = stored.itemsize * (columns.stop - columns.start)
        with OpenedFile(self.paths[0], self.size) as file:
            for t, frame in enumerate(buffer, t0):
                frame[row - y0, columns] = np.frombuffer(file.read_bytes(start + t * step, n_bytes), stored)


def _is_marked(row: NDArray[Any]) -> bool:
    return row.tobytes().startswith(_MARKER)
