"""Samples that are nearer to the one before are told from chance, whatever the law of the pixels."""

import numpy as np

from pchem_pipeline.discrepancy.observe.digital import nearer_statistics
from pchem_pipeline.effects.framework.evidence import PixelMaps

SHAPE, FRAMES = (12, 12), 400
EDGES = np.arange(0, FRAMES + 1, 50)


def drawn(seed, exposure, noise, step):
    """Return frames of pixels of equal law, and their maps."""
    rng = np.random.default_rng(seed)
    signal = rng.poisson(exposure, (FRAMES, *SHAPE)) + noise * rng.standard_normal((FRAMES, *SHAPE))
    return np.floor(100.5 + step * signal).astype(np.uint16)


def maps_of(exposure, noise, step):
    columns = (np.full(SHAPE, v) for v in (exposure, 1 / step, 100.0, noise * step))
    return PixelMaps.known(columns, np.ones(SHAPE, bool))


def test_samples_averaged_with_those_before_them_are_nearer():
    law = 2.0, 0.3, 11.0
    frames = drawn(1, *law)
    chosen = np.random.default_rng(2).random(frames[1:].shape) < 0.4
    alike = abs(frames[1:].astype(int) - frames[:-1]) < 5
    frames[1:][chosen & alike] = ((frames[1:] + frames[:-1]) // 2)[chosen & alike]
    assert nearer_statistics(frames, EDGES, maps_of(*law))["time.nearer"] > 8.0


def test_frames_too_few_or_samples_that_always_agree_give_none():
    maps = maps_of(1.0, 0.3, 10.0)
    assert nearer_statistics(drawn(1, 1.0, 0.3, 10.0)[:5], np.array([0, 5]), maps) == {}
    assert nearer_statistics(np.full((FRAMES, *SHAPE), 7, np.uint16), EDGES, maps) == {}
