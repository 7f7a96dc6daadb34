"""Processes with a long memory, at any block of frames: exact, and the same at every division into blocks.

A stationary Markov process at a frame between two known ones depends on those two alone. So from a coarse
grid of frames, so far apart that they are independent, midpoints are filled in level by level, down to the
frames that are wanted (Levy's construction of Brownian motion, by dyadic midpoints). Every frame has a
random number of its own, keyed on its number, and a block needs but a few beside its own: about two for
each level.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pchem_pipeline.effects.types import AnyArray, FloatArray, IntArray

# frames apart by that many correlation times are independent but for 1e-7
_FAR = 16.0
_BITS = 29
_FRAMES = (1 << _BITS) - 1
#: Draws that are no frame's, for what a pixel has throughout the run.
OF_PIXEL = (0xFFFFFFFE, 0xFFFFFFFF, 0xFFFFFFFD, 0xFFFFFFFC)


def frame_key(frame: int, process: int = 0) -> int:
    """Return the number of the draw that belongs to a frame, also to one that is not in the block.

    Args:
        frame: its number; those before the run are negative.
        process: tells up to 7 independent processes of one effect apart (0 to 6).
    """
    return frame & _FRAMES | process << _BITS


def between_grid_points(
    frames: IntArray,
    longest: float,
    independent: Callable[[int], AnyArray],
    midpoint: Callable[[int, AnyArray, AnyArray, int], AnyArray],
) -> list[AnyArray]:
    """Return the states of a stationary Markov process at frames.

    Args:
        frames: frame numbers, shape (n,), at least one.
        longest: correlation time, frames, > 0: states much farther apart are independent.
        independent: gives the state at a frame from its stationary law.
        midpoint: gives the state at a frame from (its number, the state h frames before, the state h frames
            after, h).

    Returns:
        The state at each frame, in order.
    """
    step = 1 << int(np.ceil(np.log2(max(_FAR * longest, 1.0))))
    first, last = int(frames.min()), int(frames.max())
    known = {at: independent(at) for at in range(first // step * step, last + step + 1, step)}
    while step > 1:
        half = step // 2
        for left in [at for at in known if at + step in known]:
            known[left + half] = midpoint(left + half, known[left], known[left + step], half)
        # the next level needs the points around the block only
        known = {at: state for at, state in known.items() if first - half < at < last + half}
        step = half
    return [known[int(frame)] for frame in frames]


def two_states(
    frames: IntArray,
    correlation_frames: FloatArray | float,
    occupied: FloatArray | float,
    uniform: Callable[[int], FloatArray],
    longest: float,
) -> FloatArray:
    """Return a Markov chain of two states for each of n traps: 1 where it is full and 0 where it is empty.

    Args:
        frames: frame numbers, shape (m,), at least one.
        correlation_frames: tau > 0, of all or of each, (n,): the correlation of states h frames apart is
            exp(-h / tau).
        occupied: probability that a trap is full, of all or of each, (n,).
        uniform: gives the uniform numbers of a frame, shape (n,).
        longest: about the largest correlation time of any trap, whichever are asked for here.

    Returns:
        Shape (m, n).
    """

    def full_after(state: FloatArray | float, rho: FloatArray) -> FloatArray:
        return np.asarray(occupied + (state - occupied) * rho, np.float64)

    def independent(frame: int) -> FloatArray:
        return (uniform(frame) < occupied).astype(np.float64)

    def midpoint(frame: int, before: FloatArray, after: FloatArray, half: int) -> FloatArray:
        rho = np.exp(-half / np.asarray(correlation_frames))
        # Bayes: the way there by way of "full" and by way of "empty"
        up, from_full, from_empty = full_after(before, rho), full_after(1.0, rho), full_after(0.0, rho)
        by_full = up * np.where(after > 0, from_full, 1.0 - from_full)
        by_empty = (1.0 - up) * np.where(after > 0, from_empty, 1.0 - from_empty)
        return (uniform(frame) * (by_full + by_empty) < by_full).astype(np.float64)

    return np.stack(between_grid_points(frames, longest, independent, midpoint))
