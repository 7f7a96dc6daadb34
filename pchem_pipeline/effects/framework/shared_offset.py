"""An offset that many pixels share, as far as the camera has it in other frames, too."""

from __future__ import annotations

from typing import Literal, NamedTuple


class SharedOffset(NamedTuple):
    """An offset of all pixels of a frame, of a row, of a column, or along a wave across the sensor.

    Attributes:
        of: what has one offset; a wave has a sine and a cosine of its own in each frame.
        variance: of the offset, of a wave's sine and of its cosine, in any frame of the camera, DN^2; None:
            other frames have another one.
        cycles_per_row, cycles_per_column: of a wave, from row to row and from column to column.
    """

    of: Literal["frame", "row", "column", "wave"]
    variance: float | None
    cycles_per_row: float = 0.0
    cycles_per_column: float = 0.0
