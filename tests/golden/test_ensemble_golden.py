"""Ensemble formulas against mpmath and scipy, along ways that the package does not take."""

import mpmath
import numpy as np
import pytest

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import DnAxis, weighted_mass
from pchem_pipeline.model.ensemble.ensemble_binned import HistogramChoice, epcd_independent
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_mass_of_one_pixel_to_forty_digits() -> None:
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
