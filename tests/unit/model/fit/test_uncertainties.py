"""Standard errors, sandwich errors and profile intervals against independent computations."""

import numpy as np
import pytest
from helpers.drawn_pixels import draw
from iminuit import Minuit
from scipy.stats import false_discovery_control

from pchem_pipeline.base.variables import INTERVALS, interval_names
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.model.arithmetic.statistics import false_discovery, misfit, poorest
from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, curve_errors
from pchem_pipeline.model.errors.expected_information import correlations, covariance_from
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.pcd import log_pcd, pcd_posterior
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile

CASES = [(2.0, 11.0, 0.3), (0.15, 9.0, 0.2), (1.5, 12.0, 0.46)]
N = 3000


def fitted(case, level):
    """Return a pixel, its fit and the ends of its profile intervals."""
    pixel = draw(np.random.default_rng(3), *case, n_frames=N)
    settings = FitSettings(tolerance=1e-12, intervals="profile", interval_level=level)
    fit = fit_histograms(pixel.counts, pixel.origin, settings=settings)
    return pixel, fit.columns[0], fit.intervals[0]


def minuit(pixel, start, plain):
    """Return iminuit at the maximum; ``plain`` makes H, g, mu and sigma of its own parameters."""
    codes = np.flatnonzero(pixel.counts[0])
    x, c = (pixel.origin[0] + codes).astype(float), pixel.counts[0, codes]
    found = Minuit(lambda *own: -float(c @ log_pcd(x, *plain(*own))), *start, name=("h", "g", "mu", "s"))
    found.errordef = Minuit.LIKELIHOOD
    found.tol = 1e-4
    return found.migrad()


@pytest.mark.parametrize("case", CASES)
def test_intervals_are_those_of_minuit(case):
    pixel, at, ends = fitted(case, 0.6827)
    found = minuit(pixel, at, lambda *theta: theta).minos(cl=0.6827)
    for place, name in enumerate(("h", "g", "mu", "s")):
        other = found.merrors[name]
        width = ends[place, 1] - ends[place, 0]
        np.testing.assert_allclose(ends[place] - at[place], (other.lower, other.upper), atol=0.01 * width)


def test_the_interval_of_the_noise_in_electrons_is_a_profile_too():
    pixel, at, ends = fitted(CASES[2], 0.95)
    noise_e = at[1] * at[3]
    found = minuit(pixel, (*at[:3], noise_e), lambda h, g, mu, noise: (h, g, mu, noise / g))
    other = found.minos("s", cl=0.95).merrors["s"]
    np.testing.assert_allclose(ends[-1] - noise_e, (other.lower, other.upper), rtol=0.02)
    # and it is far from symmetric here: standard errors would not do
    assert (other.upper + other.lower) / (other.upper - other.lower) > 0.02


@pytest.mark.parametrize("law", [SampleLaw(), SampleLaw().with_noise([0.5, 0.5], shift_e=[0.0, 0.5])])
def test_variance_of_a_curve_follows_from_its_slopes(law):
    rng = np.random.default_rng(5)
    pixels = np.array([[0.3, 0.4, 100.2, 0.9], [6.0, 0.11, 99.0, 3.0]])
    roots = rng.standard_normal((2, 4, 4)) * (0.1 * pixels)[:, :, None]
    covariance = roots @ np.swapaxes(roots, 1, 2)
    covariance[1, 2] = covariance[1, :, 2] = np.nan  # the bias was held by a bound
    dn, nuced = DnAxis(85, 60), NucedAxis(0.2, -3, 40)
    found = curve_errors(law, UsablePixels(*np.ascontiguousarray(pixels.T)), covariance, dn, nuced)
    expected = np.zeros(60), np.zeros(40)
    for at, known in zip(pixels, np.nan_to_num(covariance), strict=True):
        near = at + 1e-6 * np.stack([np.diag(at), -np.diag(at)])  # up and down, (2, step, parameter)
        up, down = (sample_mass(law, each.T, dn.dn) for each in near)
        slopes = (up - down) / (2e-6 * at[:, None])
        place = np.floor((dn.dn - at[2]) * at[1] / nuced.width + 0.5).astype(int) + 3
        inside = (place >= 0) & (place < 40)
        in_bins = [np.bincount(place[inside], each[inside], 40) for each in slopes]
        for sums, each in zip(expected, (slopes, np.array(in_bins)), strict=True):
            sums += np.einsum("ix,ij,jx->x", each, known, each)
    for sums, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(sums, wanted, rtol=1e-4, atol=1e-8 * wanted.max())


