"""The analog signal of a block of frames, with and without an effect, by numpy."""

from types import MappingProxyType

import numpy as np

from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.simulate.streams import KeyedStreams


def analog(effect: Effect, shape=(500, 20, 30), *, charge=None, first=0, n_run=None, noise=0.3, seed=1):
    """Return the signal with the effect, that without, and its parts K and R, all (frame, y, x)."""
    rng = np.random.default_rng(seed)
    k = rng.poisson(1.5, shape) if charge is None else np.broadcast_to(charge, shape)
    r = noise * rng.standard_normal(shape)
    frames, rows = np.arange(first, first + shape[0]), np.arange(shape[1])
    context = EffectContext(
        frames=frames,
        n_frames=n_run or shape[0],
        rows=rows,
        shape=shape[1:],
        integration_time=1.0,
        bit_depth=12,
        truth=MappingProxyType({"analog_read_noise_e": np.full(shape[1:], noise)}),
        random=KeyedStreams(seed, effect.tag, frames, rows, np.arange(shape[2])),
        charge=k,
        read_noise=r,
    )
    return effect.apply(k + r, context), k + r, k, r


def within(seen, expected, stderr, widths: float = 5.0) -> None:
    """Assert that a number is within so many standard errors of another."""
    assert abs(seen - expected) <= widths * stderr, (seen, expected, stderr)
