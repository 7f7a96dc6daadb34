"""Exposure of frames of known pixels: pulls N(0, 1), and as precise as the samples allow."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.known_camera import KnownCamera, estimated
from scipy.stats import norm, poisson

from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.use.exposure import estimate_exposure

N_FRAMES, SHAPE = 400, (30, 40)
N = SHAPE[0] * SHAPE[1]
ERRORS = (2e-3, 0.8, 0.1)


@pytest.fixture(scope="module")
def night():
    """Exposures of 0.8 to 3 e-, read noise 0.15 to 0.6 e-, and a calibration that has errors."""
    rng = np.random.default_rng(20)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.6))
    exposure = rng.uniform(0.8, 3.0, SHAPE)
    _, frames = camera.frames(rng, exposure, N_FRAMES)
    histograms = histogram_frames(frames)
    found = estimate_exposure(histograms.counts, histograms.origin, camera.calibration(rng, ERRORS))
    return camera, exposure, frames, histograms, found


def pulls(found, exposure):
    return ((found.exposure - exposure) / found.stderr).ravel()


def assert_right(found, exposure, skew=0.05):
    """Pulls are N(0, 1); as a Poisson count the estimate is skewed by a part of the root of the events."""
    z = pulls(found, exposure)
    assert abs(z.mean()) < 5 / np.sqrt(z.size) + skew
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size)


def test_pulls_are_normal_with_both_errors_and_not_with_one(night):
    _, exposure, _, _, found = night
    assert_right(found, exposure)
    z = pulls(found, exposure)
    for width, share in ((1, 0.6827), (2, 0.9545)):
        assert abs((abs(z) < width).mean() - share) < 5 * np.sqrt(share * (1 - share) / N)
    # half of an exposure's error is of the calibration: without that part the same limit is passed by far
    alone = (found.exposure - exposure) / found.counting
    assert alone.std() - 1 > 6 / np.sqrt(2 * N)


def test_a_perfect_calibration_leaves_counting_alone(night):
    camera, exposure, _, histograms, _ = night
    found = estimate_exposure(histograms.counts, histograms.origin, camera.calibration())
    assert (found.calibration == 0).all()
    assert_right(found, exposure)
    # a bias that is wrong by a tenth of an electron, unknown to the calibration, is seen at once
    off = estimate_exposure(histograms.counts, histograms.origin + 1, camera.calibration())
    assert pulls(off, exposure).mean() > 0.5


def test_an_effect_of_the_law_is_in_the_estimate():
    """A fifth of the samples twice as bright: without it in the law errors would be too small."""
    rng = np.random.default_rng(22)
    camera = KnownCamera.drawn(rng, SHAPE)
    flicker = np.where(rng.random((N_FRAMES, 1, 1)) < 0.2, 2.0, 0.75)
    _, frames = camera.frames(rng, 1.5 * flicker, N_FRAMES)
    law = SampleLaw().with_exposures([0.2, 0.8], [2.0, 0.75])
    plain = estimated(frames, camera.calibration())
    found = estimated(frames, replace(camera.calibration(), law=law))
    assert np.median(found.counting) > 1.05 * np.median(plain.counting)
    assert abs(np.median(found.exposure) - 1.5) < 0.1


def test_dark_and_unknown_pixels():
    rng, camera, _, frames = KnownCamera.taken(23, (4, 5), 0.0, 200)
    calibration = camera.calibration(rng, ERRORS)
    calibration.bias[1, 2] = np.nan
    # all samples, or half of them, lie where no exposure of this pixel puts any
    frames[:, 0, 3] = frames[:100, 0, 4] = 35
    found = estimated(frames, calibration)
    known = np.ones((4, 5), np.bool_)
    known[[1, 0], [2, 3]] = False
    assert np.isnan(found.exposure[~known]).all()
    assert np.isnan(found.stderr[~known]).all()
    assert (found.exposure[known] < 5 * found.stderr[known]).all()
    assert (found.counting[known] > 0).all()


def test_a_sample_far_below_is_one_without_electrons_where_the_law_has_wider_noise():
    camera = KnownCamera(np.full((1, 1), 0.1), np.full((1, 1), 200.0), np.full((1, 1), 0.3))
    frames = np.full((1, 1, 1), 170, np.uint16)  # 10 sigma below, and 2 of the wide noise
    wide = replace(camera.calibration(), law=SampleLaw().with_noise([0.9, 0.1], width=[1.0, 5.0]))
    assert estimated(frames, wide).exposure == 0.0
    assert np.isnan(estimated(frames, camera.calibration()).exposure)


def test_samples_at_the_top_of_the_adc_are_taken_as_a_limit():
    rng = np.random.default_rng(24)
    camera = KnownCamera(np.full(SHAPE, 0.1), np.full(SHAPE, 20.0), np.full(SHAPE, 0.25))
    _, frames = camera.frames(rng, 4.0, N_FRAMES)
    frames = np.minimum(frames, 63)  # 6 bits: more than 4.3 e- are cut
    censored = replace(camera.calibration(), law=SampleLaw().with_clip(0, 63))
    found = estimated(frames, censored)
    assert_right(found, 4.0)
    naive = estimated(frames, camera.calibration())
    assert pulls(naive, 4.0).mean() < -5


def test_a_bias_that_may_be_an_electron_off_is_in_the_error():
    """Half an electron for certain would be a shift; a tenth of a chance of one electron is an error."""
    _, camera, _, frames = KnownCamera.taken(25, (6, 8), 2.0, 200, read_noise=(0.15, 0.2))
    calibration = camera.calibration()
    off = np.stack([camera.gain, camera.bias - 1 / camera.gain, camera.sigma], axis=-1)
    rivals = np.zeros((6, 8, 2, 4))
    rivals[..., 0, 0], rivals[..., 0, 1:] = 0.1, off
    found = estimated(frames, replace(calibration, rivals=rivals))
    np.testing.assert_allclose(found.calibration, np.sqrt(0.1), rtol=0.05)
    alone = estimated(frames, calibration)
    np.testing.assert_array_equal(found.exposure, alone.exposure)
    assert (alone.calibration == 0).all()


@pytest.mark.parametrize("n_frames", [1, 10, 1000])
def test_the_error_of_no_exposure_is_that_of_its_likelihood(n_frames):
    """The mean square of H over its likelihood, by plain sums; the curvature at 0 would say anything."""
    rng, camera, _, frames = KnownCamera.taken(26, (10, 12), 0.0, n_frames, read_noise=(0.2, 0.45))
    found = estimated(frames, camera.calibration(rng, (1e-4, 0.1, 0.02)))
    exact = estimated(frames, camera.calibration())
    dark = np.argwhere(exact.exposure == 0)
    assert len(dark) > 30
    root = np.linspace(0, 1, 4001)[1:]  # fine where H is small
    h = 40 / np.sqrt(n_frames) * root**2
    k = np.arange(80)[:, None]
    numbers = poisson.pmf(k, h)
    for y, x in dark[:6]:
        g, mu, s = (each[y, x] for each in (camera.gain, camera.bias, camera.read_noise_e))
        log = np.zeros(h.size)
        levels, number = np.unique(frames[:, y, x], return_counts=True)
        for dn, count in zip(levels, number, strict=True):
            edges = (np.array([-0.5, 0.5])[:, None, None] + dn - mu - k / g) / (s / g)
            share = norm.cdf(edges[1]) - norm.cdf(edges[0])
            log += count * np.log((numbers * share).sum(axis=0))
        weight = root * np.exp(log - log.max())
        expected = np.sqrt((weight * h**2).sum() / weight.sum())
        assert exact.counting[y, x] == pytest.approx(expected, rel=0.03)
    assert np.nanmax(found.stderr) < 4.0 / np.sqrt(n_frames) + 0.2


def test_codes_in_parts_of_a_dn_tell_what_whole_ones_do():
    """Samples moved by offsets that are known in quarters of a DN: the same exposures and errors."""
    rng, camera, _, frames = KnownCamera.taken(27, (6, 8), 2.0, 200)
    calibration = camera.calibration(rng, (1e-4, 0.1, 0.02))
    whole, histograms = estimated(frames, calibration), histogram_frames(4 * frames)
    parts = estimate_exposure(histograms.counts, histograms.origin, calibration, 4)
    for name in ("exposure", "counting", "calibration"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-9)
    shift = rng.integers(-6, 7, (200, 1, 1))
    _, frames = camera.frames(rng, 2.0, 200, shift / 4)
    histograms = histogram_frames((4 * frames.astype(int) - shift).astype(np.uint16))
    moved = estimate_exposure(histograms.counts, histograms.origin, camera.calibration(), 4)
    assert_right(moved, 2.0, skew=0.0)


def test_the_calibration_error_is_the_slope_of_the_exposure(night):
    camera, _, _, histograms, _ = night
    for index, name in enumerate(("conversion_gain", "bias", "read_noise_dn")):
        own = camera.calibration(errors=np.eye(3)[index])
        step = 1e-4 * getattr(own, name).mean() / 10
        ends = [
            estimate_exposure(
                histograms.counts, histograms.origin, replace(own, **{name: getattr(own, name) + side * step})
            ).exposure
            for side in (1, -1)
        ]
        found = estimate_exposure(histograms.counts, histograms.origin, own).calibration
        np.testing.assert_allclose(found, abs(ends[0] - ends[1]) / (2 * step), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("noise", "gain"), [(4.0, 0.1), (0.3, 2.5)])
def test_known_pixels_may_be_beyond_what_a_fit_can_tell(noise, gain):
    rng = np.random.default_rng(28)
    camera = KnownCamera(np.full(SHAPE, gain), np.full(SHAPE, 200.0), np.full(SHAPE, noise))
    found = estimated(camera.frames(rng, 5.0, N_FRAMES)[1], camera.calibration())
    assert_right(found, 5.0)
