"""A simulated camera with the parameters of a characterised one: what it gives is what that gave."""

import numpy as np
import pytest
from helpers.known_camera import KnownCamera

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import Defect
from pchem_pipeline.use.twin import Twin, extrapolated, redrawn, twin_maps

SHAPE, N_FRAMES = (20, 30), 2000


@pytest.fixture(scope="module")
def camera():
    return KnownCamera.drawn(np.random.default_rng(70), SHAPE)


@pytest.fixture(scope="module")
def exposure():
    return np.random.default_rng(71).uniform(0.5, 3.0, SHAPE)


def twin_of(camera, exposure, usable=True):
    usable = np.broadcast_to(usable, SHAPE)
    truth = twin_maps((exposure, camera.gain, camera.bias, camera.sigma), usable, np.full(SHAPE, 77.0))
    return Twin(truth, SimulateSettings(shape=SHAPE, bit_depth=14))


def moments_differ_by(one, other):
    """Return differences of means and of variances of pixels over their standard errors."""
    n = len(one), len(other)
    means, variances = ([each.mean(axis=0), each.var(axis=0, ddof=1)] for each in (one, other))
    (m1, v1), (m2, v2) = means, variances
    fourth = [((each - each.mean(axis=0)) ** 4).mean(axis=0) for each in (one, other)]
    of_variance = sum((f - v**2) / k for f, v, k in zip(fourth, (v1, v2), n, strict=True))
    return (m1 - m2) / np.sqrt(v1 / n[0] + v2 / n[1]), (v1 - v2) / np.sqrt(of_variance)


def test_its_frames_have_the_moments_of_the_camera(camera, exposure):
    _, taken = camera.frames(np.random.default_rng(72), exposure, N_FRAMES)
    simulated = twin_of(camera, exposure).frames(n=N_FRAMES, seed=5)
    assert simulated.shape == taken.shape
    for z in moments_differ_by(taken.astype(float), simulated.astype(float)):
        assert abs(z.mean()) < 5 / np.sqrt(z.size)
        assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) + 0.02
    # of the whole ensemble, too
    codes = np.arange(taken.max() + 2)
    counts = [np.bincount(each.ravel(), minlength=codes.size)[: codes.size] for each in (taken, simulated)]
    both = counts[0] + counts[1]
    chi2 = ((counts[0] - counts[1]) ** 2 / np.maximum(both, 1))[both > 20]
    assert abs(chi2.sum() - chi2.size) < 5 * np.sqrt(2 * chi2.size)
    # a gain that is 2 % off is seen
    off = KnownCamera(camera.gain * 1.02, camera.bias, camera.read_noise_e)
    other = twin_of(off, exposure).frames(n=N_FRAMES, seed=5)
    assert abs(moments_differ_by(taken.astype(float), other.astype(float))[0].mean()) > 0.5


def test_scenes(camera, exposure):
    twin = twin_of(camera, exposure)
    image = np.linspace(0.0, 4.0, exposure.size).reshape(SHAPE)
    for scene, expected in ((1.5, 1.5), (image, image), (np.stack([image, 3 * image]), 2 * image)):
        frames = twin.frames(scene, 600)
        mean = ((frames - camera.bias) * camera.gain).mean(axis=0)
        error = np.sqrt((np.asarray(expected) + 2 * np.asarray(expected) ** 2 + 0.2) / 600)
        assert (abs(mean - expected) < 5.5 * error).all()
    # a sequence is a sequence: even frames see the first image, odd ones the second
    frames = twin.frames(np.stack([0 * image, image + 5]), 200)
    assert frames[1::2].mean() > frames[::2].mean() + 30
    for wrong in (np.ones((3, 3)), -1.0, np.full(SHAPE, np.nan)):
        with pytest.raises(ConfigError, match="scene"):
            twin.frames(wrong, 10)
    with pytest.raises(ConfigError, match="1 or more"):
        twin.frames(1.0, 0)


def test_pixels_without_a_fit_stay_at_their_level(camera, exposure):
    usable = np.ones(SHAPE, bool)
    usable[4, 7] = False
    twin = twin_of(camera, np.where(usable, exposure, np.nan), usable)
    assert twin.truth.defect[4, 7] == Defect.STUCK
    assert twin.truth.conversion_gain[4, 7] == np.median(twin.truth.conversion_gain[usable])
    for scene in (None, 9.0, np.full((2, *SHAPE), 9.0)):
        assert (twin.frames(scene, 20)[:, 4, 7] == 77).all()


def test_maps_are_redrawn_within_their_errors(camera, exposure):
    stderr = np.stack([np.full(SHAPE, e) for e in (0.05, 0.002, 0.3, 0.1)])
    correlation = np.zeros((*SHAPE, 6))
    correlation[..., 3] = -0.8
    maps = (exposure, camera.gain, camera.bias, camera.sigma)
    found = redrawn(maps, stderr, correlation, 8)
    pulls = np.stack([(new - old) / e for new, old, e in zip(found, maps, stderr, strict=True)])
    n = exposure.size
    assert (abs(pulls.mean(axis=(1, 2))) < 5 / np.sqrt(n)).all()
    assert (abs(pulls.std(axis=(1, 2)) - 1) < 5 / np.sqrt(2 * n)).all()
    measured = np.corrcoef(pulls.reshape(4, -1))
    assert abs(measured[1, 2] + 0.8) < 5 * (1 - 0.8**2) / np.sqrt(n)
    assert abs(measured[0, 3]) < 5 / np.sqrt(n)


def test_a_larger_sensor_has_the_same_distributions_and_correlations():
    rng = np.random.default_rng(73)
    shape = (64, 64)
    columns = rng.normal(0.0, 3.0, 64)
    smooth = rng.standard_normal((66, 66))
    # neighbours belong together
    smooth = (smooth[1:-1, 1:-1] + smooth[2:, 1:-1] + smooth[1:-1, 2:]) / np.sqrt(3)
    noise = np.exp(0.2 * smooth - 1.3)
    gain = 0.1 * np.exp(0.05 * smooth + 0.03 * rng.standard_normal(shape))  # gain goes with read noise
    bias = 100 + columns + 2.0 * rng.standard_normal(shape)
    sigma = np.sqrt((noise / gain) ** 2 + 1 / 12)
    truth = twin_maps((np.full(shape, 1.0), gain, bias, sigma), np.ones(shape, bool), np.zeros(shape))
    large = extrapolated(truth, (96, 160), 4)
    assert large.shape == (96, 160)
    for name in ("conversion_gain", "bias", "analog_read_noise_e"):
        old, new = (np.sort(getattr(each, name).ravel()) for each in (truth, large))
        shares = np.linspace(0.02, 0.98, 25)
        spread = old.std()
        # columns are drawn from 64: a median is known to about an eighth of their spread
        assert (abs(np.quantile(old, shares) - np.quantile(new, shares)) < 0.5 * spread).all()
        assert 0.7 < new.std() / spread < 1.4
    # of gain with read noise, of read noise with that of the next pixel; variance of the columns
    pair, beside, of_columns = [], [], []
    for each in (truth, large):
        noise = each.analog_read_noise_e
        pair.append(np.corrcoef(each.conversion_gain.ravel(), noise.ravel())[0, 1])
        beside.append(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1])
        of_columns.append(np.var(each.bias.mean(axis=0)))
    assert abs(pair[0] - pair[1]) < 0.1
    assert beside[0] > 0.2
    assert abs(beside[0] - beside[1]) < 0.1
    assert 0.5 < of_columns[1] / of_columns[0] < 2.0
