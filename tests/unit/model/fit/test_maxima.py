"""The search ends, and at the highest maximum that has an answer."""

from dataclasses import fields

import numpy as np
import pytest
from helpers.drawn_pixels import codes, histograms

from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.operators.noise import NoiseSkew
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.sample_law import SampleLaw

#: 3,000 frames of H = 3.6 e-, 1/g = 2.01 DN, mu = 95.8 DN and a read noise of 0.53 DN, from 95 DN on.
COMB = [
    19, 58, 81, 192, 127, 371, 190, 481, 159, 432, 118, 307, 94, 159, 34, 78, 25, 35, 4, 22, 5, 4,
    1, 2, 1, 1,
]  # fmt: skip


def drawn(rng, truth, n_frames, per_electron=0.0):
    """Return histograms of pixels with (H, g, mu, analog read noise in DN), and DN of bin 0."""
    h, g, mu, sigma = (column[:, None] for column in truth.T)
    k = rng.poisson(h, (truth.shape[0], n_frames))
    signal = k + np.sqrt(per_electron * k) * rng.standard_normal(k.shape)
    return histograms(np.rint(mu + signal / g + sigma * rng.standard_normal(k.shape)).astype(np.int64))


def test_a_comb_that_fits_whole_numbers_is_no_answer():
    # 2 DN per electron: peaks as narrow as a DN, at whole numbers, are 0.14 nats likelier than the truth, but
    # their width says nothing of the read noise
    counts = np.array([COMB], np.uint16)
    found = fit_histograms(counts, np.array([95]), settings=FitSettings(likelihood="exact"))
    assert not found.fit_status[0] & int(FAILED)
    assert found.read_noise_dn[0] == pytest.approx(0.530, abs=0.005)
    assert np.isfinite(found.covariance[0]).all()


def test_read_noise_at_its_floor_converges():
    # the law has more noise than the pixels: nothing is left for their own, and its floor is in e-, so it
    # moves with the gain
    rng = np.random.default_rng(1)
    counts, origin = drawn(rng, np.array([[40.0, 1 / 11, 100.0, 3.3]] * 24), 2500)
    law = SampleLaw(variance_per_electron=0.0081, curvature=0.004, extra_variance_dn2=np.array([1.44]))
    found = fit_histograms(counts, origin, law=law)
    assert np.count_nonzero(found.fit_status & int(FitStatus.NOT_CONVERGED)) <= 1


def test_an_ambiguous_pixel_gets_the_likeliest_gain_of_the_law():
    # where the peaks are not resolved, the density and the law rank the maxima differently
    rng = np.random.default_rng(2)
    n, extra = 150, 0.09**2
    step, noise = rng.uniform(8, 14, n), rng.uniform(0.38, 0.5, n)
    truth = np.stack([rng.uniform(3, 9, n), 1 / step, rng.uniform(95, 105, n), noise * step], 1)
    counts, origin = drawn(rng, truth, 2500, extra)
    law = SampleLaw(variance_per_electron=extra)
    found = fit_histograms(counts, origin, law=law)
    truth[:, 3] = np.hypot(truth[:, 3], np.sqrt(1 / 12))
    from_truth = fit_histograms(counts, origin, law=law, start=truth)
    both = np.isfinite(found.bias + from_truth.bias) & (found.outlier_share == from_truth.outlier_share)
    lower = found.log_likelihood < from_truth.log_likelihood - 1e-6
    ambiguous = (found.fit_status & int(FitStatus.BIAS_AMBIGUOUS)) != 0
    assert (both & ambiguous).sum() > 40
    assert not (both & lower & ~ambiguous).any()
    assert (both & lower).sum() <= 8  # 14 by the maxima of the density alone, one by 17 nats


def test_a_misfit_of_the_model_calls_for_no_other_starts():
    # noise that grows with the signal: the fit is poor, the peaks are resolved, and no other gain is likelier
    rng = np.random.default_rng(3)
    n = 60
    step, noise = rng.uniform(8, 14, n), rng.uniform(0.15, 0.28, n)
    truth = np.stack([rng.uniform(1.5, 6, n), 1 / step, rng.uniform(95, 105, n), noise * step], 1)
    counts, origin = drawn(rng, truth, 6000, 0.18**2)
    settings = FitSettings(tail_guard=0.0)
    found = fit_histograms(counts, origin, settings=settings)
    poor = (found.fit_status & int(FitStatus.POOR_FIT)) != 0
    assert poor.sum() > 20
    assert np.median(found.n_iterations[poor]) < 30  # it was 80
    h, g, mu, sigma = found.columns.T
    for scale in (0.5, 0.71, 0.83, 1.2, 1.4, 2.0):  # of 1/g, with the same mean and about the same variance
        start = np.stack([h / scale**2, g / scale, mu + h / g * (1 - 1 / scale), sigma * scale], axis=1)
        again = fit_histograms(counts, origin, settings=settings, start=start)
        assert not (again.log_likelihood[poor] > found.log_likelihood[poor] + 1e-6).any()


