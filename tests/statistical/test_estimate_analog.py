"""What the estimators of the analog effects make of simulated frames: near the truth, else silent."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_of_modes import drawn_truth, seen, taken

from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.analog.analog_memory import AnalogMemory
from pchem_pipeline.effects.analog.flicker_noise import FlickerNoise
from pchem_pipeline.effects.analog.gain_drift import GainDrift
from pchem_pipeline.effects.analog.heavy_tailed_noise import HeavyTailedNoise
from pchem_pipeline.effects.analog.interpixel_capacitance import InterpixelCapacitance
from pchem_pipeline.effects.analog.noise_skew import NoiseSkew
from pchem_pipeline.effects.analog.nonlinearity import Nonlinearity
from pchem_pipeline.effects.analog.rts_noise import RtsNoise
from pchem_pipeline.effects.analog.signal_dependent_noise import SignalDependentNoise
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence

CLASSES: tuple[type[Effect], ...] = (
    AnalogMemory, FlickerNoise, GainDrift, HeavyTailedNoise, InterpixelCapacitance, NoiseSkew,
    Nonlinearity, RtsNoise, SignalDependentNoise,
)  # fmt: skip
TRUTH = drawn_truth((28, 28), exposure=(0.5, 3.0), noise_e=(0.22, 0.32))
N_FRAMES = 2400


@functools.cache
def evidence_of(*effects: Effect, seed: int = 1) -> Evidence:
    return seen(taken(TRUTH, *effects, n_frames=N_FRAMES, seed=seed))


def test_nothing_is_guessed_where_nothing_is():
    # each fires by chance in about one stack in 300
    fired = [c.__name__ for seed in range(3) for c in CLASSES if c.estimate(evidence_of(seed=10 + seed))]
    assert len(fired) <= 2, fired


@pytest.mark.parametrize(
    ("effect", "relative"),
    [
        # strengths of 10 standard errors or more; the rest is what the first order and a coarse grid leave
        (AnalogMemory(memory=0.006), 0.3),
        (AnalogMemory(memory=-0.006), 0.3),
        (FlickerNoise(share=0.03, correlation_frames=3.0), 0.4),
        (FlickerNoise(share=0.02, correlation_frames=40.0), 0.4),
        (GainDrift(drift=0.03), 0.3),
        (GainDrift(drift=-0.03), 0.3),
        (HeavyTailedNoise(share=1e-3), 0.4),
        (InterpixelCapacitance(coupling=0.005), 0.3),
        (NoiseSkew(share=0.6), 0.25),
        (NoiseSkew(share=-0.6), 0.25),
        (Nonlinearity(step_change=0.01), 0.35),
        (Nonlinearity(step_change=-0.01), 0.35),
        (Nonlinearity(step_change=-0.01, noise="bent"), 0.35),
        (SignalDependentNoise(noise_e=0.08), 0.25),
    ],
    ids=lambda v: v.tag if isinstance(v, Effect) else "",
)
def test_the_strength_is_found(effect, relative):
    first = next(iter(type(effect).estimate(evidence_of(effect))))
    truth = getattr(effect, effect.strength)
    assert getattr(first, effect.strength) == pytest.approx(truth, rel=relative)


@pytest.mark.parametrize("memory", [0.006, 0.05])
def test_a_memory_that_differs_is_told_from_one_alike(memory):
    alike, differs = AnalogMemory.estimate(evidence_of(AnalogMemory(memory=memory, spread=0.8)))
    assert alike.spread == 0.0
    # of 784 lognormal numbers, with what chance adds to each
    assert differs.spread == pytest.approx(0.8, abs=0.12)
    assert differs.memory == pytest.approx(memory, rel=0.15)
    assert len(AnalogMemory.estimate(evidence_of(AnalogMemory(memory=memory)))) == 1


def test_a_linear_growth_is_among_the_guesses():
    effect = SignalDependentNoise(noise_e=0.05, growth="linear")
    found = {guess.growth: guess for guess in SignalDependentNoise.estimate(evidence_of(effect))}
    assert found["linear"].noise_e == pytest.approx(0.05, rel=0.25)


def test_the_correlation_time_is_found():
    for tau in (3.0, 40.0):
        effect = FlickerNoise(share=0.03 if tau < 10 else 0.02, correlation_frames=tau)
        first = next(iter(FlickerNoise.estimate(evidence_of(effect))))
        assert 0.3 < first.correlation_frames / tau < 3.5


def test_anisotropy_is_found_where_it_is():
    effect = InterpixelCapacitance(coupling=0.005, anisotropy=0.7)
    first = next(iter(InterpixelCapacitance.estimate(evidence_of(effect))))
    assert first.anisotropy == pytest.approx(0.7, abs=0.2)
    [plain] = InterpixelCapacitance.estimate(evidence_of(InterpixelCapacitance(coupling=0.005)))
    assert plain.anisotropy == 0.0


def test_a_path_of_the_gain_is_found():
    effect = GainDrift(drift=0.06, shape="path", path=(-0.5, 0.5, -0.5))
    found = GainDrift.estimate(evidence_of(effect))
    assert found[0].shape == "path"
    position = np.linspace(0, 1, 50)
    seen_profile, true_profile = (
        found[0].drift * found[0].profile(position),
        0.06 * effect.profile(position),
    )
    assert np.abs(seen_profile - true_profile).max() < 0.02


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_gain_that_settles_is_found_as_such(sign):
    effect = GainDrift(drift=0.06 * sign, shape="settling", settling_fraction=0.1)
    [first] = [e for e in GainDrift.estimate(evidence_of(effect)) if e.shape == "settling"]
    assert 0.05 <= first.settling_fraction <= 0.2
    position = np.linspace(0, 1, 50)
    apart = first.drift * first.profile(position) - effect.drift * effect.profile(position)
    assert np.abs(apart).max() < 0.02
    line = effect.drift * (position - 0.5) - effect.drift * effect.profile(position)
    assert np.abs(line).max() > 0.02  # what the limit would catch


@pytest.mark.parametrize(
    "effect",
    [
        RtsNoise(fraction=0.03, amplitude_e=1.0, probability=0.2),
        RtsNoise(fraction=0.03, amplitude_e=2.0, probability=0.1),
    ],
    ids=lambda e: f"{e.amplitude_e}",
)
def test_telegraph_noise_is_found(effect):
    found = RtsNoise.estimate(evidence_of(effect))
    assert 1 <= len(found) <= 5
    near = [g for g in found[:3] if g.samples == 1 and 0.6 < g.amplitude_e / effect.amplitude_e < 1.6]
    assert near
    # pixels whose fit it ruins are not looked at, so the share may be too small
    assert any(0.25 < guess.fraction / 0.03 < 2.0 for guess in near)


def test_slow_telegraph_noise_is_found():
    effect = RtsNoise(
        fraction=0.03, amplitude_e=0.5, probability=0.5, sampling="single", correlation_frames=15.0
    )
    slow = [g for g in RtsNoise.estimate(evidence_of(effect)) if g.sampling == "single"]
    assert [g.times_spread > 0 for g in slow] == [False, True, True]
    assert slow[0].amplitude_e == pytest.approx(0.5, rel=0.4)
    assert 0.3 < slow[0].correlation_frames / 15.0 < 3.5


def test_slow_traps_that_differ_have_smaller_steps_than_those_that_stand_out():
    """Drawn by numpy alone: traps of their own steps and times; the weak ones are lost in the light."""
    rng = np.random.default_rng(8)
    n_frames, shape, share, step = 1500, (24, 24), 0.15, 1.0
    n = int(share * 576)
    leave = 1.0 / rng.uniform(3.0, 80.0, (2, n))  # of the empty and of the full state, per frame
    state = rng.random(n) < leave[0] / leave.sum(axis=0)
    traps = np.zeros((n_frames, n))
    for t in range(n_frames):
        traps[t] = state
        state = np.where(rng.random(n) < np.where(state, leave[1], leave[0]), ~state, state)
    signal = rng.poisson(1.5, (n_frames, 576)) + 0.25 * rng.standard_normal((n_frames, 576))
    steps = np.maximum(rng.normal(step, 0.2, n), 0.4)
    signal[:, rng.choice(576, n, replace=False)] += steps * (traps - traps.mean(axis=0))
    frames = np.rint(100.0 + 10.0 * signal).reshape(n_frames, *shape).astype(np.uint16)
    evidence = observe(frames, np.arange(n_frames), n_run=n_frames, block_frames=50)
    alike, *differing = [g for g in RtsNoise.estimate(evidence) if g.sampling == "single"]
    assert alike.amplitude_e / step > 1.15
    assert any(abs(g.amplitude_e / step - 1.0) < 0.15 and g.times_spread > 0 for g in differing)


@pytest.mark.parametrize("effect", CLASSES, ids=lambda c: c.__name__)
def test_the_opposite_direction_counts_for_nothing(effect):
    plain = evidence_of(seed=10)
    assert plain.time is not None
    scores = {name: -20.0 * np.ones_like(values) for name, values in plain.scores.items()}
    time = replace(
        plain.time,
        lag_readout=-np.abs(plain.time.lag_readout) - 0.2,
        block_readout=0.1 * plain.time.block_readout,
        neighbours=dict.fromkeys(plain.time.neighbours, -0.1),
    )
    against = replace(plain, scores=scores, time=time, goodness=-np.abs(plain.goodness))
    signed = effect in (NoiseSkew, Nonlinearity)
    assert bool(effect.estimate(against)) == signed


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 1)])
def test_very_small_sensors_do_no_harm(shape):
    evidence = seen(taken(drawn_truth(shape), n_frames=400))
    for effect in CLASSES:
        assert len(effect.estimate(evidence)) <= 1
