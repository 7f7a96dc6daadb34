"""One door to all writers: streams of frame blocks into files of any of our formats."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError

#: module and usual suffix of each format that can be written
WRITERS = {
    "tiff": ("tiff", ".tif"),
    "fits": ("fits", ".fits"),
    "hdf5": ("hdf5", ".h5"),
    "npy": ("npy", ".npy"),
    "raw": ("raw", ".raw"),
    "zarr": ("omezarr", ".zarr"),
    "ser": ("ser", ".ser"),
}


class StackFacts(NamedTuple):
    """What the writer of a format is told of a stack.

    Attributes:
        shape: (frames, rows, columns).
        dtype: of the samples.
        integration_time: s; None: not known.
        bit_depth: bits of the ADC; None: not known.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    integration_time: float | None = None
    bit_depth: int | None = None

    @property
    def stated(self) -> dict[str, Any]:
        """Integration time and bit depth by their names, as far as they are known."""
        facts = {"integration_time": self.integration_time, "bit_depth": self.bit_depth}
        return {name: value for name, value in facts.items() if value is not None}


def write_frames(
    format: str,
    path: Path,
    blocks: Iterable[NDArray[Any]],
    shape: tuple[int, int, int],
    dtype: np.dtype[Any] | str | type[np.unsignedinteger[Any]],
    *,
    integration_time: float | None = None,
    bit_depth: int | None = None,
    frames_per_file: int | None = None,
) -> list[Path]:
    """Write a stream of frames; each file appears only when it is whole.

    Args:
        format: tiff, fits, hdf5, npy, raw, zarr or ser.
        path: the file; without a suffix the format's own is added. With ``frames_per_file``, parts are named
            ``<stem>_00001<suffix>`` and so on.
        blocks: arrays (any number of frames, rows, columns), in order, together ``shape``.
        shape: (frames, rows, columns).
        dtype: uint8, uint16 or uint32.
        integration_time: s, recorded where the format has a place for it.
        bit_depth: bits of the ADC, recorded likewise.
        frames_per_file: frames of a part (1: a sequence of single frames); None: all in one file.

    Returns:
        The files written, in order.

    Raises:
        ConfigError: an unknown format, or an optional library is missing.
        StoreError: the folder cannot be written.
        ValueError: the blocks do not make up ``shape``.
    """
    if format not in WRITERS:
        raise ConfigError(f"frames cannot be written as {format!r}; choose one of: {', '.join(WRITERS)}")
    kind = np.dtype(dtype)
    if kind.kind != "u" or kind.itemsize not in (1, 2, 4):
        raise ValueError(f"frames are uint8, uint16 or uint32, not {kind.name}")
    module, suffix = WRITERS[format]
    writer = importlib.import_module(f"pchem_pipeline.frames.formats.{module}").write_frames
    path = path if path.suffix else path.with_suffix(suffix)
    stream = _Stream(blocks, shape)
    written: list[Path] = []
    for part, count in _parts(path, shape[0], frames_per_file):
        stack = StackFacts((count, *shape[1:]), kind.newbyteorder("="), integration_time, bit_depth)
        writer(part, stream.take(count), stack)
        written.append(part)
    stream.finish()
    return written


def _parts(path: Path, n: int, frames_per_file: int | None) -> list[tuple[Path, int]]:
    """Return (file, frames) of each part."""
    if frames_per_file is None:
        return [(path, n)]
    starts = range(0, n, frames_per_file)
    width = max(5, len(str(len(starts))))
    return [
        (path.with_name(f"{path.stem}_{i:0{width}d}{path.suffix}"), min(frames_per_file, n - start))
        for i, start in enumerate(starts, 1)
    ]


class _Stream:
    """Blocks cut at the borders of the parts."""

    def __init__(self, blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int]) -> None:
        self._blocks = iter(blocks)
        self._shape = shape

    def take(self, count: int) -> Iterator[NDArray[Any]]:
        """Yield blocks that make up the next ``count`` frames."""
        while count > 0:
            block = next(self._blocks, None)
            if block is None:
                raise ValueError(f"the blocks end {count} frames too early")
            if block.ndim != 3 or block.shape[1:] != self._shape[1:]:
                raise ValueError(f"a block of shape {block.shape} for frames of {self._shape[1:]}")
            if len(block) > count:
                self._blocks = chain([block[count:]], self._blocks)
                block = block[:count]
            count -= len(block)
            yield block

    def finish(self) -> None:
        """Check that nothing is left over."""
        if any(len(block) for block in self._blocks):
            raise ValueError("the blocks hold more frames than the shape says")
