"""Disjoint parts of the frames: one to fit, one to score, one to measure the final gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.verdict import Examined

#: Fewer frames leave hardly five blocks to each third.
MINIMUM_FRAMES = 300
_SHORTEST, _LONGEST, _BLOCKS = 20, 100, 60
# the order changes from group to group, so that no part is always the earlier one
_ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))


@dataclass(frozen=True)
class Splits:
    """Positions (along the first axis of the stack) of the frames of each part, equally many each.

    Effects are estimated on the part train and scored on test; final is for the remaining gap, and to confirm
    what was found without it. Consecutive frames come in blocks of ``block_frames``.
    """

    train: IntArray
    test: IntArray
    final: IntArray
    block_frames: int

    def examined(self, shape: tuple[int, ...]) -> Examined:
        """Return what was looked at of a stack of a shape (frame, y, x)."""
        return Examined(
            frames=shape[0],
            rows=(0, shape[1]),
            columns=(0, shape[2]),
            train=self.train.size,
            test=self.test.size,
            final=self.final.size,
        )


def block_length(n_frames: int, wanted: int | None = None) -> int:
    """Return the frames in a block: even, so that even and odd frames stay in balance.

    Raises:
        InputError: the frames are too few for the blocks.
    """
    length = wanted or min(max(n_frames // _BLOCKS, _SHORTEST), _LONGEST)
    length += length % 2
    needed = max(MINIMUM_FRAMES, 9 * length)
    if n_frames < needed:
        raise InputError(
            f"{n_frames} frames are too few to look for a discrepancy; three parts in blocks of {length} "
            f"need {needed}: take more frames"
            + ("" if wanted is None or n_frames < MINIMUM_FRAMES else ", or lower discrepancy.block_frames")
        )
    return length


def split_frames(numbers: IntArray, block_frames: int) -> Splits:
    """Deal whole blocks of consecutive frames to train, test and final in turn; a rest is left out."""
    # a block never spans a gap in the numbering
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    starts = [
        start
        for run in np.split(np.arange(numbers.size), breaks)
        for start in range(int(run[0]), int(run[-1]) + 2 - block_frames, block_frames)
    ]
    parts: tuple[list[int], list[int], list[int]] = ([], [], [])
    for group in range(len(starts) // 3):
        for part, start in zip(_ORDERS[group % 6], starts[3 * group : 3 * group + 3], strict=True):
            parts[part].append(start)
    train, test, final = (
        (np.asarray(part, np.int64)[:, None] + np.arange(block_frames)).ravel() for part in parts
    )
    return Splits(train, test, final, block_frames)
