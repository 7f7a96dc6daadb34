"""Effects on the exposure: time profiles, flicker, blinking pixels and ghosts against theory.

Limits are five standard errors from theory; what they guard against is many more.
"""

import numpy as np
import pytest
from helpers.small_sensors import exposures

from pchem_pipeline.effects.estimators.charge_sums import ExposureProfile
from pchem_pipeline.effects.operators.drifts import ExposureDrift, ExposureFlicker, _random
from pchem_pipeline.effects.operators.light import DarkCurrentRts, Persistence


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
    found = _random(ExposureFlicker, ExposureProfile(np.arange(400.0), deviation, 4e-4))
    assert found[0].levels
    assert {each.rms for each in found} == {1.0}


def test_a_sine_has_its_rms_period_and_phase():
    effect = ExposureFlicker(rms=0.1, period_frames=8.0, phase_cycles=0.25)
    a = exposures(effect, np.ones((1, 1)), 800)[:, 0, 0] - 1.0
    assert a.std() == pytest.approx(0.1)
    assert a[0] == pytest.approx(0.1 * np.sqrt(2.0))
    assert np.allclose(a[8:], a[:-8])


@pytest.mark.parametrize(("low", "high"), [(30.0, 10.0), (4.0, 4.0)])
def test_blinking_pixels_are_a_markov_chain(low, high):
    n, step = 60_000, 0.8
    effect = DarkCurrentRts(fraction=0.25, step_e=step, dwell_low_frames=low, dwell_high_frames=high)
    h = exposures(effect, np.ones((12, 12)), n) - 1.0
    blinks = h.any(axis=0)
    assert abs(blinks.mean() - 0.25) < 5 * np.sqrt(0.25 * 0.75 / 144)
    s = h[:, blinks] / step
    assert np.all((s == 0) | (abs(s - 1) < 1e-9))
    share, tau = high / (low + high), 1.0 / (1.0 / low + 1.0 / high)
    error = np.sqrt(share * (1 - share) * 2 * tau / s.size)
    assert abs(s.mean() - share) < 5 * error
    d = s - s.mean()
    for lag in (1, 5, 20):
        seen = (d[lag:] * d[:-lag]).mean()
        assert abs(seen - share * (1 - share) * np.exp(-lag / tau)) < 5 * error
    assert share * (1 - share) * np.exp(-1 / tau) > 20 * error


def test_pixels_that_blink_at_a_small_fraction_blink_alike_at_a_larger_one():
    small, large = (
        exposures(DarkCurrentRts(fraction=f, steps="exponential"), np.ones((15, 15)), 500) for f in (0.1, 0.3)
    )
    blinks = (small != 1.0).any(axis=0)
    assert 5 < blinks.sum() < (large != 1.0).any(axis=0).sum()
    assert np.array_equal(small[:, blinks], large[:, blinks])


def test_an_image_in_a_part_of_the_sensor_stays_at_its_place():
    y, x = np.mgrid[0:8, 0:12] + 0.5
    smooth = np.exp(-((y - 3.0) ** 2 + (x - 8.0) ** 2) / 18.0)
    effect = Persistence(peak_e=2.0, decay_frames=9.0, image=tuple(map(tuple, smooth.tolist())))
    whole = 2.0 * effect.pattern(np.arange(40), (40, 60))
    for rows, columns in (((0, 20), (20, 50)), ((16, 40), (0, 30)), ((0, 40), (0, 60))):
        size = (rows[1] - rows[0], columns[1] - columns[0])
        part = effect.to_window(rows, columns, (40, 60))
        own = part.peak_e * part.pattern(np.arange(size[0]), size)
        assert np.abs(own - whole[slice(*rows), slice(*columns)]).max() < 0.1
        back = part.to_sensor(rows, columns, (40, 60))
        seen = back.peak_e * back.pattern(np.arange(40), (40, 60))
        middle = (slice(rows[0] + 4, rows[1] - 4), slice(columns[0] + 4, columns[1] - 4))
        assert np.abs(seen - whole)[middle].max() < 0.2
        seen[slice(*rows), slice(*columns)] = 0.0
        beside = seen.copy()
        beside[max(rows[0] - 5, 0) : rows[1] + 5, max(columns[0] - 5, 0) : columns[1] + 5] = 0.0
        assert not beside.any()
    tiny = effect.to_sensor((20, 21), (30, 31), (4000, 6000))
    assert np.isfinite(tiny.pattern(np.arange(40), (4000, 6000))).all()


def test_the_ghost_of_an_image_fades():
    effect = Persistence(
        peak_e=2.0,
        decay_frames=10.0,
        slow_decay_frames=40.0,
        slow_share=0.25,
        centre_y=0.25,
        centre_x=0.75,
        radius=0.1,
    )
    h = exposures(effect, np.zeros((40, 20)), 100)
    assert np.unravel_index(h[0].argmax(), h[0].shape) == (9, 14)
    assert np.allclose(h[20] / h[0], 0.75 * np.exp(-2.0) + 0.25 * np.exp(-0.5))
    # one radius (a tenth of 40 rows) away
    assert h[0, 9 + 4, 14] / h[0, 9, 14] == pytest.approx(np.exp(-0.5 * (3.5**2 - 0.5**2) / 16.0), rel=0.2)
    image = Persistence(peak_e=2.0, decay_frames=10.0, image=((0.0, 4.0), (0.0, 2.0)))
    h = exposures(image, np.zeros((40, 20)), 1)[0]
    assert h[0, 0] == 0.0
    assert h[0, -1] == 2.0
    assert h[-1, -1] == 1.0
