"""The judgement of all pixels of a sensor together: what it flags, and what it leaves alone."""

import numpy as np
import pytest

from pchem_pipeline.model.checks.shrinkage import LOOSEST, Judged, NoisePool, noise_of
from pchem_pipeline.model.fit.settings import FitSettings


def pixels(noise, spread, error, gap, n=4000, seed=1):
    """Pixels whose read noises differ by ``spread``, estimated to ``error``; a quiet one has a larger gap."""
    rng = np.random.default_rng(seed)
    true = noise + spread * rng.standard_normal(n)
    found = true + error * rng.standard_normal(n)
    return Judged(found, np.full(n, error), gap * np.exp(-25.0 * (found - noise)))


def weak(sensor):
    return np.logical_or(*NoisePool.of(sensor).reasons(sensor, FitSettings()))


ROUGH = LOOSEST / (8 * np.pi**2 * 0.4)


@pytest.mark.parametrize(
    ("sensor", "least", "most"),
    [
        (pixels(0.46, 0.0, 0.02, gap=3.0), 0.99, 1.0),  # a poor sensor, of which some are clear by themselves
        (pixels(0.42, 0.0, 0.015, gap=9.0), 0.0, 0.0),  # a good one, of which some are not
        (pixels(0.52, 0.0, 0.02, gap=100.0), 1.0, 1.0),
        (pixels(0.49, 0.0, 0.01, gap=100.0), 0.0, 0.0),
        (pixels(0.4, 0.0, 1.15 * ROUGH, gap=1000.0), 0.99, 1.0),
        (pixels(0.4, 0.0, 0.85 * ROUGH, gap=1000.0), 0.0, 0.02),
        (Judged(np.full(40, 0.3), np.full(40, 0.005), np.full(40, 50.0)), 0.0, 0.0),  # all alike
    ],
)
def test_equal_pixels_are_judged_in_common(sensor, least, most):
    assert least <= weak(sensor).mean() <= most


def test_pixels_that_really_differ_are_judged_by_themselves():
    sensor = pixels(0.42, 0.08, 0.01, gap=10.0)
    clear = sensor.gap > 5.0
    disagree = weak(sensor) != (~clear | (sensor.noise > 0.5))
    assert 0.2 < clear.mean() < 0.9
    assert disagree.mean() < 0.03


def test_one_pixel_far_rougher_than_its_like_is_flagged():
    sensor = pixels(0.3, 0.0, 0.005, gap=500.0)
    sensor.stderr[7], sensor.noise[7] = 0.1, 0.3
    assert np.flatnonzero(weak(sensor)).tolist() == [7]


def test_pixels_without_a_value_have_no_part_in_it():
    sensor = pixels(0.46, 0.0, 0.02, gap=3.0)
    expected = weak(sensor)
    hole = np.array([np.nan])
    more = Judged.join([Judged(hole, hole, hole), sensor, Judged(np.array([0.3]), hole, np.array([50.0]))])
    np.testing.assert_array_equal(weak(more), [False, *expected, False])
    pools = [NoisePool.of(pixels(0.46, 0.0, 0.02, gap=3.0, n=n)) for n in (29, 30)]
    assert [pool is None for pool in pools] == [True, False]


def test_noise_in_electrons_by_the_delta_method():
    noise, error = noise_of(*np.array([[0.1], [3.0], [2e-3], [0.1], [-0.5]]))
    assert noise[0] == pytest.approx(0.3)
    assert error[0] == pytest.approx(np.sqrt(9 * 4e-6 + 0.01 * 0.01 - 2 * 0.3 * 1e-4))
