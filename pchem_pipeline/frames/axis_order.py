"""A look at whether the last axis of an array is time, where its format does not say.

The pixels of a sensor differ from one another by the same in every frame, and the samples of one pixel hardly
do. So the means of two halves of the samples along time vary alike from pixel to pixel. Where they do along
the first two axes of an array, and not along its last one, that is time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.reader import FrameReader

_FRAMES, _ROWS = 48, 16  # that are looked at
_FEWEST = 8
_CLEARLY = 4.0  # times the common variance of the one is that of the other
_ERRORS = 3.0


def last_axis_note(reader: FrameReader) -> tuple[str, ...]:
    """Return a remark on a stack whose last axis looks like time; none where that is not clear."""
    n, rows, columns = reader.shape
    if min(n, rows, columns) < _FEWEST:
        return ()
    frames = np.unique(np.linspace(0, n - 1, min(n, _FRAMES)).astype(int))
    first = max(0, (rows - _ROWS) // 2)
    try:
        some = [reader.read(t, t + 1, first, min(first + _ROWS, rows))[0] for t in frames.tolist()]
    except InputError:
        return ()  # it is told where the frames are read
    if not _is_time_last(np.array(some, np.float64)):
        return ()
    return (
        f"{reader.paths[0].name}: read as {n} frames of {rows} x {columns} pixels, but by its samples the "
        "last axis looks like time; if it is, save numpy.moveaxis(array, -1, 0)",
    )


def _is_time_last(values: NDArray[np.float64]) -> bool:
    """Tell it from samples (first axis, second axis, last axis)."""
    along_last = _common_variance(np.moveaxis(values, 1, 0))
    along_first = _common_variance(np.moveaxis(values, 1, 0).swapaxes(1, 2))
    seen = along_first[0] > _ERRORS * along_first[1]
    return bool(seen and along_first[0] > _CLEARLY * (max(along_last[0], 0.0) + _ERRORS * along_last[1]))


def _common_variance(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the covariance along the last axis of the means of two halves of the second, and its error.

    Args:
        values: shape (m, n, k); averaged over m.
    """
    one, other = values[:, ::2].mean(axis=1), values[:, 1::2].mean(axis=1)
    one, other = (each - each.mean(axis=1, keepdims=True) for each in (one, other))
    products = one * other
    number = products.shape[0] * (products.shape[1] - 1)
    error = float(np.sqrt((one**2).mean() * (other**2).mean() / number))
    return float(products.sum() / number), error
