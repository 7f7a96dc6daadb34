"""Electron numbers: the threshold table against the memberships it stands for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, poisson

from pchem_pipeline.model.electrons.electrons import (
    LARGEST_NUMBER,
    NO_NUMBER,
    cell_probabilities,
    compare_electron_numbers,
    electron_counts,
    electron_numbers,
    electrons_numba,
    thresholds,
)
from pchem_pipeline.model.maps.pixels import PixelParameters

CASES = [
    (0.05, 0.1, 100.0, 3.0),
    (1.8, 0.1, 100.0, 3.3),
    (8.0, 0.07, 512.4, 6.0),
    (40.0, 0.12, 64.2, 2.5),
    (2.0, 0.1, 100.0, 12.0),  # s_e = 1.2: cells far from the centres
]


def membership_argmax(x: np.ndarray, h: float, g: float, mu: float, sigma: float) -> np.ndarray:
    """Largest membership by trying all k, eq. gamma_nk."""
    k = np.arange(400)
    log_weight = poisson.logpmf(k, h) + norm.logpdf(x[:, None], mu + k / g, sigma)
    return np.asarray(log_weight.argmax(axis=1))


@pytest.mark.parametrize("case", CASES)
def test_thresholds_are_where_the_largest_membership_changes(case: tuple[float, ...]) -> None:
    h, g, mu, sigma = case
    x = np.linspace(mu - 4 / g, mu + 60 / g, 20_001)
    table = thresholds(h, g, mu, sigma, 399)
    assert np.all(np.diff(table) > 0)
    np.testing.assert_array_equal(np.searchsorted(table, x), membership_argmax(x, *case))


def test_the_paper_s_example_is_not_centred() -> None:
    # x ~ PCD(1.8, 1, 0, 0.33^2), fig:optimal_quantization
    edges = thresholds(1.8, 1.0, 0.0, 0.33, 3)
    np.testing.assert_allclose(edges, [0.5 + 0.1089 * np.log(j / 1.8) + j - 1 for j in (1, 2, 3)])
    assert edges[0] < 0.5 < edges[2] - 2


def frames_of(case: tuple[float, ...], rng: np.random.Generator, spread: int) -> np.ndarray:
    return rng.integers(int(case[2]) - 30, int(case[2]) + spread, size=(50, 3, 4)).astype(np.uint16)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("spread", [200, 6000])
def test_frames_are_converted_by_the_table(case: tuple[float, ...], spread: int) -> None:
    # 6000 DN is longer than the table of a pixel, so both ways through the kernel are taken
    frames = frames_of(case, np.random.default_rng(5), spread)
    maps = [np.full((3, 4), value) for value in case]
    expected = np.searchsorted(thresholds(*case, 1000), frames.ravel()).reshape(frames.shape)
    np.testing.assert_array_equal(electron_numbers(frames, *maps), expected)


def test_pixels_without_parameters_have_no_number() -> None:
    frames = np.full((2, 1, 3), 130, dtype=np.uint16)
    maps = [np.array([[v, v, v]]) for v in (2.0, 0.1, 100.0, 3.0)]
    maps[1][0, 1] = np.nan
    maps[0][0, 2] = np.inf
    result = electron_numbers(frames, *maps)
    np.testing.assert_array_equal(result[:, 0], [[3, NO_NUMBER, NO_NUMBER]] * 2)


def test_no_exposure_means_no_electrons_and_huge_numbers_are_cut() -> None:
    frames = np.array([[[100, 65535]]], dtype=np.uint16)
    one = np.ones((1, 2))
    np.testing.assert_array_equal(electron_numbers(frames, 0 * one, 0.1 * one, 50 * one, 3 * one), [[[0, 0]]])
    large = electron_numbers(frames, 1000 * one, 2.0 * one, 50 * one, 0.1 * one)
    assert large[0, 0, 1] == LARGEST_NUMBER
    assert electron_numbers(frames[:0], one, one, one, one).shape == (0, 1, 2)


def test_a_tie_goes_to_the_smaller_number() -> None:
    # H = 1: the boundary between 0 and 1 is exactly half-way, mu + 1/(2 g) = 105
    frames = np.array([[[105, 106]]], dtype=np.uint16)
    maps = [np.full((1, 2), v) for v in (1.0, 0.1, 100.0, 3.0)]
    np.testing.assert_array_equal(electron_numbers(frames, *maps), [[[0, 1]]])


def test_compiled_and_plain_conversion_agree() -> None:
    frames = frames_of(CASES[1], np.random.default_rng(6), 5000)[:8]
    maps = [np.full((3, 4), value) for value in CASES[1]]
    maps[1][0, 0] = np.nan
    plain = np.empty(frames.shape, dtype=np.uint16)
    electrons_numba.convert_frames.py_func(frames, *maps, LARGEST_NUMBER, NO_NUMBER, plain)
    np.testing.assert_array_equal(electron_numbers(frames, *maps), plain)


def test_histograms_and_frames_give_the_same_numbers() -> None:
    rng = np.random.default_rng(7)
    frames = rng.integers(60, 250, size=(300, 1, 5)).astype(np.uint16)
    rows = np.array(CASES).T[:, None, :]
    numbers = electron_numbers(frames, *rows)
    pixels = PixelParameters(*(row[0] for row in rows))
    counts = np.stack([np.bincount(frames[:, 0, x] - 60, minlength=200) for x in range(5)])
    found, beyond = electron_counts(counts, np.full(5, 60), pixels, 12)
    everything = np.bincount(numbers.ravel(), minlength=12)
    np.testing.assert_array_equal(found, everything[:12])
    assert beyond == everything[12:].sum()


def test_cell_probabilities_are_those_of_all_integers() -> None:
    pixels = PixelParameters(*np.array(CASES).T.copy())
    other = PixelParameters(
        pixels.quanta_exposure * 1.1,
        pixels.conversion_gain * 1.02,
        pixels.bias + 0.7,
        pixels.read_noise_dn * 0.9,
    )
    k = np.arange(200)
    for used in (pixels, other):
        total, errors = np.zeros(60), []
        for true, guess in zip(
            zip(*pixels.columns(), strict=True), zip(*used.columns(), strict=True), strict=True
        ):
            h, g, mu, sigma = true
            x = np.arange(int(mu) - 150, int(mu) + 1500)
            analog = np.sqrt(sigma**2 - 1 / 12)
            centres = mu + k[:, None] / g
            joint = poisson.pmf(k, h)[:, None] * (
                norm.cdf(x + 0.5, centres, analog) - norm.cdf(x - 0.5, centres, analog)
            )
            cell = np.searchsorted(thresholds(*guess, 399), x)
            total += np.bincount(cell, weights=joint.sum(axis=0), minlength=60)[:60]
            errors.append(1.0 - joint[cell.clip(max=199), np.arange(x.size)].sum())
        result = cell_probabilities(pixels, 60, used)
        np.testing.assert_allclose(result.estimated, total, atol=1e-11)
        np.testing.assert_allclose(result.error, errors, atol=1e-11)


def test_comparison_with_the_truth() -> None:
    estimated = np.array([[3, 5, NO_NUMBER], [0, 9, 2]], dtype=np.uint16)
    true = np.array([[3, 6, 4], [0, 1, 2]], dtype=np.uint16)
    result = compare_electron_numbers(estimated, true, 3)
    np.testing.assert_array_equal(result.by_size, [3, 1, 1])
    assert (result.n_samples, result.signed) == (5, 7)