def test_of_two_maxima_on_one_comb_the_higher_one_is_kept():
    # three exposures and a bias: two gains 4 % apart give the same bias and nearly the same brightest mean;
    # the one that is climbed to first is 0.055 nats lower
    rng = np.random.default_rng(9)
    ranges = ((0.3, 0.8), (9.0, 13.0), (95.0, 105.0), (0.25, 0.8))
    exposure, step, bias, noise = (rng.uniform(*each, (12, 12)) for each in ranges)
    drawn = []
    for seed, scale in enumerate((1.0, 3.0, 8.0, 0.0)):
        rng = np.random.default_rng(10 + seed)
        dn = codes(rng, (1200, 12, 12), scale * exposure, step, noise, bias)
        drawn.append(histograms(dn[None, :, 9, 11]))
    found = fit_histograms(*zip(*drawn, strict=True), dark=[False, False, False, True])
    assert found.log_likelihood[0] == pytest.approx(-18261.2198, abs=1e-3)
    assert found.conversion_gain[0] == pytest.approx(0.1093, abs=1e-4)


def test_the_gain_of_a_pixel_with_hundreds_of_electrons_is_found():
    # the comb is sharp: the modulus of its lobe, 0.34, is ten standard errors; that of the gain is 5e-4
    counts, origin = histograms(codes(np.random.default_rng(5), (12, 800), 300.0, 9.2, 0.233))
    found = fit_histograms(counts, origin)
    np.testing.assert_allclose(found.conversion_gain, 1.0 / 9.2, rtol=0.0025)


@pytest.mark.timeout(120)
def test_steps_out_of_bounds_end_a_climb():
    # a gain that moves from frame to frame, under a law that cannot follow it: all noise is a one-sided tail
    rng = np.random.default_rng(4)
    n, frames = 300, 990
    electrons, noise = rng.poisson(0.94, (n, frames)), 4.8 * rng.standard_normal((n, frames))
    gain = 17.0 * (1.0 + 0.15 * rng.standard_normal(frames))
    samples = np.rint(200.0 + gain * electrons + noise).astype(np.int64)
    near = np.tile([0.94, 1.0 / 17.0, 200.0, 4.8], (n, 1))
    law = sample_law([NoiseSkew(share=1.0)], pixel_maps(near.T, np.ones(n, np.bool_)))
    fit = fit_histograms(*histograms(samples), law=law, start=near)
    assert np.all(fit.n_iterations > 0)
    assert np.all(np.isfinite(fit.log_likelihood) | (fit.fit_status > 0))


@pytest.fixture(scope="module")
def repeated():
    """Histograms of pixels whose frames come five times each: no law of single frames fits them."""
    rng = np.random.default_rng(90210)
    exposure, noise = rng.uniform(0.5, 6.0, (40, 1)), rng.uniform(0.2, 0.5, (40, 1))
    return histograms(np.repeat(codes(rng, (40, 800), exposure, 11.0, noise, bias=100.0), 5, axis=1))


def test_a_misfit_without_outliers_has_the_fit_of_all_samples_and_costs_little_more(repeated):
    counts, origin = repeated
    guarded = fit_histograms(counts, origin)
    plain = fit_histograms(counts, origin, settings=FitSettings(tail_guard=0.0))
    whole = guarded.outlier_share == 0.0
    poor = (plain.fit_status & int(FitStatus.POOR_FIT)) != 0
    assert poor.mean() > 0.9
    assert (whole & poor).mean() > 0.8
    for name in {each.name for each in fields(plain)} - {"n_iterations", "intervals"}:
        np.testing.assert_array_equal(getattr(guarded, name)[whole], getattr(plain, name)[whole], name)
    # the histogram without its ends is fitted too, once and from the first start: a search from everywhere
    # would take as many evaluations again
    assert guarded.n_iterations[whole].mean() < 1.5 * plain.n_iterations[whole].mean()
    assert guarded.n_iterations[whole & poor].min() > plain.n_iterations[whole & poor].min()


def test_outliers_of_a_misfit_are_still_left_out(repeated):
    counts, origin = repeated
    struck = np.pad(counts, ((0, 0), (0, 400)))
    struck[:, -20] = 3
    found, plain = fit_histograms(struck, origin), fit_histograms(counts, origin)
    np.testing.assert_array_less(2.5 / struck.sum(axis=1), found.outlier_share)
    np.testing.assert_allclose(found.bias, plain.bias, atol=1e-3 * 11.0)
