"""The ensemble predictions against simulated frames; every limit is five standard errors from theory."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.counting_noise import counting_variance
from helpers.plain_law import joint_mass

from pchem_pipeline.model.checks.residuals import noise_floor, rmse
from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.components import moment_errors, predicted_moments
from pchem_pipeline.model.ensemble.ensemble import (
    DnAxis,
    EnsembleSums,
    NucedAxis,
    mass_sums,
    nuced_axis,
    tally,
)
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

N_PIXELS, N_FRAMES = 600, 40
DN = DnAxis(40, 360)


def make_pixels() -> UsablePixels:
    rng = np.random.default_rng(11)
    z = rng.standard_normal(N_PIXELS)
    g = 0.1 * np.exp(0.05 * z)
    s_e = 0.305 * np.exp(0.08 * z + 0.08 * rng.standard_normal(N_PIXELS))
    h = 2.0 * np.exp(0.4 * rng.standard_normal(N_PIXELS))
    return UsablePixels(h, g, 100.0 + 4.0 * rng.standard_normal(N_PIXELS), s_e / g)


def draw(pixels: UsablePixels, n_frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Frames by eq. PCD_RV_definition, rounding included, and the electrons behind them."""
    h, g, mu, sigma = pixels.maps
    electrons = rng.poisson(h, size=(n_frames, len(pixels)))
    noise = np.sqrt(sigma**2 - 1 / 12) * rng.standard_normal(electrons.shape)
    return np.rint(mu + electrons / g + noise).astype(np.int64), electrons


def counts_of(frames: np.ndarray) -> np.ndarray:
    counts = np.zeros((frames.shape[1], DN.size), dtype=np.int64)
    np.add.at(counts, (np.arange(frames.shape[1])[None, :], frames - DN.start), 1)
    return counts


def probabilities(pixels: UsablePixels, axis: NucedAxis) -> tuple[np.ndarray, np.ndarray]:
    """Exact probability of each DN, and of each NUCed bin, of each pixel; shapes (n, bins)."""
    raw = np.empty((len(pixels), DN.size))
    nuced = np.empty((len(pixels), axis.size))
    for p, (h, g, mu, sigma) in enumerate(zip(*pixels.maps, strict=True)):
        raw[p] = joint_mass(DN.dn, h, g, mu, sigma, 80).sum(axis=0)
        place = np.floor((DN.dn - mu) * g / axis.width + 0.5).astype(int) - axis.start
        inside = (place >= 0) & (place < axis.size)
        nuced[p] = np.bincount(place[inside], weights=raw[p, inside], minlength=axis.size)
    return raw, nuced


def spread_of_mean_square(p: np.ndarray, n_frames: int, width: float) -> float:
    """Standard deviation of the mean square residual: binomial covariances, residuals nearly normal."""
    covariance = -(p.T @ p)
    covariance[np.diag_indices(p.shape[1])] += p.sum(axis=0)
    covariance /= n_frames * (p.shape[0] * width) ** 2
    return float(np.sqrt(2.0 * np.sum(covariance**2)) / p.shape[1])


def plain_sums(pixels: UsablePixels, dn: DnAxis, axis: NucedAxis) -> EnsembleSums:
    known = KnownPixels(pixels, SampleLaw())
    tables = number_tables(*known.codes(), known.exposure, known, detailed=True)
    return mass_sums(tables.mass, tables.first, tables.start, pixels, dn, axis)[0]


@pytest.fixture(scope="module")
def repeats() -> dict[str, np.ndarray]:
    """Mean square residuals of 40 captures: true model, and one with an exposure 10 % off."""
    pixels = make_pixels()
    axis = nuced_axis(pixels, DN)
    wrong = UsablePixels(
        pixels.quanta_exposure * 1.1, pixels.conversion_gain, pixels.bias, pixels.read_noise_dn
    )
    sums, off = plain_sums(pixels, DN, axis), plain_sums(wrong, DN, axis)
    rng = np.random.default_rng(12)
    found: dict[str, list[float]] = {"raw": [], "nuced": [], "raw_wrong": [], "nuced_wrong": []}
    for _ in range(40):
        frames, _ = draw(pixels, N_FRAMES, rng)
        result = tally(counts_of(frames), np.full(N_PIXELS, DN.start), pixels, DN, axis)
        n = frames.size
        raw, nuced = result.raw / n, result.nuced / n / axis.width
        found["raw"].append(rmse(raw, sums.raw / N_PIXELS) ** 2)
        found["nuced"].append(rmse(nuced, sums.nuced / N_PIXELS / axis.width) ** 2)
        found["raw_wrong"].append(rmse(raw, off.raw / N_PIXELS) ** 2)
        found["nuced_wrong"].append(rmse(nuced, off.nuced / N_PIXELS / axis.width) ** 2)
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize("kind", ["raw", "nuced"])
def test_rmse_of_the_true_model_is_at_the_noise_floor(kind: str, repeats: dict[str, np.ndarray]) -> None:
    pixels = make_pixels()
    axis = nuced_axis(pixels, DN)
    sums = plain_sums(pixels, DN, axis)
    raw, nuced = probabilities(pixels, axis)
    if kind == "raw":
        floor = noise_floor(counting_variance(sums.raw, sums.raw_square, N_PIXELS, N_FRAMES))
        spread = spread_of_mean_square(raw, N_FRAMES, 1.0)
    else:
        variance = counting_variance(sums.nuced, sums.nuced_square, N_PIXELS, N_FRAMES, axis.width)
        floor = noise_floor(variance)
        spread = spread_of_mean_square(nuced, N_FRAMES, axis.width)
    limit = 5.0 * spread / np.sqrt(40)
    assert abs(repeats[kind].mean() - floor**2) < limit
    assert limit < 0.2 * floor**2
    # an exposure wrong by 10 % must be seen, and with a wide margin
    assert repeats[f"{kind}_wrong"].mean() - floor**2 > 4 * limit


