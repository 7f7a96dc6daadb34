"""Appendices A and B: moments of the ensemble and widths of its components."""

import numpy as np
import pytest
from helpers.drawn_pixels import unlike_pixels
from scipy.stats import poisson

from pchem_pipeline.model.ensemble.components import (
    COMPONENT_CASES,
    bias_weight,
    component_widths,
    moment_errors,
    predicted_moments,
)
from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, PixelErrors, curve_errors
from pchem_pipeline.model.errors.expected_information import covariance_from
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw


def brute_width(h, g, mu, s2, k):
    """E and Var of E | K_e = k as the appendix writes them."""
    weight = np.exp(-h) * h**k
    first = np.mean(weight * (mu + k / g)) / np.mean(weight)
    second = np.mean(weight * (s2 + (mu + k / g) ** 2)) / np.mean(weight)
    return float(first), float(second - first**2)


def test_every_case_is_that_of_maps_held_constant():
    pixels = unlike_pixels(500)
    result = component_widths(pixels, 12)
    h, g, mu, sigma = pixels.maps
    maps = {"H": h, "g": g, "mu": mu, "sigma2": sigma**2}
    for row, case in enumerate(COMPONENT_CASES):
        held = [np.full(500, v.mean()) if name in case else v for name, v in maps.items()]
        expected = [brute_width(*held, k)[1] for k in range(12)]
        np.testing.assert_allclose(result["component_variance"][row], expected, rtol=1e-8, err_msg=str(case))
    expected = [brute_width(*maps.values(), k)[0] for k in range(12)]
    np.testing.assert_allclose(result["component_mean"][:12], expected, rtol=1e-12)
    weight = poisson.pmf(np.arange(12)[:, None], h)
    expected = weight @ pixels.read_noise_e**2 / weight.sum(axis=1)
    np.testing.assert_allclose(result["nuced_component_variance"][:12], expected, rtol=1e-11)


def test_widths_survive_hot_pixels_many_electrons_and_none():
    columns = np.array([[0.0, 2.0, 900.0], [0.1, 0.2, 0.1], [90.0, 100.0, 110.0], [1.0, 1.0, 1.0]])
    result = component_widths(UsablePixels(*columns), 1500)
    assert np.isfinite(result["component_variance"]).all()
    assert result["component_mean"][0] == pytest.approx((90 + np.exp(-2) * 100) / (1 + np.exp(-2)))
    assert result["component_mean"][1400] == pytest.approx(110 + 1400 / 0.1)
    none = component_widths(UsablePixels(*np.outer((0.0, 0.1, 100.0, 3.0), np.ones(3))), 2)
    assert none["component_variance"][0, 0] == pytest.approx(9.0)
    assert np.isnan(none["component_mean"][1])


def test_moments_are_those_of_the_mixture():
    pixels = unlike_pixels(300)
    h, g, mu, sigma = pixels.maps
    k = np.arange(120)
    weight = poisson.pmf(k, h[:, None]) / 300
    found = predicted_moments(pixels)
    cases = ("", mu[:, None] + k / g[:, None], sigma, 1e-9), ("nuced_", k, g * sigma, 1e-10)
    for prefix, centre, noise, near in cases:
        mean = np.sum(weight * centre)
        variance = np.sum(weight * (centre**2 + noise[:, None] ** 2)) - mean**2
        assert found[f"{prefix}mean"] == pytest.approx(mean, rel=1e-11)
        assert found[f"{prefix}variance"] == pytest.approx(variance, rel=near)
    terms = ("variance_of_bias", "variance_of_signal", "mean_read_variance", "mean_shot_variance")
    assert found["variance"] == pytest.approx(sum(found[name] for name in (*terms, "bias_signal_covariance")))


