"""Robust scatter and what many looks do to a probability; steps and modes of maps."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.model.arithmetic.statistics import chi_square, look_elsewhere, robust_sd
from pchem_pipeline.model.checks.map_parts import map_parts


def test_three_parts_on_a_slope():
    rng, x = np.random.default_rng(2), np.arange(90)
    level = 100.0 + 0.05 * x + 12.0 * ((x >= 20) & (x < 60))
    (found,) = map_parts(level + rng.standard_normal((40, 90)))
    assert found.boxes == ((0, 40, 0, 20), (0, 40, 20, 60), (0, 40, 60, 90))


@pytest.mark.parametrize(
    "gains",
    [
        [[1.0, 1.15]],
        [[1.0], [1.15]],
        [[1.0, 1.1], [1.15, 0.92]],
        [[1.0, 1.1], [1.1, 1.0]],  # the steps of both halves cancel in the medians of whole lines
        [[1.0, 1.1, 1.2], [0.8, 0.9, 1.3]],
    ],
)
def test_parts_that_differ_along_rows_and_columns(gains):
    ny, nx = 24 * len(gains), 30 * len(gains[0])
    values = np.kron(gains, np.ones((24, 30)))
    values *= 1 + 0.02 * np.random.default_rng(5).standard_normal((ny, nx))
    values[::7, 3] = np.nan
    (found,) = map_parts(values)
    assert found.boxes == tuple((y, y + 24, x, x + 30) for y in range(0, ny, 24) for x in range(0, nx, 30))
    assert found.medians == pytest.approx(np.ravel(gains), abs=5 * 1.25 * 0.026 / np.sqrt(24 * 30))


def test_alternating_columns_are_two_modes():
    rng = np.random.default_rng(3)
    values = np.where(np.arange(64) % 2, 0.115, 0.100) * (1 + 0.02 * rng.standard_normal((48, 64)))
    (found,) = map_parts(values)
    assert found.boxes == ()
    assert found.medians == pytest.approx((0.100, 0.115), rel=0.005)


def test_maps_of_one_part_give_nothing():
    """At most 1 in 10,000 may; of 150 none: uniform, shaded, skewed, with columns that differ, with gaps."""
    rng, (y, x) = np.random.default_rng(4), np.mgrid[-1:1:40j, -1:1:56j]
    for i in range(30):
        noise = rng.standard_normal(y.shape)
        vignetted = 10.0 * np.exp(-((x - 0.2) ** 2) - y**2) + 0.1 * noise
        gaps = np.where(rng.random(y.shape) < 0.2, np.nan, noise)
        skewed, columns = rng.exponential(size=y.shape), noise + rng.standard_normal(56)
        for values in (noise, vignetted, skewed, columns, gaps):
            assert map_parts(values) == [], i
    for values in (np.full((8, 8), 2.0), np.full((8, 8), np.nan), np.arange(6.0)[None]):
        assert map_parts(values) == []


def test_the_scatter_of_a_normal_law_is_its_standard_deviation_whatever_a_few_values_are():
    values = np.random.default_rng(1).normal(3.0, 2.0, (20_001, 2))
    values[:100] = 1e9
    assert robust_sd(values, axis=0) == pytest.approx([2.0, 2.0], abs=0.1)
    assert robust_sd([1.0, 2.0, 4.0]) == pytest.approx(1.4826, rel=1e-12)
    assert robust_sd([1.0, 2.0, 4.0], 0.0) == pytest.approx(2.0 * 1.4826, rel=1e-12)


def test_the_smallest_of_many_p_values():
    assert look_elsewhere(0.01, 10) == pytest.approx(1.0 - 0.99**10, rel=1e-12)
    assert look_elsewhere(1e-15, 100) == pytest.approx(1e-13, rel=1e-9)


@pytest.mark.parametrize("freedom", [20, 60, 400])
def test_a_chi_square_as_a_normal_deviate(freedom):
    deviates = np.array([-2.0, 0.0, 2.0, 4.0])
    values = stats.chi2.ppf(stats.norm.cdf(deviates), freedom)
    # Wilson and Hilferty 1931: good to some hundredths
    assert chi_square(values, freedom) == pytest.approx(deviates, abs=0.06)
    assert chi_square(3.0 * values, 3.0 * freedom, 18.0 * freedom) == pytest.approx(deviates, abs=0.06)
