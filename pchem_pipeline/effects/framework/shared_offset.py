"""Offsets that many pixels share: how they are added, and how an effect tells of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from pchem_pipeline.effects.framework.context import EffectContext


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


def add_offset(values: NDArray[Any], offset_dn: ArrayLike, context: EffectContext) -> NDArray[Any]:
    """Return the analog signal (frame, y, x), e-, with offsets in DN referred to the input."""
    result: NDArray[Any] = values + np.asarray(offset_dn) * context.truth["conversion_gain"]
    return result
