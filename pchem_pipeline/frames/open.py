"""Open the camera files of the section ``input`` as one stack, with a look at some of its samples.

About 100,000 stored samples tell what a format does not say: byte order, justification, axes.
The pixels of a sensor differ from one another by the same in every frame, and the samples of one pixel hardly
do. So the means of two halves of the samples along time vary alike from pixel to pixel. Where they do along
the first two axes of an array, and not along its last one, that is time. Where the samples of a pixel differ
far less with their bytes in the other order, that is their order.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.map_files import read_image
from pchem_pipeline.frames.inspect import survey
from pchem_pipeline.frames.resolve import mask_path
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings

#: what cameras write for pixels that they mask, 32 bits
_MARKER = (1 << 32) - 1
_FRAMES, _PLACES, _ROWS, _SAMPLES = 48, 4, 16, 100_000  # that are looked at
_FEWEST, _FEWEST_CODES, _FEWEST_STEPS = 8, 8, 500
_CLEARLY = 4.0  # times the common variance of the one is that of the other
_ERRORS = 3.0
_OCTAVES = 1.5  # by which steps shrink on average in the right byte order; in the wrong one they grow


def open_frames(
    settings: InputSettings, base_dir: Path, *, check_duplicates: bool = True, least: int = 2
) -> FrameSequence:
    """Open all camera files as one stack, with bit shift, region of interest and frame range applied.

    Args:
        settings: the section ``input``.
        base_dir: folder to which relative paths refer.
        check_duplicates: also look for equal files (reads a little of each), and at some samples.
        least: frames that there must be.

    Returns:
        A reader for threads and processes alike; its ``report`` says what was found and left out.

    Raises:
        InputError: bad files (all in one message), too few frames, or a region outside of the frames.
        ConfigError: an unknown format, or an optional library is missing.
    """
    readers, report = survey(settings, base_dir, check_duplicates=check_duplicates)
    report.raise_if_refused(settings.on_bad_file)
    frames = FrameSequence(readers, settings, report, least)
    frames.exclude(_excluded(frames, settings, base_dir))
    if check_duplicates:
        report.notes += _first_look(frames, settings)
    return frames


def _excluded(frames: FrameSequence, settings: InputSettings, base_dir: Path) -> NDArray[np.bool_]:
    """Return the pixels (y, x) that ``input.mask`` excludes, or that hold the marker at both ends."""
    n, rows, columns = frames.shape
    excluded = np.zeros((rows, columns), np.bool_)
    if frames.dtype.itemsize == 4:
        first, last = (frames.stored(t, t + 1, 0, rows)[0] for t in (0, n - 1))
        excluded |= (first == _MARKER) & (last == _MARKER)
    path = mask_path(settings, base_dir)
    if path is None:
        return excluded
    mask: NDArray[np.bool_] = read_image(path) != 0
    if settings.roi is not None and mask.shape != excluded.shape and mask.ndim == 2:
        y0, y1, x0, x1 = settings.roi
        mask = mask[y0:y1, x0:x1]
    if mask.shape != excluded.shape:
        raise InputError(
            f"{path}: mask of shape {mask.shape}, frames of {excluded.shape}; correct input.mask (--mask)"
        )
    excluded |= mask
    return excluded


def _first_look(frames: FrameSequence, settings: InputSettings) -> list[str]:
    """Return remarks on left-justified samples, and on a stack whose last axis looks like time.

    What is set is not looked for. InputError: the samples look byte-swapped, and no order is set.
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
        return []  # it is told where the frames are read
    values = np.concatenate(parts)
    name = frames.paths[0]
    if settings.byte_order is None and settings.bit_shift is None:
        _check_byte_order(values, f"{name}: ", frames.byte_order)
    notes = []
    unused = _unused_bits(values)
    if unused and settings.bit_shift is None and not frames.bit_shift:
        notes.append(
            f"{name.name}: the lowest {unused} bits of the samples are 0: left-justified samples; set "
            f"input.bit_shift: {unused} (--bit-shift {unused}), or DN count {1 << unused} times"
        )
    if frames.order_by_habit and not frames.unwritten and _is_time_last(values):
        notes.append(
            f"{name.name}: read as {n} frames of {rows} x {columns} pixels, but by its samples the last axis "
            "looks like time; if it is, save numpy.moveaxis(array, -1, 0)"
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
    cure = "write the file again with its bytes swapped (numpy: byteswap)"
    if order is not None:
        other = "little" if order == "big" else "big"
        cure = f"set input.byte_order: {other} (--byte-order {other})"
    if unused >= 8:
        cure += f", or, if they are left-justified, input.bit_shift: {unused}"
    raise InputError(f"{where}the samples look byte-swapped: {cure}")


def _unused_bits(values: NDArray[Any]) -> int:
    """Return how many of the lowest bits no sample uses; 0 where there are too few codes to tell."""
    if np.unique(values).size < _FEWEST_CODES:
        return 0
    used = int(np.bitwise_or.reduce(values, axis=None))
    return (used & -used).bit_length() - 1


def _is_time_last(values: NDArray[Any]) -> bool:
    """Tell it from samples (first axis, second axis, last axis)."""
    values = values[np.ptp(values, axis=(1, 2)) > 0]  # empty frames are no pattern of pixels
    if min(values.shape) < _FEWEST:
        return False
    along_last = _common_variance(np.moveaxis(values, 1, 0))
    along_first = _common_variance(np.moveaxis(values, 1, 0).swapaxes(1, 2))
    seen = along_first[0] > _ERRORS * along_first[1]
    return bool(seen and along_first[0] > _CLEARLY * (max(along_last[0], 0.0) + _ERRORS * along_last[1]))


def _common_variance(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the covariance of the means of two halves along axis 1 of (m, n, k) values, and its error."""
    one, other = values[:, ::2].mean(axis=1), values[:, 1::2].mean(axis=1)
    one, other = (each - each.mean(axis=1, keepdims=True) for each in (one, other))
    products = one * other
    number = products.shape[0] * (products.shape[1] - 1)
    error = float(np.sqrt((one**2).mean() * (other**2).mean() / number))
    return float(products.sum() / number), error
