"""The law of a pixel's samples under common modes and a real ADC, against what the forward models do."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, offsets
from scipy.special import ndtri

from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.drifts import BiasDrift
from pchem_pipeline.effects.operators.offsets import (
    BiasJumps,
    ColumnNoise,
    FrameNoise,
    PeriodicPickup,
    ReadoutAlternation,
    RowNoise,
)
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

H, STEP, MU, NOISE_E = 1.4, 12.0, 100.3, 0.25
SIGMA = float(np.sqrt((NOISE_E * STEP) ** 2 + 1 / 12))
CODES = np.arange(60, 260)
NORMAL = ndtri((np.arange(2000) + 0.5) / 2000)


def maps_of(bias):
    bias = np.atleast_1d(np.asarray(bias, float))
    constant = [np.full(bias.shape, v) for v in (H, 1 / STEP, SIGMA)]
    return PixelMaps(constant[0], constant[1], bias, constant[2], np.ones(bias.shape, np.bool_))


def law_of(effect):
    maps = maps_of(MU)
    return sample_mass(effect.sample_law(SampleLaw(), maps), maps, CODES)[0]


def smeared(added):
    """Return the mean of the plain law over these offsets, DN."""
    return sample_mass(SampleLaw(), maps_of(MU + added.ravel()), CODES).mean(axis=0)


@pytest.mark.parametrize("scale", [0.2, 3.0])
@pytest.mark.parametrize(
    "effect",
    [
        BiasDrift(drift_dn=2.0),
        BiasDrift(drift_dn=-2.0, shape="path", path=(0.0, 0.2, 1.0, -0.1)),
        BiasDrift(drift_dn=2.0, shape="settling", settling_fraction=0.3),
        PeriodicPickup(amplitude_dn=1.0, cycles_per_frame=0.2137),
        ReadoutAlternation(alternation_dn=-0.8),
        BiasJumps(amplitude_dn=1.0, rate=0.4, levels=5),
        BiasJumps(amplitude_dn=1.0, path=(((0, 1.0), (700, -0.5), (1400, 0.8)),) * 4),
    ],
    ids=lambda e: getattr(e, "tag", ""),
)
def test_offsets_smear_the_law_as_they_smear_the_samples(effect, scale):
    effect = effect.scaled(scale)
    exact = smeared(offsets(effect, context_of((1, 1), 2100))[:, 0, 0])
    change = np.abs(exact - smeared(np.zeros(1))).max()
    assert np.abs(law_of(effect) - exact).max() < 0.06 * change


@pytest.mark.parametrize("size", [0.2, 2.0])
def test_gaussian_offsets_widen_the_law(size):
    quantiles = NORMAL / NORMAL.std() * size
    exact = smeared(quantiles)
    change = np.abs(exact - smeared(np.zeros(1))).max()
    noises = FrameNoise(frame_noise_dn=size), RowNoise(row_noise_dn=size), ColumnNoise(column_noise_dn=size)
    for effect in noises:
        assert np.abs(law_of(effect) - exact).max() < 0.06 * change, effect
