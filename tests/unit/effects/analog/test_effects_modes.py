"""Common modes, ADC and data path: what their forward models do to frames, and what they refuse."""

import itertools
from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, offsets

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.operators.curve import AdcDnl, AdcInl, Clipping
from pchem_pipeline.effects.operators.drifts import BiasDrift
from pchem_pipeline.effects.operators.offsets import (
    BiasJumps,
    ColumnNoise,
    FrameNoise,
    PeriodicPickup,
    ReadoutAlternation,
    RowNoise,
)
from pchem_pipeline.effects.operators.replace import RepeatedFrames
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings

JUMPS = (((0, 1.0), (5, -2.0), (9, 0.0)), ((3, 1.0),), (), ((2, 0.5), (11, 4.0)))
N_FRAMES, SHAPE = 14, (6, 5)


def frames_of(*effects: Effect) -> Any:
    sensor = SimulateSettings(shape=SHAPE, n_frames=N_FRAMES, seed=8, effects=effects)
    return simulate_block(drawn_truth(SHAPE), sensor, (0, N_FRAMES))[0]


# -- moments and shapes ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "axes"),
    [
        (FrameNoise(frame_noise_dn=0.7), (0,)),
        (RowNoise(row_noise_dn=0.7), (0, 1)),
        (ColumnNoise(column_noise_dn=0.7), (0, 2)),
    ],
    ids=lambda v: getattr(v, "tag", ""),
)
def test_random_offsets_have_their_variance_and_their_place(effect, axes):
    added = offsets(effect, context_of((40, 50), 500))
    others = tuple(axis for axis in range(3) if axis not in axes)
    # along the other axes there is one and the same number
    np.testing.assert_allclose(np.ptp(added, axis=others), 0.0, atol=1e-12)
    numbers = added.mean(axis=others).ravel()
    assert abs(numbers.mean()) < 5 * 0.7 / np.sqrt(numbers.size)
    assert abs((numbers**2).mean() / 0.49 - 1) < 5 * np.sqrt(2 / numbers.size)
    # half the variance would be found out
    assert abs(0.5 - 1) > 5 * np.sqrt(2 / numbers.size)


def test_linear_drift_ends_where_it_says_and_keeps_the_mean():
    added = offsets(BiasDrift(drift_dn=-0.3), context_of(n_frames=101))
    np.testing.assert_allclose(added[-1] - added[0], -0.3)
    np.testing.assert_allclose(added.mean(axis=0), 0.0, atol=1e-12)
    before = offsets(BiasDrift(drift_dn=-0.3), context_of(n_frames=101, frames=[-5, 0]))
    np.testing.assert_array_equal(before[0], before[1])


def test_a_bias_settles_by_an_exponential_and_keeps_the_mean():
    effect = BiasDrift(drift_dn=2.0, shape="settling", settling_fraction=0.25)
    added = offsets(effect, context_of(n_frames=401))[:, 0, 0]
    assert added[-1] - added[0] == pytest.approx(2.0)
    rest = (added[-1] - added) + 2.0 * np.exp(-4.0) / -np.expm1(-4.0)
    np.testing.assert_allclose(rest[100] / rest[0], np.exp(-1.0))
    assert abs(added.mean()) < 2.0 * 3 / 401


def test_a_path_goes_through_its_nodes():
    path = BiasDrift(drift_dn=2.0, shape="path", path=(0.0, 1.0, -1.0))
    added = offsets(path, context_of(n_frames=201))[:, 0, 0]
    np.testing.assert_allclose(added[[0, 100, 200]] - added[0], [0.0, 2.0, -2.0])
    np.testing.assert_allclose(added[50] - added[0], 1.0)
    assert abs(added.mean()) < 2.0 * 3 / 201


def test_a_walk_has_the_variance_of_its_end():
    ends = []
    for seed in range(400):
        walk = offsets(BiasDrift(drift_dn=0.5, shape="walk"), context_of((1, 1), 60, seed=seed))[:, 0, 0]
        assert abs(walk.mean()) < 1e-12
        ends.append(walk[-1] - walk[0])
    # from the first frame to the last there are 59 of the 60 steps
    assert abs(np.mean(np.square(ends)) / (0.25 * 59 / 60) - 1) < 5 * np.sqrt(2 / 400)


def test_jumps_have_their_rate_and_their_levels():
    n_frames, rate = 20_000, 0.01
    added = offsets(BiasJumps(amplitude_dn=0.5, rate=rate, levels=3), context_of((2, 2), n_frames))
    for y, x in itertools.product((0, 1), (0, 1)):
        series = np.round(added[:, y, x], 9)
        assert set(series) <= {-0.5, 0.0, 0.5}
        number = int((np.diff(series) != 0).sum())
        assert abs(number - rate * n_frames) < 5 * np.sqrt(rate * n_frames)
    together = np.corrcoef(added.reshape(n_frames, 4).T)
    assert np.abs(together - np.eye(4)).max() < 5 * np.sqrt(1 / (rate * n_frames))