def test_pixels_whose_bias_may_be_an_electron_off_do_not_count():
    pixels, doubtful = unlike_pixels(300), np.arange(300) < 60
    h, g, mu, sigma = pixels.maps
    wrong = UsablePixels(h + doubtful, g, mu - doubtful / g, sigma)
    weight = bias_weight(np.where(doubtful, 0.0, np.inf))
    kept = pixels.of(~doubtful)
    wrong.maps[0][doubtful] = 300.0  # far more electrons than any that counts
    expected, found = component_widths(kept, 400), component_widths(wrong, 400, weight)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-10)
    right = predicted_moments(kept)["variance_of_bias"]
    assert predicted_moments(wrong, weight)["variance_of_bias"] == pytest.approx(right)
    assert predicted_moments(wrong)["variance_of_bias"] > 1.1 * right
    # of many with a rival at 1 nat as many are wrong as its posterior says: Var(mu) is right on average
    rng, weight = np.random.default_rng(4), bias_weight(np.full(20_000, 1.0))
    bias = 100.0 + rng.standard_normal(20_000) + 10.0 * (rng.random(20_000) < 1.0 / (1.0 + np.e))
    many = UsablePixels(*np.outer((2.0, 0.1), np.ones(20_000)), bias, np.full(20_000, 3.0))
    found = predicted_moments(many, weight)["variance_of_bias"]
    # 1 DN^2; a share p of 10 DN scatters by its binomial error
    assert found == pytest.approx(1.0, abs=4 * 100 * 0.46 * np.sqrt(0.27 * 0.73 / 20_000))
    assert bias.var() > 15.0
    np.testing.assert_allclose(bias_weight(np.array([0.0, np.log(3.0), np.nan])), [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(bias_weight(np.zeros(3)), 1.0)  # nothing else to go by


def test_moment_errors_of_equal_poisson_pixels():
    # g = 1 and hardly any noise: mean and variance of n Poisson(H) counts, known in closed form
    ones = np.ones(50)
    errors = moment_errors(UsablePixels(4.0 * ones, ones, 0.0 * ones, 1e-6 * ones), 200)
    n = 50 * 200
    assert errors["mean"] == pytest.approx(np.sqrt(4.0 / n))
    assert errors["variance"] == pytest.approx(np.sqrt((4.0 + 2 * 16.0) / n))
    assert errors["nuced_variance"] == pytest.approx(errors["variance"])


def test_moment_errors_are_those_of_repeated_captures():
    pixels, rng, n = unlike_pixels(600), np.random.default_rng(14), 400
    h, g, mu, sigma = pixels.maps
    moments = []
    for _ in range(n):
        signal = rng.poisson(h, (20, 600)) / g
        frames = np.rint(mu + signal + np.sqrt(sigma**2 - 1 / 12) * rng.standard_normal(signal.shape))
        nuced = (frames - mu) * g
        moments.append([frames.mean(), frames.var(), nuced.mean(), nuced.var()])
    stated = [*moment_errors(pixels, 20).values()]
    # relative standard error of a standard deviation: 1/sqrt(2 (n - 1))
    np.testing.assert_allclose(np.std(moments, axis=0, ddof=1) / stated, 1.0, atol=5.0 / np.sqrt(2 * (n - 1)))


N, FRAMES = 40_000, 600


@pytest.fixture(scope="module")
def sensor():
    """Errors as the samples allow; of one pixel in 200 from ten to a hundred times larger."""
    rng = np.random.default_rng(11)
    h, g = rng.lognormal(0.7, 0.3, N), 0.09 * rng.lognormal(0.0, 0.05, N)
    pixels = UsablePixels(h, g, rng.normal(100, 4, N), 3.3 * rng.lognormal(0, 0.1, N))
    sigma = pixels.read_noise_dn
    slopes = np.stack([np.sqrt(h), g**2 * sigma / np.sqrt(h * (1 + h)), sigma, sigma / np.sqrt(2)], axis=1)
    stderr = slopes / np.sqrt(FRAMES) * np.where(rng.random(N) < 0.005, rng.uniform(10, 100, N), 1.0)[:, None]
    stderr[rng.random(N) < 0.01] = np.nan
    return pixels, PixelErrors(stderr, rng.uniform(-0.3, 0.3, (N, 6)), np.arange(N))


def test_some_pixels_give_the_same_errors_within_theirs(sensor):
    pixels, errors = sensor
    law, axes = SampleLaw(), (DnAxis(80, 120), NucedAxis(0.09, -10, 120))
    every, of_all = errors.sampled(pixels, np.full(N, FRAMES))  # where they are few
    assert every.all()
    np.testing.assert_array_equal(of_all, covariance_from(errors.stderr, errors.correlation))
    exact = curve_errors(law, pixels, of_all, *axes)
    few = PixelErrors(errors.stderr, errors.correlation, errors.place, 0.1)
    some, covariance = few.sampled(pixels, np.full(N, FRAMES))
    found = curve_errors(law, pixels.of(some), covariance, *axes)
    # ordinary pixels one in ten, nearly all of the others (one in a hundred has no errors to add)
    assert 0.1 * N < some.sum() < 0.13 * N
    # variances of the ordinary scatter by no more than twice their mean; of a standard error it is half
    limit = 5 * 0.5 * 2.0 / np.sqrt(some.sum())
    for sums, whole in zip(found, exact, strict=True):
        seen = whole > 1e-3 * whole.max()
        np.testing.assert_allclose(np.sqrt(sums[seen] / whole[seen]), 1.0, atol=limit)
    # every tenth pixel alike, the bad ones left to chance, would miss it
    rng = np.random.default_rng(1)
    plain = rng.random(N) < 0.1
    raw, _ = curve_errors(law, pixels.of(plain), 10 * of_all[plain], *axes)
    seen = exact[0] > 1e-3 * exact[0].max()
    assert np.abs(np.sqrt(raw[seen] / exact[0][seen]) - 1.0).max() > limit


def test_which_pixels_are_taken_depends_on_no_tile(sensor):
    pixels, errors = sensor
    few = PixelErrors(errors.stderr, errors.correlation, errors.place, 0.2)
    whole, _ = few.sampled(pixels, np.full(N, FRAMES))
    apart = np.zeros(N, bool)
    for part in (np.arange(N) % 3 == i for i in range(3)):
        apart[part] = few.of(part).sampled(pixels.of(part), np.full(part.sum(), FRAMES))[0]
    np.testing.assert_array_equal(apart, whole)
