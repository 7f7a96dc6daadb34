"""Fits, masses and error rates against iminuit and many digits."""

import mpmath
import numpy as np
import pytest
from helpers.drawn_pixels import draw
from iminuit import Minuit
from scipy.special import gammaln

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import DnAxis, weighted_mass
from pchem_pipeline.model.ensemble.ensemble_binned import HistogramChoice, epcd_independent
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.pcd import log_pcd
from pchem_pipeline.model.law.sample_law import SampleLaw

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


def test_mass_of_one_pixel_to_forty_digits():
    h, g, mu, sigma = 2.3, 0.11, 98.7, 2.9
    pixels = UsablePixels(*(np.array([v]) for v in (h, g, mu, sigma)))
    found = weighted_mass(pixels, DnAxis(80, 120), np.ones(1))
    independent = epcd_independent(pixels, DnAxis(80, 120), HistogramChoice())
    with mpmath.workdps(40):
        analog, at = mpmath.sqrt(sigma**2 - 1 / mpmath.mpf(12)), lambda k: mu + k / mpmath.mpf(g)
        for i in (0, 7, 19, 44, 80, 119):
            expected = mpmath.mpf(0)
            for k in range(80):
                inside = [mpmath.ncdf(80 + i + side, at(k), analog) for side in (-0.5, 0.5)]
                weight = mpmath.exp(-h) * mpmath.mpf(h) ** k / mpmath.factorial(k)
                expected += weight * (inside[1] - inside[0])
            assert found[i] == pytest.approx(float(expected), rel=1e-11)
            assert independent[i] == pytest.approx(float(expected), abs=2e-15)


def test_error_rate_without_rounding_is_the_bit_error_rate():
    # a fine ADC (1000 DN per electron) and s_e = 0.3: the error is that of the continuous thresholds
    h, s_e = 1.5, 0.3
    pixels = UsablePixels(*(np.array([v]) for v in (h, 1e-3, 50.0, s_e * 1e3)))
    with mpmath.workdps(30):
        correct = mpmath.mpf(0)
        for k in range(40):
            upper = mpmath.mpf(1) / 2 + s_e**2 * mpmath.log((k + 1) / mpmath.mpf(h))
            part = mpmath.ncdf(upper / s_e)
            if k:
                part -= mpmath.ncdf((-mpmath.mpf(1) / 2 + s_e**2 * mpmath.log(k / mpmath.mpf(h))) / s_e)
            correct += mpmath.exp(-h) * mpmath.mpf(h) ** k / mpmath.factorial(k) * part
        expected = float(1 - correct)
    # half a DN of rounding moves a threshold by 5e-4 e-, against which the error is stationary
    known = KnownPixels(pixels, SampleLaw())
    outcomes = number_tables(*known.codes(), known.exposure, known, detailed=True).outcomes(20)
    assert outcomes.error[0] == pytest.approx(expected, rel=1e-4)