def test_a_path_of_jumps_holds_each_level_from_its_frame_on():
    effect = BiasJumps(amplitude_dn=2.0, path=JUMPS)
    added = offsets(effect, context_of((5, 5)))
    top_left = added[:, 0, 0]
    np.testing.assert_allclose(top_left[:5] - top_left[5], 6.0)
    np.testing.assert_allclose(top_left[9:] - top_left[8], 4.0)
    np.testing.assert_allclose(added.mean(axis=0), 0.0, atol=1e-12)
    # an odd middle row and column belong to the bottom and the right; their path has one level only
    np.testing.assert_array_equal(added[:, 0, 2:], 0.0)
    np.testing.assert_array_equal(added[:, 2:, 0], 0.0)
    np.testing.assert_array_equal(added[:, 2, 2], added[:, 4, 4])
    assert np.ptp(added[:, 2, 2]) == pytest.approx(7.0)


def test_halves_jump_together():
    tops = offsets(BiasJumps(amplitude_dn=2.0, rate=0.3, parts="top_bottom"), context_of((4, 6), 50))
    sides = offsets(BiasJumps(amplitude_dn=2.0, parts="left_right", path=JUMPS[:2]), context_of((4, 6)))
    assert np.ptp(tops, axis=2).max() == 0
    assert (tops[:, 0] != tops[:, 3]).any()
    np.testing.assert_array_equal(tops[:, 0], tops[:, 1])
    assert np.ptp(sides, axis=1).max() == 0
    np.testing.assert_allclose(sides[9, 0] - sides[8, 0], [4.0] * 3 + [0.0] * 3)


def test_pickup_is_the_sine_that_it_says():
    effect = PeriodicPickup(
        amplitude_dn=0.4, cycles_per_row=0.11, cycles_per_frame=-0.27, cycles_per_column=0.07, phase=0.6
    )
    context = context_of((6, 7), 30, frames=np.arange(10, 30))
    t, y, x = np.ogrid[10:30, :6, :7]
    expected = 0.4 * np.sin(2 * np.pi * (0.11 * y - 0.27 * t + 0.07 * x) + 0.6)
    np.testing.assert_allclose(offsets(effect, context), expected, atol=1e-12)


def test_a_random_phase_is_new_in_every_frame():
    effect = PeriodicPickup(amplitude_dn=0.4, cycles_per_row=0.25, random_phase=True)
    added = offsets(effect, context_of((4, 1), 2000))[:, :, 0]
    np.testing.assert_allclose((added**2).sum(axis=1), 2 * 0.16, atol=1e-9)
    assert abs(added.mean()) < 5 * 0.4 / np.sqrt(2 * added.size)
    lag = (added[1:, 0] * added[:-1, 0]).mean() / 0.08
    assert abs(lag) < 5 / np.sqrt(2000)


def test_alternation_is_positive_in_even_frames():
    added = offsets(ReadoutAlternation(alternation_dn=0.3), context_of(frames=[-1, 0, 1, 7, 8]))
    np.testing.assert_allclose(added[:, 0, 0], [-0.3, 0.3, -0.3, -0.3, 0.3])


def coded(effect: AdcDnl | AdcInl, values: Any, **kwargs: Any) -> Any:
    values = np.asarray(values, float).reshape(-1, 1, 1)
    context = context_of((1, 1), len(values), **kwargs)
    return np.rint(effect.apply(values, context)).astype(int).ravel()


def edges_of(effect: AdcDnl | AdcInl, first: int, last: int, **kwargs: Any) -> Any:
    """Return where codes first + 1 .. last begin."""
    fine = np.arange(first - 0.5, last + 0.5, 1e-3) + 5e-4
    codes = coded(effect, fine, **kwargs)
    assert (np.diff(codes) >= 0).all()
    return np.array([fine[np.searchsorted(codes, code)] for code in range(first + 1, last + 1)]) - 5e-4


def test_listed_edges_move_and_no_others():
    effect = AdcDnl(dnl_lsb=0.5, pattern="edges", first_code=101, edges=(0.6, -0.4))
    moved = edges_of(effect, 98, 104) - (np.arange(99, 105) - 0.5)
    np.testing.assert_allclose(moved, [0, 0, 0.3, -0.2, 0, 0], atol=2e-3)


def test_a_code_whose_edges_coincide_is_missing():
    effect = AdcDnl(dnl_lsb=1.0, pattern="edges", first_code=101, edges=(1.0, 0.0, 0.0, 0.5, -0.5, 0.0, -1.0))
    fine = np.arange(97.5, 112.5, 1e-2) + 5e-3
    codes = coded(effect, fine)
    # 101 reads 100; the halves of 104 read 103 and 105; 106 reads 107
    expected = np.rint(fine).astype(int)
    expected[expected == 101] = 100
    expected[(expected == 104) & (fine < 104)] = 103
    expected[expected == 104] = 105
    expected[expected == 106] = 107
    np.testing.assert_array_equal(codes, expected)


def test_edges_in_the_wrong_order_coincide():
    effect = AdcDnl(dnl_lsb=1.0, pattern="edges", first_code=101, edges=(1.0, -1.0))
    assert set(coded(effect, np.arange(99.5, 103.5, 1e-2))) == {100, 102, 103}


