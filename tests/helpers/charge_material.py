"""Sensors, frames, electron numbers and evidence for the tests of the effects on light and charge."""

import numpy as np

from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.streams import KeyedStreams
from pchem_pipeline.simulate.truth import TruthMaps

BLOCK = 50


def a_sensor(shape=(24, 24), seed=5, exposure=(0.5, 4.0)):
    """Return maps of a sensor drawn evenly from ranges."""
    rng = np.random.default_rng(seed)
    return TruthMaps(
        quanta_exposure=rng.uniform(*exposure, shape),
        conversion_gain=1.0 / rng.uniform(8.0, 14.0, shape),
        bias=rng.uniform(100.0, 104.0, shape),
        analog_read_noise_e=rng.uniform(0.2, 0.35, shape),
        defect=np.zeros(shape, np.uint8),
    )


def a_uniform_sensor(shape, exposure, gain, bias, noise):
    """Return maps of a sensor of pixels that are all alike: e-, e-/DN, DN and read noise, e-."""
    values = (np.full(shape, value) for value in (exposure, gain, bias, noise))
    return TruthMaps(*values, defect=np.zeros(shape, np.uint8))


def simulated(truth, *effects, n_frames, seed=1, frames=None, rows=None, of_run=None, bit_depth=14):
    """Return frames (frame, y, x), DN, and electron numbers of a sensor with effects."""
    settings = SimulateSettings(
        shape=truth.shape, n_frames=of_run or n_frames, seed=seed, effects=effects, bit_depth=bit_depth
    )
    return simulate_block(truth, settings, frames or (0, n_frames), rows)


def electrons(exposure, shape, n_frames, *effects, seed=1):
    """Return electron numbers (frame, y, x) of a sensor with one exposure, as int64."""
    truth = a_sensor(shape, exposure=(exposure, exposure))
    return simulated(truth, *effects, n_frames=n_frames, seed=seed)[1].astype(np.int64)


def exposures(effect, exposure, n_frames, seed=1, frames=None):
    """Return what an effect makes of an exposure (y, x) in each frame, e-."""
    frames = np.arange(n_frames) if frames is None else frames
    ny, nx = exposure.shape
    random = KeyedStreams(seed, effect.tag, frames, np.arange(ny), np.arange(nx))
    context = EffectContext(
        frames=frames,
        n_frames=n_frames,
        rows=np.arange(ny),
        shape=(ny, nx),
        integration_time=1.0,
        bit_depth=12,
        truth={},
        random=random,
    )
    return effect.apply(np.array(np.broadcast_to(exposure, (frames.size, ny, nx))), context)


def evidence_of(truth, *effects, n_frames=2000, seed=1, every=1):
    """Return the evidence of every n-th block of the frames of a sensor with effects."""
    frames = simulated(truth, *effects, n_frames=n_frames, seed=seed)[0]
    numbers = np.flatnonzero(np.arange(n_frames) // BLOCK % every == 0)
    return observe(frames[numbers], numbers, n_run=n_frames, block_frames=BLOCK)
