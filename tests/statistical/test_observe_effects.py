"""Effects move the statistics that are named after them, in the direction that the names say."""

from typing import Any

import numpy as np
import pytest
from helpers.small_stacks import small_stack

from pchem_pipeline.discrepancy.observe.observe import observe

SHAPE, N_FRAMES, BLOCK, SEED = (32, 32), 1600, 50, 17
NUMBERS = np.arange(N_FRAMES)


def _seen(frames):
    return observe(frames, NUMBERS, n_run=N_FRAMES, block_frames=BLOCK).z


@pytest.fixture(scope="module")
def frames():
    return small_stack(SHAPE, N_FRAMES, SEED)


@pytest.fixture(scope="module")
def plain(frames):
    return _seen(frames)


CASES: list[tuple[dict[str, Any], dict[str, float]]] = [
    ({"tag": "row_noise", "row_noise_dn": 0.3}, {"space.row.readout.variance": 4}),
    ({"tag": "exposure_drift", "drift": 0.02}, {"frame.charge.trend": 4, "frame.charge.slow": 4}),
    ({"tag": "exposure_drift", "drift": -0.02}, {"frame.charge.trend": -4}),
    ({"tag": "clipping", "high": 150}, {"code.top": 4}),
    ({"tag": "clipping", "low": 92}, {"code.bottom": 4}),
]


@pytest.mark.parametrize(("effect", "moved"), CASES, ids=lambda case: "-".join(map(str, case.values())))
def test_an_effect_moves_its_statistics(effect, moved, plain):
    z = _seen(small_stack(SHAPE, N_FRAMES, SEED, [effect]))
    for name, least in moved.items():
        difference = z[name] - plain[name]
        assert difference * np.sign(least) > abs(least), (name, difference)
    # nothing else moves more
    largest = max(z, key=lambda name: abs(z[name] - plain[name]))
    assert largest in moved or "clip" in effect["tag"], largest


def test_changes_of_the_codes_move_theirs(frames, plain):
    rng = np.random.default_rng(3)
    # some even frames one DN higher
    shifted = frames.copy()
    shifted[::20] += 1
    z = _seen(shifted)
    assert z["frame.readout.alternating"] - plain["frame.readout.alternating"] > 4
    assert z["frame.readout.variance"] - plain["frame.readout.variance"] > 4
    # some odd codes become even
    odd = frames - ((frames % 2 == 1) & (rng.random(frames.shape) < 0.02)).astype(np.uint16)
    assert _seen(odd)["code.alternating"] - plain["code.alternating"] > 10
    # a quadrant that jumps half-way
    jumped = frames.copy()
    jumped[N_FRAMES // 2 :, :16, 16:] += rng.random((N_FRAMES // 2, 16, 16)) < 0.2
    z = _seen(jumped)
    assert z["frame.readout.quadrants"] - plain["frame.readout.quadrants"] > 4
    # a frame and a row twice
    twice = frames.copy()
    twice[101] = twice[100]
    twice[301, 5] = twice[300, 5]
    z = _seen(twice)
    assert (z["frame.repeated"], z["frame.repeated_rows"]) == (10, 10)


def test_a_share_of_the_neighbour_moves_the_pairs(frames, plain):
    rng = np.random.default_rng(4)
    # 1 % of the right neighbour's signal, as whole DN at random
    share = 0.01 * (frames[:, :, 1:].astype(float) - frames[:, :, 1:].mean(axis=0))
    mixed = frames.astype(np.int64)
    mixed[:, :, :-1] += np.floor(share + rng.random(share.shape)).astype(np.int64)
    z = _seen(mixed.astype(np.uint16))
    assert z["space.x.rk"] - plain["space.x.rk"] > 4
    assert abs(z["space.y.rk"] - plain["space.y.rk"]) < 2
    # 1 % of the frame before
    late = frames.astype(np.int64)
    share = 0.01 * (frames[:-1].astype(float) - frames.mean(axis=0))
    late[1:] += np.floor(share + rng.random(share.shape)).astype(np.int64)
    z = _seen(late.astype(np.uint16))
    assert z["time.cross.readout_charge"] - plain["time.cross.readout_charge"] > 4
