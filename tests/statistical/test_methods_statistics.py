"""Each method is right where its assumptions hold, as well as theory says, and fails where theory says so.

Limits are five standard errors of the simulation; each failure sought is more than twenty of them.
"""

import numpy as np
import pytest
from helpers.plain_law import pcd_mass

from pchem_pipeline.methods.base import PixelSamples, Sample, methods
from pchem_pipeline.methods.photon_transfer import gain_variance
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.errors.expected_information import (
    expected_information,
    inverse_information,
    shared_information,
)
from pchem_pipeline.model.law.mass import draw_histograms

GAIN, N = 1 / 11, 4000


def pixels(exposures, noise, n_pixels, n_frames=N, seed=1, gain=GAIN):
    rng = np.random.default_rng([seed, round(1000 * noise), *(round(100 * h) for h in exposures)])
    bias = 100 + rng.random(n_pixels)
    drawn = [draw_histograms(rng, h, gain, bias, noise, n_frames) for h in exposures]
    return PixelSamples(tuple(Sample(d.counts, d.origin) for d in drawn)), drawn[0].truth


def log_errors(name, given, truth, settings=None):
    """ln(g / g_true) of the pixels with an answer."""
    found = methods()[name].estimate(given, settings or MethodsSettings()).parameters
    errors = np.log(found[:, 1] / truth[:, 1])
    return errors[np.isfinite(errors)], found


def assert_sd(values, expected):
    """The standard deviation of n normal values scatters by 1 / sqrt(2 n)."""
    assert abs(values.std(ddof=1) / expected - 1) < 5 / np.sqrt(2 * values.size)


def assert_mean_zero(values, second_order):
    """The mean is 0 within five standard errors and the second order of the delta method."""
    assert abs(values.mean()) < 5 * values.std(ddof=1) / np.sqrt(values.size) + second_order


@pytest.mark.parametrize("noise", [0.2, 0.5, 0.9])
def test_photon_transfer_errs_as_the_delta_method_says(noise):
    given, truth = pixels((2.0, 0.0), noise, 2000)
    errors, found = log_errors("photon_transfer", given, truth)
    variance = gain_variance(2.0, 0.0, noise, N, N)
    assert_sd(errors, np.sqrt(variance))
    assert_mean_zero(errors, variance)
    sigma = found[:, 3] / truth[:, 3] - 1
    assert_sd(sigma, np.sqrt(1 / (2 * N)))


def test_a_series_knows_the_gain_at_least_as_well_as_its_ends():
    lights = (6.0, 0.0, 1.5, 3.0)
    given, truth = pixels(lights, 0.6, 1500)
    errors, _ = log_errors("photon_transfer_series", given, truth)
    ends = PixelSamples(given.samples[:2])
    pair, _ = log_errors("photon_transfer", ends, truth)
    assert_mean_zero(errors, errors.var())
    # paired: the middle samples add information
    assert errors.std() < pair.std()
    shared = N * sum(shared_information(h, 0.6) for h in lights)
    assert errors.std(ddof=1) > np.sqrt(inverse_information(shared)[0, 0]) * (1 - 5 / np.sqrt(3000))


def test_emva_gives_the_sensor_one_gain():
    """Right for equal pixels; where gains differ, every pixel errs by as much as it differs."""
    given, truth = pixels((2.0, 0.0), 0.3, 400)
    errors, _ = log_errors("emva1288", given, truth)
    assert np.ptp(errors) == 0
    assert abs(errors[0]) < 5 * np.sqrt(gain_variance(2.0, 0.0, 0.3, N, N) / 400)
    spread = 0.05 * np.random.default_rng(3).standard_normal(400)
    given, truth = pixels((2.0, 0.0), 0.3, 400, gain=GAIN * np.exp(spread))
    errors, _ = log_errors("emva1288", given, truth)
    assert errors.std() == pytest.approx(spread.std(), rel=1e-9)


