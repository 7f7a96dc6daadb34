"""Pictures of few colours as PNG files."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

#: Of maps: files are within 3 % as small as at levels 6 and 9, in three quarters of the time.
COMPRESSION = 4


def png_of(index: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    """Return a picture as a PNG file.

    Args:
        index: number of the colour of each dot, (row, column).
        colours: red, green and blue, shape (n, 3), n up to 256.
    """
    rows, columns = index.shape
    # before each row the number of the filter: none
    lines = np.zeros((rows, columns + 1), np.uint8)
    lines[:, 1:] = index
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)),
        (b"PLTE", colours.tobytes()),
        (b"IDAT", zlib.compress(lines.tobytes(), COMPRESSION)),
        (b"IEND", b""),
    )
    written = (
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(written)


def png_url(index: NDArray[np.uint8], colours: NDArray[np.uint8]) -> str:
    """Return a picture as a data URL; see :func:`png_of`."""
    return f"data:image/png;base64,{base64.b64encode(png_of(index, colours)).decode('ascii')}"
