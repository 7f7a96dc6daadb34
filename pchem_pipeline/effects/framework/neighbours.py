"""Samples beside a sample and before it: where they are, in arrays and in words, and what they predict.

Replacing a sample by the median of its eight neighbours is the usual correction of hot pixels and of
telegraph noise; their mean, or that of the left and the right one alone, are its cheaper forms.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, IntArray


def neighbour_words(place: tuple[int, int, int]) -> str:
    """Return the place of a neighbour in words, for example ``the sample one column to the left``."""
    frames, rows, columns = place
    parts = []
    for number, noun, (before, after) in (
        (frames, "frame", ("earlier", "later")),
        (rows, "row", ("above", "below")),
        (columns, "column", ("to the left", "to the right")),
    ):
        if number:
            count = "one" if abs(number) == 1 else str(abs(number))
            parts.append(f"{count} {noun}{'s' if abs(number) > 1 else ''} {before if number < 0 else after}")
    return f"the sample {' and '.join(parts)}"


def neighbours(values: NDArray[Any], place: tuple[int, int, int]) -> tuple[NDArray[Any], BoolArray]:
    """Return the samples at a place beside those of frames (frame, y, x), and where there are any."""
    to, source = [], []
    for shift, size in zip(place, values.shape, strict=True):
        to.append(slice(max(-shift, 0), max(size - max(shift, 0), 0)))
        source.append(slice(max(shift, 0), max(size + min(shift, 0), 0)))
    found, known = values.copy(), np.zeros(values.shape, np.bool_)
    found[tuple(to)], known[tuple(to)] = values[tuple(source)], True
    return found, known


def along_axis(values: NDArray[Any], step: IntArray, axis: int) -> NDArray[Any]:
    """Return the values so many places later along an axis, those at the ends instead of what is beyond."""
    at = np.arange(values.shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
    index = np.clip(at + step, 0, values.shape[axis] - 1)
    return np.take_along_axis(values, np.broadcast_to(index, values.shape), axis)


Predictor = Literal["median", "mean", "row"]
PREDICTORS: tuple[Predictor, ...] = get_args(Predictor)

_AROUND = tuple((dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1))
# Batcher's odd-even merge sort of eight, as far as the sum of the middle two asks for it
_COMPARATORS = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6),
    (0, 4), (1, 5), (2, 6), (3, 7), (2, 4), (3, 5),
)  # fmt: skip


def predicted(frames: NDArray[np.unsignedinteger[Any]], predictor: Predictor) -> NDArray[np.int32]:
    """Return what the neighbours predict for the samples inside the border, DN, halves cut off.

    By the median or the mean of the eight neighbours, or the mean of the left and the right one; of frames
    (frame, y, x), (frame, y - 2, x - 2) samples: those at the border have not all neighbours.
    """
    codes = frames.astype(np.int32)
    rows, columns = codes.shape[1] - 2, codes.shape[2] - 2
    around = [codes[:, dy : dy + rows, dx : dx + columns] for dy, dx in _AROUND]
    if predictor == "row":
        return np.asarray((around[3] + around[4]) // 2)
    if predictor == "mean":
        return np.asarray(sum(around[1:], around[0]) // 8)
    for low, high in _COMPARATORS:
        around[low], around[high] = (
            np.minimum(around[low], around[high]),
            np.maximum(around[low], around[high]),
        )
    return np.asarray((around[3] + around[4]) // 2)
