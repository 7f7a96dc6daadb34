"""SER video of astronomers' cameras: a header of 178 bytes, the frames, and a trailer of times.

The flag for the byte order is written by most programs with the opposite meaning of the format's text: 0 is
in fact little-endian. So 0 is read as little-endian; ``input.byte_order`` overrides.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import CameraFacts, text_of
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, even_offsets, write_plain
from pchem_pipeline.frames.formats.kinds import mosaic_note
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts

_HEADER = struct.Struct("<14s7i40s40s40s2q")
_MAGIC = b"LUCAM-RECORDER"
#: ticks of 100 ns from year 1 to 1970
_EPOCH = 621_355_968_000_000_000
#: ColorID of mosaics
_MOSAICS = {
    **{8: "RGGB", 9: "GRBG", 10: "GBRG", 11: "BGGR"},
    **{16: "CYYM", 17: "YCMY", 18: "YMCY", 19: "MYYC"},
}


class SerReader(ContiguousReader):
    """Monochrome or Bayer SER video, 1 to 16 bits."""

    format_name = "ser"
    suffixes: ClassVar[tuple[str, ...]] = (".ser",)
    magic: ClassVar[tuple[bytes, ...]] = (_MAGIC,)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        with path.open("rb") as stream:
            head = stream.read(_HEADER.size)
        if not head.startswith(_MAGIC):
            raise ValueError
        _, _, colour, flag, columns, rows, depth, n, _, instrument, _, _, ticks = _HEADER.unpack(head)
        if colour in _MOSAICS:
            self.notes = (mosaic_note(_MOSAICS[colour]),)
        elif colour != 0:
            raise InputError(f"colour video (ColorID {colour}); record raw frames (monochrome or Bayer)")
        if not 1 <= depth <= 16 or rows < 1 or columns < 1 or n < 0:
            raise InputError(f"damaged header ({n} frames, {rows} x {columns}, {depth} bits); copy it again")
        order = settings.byte_order or ("big" if flag else "little")
        stored = np.dtype("u1" if depth <= 8 else "u2").newbyteorder(order)
        offsets = even_offsets(n, rows * columns * stored.itemsize, self.size, start=_HEADER.size)
        self.set_layout(Layout(offsets, rows, columns, stored))
        self.bit_depth, self.byte_order = depth, order
        taken = (ticks - _EPOCH) * 1e-7 if ticks > _EPOCH else None
        end = self._layout.end
        if n and self.size >= end + 8 * n:  # there is a trailer of times
            times = np.fromfile(path, "<i8", n, offset=end)
            if (times > 0).all():
                self.timestamps = (times - _EPOCH) * 1e-7
                taken = float(self.timestamps[0])
        self.camera = CameraFacts(text_of(instrument), taken=taken)


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as SER video (uint8 or uint16) without times; see `frames.writing.write_frames`."""
    shape, dtype, _, bit_depth = stack
    if dtype.itemsize > 2:
        raise InputError(f"{path}: SER has at most 16 bits, not {dtype.name}; choose another format")
    n, rows, columns = shape
    depth = bit_depth or 8 * dtype.itemsize
    if (depth > 8) != (dtype.itemsize == 2):
        raise InputError(f"{path}: SER cannot store {depth} bits as {dtype.name}; choose another format")
    header = _HEADER.pack(_MAGIC, 0, 0, 0, columns, rows, depth, n, b"", b"", b"", 0, 0)
    write_plain(path, header, blocks, dtype.newbyteorder("<"))
