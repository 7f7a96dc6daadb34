"""Stitch point of two gains: the forward model, its law, and what the estimator makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sensor_of_modes import context_of, drawn_truth, seen, taken
from hidden.chain import hide

from pchem_pipeline.effects.adc.gain_stitch import GainStitch
from pchem_pipeline.effects.analog.signal_dependent_noise import SignalDependentNoise
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_above_the_level_the_scale_has_another_slope():
    values = np.linspace(90, 150, 601).reshape(1, 1, -1)
    kink = GainStitch(gain_change=0.1, level_dn=120.0).apply(values, context_of((1, 601), 1))
    np.testing.assert_allclose(kink, np.maximum(values, 120 + 1.1 * (values - 120)))
    step = GainStitch(gain_change=-0.1, level_dn=120.0, origin_dn=100.0).apply(
        values, context_of((1, 601), 1)
    )
    np.testing.assert_array_equal(step[values <= 120], values[values <= 120])
    np.testing.assert_allclose(step[values > 120], 100 + 0.9 * (values[values > 120] - 100))


@pytest.mark.parametrize("effect", [
    GainStitch(gain_change=0.05, level_dn=121.3),
    GainStitch(gain_change=-0.05, level_dn=118.0, origin_dn=100.0),
    GainStitch(gain_change=0.1, level_dn=118.0, origin_dn=100.0),
])  # fmt: skip
def test_the_law_is_that_of_the_samples(effect):
    n = 400_000
    maps = PixelMaps(np.array([2.0]), np.array([0.1]), np.array([100.0]), np.array([3.0]), np.ones(1, bool))
    codes = np.arange(60, 300)
    mass = sample_mass(effect.sample_law(SampleLaw(), maps), maps, codes)[0]
    rng = np.random.default_rng(4)
    # the analog part of the read noise
    noise = np.sqrt(9.0 - 1 / 12)
    values = 100 + 10.0 * rng.poisson(2.0, n) + noise * rng.standard_normal(n)
    above = values > effect.level_dn
    origin = effect.level_dn if effect.origin_dn is None else effect.origin_dn
    values[above] += effect.gain_change * (values[above] - origin)
    counts = np.bincount(np.floor(values + 0.5).astype(int), minlength=300)[60:300]
    expected = n * mass
    used = expected > 30
    chi2 = ((counts - expected)[used] ** 2 / expected[used]).sum()
    # codes that both gains reach are right to first order only
    assert chi2 < used.sum() + 5 * np.sqrt(2 * used.sum()) + 0.02 * abs(effect.gain_change) * n / 100
    plain = n * sample_mass(SampleLaw(), maps, codes)[0]
    assert ((counts - plain)[used] ** 2 / plain[used]).sum() > 4 * used.sum()


@pytest.mark.parametrize("seed", [180100, 180101, 180103])  # a kink, a step down, a step up
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


def test_stacks_without_a_bend_have_no_stitch():
    truth = drawn_truth((24, 24))
    for number, hidden in enumerate(((), (SignalDependentNoise(noise_e=0.03),))):
        evidence = seen(taken(truth, *hidden, n_frames=1200, seed=21 + number))
        assert GainStitch.estimate(evidence) == []
