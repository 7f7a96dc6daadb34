"""Likelihood of a series whose exposure is switched by independent two-state Markov processes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

_SMALL = 1e-200  # a probability below this is taken to its logarithm


@kernel
def _forward(state: NDArray[np.float64], share: NDArray[np.float64], kept: NDArray[np.float64]) -> None:
    """Let the probabilities of the states pass over a gap.

    Bit d of a state's number says whether process d is up. Its transitions are ``kept identity + (1 - kept)
    stationary``, with the correlation over the gap.
    """
    for d in range(share.size):
        bit = 1 << d
        for low in range(state.size):
            if not low & bit:
                down, up = state[low], state[low | bit]
                lost = (1.0 - kept[d]) * (down + up)
                state[low] = kept[d] * down + (1.0 - share[d]) * lost
                state[low | bit] = kept[d] * up + share[d] * lost


@kernel
def _backward(state: NDArray[np.float64], share: NDArray[np.float64], kept: NDArray[np.float64]) -> None:
    """Turn what follows after a gap, given the states after it, into what does given those before it."""
    for d in range(share.size):
        bit = 1 << d
        for low in range(state.size):
            if not low & bit:
                down, up = state[low], state[low | bit]
                mean = (1.0 - kept[d]) * ((1.0 - share[d]) * down + share[d] * up)
                state[low] = kept[d] * down + mean
                state[low | bit] = kept[d] * up + mean


@kernel
def _kept_over(gap: int, tau: NDArray[np.float64], kept: NDArray[np.float64]) -> None:
    for d in range(tau.size):
        kept[d] = math.exp(-gap / tau[d])


@kernel
def filtered(
    emission: NDArray[np.float64],
    samples: NDArray[np.int64],
    gaps: NDArray[np.int64],
    share: NDArray[np.float64],
    tau: NDArray[np.float64],
    state: NDArray[np.float64],
) -> float:
    """Return the log-likelihood of a series (the forward recursion), nats.

    Args:
        emission: probability of each sample in each state, shape (s, states); states are 2 to the number of
            processes.
        samples: row of ``emission`` of each frame, shape (n,).
        gaps: frames from the one before to this one, shape (n,); the first does not count.
        share: of the time that each process is up, shape (d,).
        tau: its correlation time, frames, shape (d,).
        state: filled with the probabilities of the states given the frames up to each one, but for a factor,
            shape (n, states); with fewer than two rows it is not.
    """
    n_states = emission.shape[1]
    now, kept = np.ones(n_states), np.empty(tau.size)
    for s in range(n_states):
        for d in range(share.size):
            now[s] *= share[d] if s & (1 << d) else 1.0 - share[d]
    total, last = 0.0, -1
    for i in range(samples.size):
        if i:
            if gaps[i] != last:
                last = gaps[i]
                _kept_over(last, tau, kept)
            _forward(now, share, kept)
        mass = 0.0
        for s in range(n_states):
            now[s] *= emission[samples[i], s]
            mass += now[s]
        if mass < _SMALL or i == samples.size - 1:
            total += math.log(mass)
            for s in range(n_states):
                now[s] /= mass
        if state.shape[0] > 1:
            for s in range(n_states):
                state[i, s] = now[s]
    return total


@kernel
def smooth(
    emission: NDArray[np.float64],
    samples: NDArray[np.int64],
    gaps: NDArray[np.int64],
    share: NDArray[np.float64],
    tau: NDArray[np.float64],
    state: NDArray[np.float64],
) -> None:
    """Turn what :func:`filtered` left in ``state`` (n, states) into probabilities given all frames."""
    n, n_states = state.shape
    after, kept = np.ones(n_states), np.empty(tau.size)
    last = -1
    for i in range(n - 2, -1, -1):
        for s in range(n_states):
            after[s] *= emission[samples[i + 1], s]
        if gaps[i + 1] != last:
            last = gaps[i + 1]
            _kept_over(last, tau, kept)
        _backward(after, share, kept)
        mass = scale = 0.0
        for s in range(n_states):
            mass += state[i, s] * after[s]
            scale = max(scale, after[s])
        for s in range(n_states):
            state[i, s] *= after[s] / mass
            after[s] /= scale
