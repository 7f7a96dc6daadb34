"""Density, quantised mass and draws of the PCD."""

import numpy as np
import pytest
from helpers.plain_law import pcd_mass
from scipy.stats import norm

from pchem_pipeline.model.law.pcd import log_pcd, pcd

CASES = [
    (0.05, 0.1, 50.2, 3.0),
    (2.0, 0.09, 100.0, 3.4),
    (15.0, 0.07, -20.0, 6.0),
    (3.0, 1.0, 0.0, 2.5),
    (80.0, 0.1, 7.0, 2.0),
]


@pytest.mark.parametrize("theta", CASES)
def test_density_has_the_moments_of_its_cumulants(theta: tuple[float, float, float, float]) -> None:
    exposure, gain, bias, sigma = theta
    mean, variance = bias + exposure / gain, sigma**2 + exposure / gain**2
    third, fourth = exposure / gain**3, exposure / gain**4
    x = np.linspace(mean - 14 * np.sqrt(variance), mean + 40 * np.sqrt(variance), 200_001)
    weight = pcd(x, *theta) * (x[1] - x[0])
    d = x - (weight @ x)
    assert weight.sum() == pytest.approx(1, abs=1e-10)
    assert weight @ x == pytest.approx(mean, rel=1e-10)
    assert weight @ d**2 == pytest.approx(variance, rel=1e-9)
    assert weight @ d**3 == pytest.approx(third, rel=1e-7)
    assert weight @ d**4 - 3 * (weight @ d**2) ** 2 == pytest.approx(fourth, rel=1e-6, abs=1e-6 * variance**2)


def test_without_electrons_it_is_a_gaussian() -> None:
    x = np.linspace(-30, 30, 13)
    np.testing.assert_allclose(log_pcd(x, 0.0, 0.1, 1.0, 2.5), norm.logpdf(x, 1.0, 2.5), rtol=1e-14)


def test_far_tails_do_not_underflow() -> None:
    assert log_pcd(-1000.0, 2.0, 0.1, 0.0, 3.0) == pytest.approx(norm.logpdf(-1000, 0, 3) - 2.0, rel=1e-12)
    assert np.isfinite(log_pcd(1e5, 2.0, 0.1, 0.0, 3.0))


def test_bad_parameters_give_nan_not_an_error() -> None:
    assert np.isnan(
        log_pcd(0.0, [-1.0, 1.0, 1.0, np.nan], [0.1, 0.0, 0.1, 0.1], 0.0, [3.0, 3.0, -1.0, 3.0])
    ).all()


def test_mass_is_the_integral_of_the_density() -> None:
    fine = np.linspace(-0.5, 0.5, 2001)
    x = np.arange(80, 150)
    sigma = 0.3 / 0.09
    integral = np.trapezoid(pcd(x[:, None] + fine, 1.5, 0.09, 100.2, sigma), fine, axis=1)
    np.testing.assert_allclose(pcd_mass(x, 1.5, 0.09, 100.2, 0.3), integral, atol=1e-9)


def test_mass_without_noise_is_shared_by_the_cells_beside_and_of_no_parameters_is_nan() -> None:
    """A comb of 2 DN per electron that begins half-way between 0 and 1 DN."""
    np.testing.assert_allclose(
        pcd_mass([0, 1, 2, 3], 1.0, 0.5, 0.5, 0.0), np.exp(-1) * np.array([0.5, 0.5, 0.5, 0.5]), rtol=1e-12
    )
    np.testing.assert_array_equal(np.isnan(pcd_mass(100, [np.nan, 1.0], 0.1, 100.0, 0.3)), [True, False])
