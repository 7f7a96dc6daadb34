"""Parameters that all pixels share, with one or several samples of each: slopes, recovery, coverage."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.drawn_pixels import histograms

from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.model.fit.shared import Samples, SharedProblem, fit_shared

SHARED = 0.1  # e- of noise per root electron

LAYOUTS = [
    Samples(),
    Samples((False, False)),
    Samples((True, False, False)),
    Samples((True, False, False), (0.0, 1.0, 3.0)),
    Samples((False, False), (0.0, 2.0)),
]


def law(shared, own):
    effect = effect_class("signal_dependent_noise")(noise_e=float(np.sqrt(abs(shared[0]))))
    return sample_law([effect], pixel_maps(list(own.T), np.ones(own.shape[0], np.bool_)))


def problem(samples, n_pixels, n, seed):
    """Histograms of pixels at known parameters, the variance per electron shared by all."""
    rng, n_own = np.random.default_rng(seed), samples.n_exposures
    # logarithms of H of 0.6 to 2 e-, of 10 to 13 DN per electron, the bias, and of a variance of 5 to 9 DN^2
    low, high = [*n_own * [-0.5], 2.3, 60.0, 1.6], [*n_own * [0.7], 2.57, 61.0, 2.2]
    theta = rng.uniform(low, high, (n_pixels, n_own + 3))
    h, step, mu, variance = samples.rows(theta).T[:, :, None]
    k = rng.poisson(np.exp(h), (len(h), n))
    sd = np.sqrt(np.exp(variance) + np.exp(2 * step) * SHARED**2 * k)
    counts, origin = histograms(np.rint(mu + np.exp(step) * k + sd * rng.normal(size=k.shape)).astype(int))
    kept = np.ones(counts.shape, np.bool_)
    bounds, scale = np.array([[0.0, 1.0]]), np.array([0.01])
    return SharedProblem(counts, origin, kept, law, bounds, scale, samples), theta, np.array([SHARED**2])


def parameters(samples, theta):
    """(H, g, mu, sigma) of each sample of each pixel."""
    h, step, mu, variance = samples.rows(theta).T
    return np.stack([np.exp(h), np.exp(-step), mu, np.sqrt(np.exp(variance) + 1 / 12)], axis=1)


@pytest.mark.parametrize("samples", LAYOUTS)
def test_the_score_is_the_slope_of_the_log_likelihood(samples):
    whole, theta, shared = problem(samples, 3, 400, 1)
    score = whole.expansion(*whole.slopes(theta, shared)).score
    for index in range(theta.shape[1]):
        step = np.zeros_like(theta)
        step[:, index] = 1e-5
        high, low = (whole.expansion(*whole.slopes(theta + s, shared)).value for s in (step, -step))
        np.testing.assert_allclose(score[:, index], (high - low) / 2e-5, rtol=2e-4, atol=2e-3)
    high, low = (whole.expansion(*whole.slopes(theta, shared + s)).value.sum() for s in (1e-7, -1e-7))
    assert score[:, -1].sum() == pytest.approx((high - low) / 2e-7, rel=1e-2, abs=1.0)


@pytest.mark.parametrize("samples", LAYOUTS)
def test_rows_and_own_parameters_are_each_others_inverse(samples):
    _, theta, _ = problem(samples, 4, 10, 2)
    again = samples.theta(parameters(samples, theta))
    held = ~samples.slopes.any(axis=(0, 1))
    np.testing.assert_allclose(again[:, ~held], theta[:, ~held], rtol=1e-12)
    assert samples.n_free == int((~held).sum())


@pytest.mark.parametrize("samples", LAYOUTS[1:4])
def test_pulls_of_own_and_shared_parameters_have_unit_spread(samples):
    """Twelve sensors of six pixels: pulls within five standard errors of N(0, 1)."""
    own, common = [], []
    for seed in range(12):
        whole, theta, shared = problem(samples, 6, 1500, 10 + seed)
        fit = fit_shared(whole, parameters(samples, theta), 0.5 * shared, tolerance=1e-4)
        assert fit.converged
        common.append((fit.shared[0] - shared[0]) / np.sqrt(fit.covariance[0, 0]))
        free = samples.slopes.any(axis=(0, 1))
        errors = np.sqrt(np.einsum("naa->na", fit.own_covariance))
        own.append(((fit.theta - theta) / errors)[:, free])
    pulls = np.concatenate(own).ravel()
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    # the shared parameter is taken as known, so they are a little wider than 1
    assert 1 - 5 / np.sqrt(2 * pulls.size) < pulls.std() < 1.15 + 5 / np.sqrt(2 * pulls.size)
    assert abs(np.mean(common)) < 5 / np.sqrt(12)
    assert abs(np.std(common) - 1) < 5 / np.sqrt(2 * 12)


def test_the_tolerance_is_that_of_all_pixels_together_with_and_without_a_shared_parameter():
    """Else a law with a shared parameter would gain a little in each pixel, whatever the parameter does."""
    whole, theta, known = problem(Samples(), 200, 2000, 3)
    start = parameters(Samples(), theta) * [1.3, 0.97, 1.0, 1.0] - [0.0, 0.0, 1.0, 0.0]
    alone = replace(whole, bounds=np.zeros((0, 2)), scale=np.zeros(0), law=lambda _, own: law(known, own))
    best = fit_shared(alone, start, np.zeros(0), tolerance=1e-9).log_likelihood.sum()
    for each, shared in ((alone, np.zeros(0)), (whole, known)):
        fit = fit_shared(each, start, shared, tolerance=0.4)
        assert fit.converged
        assert fit.log_likelihood.sum() > best - 0.8
