"""What histograms lose, kept in compact form: order in time, and neighbours in space.

All sums are of integers, and exact. Time is cut into blocks; covariances are taken within blocks (about each
block's own mean) and averaged over them, so that slow drifts do not enter. Rows are cut into groups of
`ROW_GROUP`; nothing crosses the border of a group, so that bands of whole groups can be done apart and
every frame is read once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, CodeArray, FloatArray, IntArray
from pchem_pipeline.model.histogram.count_numba import add_products, sum_lines, update_range

#: Rows in a group: column sums are taken over it, and neighbour products stay inside.
ROW_GROUP = 64


def line_sums(frames: CodeArray) -> dict[str, NDArray[Any]]:
    """Return the sums along rows and columns of frames (frame, y, x), whole groups of rows from the top.

    By name ``row_sum``, DN, and ``row_sum_square``, DN^2, (frame, y), and ``column_sum``, DN, over
    `ROW_GROUP` rows, (frame, row_group, x).
    """
    n_frames, ny, nx = frames.shape
    row_sum, row_sum_square = np.empty((2, n_frames, ny), np.int64)
    column_sum = np.zeros((n_frames, -(-ny // ROW_GROUP), nx), np.int32)
    sum_lines(frames, ROW_GROUP, row_sum, row_sum_square, column_sum)
    return {"row_sum": row_sum, "row_sum_square": row_sum_square, "column_sum": column_sum}


def block_starts(n_frames: int, block_frames: int) -> IntArray:
    """Return the first frame of each time block; the last block may be shorter than ``block_frames``."""
    return np.arange(0, n_frames, block_frames, dtype=np.int64)


def frame_statistics(
    row_sum: IntArray, row_sum_square: IntArray, columns: int
) -> tuple[FloatArray, FloatArray]:
    """Return mean, DN, and variance, DN^2, over all n pixels of each frame (divisor n), (frame,) each.

    The sums along all rows of the sensor, of so many columns, are of shape (frame, y).
    """
    row_mean = row_sum / columns
    mean = row_mean.mean(axis=1)
    # within rows and between rows apart, so that a large mean does not drown a small variance
    within = (row_sum_square / columns - row_mean**2).mean(axis=1)
    between = ((row_mean - mean[:, None]) ** 2).mean(axis=1)
    return mean, within + between


class SummaryAccumulator:
    """Block sums and covariances of the pixels of some rows, while the frames come in.

    Sums of a block are ``block_sum``, DN, and ``block_sum_square``, DN^2, (y, x). Covariances within blocks,
    averaged over these, DN^2, (y, x), NaN where there is no pair: ``lag1_covariance`` with the next frame,
    unbiased (zero) for independent frames; ``neighbour_covariance_x`` with the pixel at x + 1, and
    ``neighbour_covariance_y`` with that at y + 1 of the same group.
    """

    def __init__(self, shape: tuple[int, int], block_frames: int) -> None:
        """Begin with no frames of some rows (from the top of a group) and columns."""
        self._block_frames = block_frames
        self._in_block = 0
        self._reference = np.zeros(shape, np.int32)
        self._before = np.zeros(shape, np.int32)
        self._sums = np.zeros((5, *shape), np.int64)
        self._covariances = np.zeros((3, *shape))
        self._freedom = 0

    @classmethod
    def resumed(cls, state: Arrays, n_frames: int, block_frames: int) -> SummaryAccumulator:
        """Go on after ``n_frames`` frames with what `open_sums` returned then."""
        sums, covariances = state["open_sums"], state["open_covariances"]
        self = cls(sums.shape[1:], block_frames)
        closed, self._in_block = divmod(n_frames, block_frames)
        self._freedom = closed * (block_frames - 1)
        self._sums[...], self._covariances[...] = sums[:5], covariances
        self._reference[...], self._before[...] = sums[5:]
        return self

    def open_sums(self) -> dict[str, NDArray[Any]]:
        """Return what is needed to go on later with a block that is not whole; to be taken before `finish`.

        ``open_sums`` are of d = DN - reference: d, d^2, d times that of the frame before, of x + 1, of y + 1;
        then the reference and the DN of the last frame; (7, y, x). ``open_covariances`` are sums over the
        closed blocks: lag 1, x + 1, y + 1; DN^2, (3, y, x).
        """
        ends = np.stack([self._reference, self._before]).astype(np.int64)
        covariances = self._covariances.copy()
        covariances[2, ROW_GROUP - 1 :: ROW_GROUP] = covariances[2, -1] = 0.0  # no pair across the border
        return {"open_sums": np.concatenate([self._sums, ends]), "open_covariances": covariances}

    def add(self, frames: CodeArray) -> list[dict[str, IntArray]]:
        """Take frames (frame, y, x), any number of them, and return the blocks that they complete."""
        done = []
        while len(frames):
            part, frames = np.split(frames, [self._block_frames - self._in_block])
            self._add_part(part)
            if self._in_block == self._block_frames:
                done.append(self._close_block())
        return done

    def finish(self) -> tuple[list[dict[str, IntArray]], dict[str, FloatArray]]:
        """Return the last block, if it was incomplete, and the covariances over all blocks."""
        done = [self._close_block()] if self._in_block else []
        lag, right, down = self._covariances / self._freedom if self._freedom else self._covariances * np.nan
        right[:, -1] = np.nan
        down[ROW_GROUP - 1 :: ROW_GROUP] = down[-1] = np.nan
        return done, {"lag1_covariance": lag, "neighbour_covariance_x": right, "neighbour_covariance_y": down}

    def exchange(self, pieces: Iterable[CodeArray], kept: BoolArray) -> dict[str, IntArray]:
        """Leave frames of a closed block out of the covariances; return the block's sums without them.

        The pieces are all frames of the block, (frame, y, x), of which some are kept, (frame,).
        """
        shape, n = self._reference.shape, int(kept.sum())
        before, after = SummaryAccumulator(shape, kept.size), SummaryAccumulator(shape, max(n, 1))
        nothing, at = np.zeros(shape, np.int64), 0
        done = [{"block_sum": nothing, "block_sum_square": nothing}]
        for piece in pieces:
            before.add(piece)
            done += after.add(piece[kept[at : at + len(piece)]])
            at += len(piece)
        self._covariances += after._covariances - before._covariances
        self._freedom += after._freedom - before._freedom
        return done[-1]

    def _add_part(self, frames: CodeArray) -> None:
        """Add frames that all belong to the open block."""
        if self._in_block == 0:
            self._reference[:] = self._before[:] = frames[0]
        narrow = self._is_narrow(frames)
        for chosen, dtype in ((narrow, np.int32), (~narrow, np.int64)):
            if chosen.any():
                work = np.zeros((7, frames.shape[2] + 1), dtype)
                add_products(frames, self._before, self._reference, ROW_GROUP, chosen, work, self._sums)
        self._before[:] = frames[-1]
        self._in_block += frames.shape[0]

    def _is_narrow(self, frames: CodeArray) -> BoolArray:
        """Return for each row whether sums of products over the frames fit into 32 bits, (y,)."""
        low, high = self._before.astype(frames.dtype), self._before.astype(frames.dtype)
        update_range(frames, low, high)
        reach = np.maximum(high - self._reference, self._reference - low).max(axis=1).astype(np.float64)
        largest = np.maximum(reach, np.append(reach[1:], 0))
        return np.asarray(frames.shape[0] * reach * largest < np.iinfo(np.int32).max)

    def _close_block(self) -> dict[str, IntArray]:
        """Turn the sums of the open block into block sums and covariances, and begin the next."""
        n = self._in_block
        plain, square, lag, right, down = self._sums.astype(np.float64)
        last = self._before.astype(np.float64) - self._reference
        # sum over t of (d_t - m)(d_(t-1) - m), m = plain / n; the first d is 0 by the choice of the reference
        lag_centred = lag - plain * (2 * plain - last) / n + (n - 1) * (plain / n) ** 2
        # independent frames would give -(n - 1) / n of the variance, on average: add it
        self._covariances[0] += lag_centred + (square - plain**2 / n) / n
        self._covariances[1, :, :-1] += right[:, :-1] - plain[:, :-1] * plain[:, 1:] / n
        self._covariances[2, :-1] += down[:-1] - plain[:-1] * plain[1:] / n
        self._freedom += n - 1
        reference = self._reference.astype(np.int64)
        total = self._sums[0] + n * reference
        squares = self._sums[1] + 2 * reference * self._sums[0] + n * reference**2
        self._sums[:] = 0
        self._in_block = 0
        return {"block_sum": total, "block_sum_square": squares}
