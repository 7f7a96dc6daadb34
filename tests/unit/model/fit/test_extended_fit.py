"""The fit under an extended law: at the maximum, with the right errors, and what it does with odd pixels."""

import dataclasses
import functools

import numpy as np
import pytest
from helpers.drawn_pixels import codes, histograms
from helpers.extended_reference import LAWS
from scipy.optimize import root

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.pcd import nearest_pcd
from pchem_pipeline.model.law.sample_law import SampleLaw

FIRST, N_CODES, FRAMES = 40, 330, 4000
TRUTH = [
    np.array([0.6, 1.5, 2.5, 4.5, 3.0]),
    1.0 / np.array([12.0, 9.0, 15.0, 11.0, 8.5]),
    np.array([100.0, 99.4, 100.8, 101.3, 98.2]),
    np.array([3.0, 2.2, 3.4, 3.1, 2.0]),
]


def log_likelihood(counts, parameters, law, satellites=None):
    """Return ``sum_i c_i log P(x_i)`` of every pixel, nats."""
    mass = sample_mass(law, parameters, np.arange(FIRST, FIRST + N_CODES), satellites=satellites)
    return (counts * np.log(np.where(counts > 0, np.maximum(mass, 1e-300), 1.0))).sum(axis=1)


def drawn(model, truth, seed=3):
    mass = np.maximum(sample_mass(model, truth, np.arange(FIRST, FIRST + N_CODES)), 0.0)
    counts = np.random.default_rng(seed).multinomial(FRAMES, mass / mass.sum(axis=1, keepdims=True))
    return counts.astype(np.uint32)


def fitted(counts, first=FIRST, **how):
    return fit_histograms(counts, np.full(len(counts), first), **how)


def stderr(fit):
    return np.asarray(np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)))


def maximum(counts, model, start, scale):
    """Where the gradient of the log-likelihood vanishes, in standard errors from ``start``, by scipy."""

    def value(offset):
        here = [np.array([v]) for v in start + offset * scale]
        return float(log_likelihood(counts[None], here, model)[0])

    def gradient(offset):
        # fourth-order differences
        far = [[value(offset + n * e) - value(offset - n * e) for n in (1, 2)] for e in 0.02 * np.eye(4)]
        return np.array(far) @ [8, -1] / 0.24

    found = root(gradient, np.full(4, 0.02), jac=lambda x: -np.eye(4), method="hybr", options={"xtol": 1e-10})
    assert abs(gradient(found.x)).max() < 1e-6
    return found.x


@pytest.mark.parametrize(
    "name", ["neutral", "negative_binomial", "skew", "variance", "edges", "clip", "everything"]
)
def test_fit_is_where_the_gradient_vanishes(name):
    model = LAWS[name]
    if name == "clip":
        model = SampleLaw().with_clip(97, 180)
    counts = drawn(model, TRUTH)
    plain = fitted(counts)
    extended = fitted(counts, law=model, start=plain)
    for pixel in (1, 3):
        offset = maximum(counts[pixel], model, extended.columns[pixel], stderr(extended)[pixel])
        assert abs(offset).max() < 1e-5, offset
    np.testing.assert_allclose(extended.log_likelihood, log_likelihood(counts, extended, model), rtol=1e-13)


def test_pixels_do_not_influence_each_other():
    model = LAWS["variance"].with_free_satellites([1.0, 2.0])
    truth = [np.repeat(column, 2) for column in TRUTH]
    counts = drawn(model, truth)
    plain = fitted(counts)
    together = fitted(counts, law=model, start=plain)
    for pixel in (0, 7):
        part = slice(pixel, pixel + 1)
        alone = fitted(counts[part])
        single = fitted(counts[part, 10:], FIRST + 10, law=model, start=alone)
        for name in {field.name for field in dataclasses.fields(FitResult)} - {"intervals"}:
            np.testing.assert_array_equal(getattr(single, name)[0], getattr(together, name)[pixel])


def test_a_pixel_without_plain_values_stays_without():
    counts = drawn(SampleLaw(), TRUTH)
    counts[1] = 0
    counts[2] = 0
    counts[2, 60] = FRAMES
    plain = fitted(counts)
    extended = fitted(counts, law=LAWS["variance"], start=plain)
    assert extended.fit_status[1] == FitStatus.NO_DATA
    assert extended.fit_status[2] == FitStatus.TOO_FEW_BINS
    assert np.isnan(extended.columns[1:3]).all()
    assert np.isnan(extended.covariance[1:3]).all()
    assert np.isfinite(extended.columns[[0, 3, 4]]).all()
    # a start that is not there says it
    start = plain.columns.copy()
    start[3] = np.nan
    found = fitted(counts, law=LAWS["variance"], start=start)
    assert found.fit_status[3] == FitStatus.NOT_CONVERGED


def test_bits_about_the_data_are_kept_and_those_about_the_plain_fit_are_not():
    model = SampleLaw().with_variance(per_electron=0.03)
    counts = drawn(model, TRUTH)
    plain = fitted(counts, over=np.array([0, 0, 0, 2, 0]), adc_limits=(0, 4000))
    marked = plain.fit_status | np.uint16(FitStatus.POOR_FIT | FitStatus.COARSE_STEPS)
    start = dataclasses.replace(plain, fit_status=marked)
    extended = fitted(counts, law=model, start=start)
    assert extended.fit_status.tolist() == [0, 0, 0, FitStatus.OUTSIDE_WINDOW, 0]


