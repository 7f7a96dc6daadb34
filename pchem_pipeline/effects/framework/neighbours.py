"""Samples beside a sample and before it: where they are, in arrays and in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


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


def neighbours(values: NDArray[Any], place: tuple[int, int, int]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the samples at a place beside those of frames (frame, y, x), and where there are any."""
    to, source = [], []
    for shift, size in zip(place, values.shape, strict=True):
        to.append(slice(max(-shift, 0), max(size - max(shift, 0), 0)))
        source.append(slice(max(shift, 0), max(size + min(shift, 0), 0)))
    found, known = values.copy(), np.zeros(values.shape, np.bool_)
    found[tuple(to)], known[tuple(to)] = values[tuple(source)], True
    return found, known


def along_axis(values: NDArray[Any], step: NDArray[np.int64], axis: int) -> NDArray[Any]:
    """Return the values so many places later along an axis, those at the ends instead of what is beyond."""
    at = np.arange(values.shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
    index = np.clip(at + step, 0, values.shape[axis] - 1)
    return np.take_along_axis(values, np.broadcast_to(index, values.shape), axis)
