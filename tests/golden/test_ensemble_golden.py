"""Ensemble formulas against mpmath and scipy, along ways that the package does not take."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.special import roots_genlaguerre
from scipy.stats import nbinom

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import DnAxis, electron_pmf, ensemble_sums
from pchem_pipeline.model.ensemble.ensemble_binned import HistogramChoice, epcd_independent
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw


@pytest.mark.parametrize("k", [0, 1, 4, 9])
def test_electron_mass_from_the_moment_generating_function(k: int) -> None:
    # second form of eq. K_ensemble_pmf: (-1)^k / k! d^k/dt^k M_H(-t) at t = 1
    exposure = [0.2, 1.7, 3.1, 6.5]
    with mpmath.workdps(40):
        derivative = mpmath.diff(lambda t: mpmath.fsum(mpmath.exp(-t * h) for h in exposure) / 4, 1, k)
        expected = float((-1) ** k * derivative / mpmath.factorial(k))
    assert electron_pmf(np.array(exposure), 10)[k] == pytest.approx(expected, rel=1e-12)


def test_electron_mass_of_a_gamma_exposure_is_negative_binomial() -> None:
    # Gauss-Laguerre nodes and weights of the gamma density as cells, for which the mixture is known
    shape, scale = 3.0, 0.8
    nodes, weights = roots_genlaguerre(60, shape - 1)
    mass = electron_pmf(nodes * scale, 20, weights / weights.sum())
    np.testing.assert_allclose(mass, nbinom.pmf(np.arange(20), shape, 1 / (1 + scale)), rtol=1e-9)


def test_density_of_one_pixel_to_forty_digits() -> None:
    h, g, mu, sigma = 2.3, 0.11, 98.7, 2.9
    pixels = UsablePixels(*(np.array([v]) for v in (h, g, mu, sigma)))
    found = ensemble_sums(pixels, DnAxis(80, 120)).raw / len(pixels)
    independent = epcd_independent(pixels, DnAxis(80, 120), HistogramChoice())
    with mpmath.workdps(40):
        for i in (0, 7, 19, 44, 80, 119):
            expected = mpmath.nsum(
                lambda k, i=i: mpmath.exp(-h) * mpmath.mpf(h) ** k / mpmath.factorial(k)
                * mpmath.npdf(80 + i, mu + k / mpmath.mpf(g), sigma),
                [0, 80],
            )  # fmt: skip
            assert found[i] == pytest.approx(float(expected), rel=1e-11)
            assert independent[i] == pytest.approx(float(expected), abs=2e-15)


def test_error_rate_without_rounding_is_the_bit_error_rate() -> None:
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
