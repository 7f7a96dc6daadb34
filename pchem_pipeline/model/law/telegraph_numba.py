"""Likelihood and states of a series that is switched by a hidden Markov process, see :mod:`.telegraph`."""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel

_SMALL = 1e-200  # a probability below this is taken to its logarithm


@kernel
def filtered(
    emission: FloatArray,
    samples: IntArray,
    start: FloatArray,
    moves: FloatArray,
    gaps: IntArray,
    state: FloatArray,
) -> float:
    """Return the log-likelihood of a series (the forward recursion, Baum et al. 1970), nats.

    Args:
        emission: probability of each sample in each of s states, shape (samples, s).
        samples: row of ``emission`` of each frame, shape (n,).
        start: probabilities of the states before the first frame, shape (s,).
        moves: from the states before a gap (rows) to those after it, of each kind of gap, shape (g, s, s).
        gaps: kind of the gap before each frame, shape (n,); the first does not count.
        state: filled with the probabilities of the states given all frames (the backward recursion), shape
            (n, s); with no rows it is not.
    """
    n_states, n = start.size, samples.size
    now, ahead = start.copy(), np.empty(n_states)
    total = 0.0
    for i in range(n):
        mass = 0.0
        for s in range(n_states):
            ahead[s] = now[s] if i == 0 else 0.0
            for before in range(n_states if i else 0):
                ahead[s] += now[before] * moves[gaps[i], before, s]
            ahead[s] *= emission[samples[i], s]
            mass += ahead[s]
        scale = mass if mass < _SMALL or i == n - 1 else 1.0
        total += math.log(scale)
        for s in range(n_states):
            now[s] = ahead[s] / scale
            if state.shape[0] > 0:
                state[i, s] = now[s]
    now[:] = 1.0
    for i in range(state.shape[0] - 2, -1, -1):
        mass = largest = 0.0
        for s in range(n_states):
            ahead[s] = 0.0
            for after in range(n_states):
                ahead[s] += moves[gaps[i + 1], s, after] * emission[samples[i + 1], after] * now[after]
            mass += state[i, s] * ahead[s]
            largest = max(largest, ahead[s])
        for s in range(n_states):
            state[i, s] *= ahead[s] / mass
            now[s] = ahead[s] / largest
    return total
