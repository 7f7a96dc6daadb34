"""Some pixels stand for all where the errors of the predicted curves are summed."""

import numpy as np
import pytest

from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, curve_errors
from pchem_pipeline.model.ensemble.error_sample import PixelErrors
from pchem_pipeline.model.errors.fisher import covariance_from
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

N, FRAMES = 40_000, 600


@pytest.fixture(scope="module")
def sensor() -> tuple[UsablePixels, PixelErrors]:
    """Errors as the samples allow; of one pixel in 200 from ten to a hundred times larger."""
    rng = np.random.default_rng(11)
    h, g = rng.lognormal(0.7, 0.3, N), 0.09 * rng.lognormal(0.0, 0.05, N)
    pixels = UsablePixels(h, g, rng.normal(100, 4, N), 3.3 * rng.lognormal(0, 0.1, N))
    sigma = pixels.read_noise_dn
    slopes = np.stack([np.sqrt(h), g**2 * sigma / np.sqrt(h * (1 + h)), sigma, sigma / np.sqrt(2)], axis=1)
    stderr = slopes / np.sqrt(FRAMES) * np.where(rng.random(N) < 0.005, rng.uniform(10, 100, N), 1.0)[:, None]
    stderr[rng.random(N) < 0.01] = np.nan
    return pixels, PixelErrors(stderr, rng.uniform(-0.3, 0.3, (N, 6)), np.arange(N))


def test_all_pixels_are_taken_where_they_are_few(sensor: tuple[UsablePixels, PixelErrors]) -> None:
    pixels, errors = sensor
    some, covariance = errors.sampled(pixels, np.full(N, FRAMES))
    assert some.all()
    np.testing.assert_array_equal(covariance, covariance_from(errors.stderr, errors.correlation))


def test_some_pixels_give_the_same_errors_within_theirs(sensor: tuple[UsablePixels, PixelErrors]) -> None:
    pixels, errors = sensor
    law, axes = SampleLaw(), (DnAxis(80, 120), NucedAxis(0.09, -10, 120))
    exact = curve_errors(law, pixels, covariance_from(errors.stderr, errors.correlation), *axes)
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
    raw, _ = curve_errors(
        law, pixels.of(plain), 10 * covariance_from(errors.stderr[plain], errors.correlation[plain]), *axes
    )
    seen = exact[0] > 1e-3 * exact[0].max()
    assert np.abs(np.sqrt(raw[seen] / exact[0][seen]) - 1.0).max() > limit


def test_which_pixels_are_taken_depends_on_no_tile(sensor: tuple[UsablePixels, PixelErrors]) -> None:
    pixels, errors = sensor
    few = PixelErrors(errors.stderr, errors.correlation, errors.place, 0.2)
    whole, _ = few.sampled(pixels, np.full(N, FRAMES))
    parts = [np.arange(N) % 3 == i for i in range(3)]
    apart = np.zeros(N, bool)
    for part in parts:
        apart[part] = few.of(part).sampled(pixels.of(part), np.full(part.sum(), FRAMES))[0]
    np.testing.assert_array_equal(apart, whole)
