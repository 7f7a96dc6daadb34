"""Noise of single pixels: the moments and levels of its forward models, and the law of a pixel."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.analog_signal import analog, within

from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.noise import FlickerNoise, RtsNoise
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.sample_law import SampleLaw


@pytest.mark.parametrize(
    ("effect", "times"),
    [
        (FlickerNoise(share=1.0, correlation_frames=5.0), [5.0]),
        (FlickerNoise(share=1.0, correlation_frames=0.5), [0.5]),
        (FlickerNoise(share=1.0, correlation_frames=64.0, spectrum="one_over_f"), [64.0, 8.0, 1.0]),
    ],
)
@pytest.mark.parametrize("first", [0, -20, 1_000_003])
def test_flicker_has_its_covariance_anywhere(effect, times, first):
    after, _, k, r = analog(effect, (60, 60, 60), first=first)
    u = (after - k) / 0.3
    for lag in (0, 1, 2, 7, 30):
        expected = np.mean([np.exp(-lag / tau) for tau in times])
        # independent pixels; their time means of products of Gaussians: variance below 1 + expected^2
        of_pixel = (u[lag:] * u[: 60 - lag]).mean(axis=0)
        within(of_pixel.mean(), expected, of_pixel.std() / 60)
    within((u[:, :, 1:] * u[:, :, :-1]).mean(), 0.0, (u[:, :, 1:] * u[:, :, :-1]).mean(axis=0).std() / 60)
    within((u * r).mean(), 0.0, 0.3 / np.sqrt(u.size))


@pytest.mark.parametrize("samples", [1, 2, 4])
def test_the_levels_of_a_jump_are_those_of_its_place(samples):
    effect = RtsNoise(fraction=1.0, amplitude_e=2.0, probability=0.3, samples=samples)
    after, before, _, _ = analog(effect)
    step = (after - before) / 2.0 * samples
    np.testing.assert_allclose(step, np.rint(step), atol=1e-9)
    levels = np.rint(step)
    n = levels.size
    for level in range(-samples, samples + 1):
        # a jump behind sample m of the 2 N, m = 1 .. 2 N - 1, moves the difference by min(m, 2 N - m) / N
        ways = sum(min(m, 2 * samples - m) == abs(level) for m in range(1, 2 * samples))
        share = 0.7 if level == 0 else 0.15 * ways / (2 * samples - 1)
        within((levels == level).mean(), share, np.sqrt(share * (1 - share) / n))
    within((step[1:] * step[:-1]).mean(), 0.0, (step**2).mean() / np.sqrt(n))


@pytest.mark.parametrize("tau", [0.7, 6.0])
def test_a_slow_trap_is_a_markov_chain_of_two_levels(tau):
    slow = {"sampling": "single", "correlation_frames": tau}
    effect = RtsNoise(fraction=1.0, amplitude_e=2.0, probability=0.3, **slow)
    after, before, _, _ = analog(effect, (60, 60, 60))
    full = (after - before) / 2.0 + 0.3
    np.testing.assert_allclose(full, np.rint(full), atol=1e-9)
    full = np.rint(full)
    of_pixel = full.mean(axis=0)
    within(of_pixel.mean(), 0.3, of_pixel.std() / 60)
    for lag in (1, 2, 9):
        both = (full[lag:] * full[:-lag]).mean(axis=0)
        within(both.mean(), 0.09 + 0.21 * np.exp(-lag / tau), both.std() / 60)
    # Markov: given the state now, the next does not depend on the one before
    now = full[1:-1] == 1
    stay = 0.3 + 0.7 * np.exp(-1 / tau)
    for before_now in (0, 1):
        of = full[2:][now & (full[:-2] == before_now)]
        within(of.mean(), stay, np.sqrt(stay * (1 - stay) / of.size))


def test_slow_traps_differ_in_their_times():
    times = {"sampling": "single", "correlation_frames": 2.0, "times_spread": 0.7}
    effect = RtsNoise(fraction=1.0, amplitude_e=2.0, probability=0.5, **times)
    after, before, _, _ = analog(effect, (4000, 12, 12))
    up = (after - before).reshape(4000, -1) > 0
    full = up.mean(axis=0)
    # the logarithms of the mean times full and empty, 4 frames in the middle, are of standard deviation 0.7
    odds = np.log(full / (1.0 - full))
    n = odds.size
    within(odds.mean(), 0.0, 0.7 * np.sqrt(2.0 / n))
    within(odds.std(), 0.7 * np.sqrt(2.0), 0.7 * np.sqrt(1.0 / n) + 0.02)
    leaves = (up[:-1] & ~up[1:]).sum(axis=0) / up[:-1].sum(axis=0)
    rate = -np.log1p(-leaves / (1.0 - full)) * (1.0 - full)  # of a chain that is looked at in every frame
    within(np.median(np.log(1.0 / rate)), np.log(4.0), 1.25 * 0.7 / np.sqrt(n) + 0.03)
    assert odds.std() > 20 * 0.02


def test_traps_are_in_a_share_of_the_pixels_and_have_steps_of_their_own_there():
    effect = RtsNoise(fraction=0.5, amplitude_e=2.0, probability=1.0, spread="exponential")
    after, before, _, _ = analog(effect, (2, 90, 90))
    steps = np.abs(after - before)
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-12)
    within((steps[0] > 0).mean(), 0.5, 0.5 / 90)
    steps = steps[0][steps[0] > 0]
    within(steps.mean(), 2.0, 2.0 / np.sqrt(steps.size))
    within(steps.std(), 2.0, 2.0 * np.sqrt(2 / steps.size) * 1.5)


MAPS = PixelMaps(*np.array([[1.5], [0.1], [100.0], [np.sqrt(9 + 1 / 12)]]), np.ones(1, bool))


def test_telegraph_noise_leaves_the_levels_to_the_pixels():
    model = RtsNoise(fraction=0.01, amplitude_e=1.5, samples=2).sample_law(SampleLaw(), MAPS)
    assert 1.5 in model.free_satellites
    assert dict(model.free_satellite_pattern) == pytest.approx({-0.5: 1 / 3, 0.5: 1 / 3, -1: 1 / 6, 1: 1 / 6})
    assert RtsNoise(fraction=0.01, amplitude_e=0.0).sample_law(SampleLaw(), MAPS).free_satellites == ()


@pytest.mark.parametrize("step", [1.5, 3.0, 4.4])
def test_the_step_of_a_trap_is_measured_however_far_it_is_from_the_stated_one(step):
    rng, shape = np.random.default_rng(1), (4000, 20)
    signal = rng.poisson(1.0, shape) + step * (rng.random(shape) < 0.3) + 0.25 * rng.standard_normal(shape)
    histograms = histogram_frames(np.rint(100.0 + 9.0 * signal).astype(np.uint16)[:, None])
    noise = RtsNoise(fraction=0.01, amplitude_e=1.0, sampling="single", spread="exponential")
    law = noise.sample_law(SampleLaw(), MAPS)
    fit = fit_histograms(histograms.counts[0], histograms.origin[0], law=law)
    assert np.median(fit.satellite_amplitude_e) == pytest.approx(step, rel=0.01)
    assert np.mean(np.abs(fit.satellite_amplitude_e / step - 1.0) < 0.1) >= 0.9
    assert np.median(fit.satellite_weight) == pytest.approx(0.3, abs=0.01)


def test_fast_traps_are_guessed_too_since_a_histogram_does_not_tell_how_long_a_trap_stays():
    seen = SimpleNamespace(z={"shape.He4.chi": 20.0}, n_frames=4000, maps=MAPS)
    times = {one.correlation_frames for one in RtsNoise.estimate(seen) if one.sampling == "single"}
    assert min(times) < 0.2
    assert max(times) > 10.0
    assert RtsNoise.estimate(SimpleNamespace(z={}, n_frames=4000, maps=MAPS)) == []
