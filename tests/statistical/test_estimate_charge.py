"""Estimators of the effects on light and charge: what they are like, and about how strong; silent on noise.

The evidence is that of the workflow, from simulated frames. Standard errors are those of theory, and each
truth is many of them away from nothing.
"""

import numpy as np
import pytest
from helpers import small_sensors
from helpers.small_sensors import a_sensor, drawn_truth, some_blocks, taken

from pchem_pipeline.effects.estimators.spots import Fading
from pchem_pipeline.effects.operators import light
from pchem_pipeline.effects.operators.drifts import ExposureDrift, ExposureFlicker
from pchem_pipeline.effects.operators.fate import (
    BranchingCounts,
    ChargeDiffusion,
    ChargeLag,
    OpticalCrosstalk,
    OverdispersedCounts,
    SpuriousCharge,
)
from pchem_pipeline.effects.operators.light import DarkCurrentRts, Persistence
from pchem_pipeline.effects.operators.strike import CosmicRays

CLASSES = (
    ExposureDrift, Persistence, DarkCurrentRts, ExposureFlicker, OverdispersedCounts, BranchingCounts,
    OpticalCrosstalk, CosmicRays, ChargeLag, ChargeDiffusion, SpuriousCharge,
)  # fmt: skip
TRUTH = a_sensor((24, 24))
N = 3000


def seen(*effects, seed=1, n_frames=N):
    """Return the evidence of every second block of frames of a small sensor."""
    frames = taken(TRUTH, *effects, n_frames=n_frames, seed=seed)
    return small_sensors.seen(frames, some_blocks(n_frames, every=2))


@pytest.mark.parametrize("seed", range(2))
def test_what_cannot_be_seen_gives_no_hypothesis(seed):
    hidden = ChargeLag(fraction=0.3), ChargeDiffusion(fraction=0.3), SpuriousCharge(mean_e=0.3)
    evidence = seen(*hidden, seed=seed)
    assert [h for cls in CLASSES for h in cls.estimate(evidence)] == []


@pytest.mark.parametrize("drift", [0.1, -0.1])
@pytest.mark.parametrize("settling", [None, 0.1])
def test_drift(drift, settling):
    first, *others = ExposureDrift.estimate(seen(ExposureDrift(drift=drift, settling_fraction=settling)))
    assert first.path == ()
    assert first.shape == ("linear" if settling is None else "settling")
    assert settling is None or abs(np.log(first.settling_fraction / settling)) < np.log(1.3)
    assert abs(first.drift / drift - 1.0) < 0.25
    assert len(others) <= 2


def test_a_drift_of_any_profile_is_followed():
    truth = ExposureDrift(drift=0.1, path=tuple(np.sin(9 * np.linspace(0, 1, 60))))
    first = ExposureDrift.estimate(seen(truth))[0]
    at = np.linspace(0, 1, 500)
    assert np.corrcoef(*(e.drift * e.profile(at) for e in (truth, first)))[0, 1] > 0.98


@pytest.mark.parametrize(("levels", "shares"), [((-1.0, 1.0), (0.5, 0.5)), ((0.0, 1.0), (0.95, 0.05))])
def test_flicker_of_two_levels(levels, shares):
    evidence = seen(ExposureFlicker(rms=0.06, levels=levels, shares=shares))
    found, plain = ExposureFlicker.estimate(evidence)
    assert 1 / 3 < found.rms / 0.06 < 3
    assert not plain.levels
    assert len(found.levels) == 2
    assert abs(found.shares[1] - shares[1]) < 5 * np.sqrt(shares[0] * shares[1] / evidence.n_frames)


def test_flicker_on_a_line():
    evidence = seen(ExposureFlicker(rms=0.02, period_frames=7.3, phase_cycles=0.3))
    found = ExposureFlicker.estimate(evidence)[0]
    assert 1 / 3 < found.rms / 0.02 < 3
    noise = 1.0 / np.sum(evidence.charge_std[evidence.maps.usable] ** 2)  # of a frame's relative exposure
    # Rife and Boorstyn 1974: variance of a frequency
    frequency = np.sqrt(6 * noise / evidence.n_frames) / (0.02 * np.sqrt(2) * np.pi * N)
    assert abs(1 / found.period_frames - 1 / 7.3) < 5 * frequency + 1e-7
    assert abs(found.phase_cycles - 0.3) < 5 * np.sqrt(noise / evidence.n_frames) / 0.02 / np.pi


@pytest.mark.parametrize(
    "truth",
    [
        ExposureFlicker(rms=0.04),
        ExposureFlicker(rms=0.05, correlation_frames=4.0),
        OverdispersedCounts(relative_variance=0.03),
        BranchingCounts(branching=0.03),
        OpticalCrosstalk(probability=0.04),
        DarkCurrentRts(fraction=0.06, step_e=1.2),
        DarkCurrentRts(fraction=0.06, step_e=1.2, dwell_low_frames=20.0, dwell_high_frames=20.0),
        CosmicRays(tracks_per_frame=0.05),
    ],
    ids=lambda effect: effect.tag,
)
def test_the_strength_is_found_to_a_factor_of_three(truth):
    evidence = seen(truth)
    found = type(truth).estimate(evidence)
    assert 1 / 3 < getattr(found[0], truth.strength) / getattr(truth, truth.strength) < 3
    assert getattr(truth, "dwell_low_frames", None) in [getattr(o, "dwell_low_frames", None) for o in found]
    if tau := getattr(truth, "correlation_frames", None):
        # as many independent values as fit into the frames
        assert abs(found[0].correlation_frames / tau - 1) < 5 * np.sqrt(2 * tau / evidence.n_frames)
    if isinstance(truth, CosmicRays):
        assert 0.5 < found[0].length_um / truth.length_um < 2.0
        assert 0.5 < found[0].electrons_per_um / truth.electrons_per_um < 2.0


