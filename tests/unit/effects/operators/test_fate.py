"""Fates of electrons: forward models and laws against theory.

Limits are five standard errors from theory; each test also shows that what it guards against is many more.
"""

import dataclasses

import numpy as np
import pytest
from helpers.small_sensors import a_sensor, electrons, exposures, simulated

from pchem_pipeline.discrepancy.estimator_check import recovered_strength
from pchem_pipeline.effects.operators.drifts import ExposureDrift
from pchem_pipeline.effects.operators.fate import (
    BranchingCounts,
    ChargeDiffusion,
    ChargeLag,
    OpticalCrosstalk,
    OverdispersedCounts,
    SpuriousCharge,
    Trapping,
)
from pchem_pipeline.effects.operators.strike import CosmicRays


def test_overdispersed_counts_follow_an_exposure_that_changes():
    drift = ExposureDrift(drift=1.6)
    truth = a_sensor((30, 30), exposure=(2.0, 2.0))
    k = simulated(truth, drift, OverdispersedCounts(relative_variance=0.3), n_frames=400)[1].astype(float)
    h = exposures(drift, truth.quanta_exposure, 400)[:, 0, 0]
    wanted = h + 0.3 * h**2
    # the fourth cumulant of these laws stays below ten variances
    error = wanted * np.sqrt((2 + 10 / wanted) / 900)
    assert np.all(abs(k.var(axis=(1, 2)) - wanted) < 5 * error)
    assert abs(k.var(axis=(1, 2)) - h - 0.3 * 4.0).max() > 20 * error.min()


@pytest.mark.parametrize("cls", [OverdispersedCounts, BranchingCounts, OpticalCrosstalk])
def test_small_strengths_change_few_samples_and_larger_ones_change_these_too(cls):
    truth = a_sensor((20, 20))
    plain, small, large = (
        simulated(truth, *(() if s == 0 else (cls(**{cls.strength: s}),)), n_frames=300)[1].astype(int)
        for s in (0, 0.002, 0.004)
    )
    mean = truth.quanta_exposure.mean()
    changed = small != plain
    bound = 0.002 * max(np.mean(truth.quanta_exposure**2), 2 * mean)
    assert 0 < changed.mean() < bound + 5 * np.sqrt(bound / changed.size)
    assert (large != plain)[changed].mean() > 0.99


def test_crosstalk_correlates_neighbours_and_adds_its_electrons():
    p, h = 0.1, 2.0
    k = electrons(h, (60, 60), 600, OpticalCrosstalk(probability=p))[:, 1:-1, 1:-1].astype(float)
    mean = h * (1 + p)
    assert abs(k.mean() - mean) < 5 * np.sqrt(mean * (1 + 2 * p) / k.size)
    d = k - mean
    along_x, along_y, two_apart = d[:, :, 1:] * d[:, :, :-1], d[:, 1:] * d[:, :-1], d[:, 2:] * d[:, :-2]
    for products, wanted in ((along_x, p / 2 * h), (along_y, p / 2 * h), (two_apart, 0.0)):
        error = mean * (1 + 2 * p) / np.sqrt(products.size)
        assert abs(products.mean() - wanted) < 5 * error
    assert p / 2 * h > 20 * error


@pytest.mark.parametrize(
    ("effect", "mean"),
    [(ChargeLag(fraction=0.3), 2.0), (ChargeDiffusion(fraction=0.3), 2.0), (SpuriousCharge(mean_e=0.3), 2.3)],
)
def test_what_cannot_be_seen_leaves_electrons_independent(effect, mean):
    k = electrons(2.0, (50, 50), 400, effect)[1:]
    d = k - mean
    error = mean / np.sqrt(d.size)
    # in time, along y, along x, and in time and along y
    later, below, right = np.s_[1:], np.s_[:, 1:], np.s_[..., 1:]
    before, above, left = np.s_[:-1], np.s_[:, :-1], np.s_[..., :-1]
    pairs = (later, before), (below, above), (right, left), (np.s_[1:, 1:], np.s_[:-1, :-1])
    for one, other in pairs:
        assert abs((d[one] * d[other]).mean()) < 5 * error
    # it did something, and its opposite number, electrons made rather than moved, would be found
    assert (k != electrons(2.0, (50, 50), 400)[1:]).mean() > 0.2
    crosstalk = electrons(2.0, (50, 50), 400, OpticalCrosstalk(probability=0.3)) - 2.6
    assert (crosstalk[:, 1:] * crosstalk[:, :-1]).mean() > 20 * error


def test_lag_takes_electrons_from_one_frame_to_the_next():
    truth = a_sensor((6, 6), exposure=(30.0, 30.0))
    step = ExposureDrift(drift=2.0, path=(0.0, 0.0, 2.0, 2.0))
    k = simulated(truth, step, ChargeLag(fraction=0.5), n_frames=4)[1].mean(axis=(1, 2))
    plain = simulated(truth, step, n_frames=4)[1].mean(axis=(1, 2))
    wanted = np.append([0.5 * plain[0]], 0.5 * (plain[1:] + plain[:-1]))
    assert np.all(abs(k - wanted)[1:] < 5 * np.sqrt(30 / 36))
    assert abs(k - plain)[2] > 10


