"""Random numbers of effects: fates of electrons, and processes with a long memory.

An effect on single electrons changes few samples. One keyed uniform number per sample says which; what
happens there is worked out for those samples alone. Every function grows with its probability from the same
end of the number, so the samples that change at a small strength also change at a large one, and none
changes at none.

A stationary Markov process at a frame between two known ones depends on those two alone. So from a coarse
grid of frames, so far apart that they are independent, midpoints are filled in level by level, down to the
frames that are wanted (Levy's construction of Brownian motion), each with a random number keyed on its
number: about two frames beside the block for each level.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.types import AnyArray, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.limits import LEAST_EXPONENT

_STEPS = np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])


def further_uniform(u: FloatArray, draw: IntArray | int) -> FloatArray:
    """Return more uniform numbers in (0, 1) of samples whose own number is ``u``, any shape.

    The bits of the number are scrambled by the finaliser of SplitMix64 (Steele, Lea and Flood 2014), once for
    the number and once with ``draw`` >= 0 added, which tells further numbers apart.
    """
    bits = _scrambled(np.ascontiguousarray(u, np.float64).view(np.uint64))
    bits = _scrambled(bits + np.asarray(draw).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))
    return ((bits >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def _scrambled(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(bits ^ (bits >> np.uint64(31)))


def binomial_upper(u: FloatArray, n: IntArray, p: FloatArray | float) -> IntArray:
    """Return binomial numbers of which the smallest ``u`` give the largest: N >= j where u < P(N >= j).

    Of n trials, with uniform numbers u, (m,) each, and a probability p below 1, (m,) or one for all.
    """
    p = np.broadcast_to(np.asarray(p, np.float64), u.shape)
    exponent = n * np.log1p(-p)
    count = np.zeros(u.size, np.int64)
    active = np.flatnonzero(exponent > LEAST_EXPONENT)
    mass, above = np.exp(exponent[active]), -np.expm1(exponent[active])
    odds = p / (1.0 - p)
    j = 0
    while active.size:
        more = (u[active] < above) & (n[active] > j)
        active, mass, above = active[more], mass[more], above[more]
        j += 1
        count[active] = j
        mass = mass * (n[active] - j + 1) / j * odds[active]
        above = above - mass
    # where the mass at zero underflows the recursion has no start
    many = np.flatnonzero(exponent <= LEAST_EXPONENT)
    if many.size:
        from scipy.stats import binom

        count[many] = binom.isf(u[many], n[many], p[many])
    return count


def numbered(count: IntArray) -> tuple[IntArray, IntArray]:
    """Return, for things of which entry i has ``count[i]``, their entries and numbers 0, 1, ... in it."""
    owner = np.repeat(np.arange(count.size), count)
    return owner, np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)


def regrouped(
    electrons: IntArray,
    u: FloatArray,
    bound: FloatArray | float,
    law: Callable[[IntArray], tuple[Any, Any]],
    extra: Callable[[FloatArray, IntArray], IntArray],
) -> IntArray:
    """Return electron numbers of which some electrons are left out and some have become clusters.

    Thinned Poisson numbers are Poisson, and Poisson many independent clusters are a compound Poisson number
    (Feller 1968, vol. I, XII.2), so every law of that kind is reached from the Poisson electrons, exactly, by
    few changes.

    Args:
        electrons: Poisson numbers, e-, any shape.
        u: a uniform number for each.
        bound: upper limit of both probabilities of ``law``, broadcasts against ``electrons``.
        law: from flat indices of samples to the probabilities, per electron, to be left out and, of the rest,
            to become a cluster.
        extra: from uniform numbers and flat indices to the electrons of a cluster beyond one, >= 1.
    """
    result = np.array(electrons)
    flat, numbers = result.reshape(-1), u.reshape(-1)
    # the lost come from the lower end of u, the clusters from the upper one
    index = np.flatnonzero((0.5 - np.abs(u - 0.5) < electrons * bound).reshape(-1))
    n, v = flat[index], numbers[index]
    drop, grow = (np.broadcast_to(np.asarray(p, np.float64), v.shape) for p in law(index))
    lost = binomial_upper(v, n, drop)
    # where nothing is lost the rest of the number is uniform again
    with np.errstate(divide="ignore"):  # many electrons are all kept with a chance of 0: some are lost
        rest = np.minimum((1.0 - v) / np.exp(n * np.log1p(-drop)), 1.0)
    more = binomial_upper(np.where(lost > 0, further_uniform(v, 0), rest), n - lost, grow)
    owner, number = numbered(more)
    more = extra(further_uniform(v[owner], 1 + number), index[owner])
    added = np.bincount(owner, weights=more, minlength=index.size).astype(np.int64)
    flat[index] = n - lost + added
    return result


def sent_to_neighbours(
    electrons: IntArray, u: FloatArray, probability: float
) -> tuple[tuple[IntArray, ...], tuple[IntArray, ...]]:
    """Choose electrons with a probability each, and for each of them one of the four neighbours.

    Of electron numbers (frame, y, x), e-, with a uniform number ``u`` for each. Returns indices (frame, y, x)
    of the pixels where the chosen ones are, and of the neighbours, which may lie outside the array.
    """
    index = np.flatnonzero((u < electrons * probability).reshape(-1))
    v = u.reshape(-1)[index]
    count = binomial_upper(v, electrons.reshape(-1)[index], probability)
    owner, number = numbered(count)
    direction = (4.0 * further_uniform(v[owner], number)).astype(np.int64)
    frame, y, x = np.unravel_index(index[owner], electrons.shape)
    step = _STEPS[direction]
    return (frame, y, x), (frame, y + step[:, 0], x + step[:, 1])


# frames apart by that many correlation times are independent but for 1e-7
_FAR = 16.0
_BITS = 29
_FRAMES = (1 << _BITS) - 1
#: Draws that are no frame's, for what a pixel has throughout the run.
OF_PIXEL = (0xFFFFFFFE, 0xFFFFFFFF, 0xFFFFFFFD, 0xFFFFFFFC)


def frame_key(frame: int, process: int = 0) -> int:
    """Return the number of the draw that belongs to a frame, also to one before the run or beside the block.

    ``process`` tells up to 7 independent processes of one effect apart (0 to 6).
    """
    return frame & _FRAMES | process << _BITS


def between_grid_points(
    frames: IntArray,
    longest: float,
    independent: Callable[[int], AnyArray],
    midpoint: Callable[[int, AnyArray, AnyArray, int], AnyArray],
) -> list[AnyArray]:
    """Return the states of a stationary Markov process at frames, (n,), n >= 1, in order.

    States much farther apart than the ``longest`` correlation time, frames, are ``independent``, drawn from
    the stationary law; ``midpoint`` gives that at (frame, state h frames before, state h frames after, h).
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
    """Return a Markov chain of two states for each of n traps, 1: full, 0: empty; shape (frame, n).

    States h frames apart are correlated by exp(-h / tau); tau, the ``correlation_frames`` > 0, and the
    probability that a trap is ``occupied`` are of all or of each, (n,). ``uniform`` gives the uniform numbers
    of a frame, (n,); ``longest`` is about the largest tau of any trap, whichever are asked for here.
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