@pytest.mark.parametrize(("exposure", "noise"), [(2.0, 0.3), (2.0, 0.6), (6.0, 0.4)])
def test_likelihood_with_a_dark_sample_beats_photon_transfer_and_no_bound(exposure, noise):
    given, truth = pixels((exposure, 0.0), noise, 200)
    errors, _ = log_errors("dark_and_bright_mle", given, truth, MethodsSettings(em_tolerance=1e-7))
    shared = N * (shared_information(exposure, noise) + shared_information(0.0, noise))
    bound = np.sqrt(inverse_information(shared)[0, 0])
    transfer = np.sqrt(gain_variance(exposure, 0.0, noise, N, N))
    width = 5 / np.sqrt(2 * errors.size)
    assert_mean_zero(errors, transfer**2)
    assert bound * (1 - width) < errors.std(ddof=1) < transfer * (1 + width)
    if noise < 0.5:
        assert errors.std(ddof=1) < 0.5 * transfer


def test_plain_em_ends_at_the_maximum():
    given, truth = pixels((2.0,), 0.25, 200)
    plain, _ = log_errors("plain_em", given, truth, MethodsSettings(em_tolerance=1e-9))
    full, _ = log_errors("pchem_em", given, truth)
    np.testing.assert_allclose(plain, full, atol=1e-5)


def expected_sample(exposure, noise, total=4_000_000_000):
    """A histogram without scatter: what infinitely many frames show."""
    x = np.arange(60, 60 + int((exposure + 12 * np.sqrt(exposure) + 14) * 11 + 80))
    mass = pcd_mass(x, exposure, GAIN, 100.3, np.sqrt(noise**2 - GAIN**2 / 12))
    counts = np.rint(total * mass / mass.sum() / 2).astype(np.uint32)
    return Sample(counts[None], np.array([60]))


def test_peaks_give_gain_and_noise_where_they_are_resolved():
    """Without scatter the method shows its own error: small at 0.2 e-, large at 0.35 e-, then no answer."""
    limits = {}
    for noise in (0.2, 0.35, 0.45, 0.55):
        one = PixelSamples((expected_sample(2.0, noise),))
        found = methods()["peak_valley"].estimate(one, MethodsSettings()).parameters[0]
        limits[noise] = np.log(found[1] / GAIN), found[1] * found[3] / noise - 1, found[0], found[2]
    assert (np.abs(np.subtract(limits[0.2], (0, 0, 2.0, 100.3))) < (2e-3, 0.02, 2e-3, 0.01)).all()
    assert abs(limits[0.35][0]) > 0.01
    assert limits[0.45][1] < -0.1
    assert np.isnan(limits[0.55]).all()
    errors, _ = log_errors("peak_valley", *pixels((2.0,), 0.2, 400))
    assert errors.size == 400
    assert abs(errors.mean() - limits[0.2][0]) < 5 * errors.std(ddof=1) / np.sqrt(400) + 1e-3
    bound = np.sqrt(inverse_information(N * expected_information(2.0, 0.2))[1, 1])
    assert errors.std(ddof=1) > bound


def cumulant_sd(exposure, noise, n_frames):
    """Asymptotic sd of ln(k3/k4) by its influence function, from the exact mass."""
    x = np.arange(-200.0, 400.0)
    mass = pcd_mass(x, exposure, GAIN, 0.3, np.sqrt(noise**2 - GAIN**2 / 12))

    def ratio(weights):
        weights = weights / weights.sum()
        e = x - weights @ x
        m2, m3, m4 = (weights @ e**p for p in (2, 3, 4))
        return np.log(m3 / (m4 - 3 * m2**2))

    assert mass.sum() == pytest.approx(1)
    # influence function by a small mass at each code
    step = 1e-7
    moved = [ratio((1 - step) * mass + step * unit) for unit in np.eye(x.size)]
    influence = (np.array(moved) - ratio(mass)) / step
    return np.sqrt(mass @ influence**2 / n_frames)


def test_cumulants_are_for_few_electrons():
    n_frames = 100_000
    given, truth = pixels((0.3,), 0.3, 600, n_frames=n_frames)
    errors, _ = log_errors("cumulants", given, truth)
    expected = cumulant_sd(0.3, 0.3, n_frames)
    assert_sd(errors, expected)
    assert_mean_zero(errors, expected**2)
    given, truth = pixels((8.0,), 0.3, 200)
    errors, _ = log_errors("cumulants", given, truth)
    bound = np.sqrt(inverse_information(N * expected_information(8.0, 0.3))[1, 1])
    assert np.sqrt(np.mean(errors**2)) > 50 * bound
