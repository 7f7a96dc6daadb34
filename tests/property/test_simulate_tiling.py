"""The same frames at every division into blocks of frames and bands of rows."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.effects.operators.couple import AnalogMemory, InterpixelCapacitance
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

SHAPE = (7, 5)
N_FRAMES = 12


MEMORY = {"tag": "analog_memory", "memory": 0.3}  # of the frame before
LEAK = {"tag": "interpixel_capacitance", "coupling": 0.1}  # of the rows above and below


def make(*effects):
    return SimulateSettings(shape=SHAPE, n_frames=N_FRAMES, seed=8, effects=effects)


# what the frame before and the rows beside lend is of frames and rows that have borrowed themselves
SENSOR = make(
    {"tag": "dark_current_rts", "fraction": 0.5, "step_e": 2.0, "dwell_low_frames": 3.0},  # Markov chains
    {"tag": "cosmic_rays", "tracks_per_frame": 1.0},  # an unknown number of draws per frame
    {"tag": "charge_lag", "fraction": 0.3},
    {"tag": "charge_diffusion", "fraction": 0.3},
    MEMORY,
    LEAK,
)
TRUTH = draw_truth(SENSOR)
WHOLE = simulate_block(TRUTH, SENSOR, (0, N_FRAMES))


def cuts(n):
    return st.sets(st.integers(1, n - 1)).map(lambda inner: [0, *sorted(inner), n])


@settings(max_examples=40, deadline=None)
@given(frames=cuts(N_FRAMES), rows=cuts(SHAPE[0]))
def test_any_division_gives_the_same_frames(frames, rows):
    dn, electrons = (np.zeros_like(array) for array in WHOLE)
    for t, y in itertools.product(itertools.pairwise(frames), itertools.pairwise(rows)):
        place = slice(*t), slice(*y)
        dn[place], electrons[place] = simulate_block(TRUTH, SENSOR, t, y)
    np.testing.assert_array_equal(dn, WHOLE[0])
    np.testing.assert_array_equal(electrons, WHOLE[1])


def test_threads_give_the_same_frames():
    blocks = [(t, t + 1) for t in range(N_FRAMES)]
    with ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(lambda block: simulate_block(TRUTH, SENSOR, block)[0], blocks))
    np.testing.assert_array_equal(np.concatenate(parts), WHOLE[0])


def test_forgetting_halo_or_history_would_be_noticed(monkeypatch):
    monkeypatch.setattr(InterpixelCapacitance, "halo", lambda self: 0)
    monkeypatch.setattr(AnalogMemory, "history", lambda self: 0)
    for effect, frames, rows in ((LEAK, (0, N_FRAMES), (2, 4)), (MEMORY, (5, 9), (0, SHAPE[0]))):
        sensor = make(effect)
        truth = draw_truth(sensor)
        whole = simulate_block(truth, sensor, (0, N_FRAMES))[0]
        part = simulate_block(truth, sensor, frames, rows)[0]
        assert (part != whole[slice(*frames), slice(*rows)]).any()
