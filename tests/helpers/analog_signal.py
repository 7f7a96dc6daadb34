"""The analog signal of a block of frames, with and without an effect, by numpy."""

from dataclasses import replace

import numpy as np
from helpers.small_sensors import context_of

from pchem_pipeline.effects.framework.effect import Effect


def analog(effect: Effect, shape=(500, 20, 30), *, charge=None, first=0, n_run=None, noise=0.3, seed=1):
    """Return the signal with the effect, that without, and its parts K and R, all (frame, y, x)."""
    rng = np.random.default_rng(seed)
    k = rng.poisson(1.5, shape) if charge is None else np.broadcast_to(charge, shape)
    r = noise * rng.standard_normal(shape)
    frames = np.arange(first, first + shape[0])
    context = context_of(shape[1:], n_run or shape[0], frames=frames, seed=seed)
    truth = {"analog_read_noise_e": np.full(shape[1:], noise)}
    return effect.apply(k + r, replace(context, truth=truth, charge=k, read_noise=r)), k + r, k, r


def within(seen, expected, stderr, widths: float = 5.0) -> None:
    """Assert that a number is within so many standard errors of another."""
    assert abs(seen - expected) <= widths * stderr, (seen, expected, stderr)
