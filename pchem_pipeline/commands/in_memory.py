"""Frames in memory, written once as a file that a run can refer to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.frames.writing import write_frames


def paths_of(frames: Any) -> list[str] | None:
    """Return camera files, globs or folders as a list; None where frames in memory are given."""
    if isinstance(frames, (str, os.PathLike)):
        return [str(frames)]
    if hasattr(frames, "shape") or not all(isinstance(each, (str, os.PathLike)) for each in frames):
        return None
    return [str(each) for each in frames]


def stack_of(frames: Any, *, least: int) -> Any:
    """Return frames as an array (frame, y, x) of whole DN, with ``least`` frames or more; it may be lazy.

    Given is an array, a list of frames, or anything whose slices along the frames become an array. Where one
    frame is enough, it may be an array (y, x).

    Raises:
        ConfigError: the message says what it should be.
    """
    frames = frames if hasattr(frames, "shape") else np.asarray(frames)
    if least == 1 and len(frames.shape) == 2:
        frames = np.asarray(frames)[None]
    shape, dtype = tuple(frames.shape), np.dtype(getattr(frames, "dtype", object))
    if len(shape) != 3 or shape[0] < least:
        needed = "" if least == 1 else f" of at least {least} frames, better some thousands"
        raise ConfigError(f"frames of shape {shape}: give an array (frame, y, x){needed}")
    if dtype.kind not in "ui":
        raise ConfigError(f"frames of {dtype}: PCH-EM needs raw DN of the ADC; give integers")
    return frames


def write_stack(path: Path, frames: Any) -> Path:
    """Write a stack (frame, y, x) as npy; the same one is left alone, so that nothing becomes stale.

    Raises:
        ConfigError: a DN is negative or too large.
    """
    dtype = _stored_type(frames)
    if not (path.exists() and _same(path, frames, dtype)):
        write_frames("npy", path, (block.astype(dtype) for _, block in _blocks(frames)), frames.shape, dtype)
    return path


def _stored_type(frames: Any) -> np.dtype[Any]:
    """Return the unsigned type that holds the frames; raise ConfigError where none does."""
    dtype = np.dtype(frames.dtype)
    if dtype.kind == "u" and dtype.itemsize <= 4:
        return np.dtype(f"u{dtype.itemsize}")
    low = min(int(block.min()) for _, block in _blocks(frames))
    high = max(int(block.max()) for _, block in _blocks(frames))
    if low < 0 or high >= 2**32:
        raise ConfigError(f"frames from {low} to {high} DN: give DN from 0 to 2^32 - 1")
    return np.dtype(np.uint16 if high < 2**16 else np.uint32)


def _blocks(frames: Any) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield the frames in blocks that fit into memory, each with its place."""
    n, rows, columns = frames.shape
    size = max(1, (64 << 20) // max(1, rows * columns * np.dtype(frames.dtype).itemsize))
    for first in range(0, n, size):
        place = slice(first, min(first + size, n))
        yield place, np.asarray(frames[place])


def _same(path: Path, frames: Any, dtype: np.dtype[Any]) -> bool:
    """Return whether a file holds these frames."""
    there = np.load(path, mmap_mode="r")
    alike = there.shape == tuple(frames.shape) and there.dtype == dtype
    return alike and all(np.array_equal(there[place], block) for place, block in _blocks(frames))
