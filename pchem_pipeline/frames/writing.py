"""One door to all writers: streams of frame blocks into files of any of our formats."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.frames.registry import reader_class

#: formats that can be written, by the modules of their readers
WRITERS = ("tiff", "fits", "hdf5", "npy", "raw", "zarr", "ser")


class StackFacts(NamedTuple):
    """What a writer has to know of a stack: (frames, rows, columns), type, integration time in s, ADC bits.

    None of the last two: not known.
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
) -> Path:
    """Write a stream of frames, and return its file, which appears only when it is whole.

    Blocks (any number of frames, rows, columns) of uint8, uint16 or uint32 make up the shape (frames, rows,
    columns). A path without a suffix gets the format's own. Integration time (s) and bits of the ADC are
    recorded where the format has a place for them.

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
    reader = reader_class(format)
    path = path if path.suffix else path.with_suffix(reader.suffixes[0])
    stream = _checked(blocks, shape)
    facts = StackFacts(shape, kind.newbyteorder("="), integration_time, bit_depth)
    importlib.import_module(reader.__module__).write_frames(path, stream, facts)
    list(stream)  # a writer may stop when it has as many frames as the shape says
    return path


def _checked(blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """Yield the blocks, which must make up the shape."""
    left = shape[0]
    for block in blocks:
        if block.ndim != 3 or block.shape[1:] != shape[1:]:
            raise ValueError(f"a block of shape {block.shape} for frames of {shape[1:]}")
        left -= len(block)
        if left < 0:
            raise ValueError("the blocks hold more frames than the shape says")
        yield block
    if left:
        raise ValueError(f"the blocks end {left} frames too early")
