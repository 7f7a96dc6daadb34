"""Electron numbers under the pixel's own law: wrong as seldom as can be, and the probability is true."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.known_camera import KnownCamera

from pchem_pipeline.model.electrons.electrons import number_tables, number_type
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.use.exposure import ExposurePool, estimate_exposure, mean_signal

BYTE = np.dtype(np.uint8)


def converted(frames, prior, calibration, dtype=BYTE, parts=1):
    ends = frames.min(axis=0), frames.max(axis=0)
    tables = number_tables(*ends, prior, calibration.known, dtype=dtype, parts=parts, detailed=True)
    return tables.convert(frames, expected=True)


def test_errors_are_as_rare_as_they_can_be_and_as_often_as_stated_and_the_expectation_is_unbiased():
    rng = np.random.default_rng(30)
    camera = KnownCamera.drawn(rng, (12, 14), read_noise=(0.15, 0.6))
    exposure = rng.uniform(0.2, 4.0, camera.bias.shape)
    electrons, frames = camera.frames(rng, exposure, 1500)
    found = converted(frames, exposure, camera.calibration())
    limit, right = camera.least_error(exposure), found.number == electrons
    error = np.sqrt((limit * (1 - limit)).sum() / len(electrons)) / limit.size
    assert abs((~right).mean() - limit.mean()) < 5 * error
    # rounding, which knows neither noise nor exposure, errs clearly more often
    rounded = np.rint((frames - camera.bias) * camera.gain).clip(0)
    assert (rounded != electrons).mean() > limit.mean() + 10 * error
    for low, high in ((0.0, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 0.999), (0.999, 1.01)):
        chosen = (found.probability >= low) & (found.probability < high)
        p, n = found.probability[chosen].mean(dtype=np.float64), chosen.sum()
        assert n > 1000
        assert abs(right[chosen].mean() - p) < 5 * np.sqrt(p * (1 - p) / n) + 1e-5
    difference = found.expected.astype(np.float64) - electrons
    assert abs(difference.mean()) < 5 * difference.std() / np.sqrt(difference.size)
    # and where it is noisy, nearer than the number
    noisy = camera.read_noise_e > 0.4
    square = (difference[:, noisy] ** 2).mean()
    assert ((found.number[:, noisy].astype(int) - electrons[:, noisy]) ** 2).mean() > 1.15 * square


def test_large_numbers_need_two_bytes():
    _, camera, electrons, frames = KnownCamera.taken(32, (3, 4), 300.0, 200, read_noise=(0.2, 0.3))
    dtype = number_type(float((frames.max() - 80) * 0.12))
    assert (dtype, number_type(254.0)) == (np.uint16, np.uint8)
    found = converted(frames, np.full((3, 4), 300.0), camera.calibration(), dtype)
    assert (found.number == electrons).mean() > 0.9


def test_pixels_without_calibration_have_no_number():
    _, camera, _, frames = KnownCamera.taken(31, (3, 4), 1.0, 50)
    calibration = camera.calibration()
    calibration.conversion_gain[2, 1] = np.nan
    found = converted(frames, np.ones((3, 4)), calibration)
    assert (found.number[:, 2, 1] == 255).all()
    assert np.isnan(found.probability[:, 2, 1]).all()
    assert np.isnan(found.expected[:, 2, 1]).all()
    assert (found.number[:, 0, 0] < 20).all()


def test_parts_of_a_dn_give_the_same_as_whole_ones():
    _, camera, _, frames = KnownCamera.taken(33, (5, 6), 2.0, 100)
    calibration, prior = camera.calibration(), np.full((5, 6), 2.0)
    whole = converted(frames, prior, calibration)
    parts = converted(frames.astype(np.uint32) * 4, prior, calibration, parts=4)
    np.testing.assert_array_equal(parts.number, whole.number)
    np.testing.assert_allclose(parts.probability, whole.probability, rtol=1e-6)


@pytest.mark.parametrize(
    ("n_frames", "exposure"), [(1, (1.0, 1.0)), (1, (0.3, 4.0)), (2, (0.0, 0.02)), (4, (0.3, 6.0))]
)
def test_a_few_frames_are_no_prior_of_themselves(n_frames, exposure):
    """The exposure of a pixel from its one sample makes that sample certain; that of all pixels does not."""
    rng = np.random.default_rng(31)
    camera = KnownCamera.drawn(rng, (70, 80), read_noise=(0.3, 0.45))
    electrons, frames = camera.frames(rng, rng.uniform(*exposure, camera.bias.shape), n_frames)
    histograms = histogram_frames(frames)
    own = estimate_exposure(histograms.counts, histograms.origin, camera.calibration()).exposure
    signal = mean_signal(histograms.counts, histograms.origin, camera.calibration())
    np.testing.assert_allclose(signal, (frames.mean(axis=0) - camera.bias) * camera.gain, atol=1e-9)
    noise = (camera.sigma * camera.gain) ** 2
    priors = ExposurePool.of(signal, noise, n_frames).priors(signal, noise)
    above = (priors - priors[..., :1]).reshape(own.size, -1)
    law = SampleLaw().with_added_exposure(above, np.full(above.shape, 1 / above.shape[1]))
    found = converted(frames, priors[..., 0], replace(camera.calibration(), law=law))

    def excess(numbers):
        """Probability stated less share that is right, in standard errors."""
        stated, n = numbers.probability.astype(np.float64), electrons.size
        error = np.sqrt((stated * (1 - stated)).sum()) / n
        return (stated.mean() - (numbers.number == electrons).mean()) / error

    assert abs(excess(found)) < 4
    if n_frames == 1:
        assert excess(converted(frames, own, camera.calibration())) > 5
