"""Small sensors with effects: frames, electron numbers, evidence, and the surroundings of an effect."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.streams import KeyedStreams
from pchem_pipeline.simulate.truth import TruthMaps

BLOCK = 50


def make(tag: str, **fields: Any) -> Effect:
    """Return an effect by its tag."""
    return effect_class(tag).model_validate({"tag": tag, **fields})


def drawn_truth(shape, seed=5, *, exposure=(0.5, 3.0), noise_e=(0.2, 0.3), step=(8.0, 16.0)) -> TruthMaps:
    """Return maps of a sensor drawn evenly from ranges; bias 100..104 DN."""
    rng = np.random.default_rng(seed)
    gain = 1.0 / rng.uniform(*step, shape)
    return TruthMaps(
        quanta_exposure=rng.uniform(*exposure, shape),
        conversion_gain=gain,
        bias=rng.uniform(100.0, 104.0, shape),
        analog_read_noise_e=rng.uniform(*noise_e, shape),
        defect=np.zeros(shape, np.uint8),
    )


def a_sensor(shape=(24, 24), exposure=(0.5, 4.0)) -> TruthMaps:
    """Return maps of a sensor with more light and read noise."""
    return drawn_truth(shape, exposure=exposure, noise_e=(0.2, 0.35), step=(8.0, 14.0))


def a_uniform_sensor(shape, exposure, gain, bias, noise) -> TruthMaps:
    """Return maps of a sensor of pixels that are all alike: e-, e-/DN, DN and read noise, e-."""
    values = (np.full(shape, value) for value in (exposure, gain, bias, noise))
    return TruthMaps(*values, defect=np.zeros(shape, np.uint8))


def simulated(truth, *effects, n_frames, seed=1, frames=None, rows=None, of_run=None, bit_depth=14, **more):
    """Return frames (frame, y, x), DN, and electron numbers of a sensor with effects."""
    settings = SimulateSettings(
        shape=truth.shape, n_frames=of_run or n_frames, seed=seed, effects=effects, bit_depth=bit_depth
    )
    return simulate_block(truth, settings, frames or (0, n_frames), rows, **more)


def taken(truth: TruthMaps, *effects: Effect, n_frames: int, seed: int = 1) -> NDArray[np.uint16]:
    """Return the frames alone."""
    return simulated(truth, *effects, n_frames=n_frames, seed=seed, electron_frames=0)[0]


def electrons(exposure, shape, n_frames, *effects, seed=1):
    """Return electron numbers (frame, y, x) of a sensor with one exposure, as int64."""
    truth = a_sensor(shape, exposure=(exposure, exposure))
    return simulated(truth, *effects, n_frames=n_frames, seed=seed)[1].astype(np.int64)


def some_blocks(n_frames: int, every: int = 3) -> NDArray[np.int64]:
    """Return the frame numbers of every n-th block."""
    return np.flatnonzero(np.arange(n_frames) // BLOCK % every == 0)


def seen(frames: NDArray[np.uint16], numbers: NDArray[np.int64] | None = None) -> Evidence:
    """Return the evidence of the numbered frames (all of them by default)."""
    numbers = np.arange(len(frames)) if numbers is None else numbers
    return observe(frames[numbers], numbers, n_run=len(frames), block_frames=BLOCK)


def context_of(shape=(6, 5), n_frames=14, *, frames=None, gain=0.1, seed=3, rows=None) -> EffectContext:
    """Return the surroundings of an effect: a sensor of equal pixels, all frames and rows by default."""
    frames = np.arange(n_frames) if frames is None else np.asarray(frames)
    rows = np.arange(shape[0]) if rows is None else rows
    return EffectContext(
        frames=frames,
        n_frames=n_frames,
        rows=rows,
        shape=shape,
        integration_time=1.0,
        bit_depth=14,
        truth={"conversion_gain": np.full((len(rows), shape[1]), gain)},
        random=KeyedStreams(seed, "test", frames, rows, np.arange(shape[1])),
    )


def offsets(effect: Effect, context: EffectContext) -> Any:
    """Return what an effect on the analog plane adds, DN, to a signal of zero."""
    zero = np.zeros((context.frames.size, context.rows.size, context.shape[1]))
    return effect.apply(zero, context) / context.truth["conversion_gain"]


def exposures(effect: Effect, exposure: NDArray[np.float64], n_frames: int) -> Any:
    """Return what an effect makes of an exposure (y, x) in each frame, e-."""
    every = np.broadcast_to(exposure, (n_frames, *exposure.shape)).copy()
    return effect.apply(every, context_of(exposure.shape, n_frames, seed=1))