def test_covariance_is_six_correlations_and_four_errors():
    root = np.random.default_rng(2).standard_normal((3, 4, 4))
    covariance = root @ np.swapaxes(root, 1, 2)
    covariance[2, 0] = covariance[2, :, 0] = np.nan
    stderr = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    correlation = correlations(covariance)
    assert correlation.shape == (3, 6)
    np.testing.assert_allclose(covariance_from(stderr, correlation), covariance, rtol=1e-12)


def test_false_discoveries_are_those_of_scipy():
    p = np.random.default_rng(5).random((6, 7)) ** 3
    np.testing.assert_allclose(false_discovery(p), false_discovery_control(p, axis=None).reshape(6, 7))
    p[2, 3] = np.nan
    q = false_discovery(p)
    assert np.isnan(q[2, 3])
    np.testing.assert_allclose(q[np.isfinite(q)], false_discovery_control(p[np.isfinite(p)]))
    assert np.isnan(false_discovery(np.full(3, np.nan))).all()


def test_the_poorest_come_first_even_where_p_is_zero():
    chi2 = np.array([[50.0, 9000.0], [7000.0, 60.0]])
    dof = np.array([[50.0, 50.0], [50.0, 0.0]])
    assert poorest(chi2, dof, 5) == [(0, 1), (1, 0), (0, 0)]
    assert np.isnan(misfit(chi2, dof)[1, 1])
    assert abs(misfit(np.array([49.33]), np.array([50.0]))[0]) < 0.01


def test_settings_bring_intervals_and_sandwich_errors_into_the_store():
    pixels = draw(np.random.default_rng(9), np.full(4, 1.5), 11.0, 0.3, n_frames=N)
    histogram = {"counts": pixels.counts[None], "origin": pixels.origin[None].astype(np.int32)}
    histogram |= {name: np.zeros((1, 4), np.uint32) for name in ("under", "over")}
    plain = fit_tile([histogram], TileFit())["fit"]
    settings = FitSettings(intervals="profile", errors="sandwich", interval_level=0.95)
    full = fit_tile([histogram], TileFit(settings))["fit"]
    for name in INTERVALS:
        low, high = (full[path][0] for path in interval_names(name))
        middle = full[name][0] if name in full else full["conversion_gain"][0] * full["read_noise_dn"][0]
        assert (low < middle).all()
        assert (middle < high).all()
        assert f"{name}_low" not in plain
    fit, middle = fit_histograms(pixels.counts, pixels.origin), np.zeros((4, 4, 4))
    for i, (h, g, mu, sigma) in enumerate(fit.columns):
        codes = np.flatnonzero(pixels.counts[i])
        given = pcd_posterior(pixels.origin[i] + codes, h, g, mu, sigma)
        charge, shift = given.k / h - 1, -given.ke / (g * sigma) ** 2
        score = np.stack([charge, shift, given.e / sigma**2, (given.ee / sigma**2 - 1) / sigma])
        middle[i] = score * pixels.counts[i, codes] @ score.T
    sandwich = fit.covariance @ middle @ fit.covariance
    np.testing.assert_allclose(full["bias_stderr"][0], np.sqrt(sandwich[:, 2, 2]), rtol=1e-5)
    assert (full["bias_stderr"] != plain["bias_stderr"]).all()
    np.testing.assert_array_equal(full["bias"], plain["bias"])
    # with effects it is the profile of their law
    how = TileFit(FitSettings(intervals="profile"), effects=[RowNoise(row_noise_dn=1.0)])
    with_noise = fit_tile([histogram], how)["fit"]
    assert (with_noise["bias_low"] < with_noise["bias"]).all()
    assert (with_noise["bias"] < with_noise["bias_high"]).all()
    assert (with_noise["read_noise_dn_high"] < full["read_noise_dn"]).all()
