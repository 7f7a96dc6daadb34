"""Samples that follow others: forward models, laws, and what estimators make of independent cameras."""

import numpy as np
import pytest
from helpers.analog_signal import analog, within
from helpers.small_sensors import context_of, drawn_truth, seen, taken
from hidden.chain import hide

from pchem_pipeline.discrepancy.observe.digital import BITS
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.couple import (
    AnalogMemory,
    BinaryOffset,
    BlackClamp,
    InterpixelCapacitance,
)
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_capacitance_moves_charge_without_losing_any():
    charge = np.zeros((3, 4, 5), int)
    charge[0, 1, 2] = charge[1, 0, 0] = 10
    after, _, _, r = analog(InterpixelCapacitance(coupling=0.02, anisotropy=0.5), charge.shape, charge=charge)
    seen = after - r
    around = [[0.0, 0.1, 0.0], [0.3, 9.2, 0.3], [0.0, 0.1, 0.0]]
    np.testing.assert_allclose(seen[0, :3, 1:4], around, atol=1e-12)
    assert seen[1, 0, 0] == pytest.approx(9.6)  # a corner has two neighbours
    np.testing.assert_allclose(seen.sum(axis=(1, 2)), charge.sum(axis=(1, 2)), atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "left"),
    [
        (AnalogMemory(memory=-0.1), lambda k: -0.1 * k),
        (AnalogMemory(memory=0.1, saturation_e=5.0), lambda k: 0.5 * (1 - np.exp(-k / 5))),
    ],
    ids=["linear", "levels off"],
)
def test_memory_is_of_the_frame_before(effect, left):
    after, before, k, _ = analog(effect, (6, 3, 4), charge=np.arange(6)[:, None, None] ** 3)
    np.testing.assert_allclose(after[1:] - before[1:], left(k[:-1]), atol=1e-12)


def test_memory_may_differ_from_pixel_to_pixel():
    effect = AnalogMemory(memory=0.1, spread=0.5)
    after, before, _, _ = analog(effect, (8, 60, 60), charge=np.full((8, 60, 60), 3))
    memory = (after[1:] - before[1:]) / 3
    np.testing.assert_allclose(np.ptp(memory, axis=0), 0.0, atol=1e-12)  # always the same
    logs = np.log(memory[0] / 0.1)
    within(logs.mean(), -(0.5**2) / 2, 0.5 / 60)
    within(logs.std(), 0.5, 0.5 / 60 / np.sqrt(2))


def test_the_code_before_moves_a_sample_one_after_the_other():
    values = np.random.default_rng(1).uniform(90, 140, (3, 4, 9))
    effect = BinaryOffset(offset_dn=2.0, bits=(1.0, 0.0, -0.5))
    expected = values.copy()
    for t, y, x in np.ndindex(values.shape):
        if x:
            before = format(round(expected[t, y, x - 1]), "016b")
            expected[t, y, x] += 2.0 * (int(before[-1]) - 0.5) - 1.0 * (int(before[-3]) - 0.5)
    np.testing.assert_allclose(effect.apply(values, context_of((4, 9), 3)), expected, atol=1e-12)


def test_the_law_has_the_variance_of_all_bits():
    codes, bits = np.arange(40, 300), (0.5, 0.2, 0.0, 1.0, -0.3)
    law = BinaryOffset(offset_dn=1.6, bits=bits).sample_law(SampleLaw(), MAPS)
    plain, wide = (sample_mass(each, MAPS, codes)[0] for each in (SampleLaw(), law))
    added = wide @ (codes - wide @ codes) ** 2 - plain @ (codes - plain @ codes) ** 2
    assert added == pytest.approx(1.6**2 / 4 * np.sum(np.square(bits)), rel=1e-6)


MAPS = PixelMaps(*np.array([[1.5], [0.1], [100.0], [3.0]]), np.ones(1, bool))
TRUE = BinaryOffset(offset_dn=-1.0, bits=(-0.3, -0.5, 0.0, 1.0))


