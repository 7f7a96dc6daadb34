"""Drifts and flicker of bias, gain and exposure: time profiles and moments against theory."""

import numpy as np
import pytest
from helpers.analog_signal import analog
from helpers.small_sensors import context_of, exposures, offsets

from pchem_pipeline.effects.estimators.charge_sums import ExposureProfile
from pchem_pipeline.effects.operators.drifts import BiasDrift, ExposureDrift, ExposureFlicker, GainDrift


@pytest.mark.parametrize(
    ("effect", "profile"),
    [
        (BiasDrift(drift_dn=-0.3), lambda t: -0.3 * t),
        (
            BiasDrift(drift_dn=2.0, shape="settling", settling_fraction=0.25),
            lambda t: 2.0 * np.expm1(-4.0 * t) / np.expm1(-4.0),
        ),
        (
            BiasDrift(drift_dn=2.0, shape="path", path=(0.0, 1.0, -1.0)),
            lambda t: np.interp(t, [0.0, 0.5, 1.0], [0.0, 2.0, -2.0]),
        ),
    ],
    ids=["linear", "settling", "path"],
)
def test_a_bias_drifts_along_its_profile_and_keeps_the_mean(effect, profile):
    added = offsets(effect, context_of(n_frames=201))[:, 0, 0]
    np.testing.assert_allclose(added - added[0], profile(np.linspace(0.0, 1.0, 201)), atol=1e-12)
    assert abs(added.mean()) < 2.0 * 3 / 201
    before = offsets(effect, context_of(n_frames=201, frames=[-5, 0]))
    np.testing.assert_array_equal(before[0], before[1])


def test_a_walk_has_the_variance_of_its_end():
    ends = []
    for seed in range(400):
        walk = offsets(BiasDrift(drift_dn=0.5, shape="walk"), context_of((1, 1), 60, seed=seed))[:, 0, 0]
        assert abs(walk.mean()) < 1e-12
        ends.append(walk[-1] - walk[0])
    # from the first frame to the last there are 59 of the 60 steps
    assert abs(np.mean(np.square(ends)) / (0.25 * 59 / 60) - 1) < 5 * np.sqrt(2 / 400)


@pytest.mark.parametrize(
    ("effect", "profile"),
    [
        (GainDrift(drift=0.2), np.linspace(-0.5, 0.5, 101)),
        (GainDrift(drift=0.2, shape="path", path=(-0.5, 0.5, -0.5)), 0.5 - np.abs(np.linspace(-1, 1, 101))),
    ],
)
def test_the_gain_follows_its_profile(effect, profile):
    after, before, _, _ = analog(effect, (101, 2, 3))
    np.testing.assert_allclose(after, before * (1 + 0.2 * profile)[:, None, None], rtol=1e-12)
    early, before, _, _ = analog(effect, (5, 2, 3), first=-9, n_run=101)
    np.testing.assert_allclose(early, before * (1 + 0.2 * profile[0]), rtol=1e-12)


@pytest.mark.parametrize(
    "shape", [{}, {"settling_fraction": 0.1}, {"settling_fraction": 3.0}, {"path": (5.0, 9.0, 1.0, 2.0)}]
)
@pytest.mark.parametrize("drift", [0.3, -0.3])
def test_profiles_have_mean_zero_and_the_range_of_the_drift(shape, drift):
    n = 3001
    h = exposures(ExposureDrift(drift=drift, **shape), np.full((1, 1), 2.0), n)[:, 0, 0]
    assert abs(h.mean() - 2.0) < 2.0 * 0.3 * 5 / n
    assert np.ptp(h) == pytest.approx(0.6, rel=1e-3)
    if "path" not in shape:
        assert h[-1] - h[0] == pytest.approx(drift * 2.0, rel=1e-9)


def test_a_drift_never_makes_the_exposure_negative():
    effect = ExposureDrift(drift=2.0, path=(0.0, 1.0, 1.0, 1.0, 1.0))
    assert exposures(effect, np.ones((1, 1)), 100).min() == 0.0


@pytest.mark.parametrize("correlation", [0.0, 4.0])
def test_flicker_has_its_rms_and_memory(correlation):
    n = 40_000
    effect = ExposureFlicker(rms=0.2, correlation_frames=correlation)
    a = exposures(effect, np.ones((1, 2)), n)
    assert np.array_equal(a[:, 0, 0], a[:, 0, 1])
    d = a[:, 0, 0] - 1.0
    independent = n / (1.0 + 2.0 * correlation)
    assert abs(d.mean()) < 5 * 0.2 / np.sqrt(independent)
    # kurtosis of this log-normal: 3.7
    assert abs((d**2).mean() - 0.04) < 5 * 0.04 * np.sqrt(2.7 / independent)
    rho = np.exp(-1.0 / correlation) if correlation else 0.0
    lag = (d[1:] * d[:-1]).mean() / (d**2).mean()
    assert abs(lag - rho) < 0.01 * (correlation > 0) + 5 / np.sqrt(n)


@pytest.mark.parametrize("correlation", [0.0, 4.0])
@pytest.mark.parametrize(("levels", "shares"), [((3.0, 1.0), (0.1, 0.9)), ((0.9, 1.0, 1.1), ())])
def test_a_flicker_of_levels_takes_these_and_has_its_rms(levels, shares, correlation):
    n = 40_000
    effect = ExposureFlicker(rms=0.2, levels=levels, shares=shares, correlation_frames=correlation)
    a = exposures(effect, np.ones((1, 1)), n)[:, 0, 0]
    values, counts = np.unique(a, return_counts=True)
    wanted = np.array(shares or [1 / 3] * 3)[np.argsort(levels)]
    # neighbours that are alike count less
    independent = n / (1.0 + 2.0 * correlation)
    assert values.size == len(levels)
    assert np.all(abs(counts / n - wanted) < 5 * np.sqrt(wanted * (1 - wanted) / independent))
    assert values @ wanted == pytest.approx(1.0)
    assert np.sqrt(wanted @ (values - 1.0) ** 2) == pytest.approx(0.2)
    assert np.diff(values) == pytest.approx(np.full(values.size - 1, values[1] - values[0]))


def test_flashes_are_guessed_within_what_the_effect_takes():
    """Their rms is 4 times the mean, more than the effect takes: a guess, and no error."""
    rng = np.random.default_rng(3)
    deviation = np.where(rng.random(400) < 0.05, 19.0, -1.0) + 0.02 * rng.standard_normal(400)
    found = ExposureFlicker._random(ExposureProfile(np.arange(400.0), deviation, 4e-4))
    assert found[0].levels
    assert {each.rms for each in found} == {1.0}


def test_a_sine_has_its_rms_period_and_phase():
    effect = ExposureFlicker(rms=0.1, period_frames=8.0, phase_cycles=0.25)
    a = exposures(effect, np.ones((1, 1)), 800)[:, 0, 0] - 1.0
    assert a.std() == pytest.approx(0.1)
    assert a[0] == pytest.approx(0.1 * np.sqrt(2.0))
    assert np.allclose(a[8:], a[:-8])