def test_neighbour_is_taken_where_it_is_likelier():
    counts = drawn(SampleLaw(), TRUTH)
    right = fitted(counts)
    wrong = dataclasses.replace(
        right,
        quanta_exposure=right.quanta_exposure + 1,
        bias=right.bias - 1 / right.conversion_gain,
        likelihood_gap=np.zeros(5),
    )
    found = fitted(counts, law=SampleLaw(), start=wrong)
    np.testing.assert_allclose(found.bias, right.bias, atol=0.01)
    assert (found.likelihood_gap > 0).all()
    # a warm start is believed
    stays = fitted(counts, law=SampleLaw(), start=wrong.columns)
    assert (abs(stays.bias - right.bias)[1:] > 5).all()


def test_exposure_that_is_added_leaves_h_as_it_is_without():
    # half of the frames get 0.9 e- in the first three pixels, a third 1.4 e- in the fourth, none in the last
    added = [[0.0, 0.9]] * 3 + [[0.0, 1.4], [0.0, 0.0]]
    weights = [[0.5, 0.5]] * 3 + [[2 / 3, 1 / 3], [1.0, 0.0]]
    model = SampleLaw().with_added_exposure(added, weights)
    truth = [np.tile(column, 20) for column in TRUTH]
    every = np.tile(np.arange(5), 20)
    counts = drawn(model.of(every), truth, seed=11)
    plain = fitted(counts)
    extended = fitted(counts, law=model.of(every), start=plain)
    pull = (extended.columns - np.stack(truth, axis=1)) / stderr(extended)
    # the mean of twenty pulls, four standard errors
    assert abs(pull.reshape(20, 5, 4).mean(axis=0)).max() < 4 / np.sqrt(20)
    assert ((plain.quanta_exposure - truth[0]) / stderr(extended)[:, 0])[every < 4].mean() > 10
    same = fitted(counts, law=SampleLaw(), start=plain)
    np.testing.assert_array_equal(extended.columns[every == 4], same.columns[every == 4])
    mean = nearest_pcd(extended.columns.T.tolist(), model.of(every))[0]
    np.testing.assert_allclose(mean, extended.columns[:, 0] + (np.array(added) * weights).sum(axis=1)[every])


def test_free_satellites_are_found_where_they_are_and_nowhere_else():
    law = SampleLaw().with_free_satellites([0.5, 1.0, 1.5, 2.0, 3.0])
    truth = [np.tile(column, 8) for column in TRUTH]
    weight, amplitude = np.zeros(40), np.zeros(40)
    weight[5:15], amplitude[5:15] = 0.15, 1.5
    weight[15:20], amplitude[15:20] = 0.1, 3.0
    shares = np.stack([0.5 * weight, 1 - weight, 0.5 * weight], axis=1)
    shifts = np.stack([-amplitude, 0 * amplitude, amplitude], axis=1)
    counts = drawn(SampleLaw().with_noise(shares, shift_e=shifts), truth)
    plain = fitted(counts)
    extended = fitted(counts, law=law, start=plain)
    found = extended.satellite_weight > 0
    np.testing.assert_array_equal(found, weight > 0)
    right = found & (abs(extended.satellite_amplitude_e - amplitude) < 0.1)
    assert right.sum() >= 14
    error = abs(extended.satellite_weight - weight)[right] / np.sqrt(weight * (1 - weight) / FRAMES)[right]
    assert (error < 8).all()
    # the parameters come right: the plain fit was led astray by electrons, this one is within its errors
    pulls, astray = ((each.columns - np.stack(truth, axis=1)) / stderr(each) for each in (extended, plain))
    assert (abs(pulls[right]) < 5).all()
    assert (abs(astray[5:20]).max(axis=1) > 10).sum() > 8
    # their log-likelihood holds the satellites
    levels = extended.satellite_amplitude_e, extended.satellite_weight
    expected = log_likelihood(counts, extended, law, levels)
    np.testing.assert_allclose(extended.log_likelihood, expected, rtol=1e-12)
    mass = sample_mass(law, extended, np.arange(FIRST, FIRST + N_CODES), satellites=levels)
    np.testing.assert_allclose(mass.sum(axis=1), 1.0, atol=1e-6)


def test_a_law_without_limits_is_cut_where_the_adc_cuts():
    """A third of the samples at 0 DN, and noise that a row shares: as the PCD, whose read noise has it in."""
    rng = np.random.default_rng(3)
    samples = codes(rng, (12, 3000), 1.0, 10.0, 0.34, bias=-3.0).clip(0, 4095)
    fit = functools.partial(fit_histograms, *histograms(samples), adc_limits=(0, 4095))
    plain, shared = fit(), fit(law=SampleLaw(extra_variance_dn2=np.array([4.0])))
    np.testing.assert_allclose(shared.log_likelihood, plain.log_likelihood, atol=1e-3)
    np.testing.assert_allclose(shared.bias, plain.bias, atol=1e-2)
    np.testing.assert_allclose(np.hypot(shared.read_noise_dn, 2.0), plain.read_noise_dn, rtol=1e-3)