def test_moments_agree_with_the_sample_and_a_wrong_gain_would_not() -> None:
    pixels, n_frames = make_pixels(), 4000
    frames, _ = draw(pixels, n_frames, np.random.default_rng(13))
    counts = counts_of(frames)
    axis = nuced_axis(pixels, DN)
    data = tally(counts, np.full(N_PIXELS, DN.start), pixels, DN, axis)
    mean, variance = frames.mean(), frames.var()
    nuced_mean = data.nuced_sum / frames.size
    nuced_variance = data.nuced_sum_square / frames.size - nuced_mean**2
    expected, error = predicted_moments(pixels), moment_errors(pixels, n_frames)
    assert abs(mean - expected.mean) < 5 * error.mean
    assert abs(variance - expected.variance) < 5 * error.variance
    assert abs(nuced_mean - expected.nuced_mean) < 5 * error.nuced_mean
    assert abs(nuced_variance - expected.nuced_variance) < 5 * error.nuced_variance
    wrong = UsablePixels(
        pixels.quanta_exposure, pixels.conversion_gain * 1.02, pixels.bias, pixels.read_noise_dn
    )
    off = predicted_moments(wrong)
    assert abs(off.mean - mean) > 20 * error.mean
    assert abs(off.variance - variance) > 20 * error.variance


def test_moment_errors_are_those_of_repeated_captures() -> None:
    pixels, rng = make_pixels(), np.random.default_rng(14)
    error, n = moment_errors(pixels, 20), 400
    moments = []
    for _ in range(n):
        frames, _ = draw(pixels, 20, rng)
        nuced = (frames - pixels.bias) * pixels.conversion_gain
        moments.append([frames.mean(), frames.var(), nuced.mean(), nuced.var()])
    ratio = np.std(moments, axis=0, ddof=1) / [
        error.mean,
        error.variance,
        error.nuced_mean,
        error.nuced_variance,
    ]
    # relative standard error of a standard deviation: 1/sqrt(2 (n - 1))
    np.testing.assert_allclose(ratio, 1.0, atol=5.0 / np.sqrt(2 * (n - 1)))


def test_error_rate_and_electron_histogram_are_as_predicted() -> None:
    pixels, n_frames = make_pixels(), 4000
    frames, true = draw(pixels, n_frames, np.random.default_rng(15))
    data = KnownPixels(pixels, SampleLaw())
    codes = data.codes(counts_of(frames), np.full(N_PIXELS, DN.start))
    tables = number_tables(*codes, data.exposure, data, detailed=True)
    numbers = tables.convert(frames.astype(np.uint16)).number.astype(int)
    expected = tables.outcomes(40)
    n = frames.size
    error = expected.error
    rate, spread = np.mean(numbers != true), np.sqrt(np.sum(error * (1 - error)) * n_frames) / n
    assert abs(rate - error.mean()) < 5 * spread
    # thresholds half-way between the peaks, the plain rounding of (x - mu) g, err more often
    rounded = np.rint((frames - pixels.bias) * pixels.conversion_gain).clip(0)
    assert np.mean(rounded != true) - rate > 20 * spread
    observed = np.bincount(numbers.ravel(), minlength=40)[:40]
    mass = expected.estimated / N_PIXELS
    # the pixels' own masses differ, so the binomial variance of the mean mass is an upper bound
    limit = 5 * np.sqrt(mass * (1 - mass) / n) + 5 / n
    np.testing.assert_array_less(np.abs(observed / n - mass), limit)
    # an exposure wrong by 10 % would be seen
    h, *others = pixels.maps
    brighter = KnownPixels(UsablePixels(1.1 * h, *others), SampleLaw())
    off = number_tables(*brighter.codes(), brighter.exposure, brighter, detailed=True).outcomes(40)
    assert np.max(np.abs(observed / n - off.estimated / N_PIXELS) / limit) > 4
