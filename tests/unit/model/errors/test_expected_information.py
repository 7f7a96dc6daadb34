"""Expected information against another formula, against plain differentiation, and in its limits."""

import numpy as np
import pytest
from helpers.plain_law import pcd_mass

from pchem_pipeline.model.errors.expected_information import (
    expected_information,
    expected_scores,
    inverse_information,
    shared_information,
)

POINTS = [(2.0, 0.2), (0.1, 0.305), (2.0, 0.305), (10.0, 0.45), (2.0, 0.6), (1.0, 1.0)]


@pytest.mark.parametrize(("exposure", "noise"), POINTS)
def test_scores_of_wide_peaks_have_mean_zero_and_the_information(exposure, noise):
    gain = noise / 4.0  # a read noise of 4 DN: sums over whole DN are integrals
    mean, information = expected_scores(([exposure], [gain], [100.3], [4.0]))
    scale = np.array([1.0, gain, 1 / gain, 4.0])  # in H, ln g, g mu and ln sigma
    expected = expected_information(exposure, noise)
    np.testing.assert_allclose(
        information[0] * np.outer(scale, scale), expected, rtol=1e-4, atol=1e-6 * expected.max()
    )
    assert np.abs(mean[0] * scale / np.sqrt(np.diagonal(expected))).max() < 1e-4
    assert np.isnan(expected_scores(([np.nan], [gain], [100.3], [4.0]))[0]).all()


def test_few_electrons_leave_one_gaussian():
    """Bias frames are one Gaussian; electrons that are rare but not ruled out cost a known part.

    The score of H at 0 is ``f_1 / f_0 - 1`` with variance ``exp(1 / s^2) - 1``; its covariance with the
    scores of bias and ln sigma is their mean under f_1, ``1 / s^2``.
    """
    noise = 0.5
    bias_frames = np.diag([0.0, 1 / noise**2, 2.0])
    np.testing.assert_allclose(shared_information(0.0, noise), bias_frames)
    cost = noise**-4 / np.expm1(noise**-2)
    expected = bias_frames - np.array([[0, 0, 0], [0, 1, 1], [0, 1, 1]]) * cost
    np.testing.assert_allclose(shared_information(1e-9, noise), expected, atol=2e-5)


def test_samples_add_up_with_an_exposure_each():
    """The Schur complements against the whole matrix of (H1, H2, ln g, g mu, ln sigma)."""
    noise, lights, frames = 0.5, (1.0, 6.0), (300.0, 700.0)
    whole = np.zeros((5, 5))
    for number in range(2):
        index = [number, 2, 3, 4]
        whole[np.ix_(index, index)] += frames[number] * expected_information(lights[number], noise)
    shared = sum(n * shared_information(h, noise) for h, n in zip(lights, frames, strict=True))
    np.testing.assert_allclose(inverse_information(shared), np.linalg.inv(whole)[2:, 2:], rtol=1e-9)


@pytest.mark.parametrize("arguments", [(0.0, 0.3), (2.0, 0.0), (np.nan, 0.3), (2.0, np.inf), (-1.0, 0.3)])
def test_impossible_pixels_are_refused(arguments):
    with pytest.raises(ValueError, match="positive"):
        expected_information(*arguments)


def test_singular_information_has_no_inverse():
    assert np.isnan([inverse_information(each) for each in (np.diag([1.0, 0.0]), np.ones((2, 2)))]).all()


@pytest.mark.parametrize(
    ("exposure", "noise", "gain"), [(2.0, 0.25, 0.5), (0.3, 0.2, 0.15), (6.0, 0.3, 0.21)]
)
def test_information_of_cells_is_that_of_their_masses(exposure, noise, gain):
    """By central differences of the mass of whole DN, for each place of the bias between two."""
    sigma, h = noise / gain, 1e-5
    x = np.arange(-12, (exposure + 12 * np.sqrt(exposure) + 14) / gain)
    covariances = []
    for offset in np.arange(8) / 8:

        def mass(step, offset=offset):
            own = sigma * np.exp(step[3])
            analog = gain * np.exp(step[1]) * np.sqrt(own**2 - 1 / 12)
            return pcd_mass(x, exposure + step[0], gain * np.exp(step[1]), offset + step[2] / gain, analog)

        slopes = np.array([(mass(h * unit) - mass(-h * unit)) / (2 * h) for unit in np.eye(4)])
        whole = mass(np.zeros(4))
        seen = whole > 1e-12
        covariances.append(np.linalg.inv((slopes[:, seen] / whole[seen]) @ slopes[:, seen].T))
    found = inverse_information(expected_information(exposure, noise, gain))
    np.testing.assert_allclose(found, np.mean(covariances, axis=0), rtol=2e-4, atol=1e-6)
    fine = expected_information(exposure, noise, noise / 1.6)
    np.testing.assert_allclose(fine, expected_information(exposure, noise))
