"""Parameters that all pixels share, with one or several samples of each: slopes, recovery, coverage."""

from dataclasses import replace

import numpy as np
import pytest

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
    rng = np.random.default_rng(seed)
    theta = np.empty((n_pixels, samples.n_exposures + 3))
    theta[:, :-3] = np.log(rng.uniform(0.6, 2.0, (n_pixels, samples.n_exposures)))
    theta[:, -3] = np.log(rng.uniform(10.0, 13.0, n_pixels))
    theta[:, -2] = rng.uniform(60.0, 61.0, n_pixels)
    theta[:, -1] = np.log(rng.uniform(5.0, 9.0, n_pixels))
    rows = samples.rows(theta)
    k = rng.poisson(np.exp(rows[:, :1]), (rows.shape[0], n))
    sd = np.sqrt(np.exp(rows[:, 3:]) + np.exp(2 * rows[:, 1:2]) * SHARED**2 * k)
    x = np.rint(rows[:, 2:3] + np.exp(rows[:, 1:2]) * k + sd * rng.normal(size=k.shape)).astype(np.int64)
    width = int(x.max()) + 1
    counts = np.stack([np.bincount(row, minlength=width) for row in np.maximum(x, 0)])
    kept = np.ones(counts.shape, np.bool_)
    bounds, scale = np.array([[0.0, 1.0]]), np.array([0.01])
    origin = np.zeros(rows.shape[0], np.int64)
    return SharedProblem(counts, origin, kept, law, bounds, scale, samples), theta, np.array([SHARED**2])


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
    h, step, mu, variance = samples.rows(theta).T
    parameters = np.stack([np.exp(h), np.exp(-step), mu, np.sqrt(np.exp(variance) + 1 / 12)], axis=1)
    again = samples.theta(parameters)
    held = ~samples.slopes.any(axis=(0, 1))
    np.testing.assert_allclose(again[:, ~held], theta[:, ~held], rtol=1e-12)
    assert samples.n_free == int((~held).sum())


@pytest.mark.parametrize("samples", LAYOUTS[1:4])
def test_pulls_of_own_and_shared_parameters_have_unit_spread(samples):
    """Twelve sensors of six pixels: pulls within five standard errors of N(0, 1)."""
    own, common = [], []
    for seed in range(12):
        whole, theta, shared = problem(samples, 6, 1500, 10 + seed)
        start = np.stack(
            [*np.exp(samples.rows(theta)[:, :1].T), *np.exp(-samples.rows(theta)[:, 1:2].T),
             samples.rows(theta)[:, 2], np.exp(0.5 * samples.rows(theta)[:, 3])], axis=1,
        )  # fmt: skip
        fit = fit_shared(whole, start, 0.5 * shared, tolerance=1e-4)
        assert fit.converged
        common.append((fit.shared[0] - shared[0]) / np.sqrt(fit.covariance[0, 0]))
        free = samples.slopes.any(axis=(0, 1))
        errors = np.sqrt(np.einsum("naa->na", fit.own_covariance))
        own.append(((fit.theta - theta) / errors)[:, free])
    pulls = np.concatenate(own).ravel()
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    # the shared parameter is taken as known, so they are a little wider than 1
    assert 1 - 5 / np.sqrt(2 * pulls.size) < pulls.std() < 1.15 + 5 / np.sqrt(2 * pulls.size)
    shared_pulls = np.array(common)
    assert abs(shared_pulls.mean()) < 5 / np.sqrt(12)
    assert abs(shared_pulls.std() - 1) < 5 / np.sqrt(2 * 12)


def test_the_tolerance_is_that_of_all_pixels_together_with_and_without_a_shared_parameter():
    """Else a law with a shared parameter would gain a little in each pixel, whatever the parameter does."""
    whole, theta, _ = problem(Samples(), 200, 2000, 3)
    rows = Samples().rows(theta)
    start = np.column_stack(
        [1.3 * np.exp(rows[:, 0]), 0.97 * np.exp(-rows[:, 1]), rows[:, 2] - 1, np.exp(rows[:, 3] / 2)]
    )
    alone = replace(
        whole, bounds=np.zeros((0, 2)), scale=np.zeros(0), law=lambda _, own: law([SHARED**2], own)
    )
    best = fit_shared(alone, start, np.zeros(0), tolerance=1e-9).log_likelihood.sum()
    for each, shared in ((alone, np.zeros(0)), (whole, np.array([SHARED**2]))):
        fit = fit_shared(each, start, shared, tolerance=0.4)
        assert fit.converged
        assert fit.log_likelihood.sum() > best - 0.8
