"""A look at about 100,000 stored samples for what a format does not say: byte order, limits, axes.

The pixels of a sensor differ from one another by the same in every frame, and the samples of one pixel hardly
do. So the means of two halves of the samples along time vary alike from pixel to pixel. Where they do along
the first two axes of an array, and not along its last one, that is time. Where the samples of a pixel differ
far less with their bytes in the other order, that is their order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import InputError

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence
    from pchem_pipeline.frames.settings import InputSettings

_FRAMES, _PLACES, _ROWS, _SAMPLES = 48, 4, 16, 100_000  # that are looked at
_FEWEST, _FEWEST_STEPS = 8, 500
_FEWEST_AT_LIMIT, _LARGEST_SPAN = 20, 1 << 20  # samples; codes
_CLEARLY = 4.0  # times the common variance of the one is that of the other
_ERRORS = 3.0
_OCTAVES = 1.5  # by which steps shrink on average in the right byte order; in the wrong one they grow


def first_look(frames: FrameSequence, settings: InputSettings) -> list[str]:
    """Return remarks on left-justified samples, and on a stack whose last axis looks like time.

    What the settings state is not looked for. ``frames.seen_limits`` becomes the codes at which its samples
    seem to be cut off.

    Raises:
        InputError: the samples look byte-swapped, and no byte order is set.
    """
    n, rows, columns = frames.shape
    least = _ROWS if frames.order_by_habit else 1
    height = min(rows, max(least, _SAMPLES // (min(n, _FRAMES) * columns)))
    first = (rows - height) // 2
    few = n if n <= _FRAMES else _FRAMES // _PLACES
    starts = np.unique(np.linspace(0, n - few, _PLACES).astype(int)).tolist()
    try:
        parts = [frames.stored(t, t + few, first, first + height) for t in starts]
    except InputError:
        return []  # reading the frames will say so
    values = np.concatenate(parts)
    name = frames.paths[0]
    if settings.byte_order is None and settings.bit_shift is None:
        _check_byte_order(values, f"{name}: ", frames.byte_order)
    notes = []
    unused = _unused_bits(values)
    if unused and settings.bit_shift is None and not frames.bit_shift:
        notes.append(
            f"{name.name}: the lowest {unused} bits of the samples are 0 (left-justified samples); set "
            f"input.bit_shift: {unused} (--bit-shift {unused}), else all DN are {1 << unused} times too large"
        )
    low, high = int(values.min()), int(values.max())
    if not frames.bit_shift and high - low < _LARGEST_SPAN:
        at_low, at_high = (int((values == end).any(axis=0).sum()) for end in (low, high))
        frames.seen_limits = _limits_seen(low, np.bincount((values - low).ravel()), (at_low, at_high))
    if frames.order_by_habit and not frames.unwritten and _is_time_last(values):
        notes.append(
            f"{name.name}: read as {n} frames of {rows} x {columns} pixels, but the last axis looks like "
            "time; if so, save numpy.moveaxis(array, -1, 0)"
        )
    return notes


def _check_byte_order(values: NDArray[Any], where: str, order: str | None) -> None:
    """Refuse samples that differ far less along time with their bytes swapped."""
    unused = _unused_bits(values)
    # of left-justified samples; a high byte in the place of the low one has low bits
    if values.dtype.itemsize == 1 or 4 <= unused < 8:
        return
    steps, swapped = (
        np.abs(np.diff(each.astype(np.float64), axis=0)) for each in (values, values.byteswap())
    )
    some = steps > 0
    if some.sum() < _FEWEST_STEPS or np.log2(steps[some] / swapped[some]).mean() < _OCTAVES:
        return
    cure = "write the file again with swapped bytes (numpy: byteswap)"
    if order is not None:
        other = "little" if order == "big" else "big"
        cure = f"set input.byte_order: {other} (--byte-order {other})"
    if unused >= 8:
        cure += f", or, if they are left-justified, input.bit_shift: {unused} (--bit-shift {unused})"
    raise InputError(f"{where}the samples look byte-swapped: {cure}")


def _unused_bits(values: NDArray[Any]) -> int:
    """Return how many of the lowest bits no sample uses; 0 where there are too few codes to tell."""
    if np.unique(values).size < _FEWEST:
        return 0
    used = int(np.bitwise_or.reduce(values, axis=None))
    return (used & -used).bit_length() - 1


def _limits_seen(first: int, samples: NDArray[Any], pixels: tuple[int, int]) -> tuple[int | None, int | None]:
    """Return the lowest and highest code if samples pile up there, in several of the pixels that have it."""
    last, few = first + samples.size - 1, _FEWEST + 1
    found: list[int | None] = []
    for code, n, (at, *beside) in (
        (first, pixels[0], samples[:few].tolist()),
        (last, pixels[1], samples[::-1][:few].tolist()),
    ):
        several = n >= _FEWEST and len(beside) == _FEWEST and min(beside) > 0
        found.append(code if several and at > _CLEARLY * max(beside) + _FEWEST_AT_LIMIT else None)
    return found[0], found[1]


def limits_in(counts: NDArray[Any], origin: NDArray[Any]) -> tuple[int | None, int | None]:
    """Return the lowest and highest code of histograms, (..., bin), where samples pile up there, else None.

    ``origin`` are the DN of their bins 0, shape (...).
    """
    first = int(origin.min())
    codes = (origin - first)[..., None] + np.arange(counts.shape[-1])
    samples, pixels = np.bincount(codes.ravel(), counts.ravel()), np.bincount(codes[counts > 0])
    used = np.flatnonzero(pixels)
    if not used.size:
        return None, None
    low, high = int(used[0]), int(used[-1])
    return _limits_seen(first + low, samples[low : high + 1], (int(pixels[low]), int(pixels[high])))


def _is_time_last(values: NDArray[Any]) -> bool:
    """Tell it from samples (first axis, second axis, last axis)."""
    values = values[np.ptp(values, axis=(1, 2)) > 0]  # empty frames are no pattern of pixels
    if min(values.shape) < _FEWEST:
        return False
    rows = np.moveaxis(values, 1, 0)
    last = _common_variance(rows)
    first = _common_variance(rows.swapaxes(1, 2))
    # what whole frames share is no pattern of pixels either
    single = _common_variance((rows - rows.mean(axis=0)).swapaxes(1, 2))
    seen = min(first[0] - _ERRORS * first[1], single[0] - _ERRORS * single[1]) > 0.0
    return bool(seen and first[0] > _CLEARLY * (max(last[0], 0.0) + _ERRORS * last[1]))


def _common_variance(values: FloatArray) -> tuple[float, float]:
    """Return the covariance over k of the means over two halves of n, averaged over m, and its error."""
    one, other = values[:, ::2].mean(axis=1), values[:, 1::2].mean(axis=1)
    one, other = (each - each.mean(axis=1, keepdims=True) for each in (one, other))
    products = one * other
    number = products.shape[0] * (products.shape[1] - 1)
    error = float(np.sqrt((one**2).mean() * (other**2).mean() / number))
    return float(products.sum() / number), error
