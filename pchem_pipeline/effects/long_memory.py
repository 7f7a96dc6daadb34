"""Processes with a long memory, at any block of frames: exact, and the same at every division into blocks.

A stationary Markov process at a frame between two known ones depends on those two alone. So from a coarse
grid of frames, so far apart that they are independent, midpoints are filled in level by level, down to the
frames that are wanted (Levy's construction of Brownian motion, by dyadic midpoints). Every frame has a
random number of its own, keyed on its number, and a block needs but a few beside its own: about two for
each level.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["between_grid_points", "frame_key"]

# frames apart by that many correlation times are independent but for 1e-7
_FAR = 16.0
_BITS = 29
_FRAMES = (1 << _BITS) - 1


def frame_key(frame: int, process: int = 0) -> int:
    """Return the number of the draw that belongs to a frame, also to one that is not in the block.

    Args:
        frame: its number; those before the run are negative.
        process: tells up to 7 independent processes of one effect apart (0 to 6).
    """
    return frame & _FRAMES | process << _BITS


def between_grid_points(
    frames: NDArray[np.int64],
    correlation_frames: float,
    independent: Callable[[int], NDArray[Any]],
    midpoint: Callable[[int, NDArray[Any], NDArray[Any], float], NDArray[Any]],
) -> list[NDArray[Any]]:
    """Return the states of a stationary Markov process at frames.

    Args:
        frames: frame numbers, shape (n,), at least one.
        correlation_frames: tau > 0: the correlation of states h frames apart is exp(-h / tau).
        independent: gives the state at a frame from its stationary law.
        midpoint: gives the state at a frame from (its number, the state h frames before, the state h frames
            after, exp(-h / tau)).

    Returns:
        The state at each frame, in order.
    """
    step = 1 << int(np.ceil(np.log2(max(_FAR * correlation_frames, 1.0))))
    first, last = int(frames.min()), int(frames.max())
    known = {at: independent(at) for at in range(first // step * step, last + step + 1, step)}
    while step > 1:
        half = step // 2
        rho = float(np.exp(-half / correlation_frames))
        for left in [at for at in known if at + step in known]:
            known[left + half] = midpoint(left + half, known[left], known[left + step], rho)
        # the next level needs the points around the block only
        known = {at: state for at, state in known.items() if first - half < at < last + half}
        step = half
    return [known[int(frame)] for frame in frames]
