"""Fits against iminuit, and the density against many digits."""

import mpmath
import numpy as np
import pytest
from helpers.drawn_pixels import draw
from iminuit import Minuit
from scipy.special import logsumexp
from scipy.stats import norm, poisson

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.pcd import log_pcd

CASES = [(2.0, 11.0, 0.3), (0.15, 9.0, 0.25), (7.0, 13.0, 0.4), (1.0, 10.0, 0.48)]


@pytest.mark.parametrize("case", CASES)
def test_maximum_and_standard_errors_match_iminuit(case):
    pixel = draw(np.random.default_rng(21), *case)
    result = fit_histograms(pixel.counts, pixel.origin, settings=FitSettings(tolerance=1e-12))
    codes = np.flatnonzero(pixel.counts[0])
    x, n = (pixel.origin[0] + codes).astype(float), pixel.counts[0, codes]
    start = pixel.truth[0] * [1.02, 1.005, 1.001, 0.98]

    def cost(h, g, mu, sigma):
        k = np.arange(60)
        log_terms = poisson.logpmf(k, h) + norm.logpdf(x[:, None], mu + k / g, sigma)
        return -float(n @ logsumexp(log_terms, axis=1))

    minuit = Minuit(cost, *start)
    minuit.errordef = Minuit.LIKELIHOOD
    minuit.limits["h"] = minuit.limits["g"] = minuit.limits["sigma"] = (1e-3, None)
    minuit.strategy = 2
    minuit.tol = 1e-6
    minuit.migrad()
    minuit.hesse()
    assert minuit.valid
    covariance, error = np.array(minuit.covariance), np.array(minuit.errors)
    np.testing.assert_allclose((result.columns[0] - minuit.values) / error, 0, atol=2e-3)
    np.testing.assert_allclose((result.covariance[0] - covariance) / np.outer(error, error), 0, atol=5e-3)
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
