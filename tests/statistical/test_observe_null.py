"""Every statistic is about N(0, 1) for stacks without any effect."""

import numpy as np
import pytest
from helpers.small_stacks import small_stack

from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe

N_STACKS, SHAPE, N_FRAMES, BLOCK = 45, (24, 24), 600, 50
LIMIT = 5.0 / np.sqrt(N_STACKS)
#: Statistics of events that all but never happen without an effect: always 0.
SILENT = (
    "frame.repeated", "frame.repeated_rows", "tail.high.clusters", "space.repeated.rows",
    "space.repeated.columns",
)  # fmt: skip
#: The fit of four parameters to so few frames takes a little more variance from the scores, and samples from
#: the tails, than first-order theory says; counts of few pixels, or of lines likelier elsewhere, are coarse.
BIAS = {"shape": 0.6, "tail": 0.6, "code": 0.3}
SMALLEST_STD = {True: 0.2, False: 0.7}
COARSE = ("cnt", "pixels", "count", "misplaced.rows", "misplaced.columns")


@pytest.fixture(scope="module")
def vectors():
    # blocks as they are dealt to a third of a run
    numbers = np.flatnonzero(np.arange(3 * N_FRAMES) // BLOCK % 3 == 0)
    stacks = (small_stack(SHAPE, N_FRAMES, 1000 + seed) for seed in range(N_STACKS))
    found = [observe(frames, numbers, n_run=3 * N_FRAMES, block_frames=BLOCK).z for frames in stacks]
    return {name: np.array([z[name] for z in found]) for name in STATISTICS}


@pytest.mark.parametrize("name", [name for name in STATISTICS if name not in SILENT])
def test_a_statistic_is_standard_normal_without_effects(name, vectors):
    z = vectors[name]
    assert abs(z.mean()) < BIAS.get(STATISTICS[name].family, 0.0) + LIMIT * max(z.std(), 1.0)
    assert SMALLEST_STD[name.endswith(COARSE)] < z.std(ddof=1) < 1.4, z.std()
    assert np.abs(z).max() < 5.0


@pytest.mark.parametrize("name", SILENT)
def test_impossible_events_do_not_happen(name, vectors):
    assert np.abs(vectors[name]).max() < 0.01