def test_diffusion_moves_electrons_and_loses_none():
    h = np.zeros((9, 9))
    h[4, 4] = h[0, 0] = 1000.0
    truth = dataclasses.replace(a_sensor((9, 9)), quanta_exposure=h)
    plain = simulated(truth, n_frames=50)[1].astype(float)
    moved = simulated(truth, ChargeDiffusion(fraction=0.2), n_frames=50)[1].astype(float)
    assert np.array_equal(plain.sum(axis=(1, 2)), moved.sum(axis=(1, 2)))
    wanted = np.zeros((9, 9))
    wanted[4, 4], wanted[0, 0] = 800, 900
    wanted[[3, 5, 4, 4, 0, 1], [4, 4, 3, 5, 1, 0]] = 50
    assert (abs(moved.mean(axis=0) - wanted) <= 5 * np.sqrt(wanted / 50)).all()


H = 2.0


def of_numpy(seed, capture=0.3, release=0.3, shape=(20, 20), n_frames=1500):
    """Return frames of pixels with a trap each, frame by frame: 10 DN and 0.3 e- of noise an electron."""
    rng = np.random.default_rng(seed)
    full = rng.random(shape) < 0.5
    frames = np.empty((n_frames, *shape), np.uint16)
    for t in range(-60, n_frames):
        k = rng.poisson(H, shape)
        freed = full & (rng.random(shape) < release)
        caught = ~full & (k > 0) & (rng.random(shape) < capture)
        full = (full & ~freed) | caught
        if t >= 0:
            seen = k + freed - caught + 0.3 * rng.standard_normal(shape)
            frames[t] = np.rint(100 + 10 * seen)
    return frames


def test_covariances_in_time_of_electrons_with_traps_are_those_of_theory():
    n, capture, release = 2000, 0.5, 0.3
    k = electrons(H, (30, 30), n, Trapping(capture=capture, release=release))
    some = -np.expm1(-H)
    several, left = some - H * np.exp(-H), 1.0 - release - capture * some
    assert abs(k.mean() - H) < 5 * np.sqrt(H / k.size)  # no charge is lost
    off = k - k.mean(axis=0)
    error = np.sqrt(3.0) * H / np.sqrt(k.size)  # of a variance; of a product it is less
    for lag in (1, 2, 3):
        found = (off[lag:] * off[:-lag]).mean() + off.var() / n
        expected = -release * capture * several * left ** (lag - 1)
        assert abs(found - expected) < 5 * error
        assert lag > 1 or abs(expected) > 20 * error


def test_it_is_guessed_in_every_stack_of_another_simulator():
    found = recovered_strength(Trapping(capture=0.3, release=0.3), camera=of_numpy)
    assert 1 / 3 < found.mean() / 0.3 < 3


def test_tracks_come_at_their_rate_and_leave_their_electrons():
    effect = CosmicRays(tracks_per_frame=0.4, length_um=6.0, electrons_per_um=50.0, pixel_pitch_um=3.0)
    n = 2000
    total = electrons(0.0, (50, 50), n, effect).sum(axis=(1, 2))
    hit = total > 0
    rate = 1 - np.exp(-0.4)
    assert abs(hit.mean() - rate) < 5 * np.sqrt(rate * (1 - rate) / n) + 0.01
    # an exponential length has E[l^2] = 2 E[l]^2; a track that crosses the edge loses half at the most
    mean, edge = 0.4 * 6.0 * 50.0, 4 * 2.0 / 50 / np.pi
    error = np.sqrt(0.4 * (2 * 300.0**2 + 300.0) / n)
    assert abs(total.mean() - mean * (1 - edge)) < 5 * error + mean * edge
    # the pixels of the first track touch each other
    k = electrons(0.0, (60, 60), 400, CosmicRays(tracks_per_frame=0.01, length_um=60.0))
    y, x = np.nonzero(k[np.flatnonzero(k.sum(axis=(1, 2)))[0]])
    assert y.size > 3
    steps = abs(y[:, None] - y) + abs(x[:, None] - x) + 99 * np.eye(y.size)
    assert steps.min(axis=1).max() <= 2


def test_clouds_of_particles_have_their_electrons_and_width():
    effect = CosmicRays(tracks_per_frame=1e-2, cloud_share=1.0, cloud_electrons=9000.0, cloud_um=2.4)
    frames = electrons(0.0, (60, 60), 4000, effect)
    y, x = np.indices((60, 60))
    inside, totals, variances = 0, [], []
    for k in frames[frames.sum(axis=(1, 2)) > 0]:
        cy, cx = (float((k * axis).sum() / k.sum()) for axis in (y, x))
        if min(cy, cx) > 5 and max(cy, cx) < 54 and k[round(cy), round(cx)] > 500:
            inside += 1
            totals.append(k.sum())
            variances.append((k * (x - cx) ** 2).sum() / k.sum())
    assert inside > 10
    assert abs(np.mean(totals) / 9000 - 1) < 5 / np.sqrt(9000 * inside) + 1e-3
    # 0.8 pixels, and where in its pixel an electron is
    assert abs(np.mean(variances) - 0.64 - 1 / 12) < 0.03
