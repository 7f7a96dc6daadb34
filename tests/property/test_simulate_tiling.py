"""The same frames at every division into blocks of frames and bands of rows."""

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Literal

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.simulate import chain
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

SHAPE = (7, 5)
N_FRAMES = 12


class Tracks(Effect):
    """Charge along a random row of each frame: an unknown number of draws per frame."""

    tag: Literal["tracks"] = "tracks"
    plane: ClassVar[Plane] = Plane.CHARGE

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        result = values.copy()
        for i, frame in enumerate(context.frames):
            rng = context.random.generator(frame=int(frame))
            for y in rng.integers(context.shape[0], size=rng.poisson(1.0)):
                result[i, context.rows == y] += int(rng.integers(20, 40))
        return result


class Leak(Effect):
    """Part of the charge of the row above and below, deterministic."""

    tag: Literal["leak"] = "leak"
    plane: ClassVar[Plane] = Plane.ANALOG
    reach: int = 1

    def halo(self) -> int:
        return self.reach

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        padded = np.pad(context.charge, ((0, 0), (1, 1), (0, 0)), mode="edge")
        return values + 0.2 * (padded[:, 2:] + padded[:, :-2] - 2 * context.charge)


class Memory(Effect):
    """Part of the signal of the frame before."""

    tag: Literal["memory"] = "memory"
    plane: ClassVar[Plane] = Plane.ANALOG
    frames: int = 1

    def history(self) -> int:
        return self.frames

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        result = values.copy()
        result[1:] += 0.3 * values[:-1]
        return result


class Trap(Effect):
    """A two-level Markov chain in some pixels, replayed from frame 0 by its dwell times."""

    tag: Literal["trap"] = "trap"
    plane: ClassVar[Plane] = Plane.ANALOG

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        result = values.copy()
        for j, x in np.argwhere(context.random.uniform(("y", "x"))[0] < 0.5):
            rng = context.random.generator(y=int(context.rows[j]), x=int(x))
            switches = np.cumsum(rng.geometric(0.4, size=3 * N_FRAMES))
            result[:, j, x] += np.searchsorted(switches, context.frames, side="right") % 2
        return result


def make(*effects: Effect | dict[str, Any]) -> SimulateSettings:
    return SimulateSettings(shape=SHAPE, n_frames=N_FRAMES, seed=8, effects=effects)


SENSORS = {
    "plain": make(),
    "shipped": make(
        {"tag": "exposure_drift", "drift": 0.5},
        {"tag": "row_noise", "row_noise_dn": 3.0},
        {"tag": "clipping", "low": 90, "high": 160},
    ),
    "every kind of state": make(Memory(), Tracks(), Leak(), Trap(), Leak(), Memory()),
}
TRUTH = {name: draw_truth(sensor) for name, sensor in SENSORS.items()}
WHOLE = {name: simulate_block(TRUTH[name], sensor, (0, N_FRAMES)) for name, sensor in SENSORS.items()}


def cuts(n: int) -> st.SearchStrategy[list[int]]:
    return st.sets(st.integers(1, n - 1)).map(lambda inner: [0, *sorted(inner), n])


@settings(max_examples=40, deadline=None)
@given(name=st.sampled_from(list(SENSORS)), frames=cuts(N_FRAMES), rows=cuts(SHAPE[0]))
def test_any_division_gives_the_same_frames(name, frames, rows):
    dn, electrons = (np.zeros_like(array) for array in WHOLE[name])
    for t0, t1 in itertools.pairwise(frames):
        for y0, y1 in itertools.pairwise(rows):
            dn[t0:t1, y0:y1], electrons[t0:t1, y0:y1] = simulate_block(
                TRUTH[name], SENSORS[name], (t0, t1), (y0, y1)
            )
    np.testing.assert_array_equal(dn, WHOLE[name][0])
    np.testing.assert_array_equal(electrons, WHOLE[name][1])


def test_threads_give_the_same_frames():
    name = "every kind of state"
    blocks = [(t, t + 1) for t in range(N_FRAMES)]
    with ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(lambda block: simulate_block(TRUTH[name], SENSORS[name], block)[0], blocks))
    np.testing.assert_array_equal(np.concatenate(parts), WHOLE[name][0])


def test_the_size_of_the_planes_held_at_once_does_not_matter(monkeypatch):
    for name, sensor in SENSORS.items():
        for samples in (1, 3 * SHAPE[0] * SHAPE[1]):
            monkeypatch.setattr(chain, "_SAMPLES_AT_ONCE", samples)
            dn, electrons = simulate_block(TRUTH[name], sensor, (0, N_FRAMES))
            np.testing.assert_array_equal(dn, WHOLE[name][0])
            np.testing.assert_array_equal(electrons, WHOLE[name][1])


def test_forgetting_halo_or_history_would_be_noticed():
    for wrong, (frames, rows) in {
        Leak(reach=0): ((0, N_FRAMES), (2, 4)),
        Memory(frames=0): ((5, 9), (0, SHAPE[0])),
    }.items():
        sensor = make(wrong)
        truth = draw_truth(sensor)
        whole = simulate_block(truth, sensor, (0, N_FRAMES))[0]
        part = simulate_block(truth, sensor, frames, rows)[0]
        assert (part != whole[slice(*frames), slice(*rows)]).any()
