"""The line through the exposures of a pixel, against numpy's least squares and by its pulls."""

import numpy as np
import pytest

from pchem_pipeline.model.maps.exposure_series import exposure_line

TIMES = np.array([0.5, 1.0, 2.0, 4.0])


def test_equal_independent_errors_are_ordinary_least_squares():
    rng = np.random.default_rng(1)
    exposures = 5.0 + 0.1 * TIMES + 0.01 * rng.standard_normal((3, 4))
    found = exposure_line(exposures, np.tile(1e-4 * np.eye(4), (3, 1, 1)), np.full((3, 4), 1e-4), TIMES)
    for pixel in range(3):
        slope, offset = np.polyfit(TIMES, exposures[pixel], 1)
        assert found.slope[pixel] == pytest.approx(slope, rel=0.01)
        assert found.offset[pixel] == pytest.approx(offset, rel=0.001)
    np.testing.assert_allclose(
        found.residual, exposures - found.slope[:, None] * TIMES - found.offset[:, None]
    )
    assert found.dof == 2


def test_an_error_that_all_exposures_share_goes_into_the_offset():
    rng = np.random.default_rng(2)
    n, shared = 4000, 0.2
    own = np.sqrt((1.05 + 0.3 * TIMES) / 2000)
    exposures = 1.05 + 0.3 * TIMES + own * rng.standard_normal((n, 4)) + shared * rng.standard_normal((n, 1))
    covariance = np.tile(np.diag(own**2) + shared**2, (n, 1, 1))
    found = exposure_line(exposures, covariance, np.tile(own**2, (n, 1)), TIMES)
    pull = (found.slope - 0.3) / np.sqrt(found.covariance[:, 0, 0])
    assert abs(pull.mean()) < 5 / np.sqrt(n)
    assert abs(pull.std() - 1) < 5 / np.sqrt(2 * n)
    # unaware of the shared error, the slope would be weighed wrongly: its error is far below the shared one
    assert np.sqrt(found.covariance[:, 0, 0]).max() < 0.1 * shared < np.sqrt(found.covariance[:, 1, 1]).min()
    assert abs(found.chi2.mean() - 2) < 5 * 2 / np.sqrt(n)
    spread = (found.residual / found.residual_stderr).std(axis=0)
    assert (np.abs(spread - 1) < 5 / np.sqrt(2 * n)).all()


def test_small_exposures_do_not_claim_too_much_weight():
    # with variances at the estimates, low estimates weigh most and the slope is biased low
    rng = np.random.default_rng(3)
    n, frames = 20_000, 400
    exposures = rng.poisson(0.02 * TIMES * frames, (n, 4)) / frames
    variance = np.maximum(exposures, 1e-4) / frames
    found = exposure_line(exposures, np.einsum("nj,jk->njk", variance, np.eye(4)), variance, TIMES)
    error = found.slope.std() / np.sqrt(n)
    weights = 1 / np.maximum(exposures, 1e-4)
    naive = (weights * exposures / TIMES).sum(axis=1) / weights.sum(axis=1)
    assert abs(naive.mean() - 0.02) > 20 * error
    assert abs(found.slope.mean() - 0.02) < 0.1 * found.slope.std()


def test_pixels_without_exposures_and_two_samples():
    exposures = np.array([[1.0, 2.0], [np.nan, 2.0]])
    found = exposure_line(exposures, np.tile(0.01 * np.eye(2), (2, 1, 1)), np.full((2, 2), 0.01), [1.0, 3.0])
    assert found.slope[0] == pytest.approx(0.5)
    assert found.offset[0] == pytest.approx(0.5)
    assert np.isnan(found.slope[1])
    assert np.isnan(found.p).all()
    assert found.residual_stderr[0].tolist() == [0.0, 0.0]


def test_equal_times_give_no_line():
    with pytest.raises(ValueError, match="two different"):
        exposure_line(np.ones((1, 2)), np.ones((1, 2, 2)), np.ones((1, 2)), [1.0, 1.0])
