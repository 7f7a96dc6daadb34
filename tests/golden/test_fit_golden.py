"""Fits against iminuit, and the density against many digits."""

import mpmath
import numpy as np
import pytest
from helpers.drawn_pixels import draw
from iminuit import Minuit
from scipy.special import gammaln

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.pcd import log_pcd

CASES = [(2.0, 11.0, 0.3), (0.15, 9.0, 0.25), (7.0, 13.0, 0.4), (1.0, 10.0, 0.48)]


def _minimise(counts, x, start):
    k = np.arange(60)

    def cost(h, a, mu, sigma):
        log_terms = k * np.log(h) - h - gammaln(k + 1) - 0.5 * ((x[:, None] - mu - k * a) / sigma) ** 2
        top = log_terms.max(axis=1)
        log_density = top + np.log(np.exp(log_terms - top[:, None]).sum(axis=1))
        return -float(counts @ (log_density - np.log(sigma) - 0.5 * np.log(2 * np.pi)))

    minuit = Minuit(cost, h=start[0], a=1 / start[1], mu=start[2], sigma=start[3])
    minuit.errordef = Minuit.LIKELIHOOD
    minuit.limits["h"] = minuit.limits["a"] = minuit.limits["sigma"] = (1e-3, None)
    minuit.strategy = 2
    minuit.tol = 1e-6
    minuit.migrad()
    minuit.hesse()
    return minuit


@pytest.mark.parametrize("case", CASES)
def test_maximum_and_standard_errors_match_iminuit(case):
    pixel = draw(np.random.default_rng(21), *case)
    result = fit_histograms(pixel.counts, pixel.origin, settings=FitSettings(tolerance=1e-12))
    occupied = np.flatnonzero(pixel.counts[0])
    start = pixel.truth[0] * [1.02, 1.005, 1.001, 0.98]
    minuit = _minimise(
        pixel.counts[0][occupied].astype(float), pixel.origin[0] + occupied.astype(float), start
    )
    assert minuit.valid
    h, a, mu, sigma = minuit.values
    slope = np.array([1, -1 / a**2, 1, 1])
    covariance = np.array(minuit.covariance) * np.outer(slope, slope)
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((result.columns[0] - [h, 1 / a, mu, sigma]) / error, 0, atol=2e-3)
    np.testing.assert_allclose(
        result.covariance[0] / np.outer(error, error), covariance / np.outer(error, error), atol=5e-3
    )
    assert result.log_likelihood[0] == pytest.approx(-minuit.fval, abs=1e-5)
    assert result.log_likelihood[0] >= -minuit.fval - 1e-7  # never below the other program's maximum


@pytest.mark.parametrize(
    ("x", "h", "g", "mu", "sigma"),
    [
        (101.0, 2.0, 0.09, 95.3, 3.3),
        (40.0, 2.0, 0.09, 95.3, 3.3),
        (420.0, 0.02, 0.11, 95.3, 2.1),
        (900.0, 90.0, 0.1, 5.0, 3.0),
        (2.0, 7.0, 1.0, 0.0, 3.0),
    ],
)
def test_log_density_matches_many_digits(x, h, g, mu, sigma):
    with mpmath.workdps(50):
        terms = [
            mpmath.exp(-mpmath.mpf(h)) * mpmath.mpf(h) ** k / mpmath.factorial(k)
            * mpmath.npdf(x, mu + k / mpmath.mpf(g), sigma)
            for k in range(600)
        ]  # fmt: skip
        expected = float(mpmath.log(mpmath.fsum(terms)))
    assert float(log_pcd(x, h, g, mu, sigma)) == pytest.approx(expected, rel=2e-14)