@pytest.mark.parametrize("bit", [0, 1, 3])
def test_a_wrong_bit_has_its_period(bit):
    moved = edges_of(AdcDnl(dnl_lsb=0.4, pattern="bit", bit=bit), 63, 96) - (np.arange(64, 97) - 0.5)
    expected = 0.4 * ((np.arange(64, 97) >> bit & 1) - 0.5)
    np.testing.assert_allclose(moved, expected, atol=2e-3)


def test_random_edges_have_their_width_and_are_the_same_everywhere():
    effect = AdcDnl(dnl_lsb=0.1)
    edges = edges_of(effect, 1000, 1500)
    # across the chunks (of 1024 codes) in which they are drawn
    np.testing.assert_allclose(edges_of(effect, 1020, 1030), edges[20:30], atol=1e-9)
    moved = edges - (np.arange(1001, 1501) - 0.5)
    assert abs((moved**2).mean() / 0.005 - 1) < 5 * np.sqrt(2 / 500)
    assert abs((np.diff(edges, prepend=np.nan)[1:] - 1).std() / 0.1 - 1) < 5 * np.sqrt(1.5 / 500)
    assert (edges_of(effect, 1000, 1010, seed=4) != edges[:10]).any()


def test_every_column_has_an_adc_of_its_own():
    values = np.random.default_rng(0).uniform(100, 130, (400, 1, 1)) * np.ones((1, 3, 2))
    out = AdcDnl(dnl_lsb=0.5, per_column=True).apply(values, context_of((3, 2), 400))
    np.testing.assert_array_equal(out[:, 0], out[:, 2])
    assert (out[:, 0, 0] != out[:, 0, 1]).any()
    one = AdcDnl(dnl_lsb=0.5).apply(values, context_of((3, 2), 400))
    np.testing.assert_array_equal(one[:, 0, 0], one[:, 0, 1])


def test_the_bent_curve_moves_edges_against_the_deviation():
    effect = AdcInl(inl_lsb=1.2, period_dn=40.0, phase=0.3)
    values = np.linspace(90.0, 180.0, 500)
    bent = effect.apply(values.reshape(-1, 1, 1), context_of((1, 1), 500)).ravel()
    np.testing.assert_allclose(bent - values, 1.2 * np.sin(2 * np.pi * values / 40 + 0.3), atol=1e-9)
    assert (np.diff(bent) > 0).all()


def test_a_curve_goes_through_its_values_and_stays_at_its_ends():
    effect = AdcInl(inl_lsb=2.0, form="curve", first_dn=100.0, spacing_dn=10.0, curve=(0.0, 1.0, -0.5, 0.25))
    places = np.array([100.0, 110.0, 120.0, 130.0, 80.0, 170.0])
    bent = effect.apply(places.reshape(-1, 1, 1), context_of((1, 1), 6)).ravel()
    np.testing.assert_allclose(bent - places, [0.0, 2.0, -1.0, 0.5, 0.0, 0.5], atol=1e-9)
    # codes begin where the bent value is their lower edge
    edges = edges_of(effect, 104, 126)[3:]
    values = effect.apply(edges.reshape(-1, 1, 1), context_of((1, 1), edges.size)).ravel()
    np.testing.assert_allclose(values, np.arange(108, 127) - 0.5, atol=3e-3)
    assert effect.scaled(100).inl_lsb < 100 / effect.inl_lsb


def test_repeats_are_exact_copies_of_what_was_delivered():
    plain, listed = frames_of(), (1, 2, 5, 9, 10, 11)
    delivered = plain.copy()
    for t in listed:
        delivered[t] = delivered[t - 1]
    np.testing.assert_array_equal(frames_of(RepeatedFrames(frames=listed)), delivered)
    some = frames_of(RepeatedFrames(frames=listed, rows=(2, 4)))
    np.testing.assert_array_equal(some[:, 2:4], delivered[:, 2:4])
    np.testing.assert_array_equal(np.delete(some, [2, 3], axis=1), np.delete(plain, [2, 3], axis=1))


def test_random_repeats_come_as_often_as_they_should():
    n_frames, p = 20_000, 0.1
    values = np.arange(n_frames, dtype=np.uint16).reshape(-1, 1, 1)
    out = RepeatedFrames(probability=p).apply(values, context_of((1, 1), n_frames)).ravel().astype(int)
    number = int((np.diff(out) == 0).sum())
    assert abs(number - p * n_frames) < 5 * np.sqrt(p * (1 - p) * n_frames)
    # a repeat of a repeat shows the frame that was last taken
    assert (np.arange(n_frames) - out).max() > 1
    assert out[0] == 0


# -- what is refused ------------------------------------------------------------------------------


def test_scaling_stops_where_the_parameters_end():
    assert AdcDnl(dnl_lsb=0.4).scaled(10).dnl_lsb == 1.0
    bent = AdcInl(inl_lsb=1, period_dn=50).scaled(100)
    assert 2 * np.pi * bent.inl_lsb < 50
    assert RepeatedFrames(probability=0.3).scaled(4).probability == 0.5
    with pytest.raises(ConfigError, match="no strength"):
        Clipping(low=3).scaled(2)
