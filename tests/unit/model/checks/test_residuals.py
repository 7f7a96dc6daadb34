"""Residuals, RMSE, the noise floor and chi-square; robust scatter and the look-elsewhere effect."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.model.arithmetic.robust import chi_square, look_elsewhere, robust_sd
from pchem_pipeline.model.checks.residuals import (
    central_window,
    chi_square,
    noise_floor,
    normalised_residuals,
    rmse,
)


def test_window_ignores_far_outliers() -> None:
    counts = np.zeros(5000, dtype=np.int64)
    counts[100:200] = 1000
    counts[4999] = 20
    assert central_window(counts, 0.999) == slice(100, 200)
    assert central_window(counts, 1.0) == slice(100, 5000)
    single = np.array([0, 7, 0])
    assert central_window(single, 0.999) == slice(1, 2)


def test_rmse_and_floor_use_the_window() -> None:
    data, model = np.array([9.0, 1.0, 2.0]), np.array([0.0, 1.0, 4.0])
    assert rmse(data, model, slice(1, 3)) == pytest.approx(np.sqrt(2.0))
    assert noise_floor(np.array([100.0, 1.0, 3.0]), slice(1, 3)) == pytest.approx(np.sqrt(2.0))


def test_normalised_residuals() -> None:
    found = normalised_residuals(np.array([1.0, 2.0]), np.array([0.0, 2.0]), np.array([0.25, 0.0]))
    assert found[0] == pytest.approx(2.0)
    assert np.isnan(found[1])


def test_chi_square_leaves_out_bins_with_few_samples() -> None:
    data, model = np.array([1.1, 0.03, 0.9, 0.5]), np.array([1.0, 0.02, 1.0, 0.4])
    variance = np.array([0.008, 0.001, 0.01, 0.0])
    found = chi_square(data, model, variance, np.array([110, 3, 90, 50]))
    assert found.dof == 2
    assert found.value == pytest.approx(0.01 / 0.008 + 0.01 / 0.01)
    assert found.p == pytest.approx(np.exp(-0.5 * found.value))  # of two degrees of freedom


def test_the_scatter_of_a_normal_law_is_its_standard_deviation_whatever_a_few_values_are() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, (20_001, 2))
    values[:100] = 1e9
    assert robust_sd(values, axis=0) == pytest.approx([2.0, 2.0], abs=0.1)
    assert robust_sd([1.0, 2.0, 4.0]) == pytest.approx(1.4826, rel=1e-12)
    assert robust_sd([1.0, 2.0, 4.0], 0.0) == pytest.approx(2.0 * 1.4826, rel=1e-12)


def test_the_smallest_of_many_p_values() -> None:
    assert look_elsewhere(0.01, 10) == pytest.approx(1.0 - 0.99**10, rel=1e-12)
    assert look_elsewhere(1e-15, 100) == pytest.approx(1e-13, rel=1e-9)


@pytest.mark.parametrize("freedom", [20, 60, 400])
def test_a_chi_square_as_a_normal_deviate(freedom: int) -> None:
    deviates = np.array([-2.0, 0.0, 2.0, 4.0])
    values = stats.chi2.ppf(stats.norm.cdf(deviates), freedom)
    # Wilson and Hilferty 1931: good to some hundredths
    assert chi_square(values, freedom) == pytest.approx(deviates, abs=0.06)
    assert chi_square(3.0 * values, 3.0 * freedom, 18.0 * freedom) == pytest.approx(deviates, abs=0.06)