@pytest.mark.parametrize(
    ("effect", "shape", "seed"),
    [
        (BinaryOffset(offset_dn=0.5), (24, 24), 1),
        (BinaryOffset(offset_dn=-0.5, bits=(0.0, 0.0, 1.0)), (20, 36), 2),
        (TRUE, (36, 20), 3),
    ],
)
def test_the_bits_and_their_offsets_are_found(effect, shape, seed):
    evidence = seen(taken(drawn_truth(shape, seed=seed), effect, n_frames=1600, seed=seed))
    [found] = BinaryOffset.estimate(evidence)
    bits = evidence.time.previous_bits
    # a bit of the sample before is known beyond its value up to these errors
    errors = np.sqrt(bits.variance / np.diag(bits.square))
    wanted, offsets = np.zeros(BITS), np.zeros(BITS)
    wanted[: len(effect.bits)] = effect.offset_dn * np.array(effect.bits)
    offsets[: len(found.bits)] = found.offset_dn * np.array(found.bits)
    small = wanted == 0
    assert not offsets[small].any()
    assert (np.abs(offsets - wanted)[~small] < 4 * errors[~small]).all()
    assert (errors[~small] < 0.35 * np.abs(wanted[~small])).all()
    assert evidence.z["space.x.bits"] > 5.0


@pytest.mark.parametrize("place", [{}, {"columns": (0, 3)}, {"rows": (9, 12)}])
def test_frames_move_against_the_clamp_s_pixels(place):
    truth, effect = drawn_truth((12, 8)), BlackClamp(follow=0.8, **place)
    plain, clamped = taken(truth, n_frames=300), taken(truth, effect, n_frames=300)
    part = np.s_[:, slice(*effect.rows or (None,)), slice(*effect.columns or (None,))]
    usual = truth.bias + truth.quanta_exposure / truth.conversion_gain
    deviation = plain[part].mean(axis=(1, 2)) - usual[part[1:]].mean()
    moved = (clamped - plain.astype(float)).mean(axis=(1, 2))
    np.testing.assert_allclose(moved, -0.8 * deviation, atol=5 * 0.8 / np.sqrt(12 * 3))
    assert moved.std() > 1.0


def test_a_window_has_its_part_of_the_clamp():
    shape, window = (40, 60), ((10, 30), (0, 20))
    found = BlackClamp(follow=0.3, columns=(0, 4)).to_sensor(*window, shape)
    assert (found.rows, found.columns) == ((10, 30), (0, 4))
    seen_again = found.to_window(*window, shape)
    assert (seen_again.rows, seen_again.columns, seen_again.follow) == ((0, 20), (0, 4), 0.3)
    assert found.to_window((10, 30), (20, 40), shape).follow == 0.0
    part = Part(Region(rows=((5, 15),)))
    looked_at = SensorWindow(*window, shape)
    placed = looked_at.found(BlackClamp(follow=0.3, rows=(0, 4)), Part(looked_at.on_sensor(part.region)))
    assert (placed.rows, placed.columns, placed.region) == ((15, 19), (0, 20), Region(rows=((15, 25),)))
    [acting] = looked_at.effects([placed])
    assert (acting.rows, acting.columns) == ((5, 9), (0, 20))
    whole = BlackClamp(follow=0.3, rows=(0, 4))
    assert whole.to_sensor((0, 40), (0, 60), shape) == whole


def test_the_law_has_the_variance_of_the_clamp():
    law = BlackClamp(follow=0.5, pixels=20).sample_law(SampleLaw(), MAPS)
    assert law.extra_variance_dn2[0] == pytest.approx(0.25 * (9.0 + 150.0) / 20)
    assert BlackClamp(follow=0.5).sample_law(SampleLaw(), MAPS).neutral


# of the whole frame, of columns, of rows
@pytest.mark.parametrize("seed", [180100, 180101, 180104])
@pytest.mark.parametrize("level", [4.0, 30.0])
def test_an_independent_camera_s_clamp_is_found(seed, level):
    hiding = hide(("black_clamp",), level, seed, (24, 24), 1500)
    (hidden,) = hiding.effects
    [found] = BlackClamp.estimate(seen(hiding.frames))
    where = hidden.parameters["where"]
    assert 0.4 < found.follow / hidden.strength < 2.5
    if where != "all" and level > 10:
        assert getattr(found, where) == (0, 3)
        assert 70 <= found.pixels <= 72  # without a pixel that has no fit
    if where == "all":
        assert found.pixels > 400
