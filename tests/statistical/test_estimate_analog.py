"""What the estimators of the analog effects make of simulated frames: near the truth, else silent."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from helpers.small_sensors import drawn_truth, seen, taken

from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.operators.couple import AnalogMemory, InterpixelCapacitance
from pchem_pipeline.effects.operators.curve import Nonlinearity
from pchem_pipeline.effects.operators.drifts import GainDrift
from pchem_pipeline.effects.operators.noise import (
    FlickerNoise,
    HeavyTailedNoise,
    NoiseSkew,
    RtsNoise,
    SignalDependentNoise,
)

CLASSES: tuple[type[Effect], ...] = (
    AnalogMemory, FlickerNoise, GainDrift, HeavyTailedNoise, InterpixelCapacitance, NoiseSkew,
    Nonlinearity, RtsNoise, SignalDependentNoise,
)  # fmt: skip
TRUTH = drawn_truth((28, 28), exposure=(0.5, 3.0), noise_e=(0.22, 0.32))
N_FRAMES = 2400


@functools.cache
def evidence_of(*effects, seed=1):
    return seen(taken(TRUTH, *effects, n_frames=N_FRAMES, seed=seed))


@pytest.mark.parametrize(
    "effect",
    [
        AnalogMemory(memory=0.006),
        AnalogMemory(memory=-0.006),
        AnalogMemory(memory=0.05, spread=0.8),
        FlickerNoise(share=0.03, correlation_frames=10.0),
        FlickerNoise(share=0.02, correlation_frames=40.0),
        GainDrift(drift=0.03),
        GainDrift(drift=-0.03),
        HeavyTailedNoise(share=1e-3),
        InterpixelCapacitance(coupling=0.005),
        NoiseSkew(share=0.6),
        NoiseSkew(share=-0.6),
        Nonlinearity(step_change=0.01),
        Nonlinearity(step_change=-0.01),
        Nonlinearity(step_change=-0.01, noise="bent"),
        RtsNoise(fraction=0.03, amplitude_e=1.0, probability=0.2),
        RtsNoise(fraction=0.03, amplitude_e=2.0, probability=0.1),
        RtsNoise(fraction=0.06, amplitude_e=0.5, probability=0.5, sampling="single"),
        SignalDependentNoise(noise_e=0.08),
        SignalDependentNoise(noise_e=0.05, growth="linear"),
    ],
    ids=lambda v: v.tag,
)
def test_the_strength_is_found_to_a_factor_of_five(effect):
    guesses = type(effect).estimate(evidence_of(effect))
    for kind in ("growth", "noise", "sampling"):
        guesses = [g for g in guesses if getattr(g, kind, None) == getattr(effect, kind, None)]
    ratio = np.array([getattr(g, effect.strength) for g in guesses]) / getattr(effect, effect.strength)
    assert ((ratio > 0.2) & (ratio < 5)).any()
    assert (ratio > 0).all()


@pytest.mark.parametrize(("share", "tau"), [(0.03, 3.0), (0.02, 40.0)])
def test_the_correlation_time_is_among_the_guesses(share, tau):
    guesses = FlickerNoise.estimate(evidence_of(FlickerNoise(share=share, correlation_frames=tau)))
    assert any(0.3 < g.correlation_frames / tau < 3.5 for g in guesses)


def test_anisotropy_is_found_where_it_is():
    effect = InterpixelCapacitance(coupling=0.005, anisotropy=0.7)
    first = next(iter(InterpixelCapacitance.estimate(evidence_of(effect))))
    assert first.anisotropy == pytest.approx(0.7, abs=0.2)
    [plain] = InterpixelCapacitance.estimate(evidence_of(InterpixelCapacitance(coupling=0.005)))
    assert plain.anisotropy == 0.0


@pytest.mark.parametrize("effect", CLASSES, ids=lambda c: c.__name__)
def test_the_opposite_direction_counts_for_nothing(effect):
    plain = evidence_of(seed=10)
    against = replace(plain, z=dict.fromkeys(plain.z, -20.0))
    assert bool(effect.estimate(against)) == (effect in (AnalogMemory, NoiseSkew, Nonlinearity))
