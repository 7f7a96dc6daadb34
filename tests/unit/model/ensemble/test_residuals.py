"""Residuals, RMSE, the noise floor and chi-square."""

import numpy as np
import pytest

from pchem_pipeline.model.ensemble.curves import (
    central_window,
    chi_square,
    noise_floor,
    normalised_residuals,
    rmse,
)


def test_window_ignores_far_outliers():
    counts = np.zeros(5000, dtype=np.int64)
    counts[100:200] = 1000
    counts[4999] = 20
    assert central_window(counts) == slice(100, 200)
    single = np.array([0, 7, 0])
    assert central_window(single) == slice(1, 2)


def test_rmse_and_floor_use_the_window_and_residuals_their_variance():
    data, model = np.array([9.0, 1.0, 2.0]), np.array([0.0, 1.0, 4.0])
    assert rmse(data, model, slice(1, 3)) == pytest.approx(np.sqrt(2.0))
    assert noise_floor(np.array([100.0, 1.0, 3.0]), slice(1, 3)) == pytest.approx(np.sqrt(2.0))
    found = normalised_residuals(data, model, np.array([9.0, 0.0, 4.0]))
    np.testing.assert_allclose(found, [3.0, np.nan, -1.0])


def test_chi_square_leaves_out_bins_with_few_samples():
    data, model = np.array([1.1, 0.03, 0.9, 0.5]), np.array([1.0, 0.02, 1.0, 0.4])
    variance = np.array([0.008, 0.001, 0.01, 0.0])
    found = chi_square(data, model, variance, np.array([110, 3, 90, 50]))
    assert found["dof"] == 2
    assert found["value"] == pytest.approx(0.01 / 0.008 + 0.01 / 0.01)
    assert found["p"] == pytest.approx(np.exp(-0.5 * found["value"]))  # of two degrees of freedom
