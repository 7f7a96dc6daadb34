"""Curves of voltage and code: forward models, and what the estimator makes of an independent camera."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, seen
from hidden.chain import hide

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.operators.curve import AdcDnl, AdcInl, Clipping, GainStitch
from pchem_pipeline.effects.operators.replace import RepeatedFrames


def coded(effect, values, **kwargs):
    values = np.asarray(values, float).reshape(-1, 1, 1)
    context = context_of((1, 1), len(values), **kwargs)
    return np.rint(effect.apply(values, context)).astype(int).ravel()


def edges_of(effect, first, last, **kwargs):
    """Return where codes first + 1 .. last begin."""
    fine = np.arange(first - 0.5, last + 0.5, 1e-3) + 5e-4
    codes = coded(effect, fine, **kwargs)
    assert (np.diff(codes) >= 0).all()
    return np.array([fine[np.searchsorted(codes, code)] for code in range(first + 1, last + 1)]) - 5e-4


def test_listed_edges_move_and_no_others_and_in_the_wrong_order_coincide():
    effect = AdcDnl(dnl_lsb=0.5, pattern="edges", first_code=101, edges=(0.6, -0.4))
    moved = edges_of(effect, 98, 104) - (np.arange(99, 105) - 0.5)
    np.testing.assert_allclose(moved, [0, 0, 0.3, -0.2, 0, 0], atol=2e-3)
    crossed = AdcDnl(dnl_lsb=1.0, pattern="edges", first_code=101, edges=(1.0, -1.0))
    assert set(coded(crossed, np.arange(99.5, 103.5, 1e-2))) == {100, 102, 103}
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


def test_scaling_stops_where_the_parameters_end():
    assert AdcDnl(dnl_lsb=0.4).scaled(10).dnl_lsb == 1.0
    bent = AdcInl(inl_lsb=1, period_dn=50).scaled(100)
    assert 2 * np.pi * bent.inl_lsb < 50
    assert RepeatedFrames(probability=0.3).scaled(4).probability == 0.5
    with pytest.raises(ConfigError, match="no strength"):
        Clipping(low=3).scaled(2)


def test_above_the_level_the_scale_has_another_slope():
    values, context = np.linspace(90, 150, 601).reshape(1, 1, -1), context_of((1, 601), 1)
    kink = GainStitch(gain_change=0.1, level_dn=120.0).apply(values, context)
    np.testing.assert_allclose(kink, np.maximum(values, 120 + 1.1 * (values - 120)))
    step = GainStitch(gain_change=-0.1, level_dn=120.0, origin_dn=100.0).apply(values, context)
    np.testing.assert_allclose(step, np.where(values > 120, 100 + 0.9 * (values - 100), values))


# a kink, a step down, a step up, and a step down at one code of 215
@pytest.mark.parametrize("seed", [180100, 180101, 180103, 180439])
def test_an_independent_camera_s_stitch_is_found(seed):
    hiding = hide(("gain_stitch",), 5.0, seed, (24, 24), 1500)
    (hidden,) = hiding.effects
    found = GainStitch.estimate(seen(hiding.frames))[0]
    change = hidden.parameters["sign"] * hidden.strength
    low, high = hidden.sensor.code_range
    if hidden.parameters["agree"] == "black":
        # the step is what is seen of it
        step = found.gain_change * (found.level_dn - found.origin_dn)
        assert step == pytest.approx(change * (hidden.code - hidden.origin), rel=0.2)
        assert abs(found.level_dn - hidden.code) <= 1.0
    else:
        assert found.gain_change == pytest.approx(change, rel=0.5)
        assert abs(found.level_dn - hidden.code) < 0.15 * (high - low)