def test_what_would_begin_brighter_than_any_scene_is_no_afterglow(monkeypatch):
    truth = Persistence(peak_e=0.5, decay_frames=600.0, centre_y=0.3, centre_x=0.6, radius=0.13)
    monkeypatch.setattr(light, "fading_of", lambda *_: Fading(600.0, None, 0.5, scale=1e9))
    assert not Persistence.estimate(seen(truth))


def test_persistence_so_bright_that_it_misleads_the_fits():
    sensor = drawn_truth((32, 32), noise_e=(0.36, 0.42), step=(11.5, 12.5))
    truth = Persistence(peak_e=6.0, decay_frames=200.0, centre_y=0.3, centre_x=0.6, radius=0.05)
    image, spot = Persistence.estimate(small_sensors.seen(taken(sensor, truth, n_frames=1200, seed=5)))
    wanted = truth.peak_e * truth.pattern(np.arange(32), (32, 32))
    for found, share in ((image, 0.05), (spot, 0.005)):
        left = found.peak_e * found.pattern(np.arange(32), (32, 32)) - wanted
        assert np.sum(left**2) < share * np.sum(wanted**2)


def test_persistence():
    truth = Persistence(peak_e=0.5, decay_frames=600.0, centre_y=0.3, centre_x=0.6, radius=0.13)
    image, spot = Persistence.estimate(seen(truth))
    assert np.shape(image.image) == (16, 16)
    wanted, found = (e.peak_e * e.pattern(np.arange(24), (24, 24)) for e in (truth, image))
    # four noisy cells for each that is lit, and the blur of the grid
    assert np.sum((found - wanted) ** 2) < 0.15 * np.sum(wanted**2)
    # the grid of radii has steps of 1.4, so the peak is known to half that
    assert abs(spot.peak_e - 0.5) < 0.5 * 0.5
    assert (spot.centre_y, spot.centre_x) == pytest.approx((0.3, 0.6), abs=0.07)
    assert 0.09 <= spot.radius <= 0.19
    assert abs(np.log(spot.decay_frames / 600)) < np.log(2.0)


def test_a_strong_afterglow_has_the_image_that_it_has_however_wrong_the_fits_are():
    """Drawn by numpy alone: a disc that is brighter than the steady light, and one level all over."""
    rng, n_frames, shape, peak = np.random.default_rng(12), 1500, (24, 24), 8.0
    y, x = np.indices(shape)
    disc = np.hypot(y - 11.5, x - 11.5) < 6
    left = np.exp(-np.arange(n_frames) / 500.0)[:, None, None]
    steady = rng.uniform(2.0, 4.0, shape)
    signal = rng.poisson(steady + peak * left * disc) + 0.33 * rng.standard_normal((n_frames, *shape))
    frames = np.rint(100.0 + 10.0 * signal).astype(np.uint16)
    image, _ = Persistence.estimate(small_sensors.seen(frames))
    # a pixel's amplitude is known to 0.2 e-; by two time constants in steps of 27 % the first frame to less
    pattern = image.pattern(np.arange(24), shape)[np.hypot(y - 11.5, x - 11.5) < 4]
    assert pattern.std() < 0.05 * pattern.mean()
    assert abs(image.peak_e * pattern.mean() / peak - 1) < 0.25
    assert image.pattern(np.arange(24), shape)[np.hypot(y - 11.5, x - 11.5) > 9].max() < 0.05


def frames_with(events, n_frames, shape=(24, 24), seed=3):
    """Return frames in which tracks, and clouds of 12,000 e- and 0.9 pixels, were drawn by numpy alone."""
    rng = np.random.default_rng(seed)
    k = rng.poisson(2.0, (n_frames, *shape)).astype(float)
    y, x = np.indices(shape) + 0.5
    for is_cloud in events:
        cy, cx, t = *rng.uniform(0, shape), rng.integers(n_frames)
        if is_cloud:
            mean = 12e3 / (2 * np.pi * 0.9**2) * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 0.9**2))
        else:
            along, angle = np.arange(0, rng.exponential(5.0), 0.05), rng.uniform(0, 2 * np.pi)
            place = np.floor([cy + along * np.sin(angle), cx + along * np.cos(angle)]).astype(int)
            inside = ((place >= 0) & (place < np.array(shape)[:, None])).all(axis=0)
            mean = np.zeros(shape)
            np.add.at(mean, tuple(place[:, inside]), 0.05 * 240)
        k[t] += rng.poisson(mean)
    return np.rint(100 + 10 * (k + 0.25 * rng.standard_normal(k.shape))).clip(0, 65535).astype(np.uint16)


def test_round_clouds_among_tracks_have_their_own_share_and_size():
    clouds, lines = 40, 80
    both, tracks = (frames_with([True] * n + [False] * lines, n_frames=1500) for n in (clouds, 0))
    (found,) = CosmicRays.estimate(small_sensors.seen(both))
    share = clouds / (clouds + lines)
    # at the edge some of either are cut, few merge
    assert abs(found.cloud_share - share) < 0.05
    assert abs(found.cloud_electrons / 12e3 - 1) < 0.15
    assert abs(found.cloud_um / found.pixel_pitch_um / 0.9 - 1) < 0.15
    # the clouds have forty times the charge of a track: left among the tracks they would be all of it
    assert abs(found.electrons_per_um * found.pixel_pitch_um / 240 - 1) < 0.35
    (alone,) = CosmicRays.estimate(small_sensors.seen(tracks))
    assert alone.cloud_share < 0.02
