"""One sweep over a stack of frames: the next block is read while the bands of rows of one are counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Sweep", "cut_rows"]

#: bands for each worker: enough to keep all busy to the end
_BANDS_PER_WORKER = 4

Parts = list[NDArray[Any]]


def cut_rows(ny: int, step: int, workers: int) -> list[tuple[int, int]]:
    """Cut ``ny`` rows into bands of multiples of ``step`` rows, a few for each worker.

    Args:
        ny: rows of the sensor.
        step: rows that must stay together, from the top.
        workers: number of workers.

    Returns:
        First row and end of each band, from top to bottom.
    """
    height = step * max(1, -(-ny // step) // (_BANDS_PER_WORKER * workers))
    return [(y, min(y + height, ny)) for y in range(0, ny, height)]


class Sweep:
    """The frames of a stack by blocks, each cut into bands of rows, with one block read ahead."""

    def __init__(
        self,
        read: Callable[[Parts, int, int], None],
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        bands: Sequence[tuple[int, int]],
        step: int,
        first: int = 0,
    ) -> None:
        """Take the memory; nothing is read yet.

        Args:
            read: fills the bands of frames t0..t1; called for one block after the other.
            shape: frames, rows, columns.
            dtype: type of the samples.
            bands: rows of each band, see `cut_rows`.
            step: frames in a block; blocks end at multiples of it, the last one may be shorter.
            first: frame to begin with.
        """
        self._read, self._n_frames, self._step = read, shape[0], min(step, shape[0])
        self._first, self._skipped = first, first // self._step
        self._buffers = [
            [np.empty((self._step, y1 - y0, shape[2]), dtype) for y0, y1 in bands] for _ in range(2)
        ]

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return -(-self._n_frames // self._step) - self._skipped

    @contextmanager
    def blocks(self) -> Iterator[Iterator[tuple[int, Parts]]]:
        """Give an iterator over the blocks: first frame, and the frames (frame, y, x) of each band.

        A block is overwritten after the next one was asked for.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="read") as pool:
            yield self._blocks(pool)

    def _blocks(self, pool: ThreadPoolExecutor) -> Iterator[tuple[int, Parts]]:
        def request(number: int) -> tuple[Parts, Future[None]]:
            t0, t1 = self._frames(number)
            parts = [band[: t1 - t0] for band in self._buffers[number % 2]]
            return parts, pool.submit(self._read, parts, t0, t1)

        pending = request(0)
        for number in range(self.n_blocks):
            parts, reading = pending
            reading.result()
            if number + 1 < self.n_blocks:
                pending = request(number + 1)
            yield self._frames(number)[0], parts

    def _frames(self, number: int) -> tuple[int, int]:
        """Return the first frame of a block, and its end."""
        start = (number + self._skipped) * self._step
        return max(start, self._first), min(start + self._step, self._n_frames)
