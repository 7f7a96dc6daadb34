"""Frames in electrons: the two parts of the error are what frames scatter by."""

from dataclasses import replace

import numpy as np
from helpers.known_camera import KnownCamera

from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.use.calibration import covariance_of
from pchem_pipeline.use.electrons import calibration_variance, electrons, read_stderr, stderr_at

SHAPE, N_FRAMES = (20, 25), 300
N = SHAPE[0] * SHAPE[1]


def test_errors_of_samples_and_errors_common_to_all_frames():
    rng, camera, true, frames = KnownCamera.taken(40, SHAPE, 3.0, N_FRAMES)
    calibration = camera.calibration(rng, (1e-3, 0.3, 0.02))
    difference = electrons(frames, calibration).astype(np.float64) - true
    z = (difference - difference.mean(axis=0)) / read_stderr(calibration)
    # sigma is known to 0.02 DN of 2 to 4
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) + 0.005
    signal = true.mean(axis=0)
    common = stderr_at(calibration_variance(calibration), signal)
    whole = np.hypot(common, read_stderr(calibration) / np.sqrt(N_FRAMES))
    pull = difference.mean(axis=0) / whole
    assert abs(pull.std() - 1) < 5 / np.sqrt(2 * N)
    assert abs(pull.mean()) < 5 / np.sqrt(N)
    # without the part of the calibration they would be many times too small
    assert (difference.mean(axis=0) / (read_stderr(calibration) / np.sqrt(N_FRAMES))).std() > 1.5


def test_it_is_the_two_point_correction_in_single_precision_less_offsets():
    rng, camera, _, frames = KnownCamera.taken(41, (6, 7), 5.0, 9)
    calibration = camera.calibration()
    calibration.fit_status[2, 3] = 4
    offset = rng.normal(size=(9, 6, 1)) + rng.normal(size=(9, 1, 7))
    for found, moved in (
        (electrons(frames, calibration), 0.0),
        (electrons(frames, calibration, offset.astype(np.float32)), offset),
    ):
        expected = (frames - camera.bias - moved) * camera.gain
        expected[:, 2, 3] = np.nan
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_noise_of_effects_is_part_of_the_error():
    calibration = KnownCamera.drawn(np.random.default_rng(43), (2, 2)).calibration()
    wide = read_stderr(replace(calibration, law=SampleLaw().with_variance(dn2=4.0)))
    gain = calibration.conversion_gain
    np.testing.assert_allclose(wide**2, read_stderr(calibration) ** 2 + 4.0 * gain**2)


def test_covariance_is_that_of_the_fit():
    stderr = np.array([0.1, 0.2, 0.3, 0.4])[:, None, None]
    correlation = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])[None, None]
    found = covariance_of(stderr, correlation)[0, 0]
    expected = [[0.04, 0.036, 0.04], [0.036, 0.09, 0.048], [0.04, 0.048, 0.16]]
    np.testing.assert_allclose(found, expected)
