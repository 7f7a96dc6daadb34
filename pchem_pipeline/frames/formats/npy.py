"""NumPy ``.npy`` arrays, read from their offset; pickles are never opened."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, even_offsets, write_plain
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts


class NpyReader(ContiguousReader):
    """An array (frames, rows, columns), or one frame (rows, columns), in C order."""

    format_name = "npy"
    order_by_habit = True
    suffixes: ClassVar[tuple[str, ...]] = (".npy",)
    magic: ClassVar[tuple[bytes, ...]] = (b"\x93NUMPY",)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        with path.open("rb") as stream:
            version = npy_format.read_magic(stream)
            old = version == (1, 0)
            read = npy_format.read_array_header_1_0 if old else npy_format.read_array_header_2_0
            shape, fortran, dtype = read(stream)
            start = stream.tell()
        if dtype.hasobject:
            raise InputError(
                "an object array (pickles are never opened); save a plain array of uint8, uint16 or uint32"
            )
        self.set_stack(shape, dtype, settings, "array")
        n, rows, columns = self.shape
        if fortran and n * rows > 1 and n * columns > 1 and rows * columns > 1:
            raise InputError("Fortran order; save it with numpy.save(..., numpy.ascontiguousarray(frames))")
        offsets = even_offsets(n, rows * columns * dtype.itemsize, self.size, start=start)
        self.set_layout(Layout(offsets, rows, columns, dtype, self._offset))
        behind = self.size - max(start, self._layout.end)
        if behind:
            self.notes = (f"{behind} bytes after the array are ignored",)


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as one npy array; the format has no place for times and bit depth."""
    shape, dtype, *_ = stack
    header = {"descr": npy_format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    head = io.BytesIO()
    npy_format.write_array_header_1_0(head, header)
    write_plain(path, head.getvalue(), blocks, dtype)
