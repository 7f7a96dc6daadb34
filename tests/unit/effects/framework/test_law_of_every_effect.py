"""The law of a pixel's samples with an effect, against samples that its forward model makes."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sensor_of_modes import taken

from pchem_pipeline.effects.adc.adc_dnl import AdcDnl
from pchem_pipeline.effects.adc.adc_inl import AdcInl
from pchem_pipeline.effects.adc.clipping import Clipping
from pchem_pipeline.effects.adc.gain_stitch import GainStitch
from pchem_pipeline.effects.analog.analog_memory import AnalogMemory
from pchem_pipeline.effects.analog.flicker_noise import FlickerNoise
from pchem_pipeline.effects.analog.gain_drift import GainDrift
from pchem_pipeline.effects.analog.heavy_tailed_noise import HeavyTailedNoise
from pchem_pipeline.effects.analog.interpixel_capacitance import InterpixelCapacitance
from pchem_pipeline.effects.analog.noise_skew import NoiseSkew
from pchem_pipeline.effects.analog.nonlinearity import Nonlinearity
from pchem_pipeline.effects.analog.signal_dependent_noise import SignalDependentNoise
from pchem_pipeline.effects.charge.branching_counts import BranchingCounts
from pchem_pipeline.effects.charge.optical_crosstalk import OpticalCrosstalk
from pchem_pipeline.effects.charge.overdispersed_counts import OverdispersedCounts
from pchem_pipeline.effects.charge.spurious_charge import SpuriousCharge
from pchem_pipeline.effects.exposure.exposure_drift import ExposureDrift
from pchem_pipeline.effects.exposure.exposure_flicker import ExposureFlicker
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.simulate.truth import TruthMaps

EXPOSURE, GAIN, BIAS, NOISE_E = 1.5, 0.1, 100.3, 0.3
SHAPE, N_FRAMES = (34, 34), 400
CODES = np.arange(50, 700)

EFFECTS = [
    AnalogMemory(memory=0.05),
    AnalogMemory(memory=0.2, saturation_e=1.5),
    FlickerNoise(share=0.5, correlation_frames=1.0),
    HeavyTailedNoise(share=0.05, factor=3.0),
    NoiseSkew(share=0.5),
    NoiseSkew(share=-0.7),
    Nonlinearity(step_change=0.02),
    Nonlinearity(step_change=-0.02, noise="bent"),
    SignalDependentNoise(noise_e=0.1),
    SignalDependentNoise(noise_e=0.05, growth="linear"),
    InterpixelCapacitance(coupling=0.01, anisotropy=0.5),
    GainDrift(drift=0.12, shape="path", path=(0.5, -0.5, 0.5)),
    AdcDnl(dnl_lsb=0.2, pattern="bit", bit=1),
    AdcDnl(dnl_lsb=0.3, pattern="edges", first_code=100, edges=(0.5, -1.0, 0.8, 0.3)),
    AdcDnl(dnl_lsb=1.0, pattern="edges", first_code=108, edges=(1.0, 0.0, 0.5, -0.5)),
    AdcInl(inl_lsb=1.0, period_dn=37.0, phase=1.0),
    AdcInl(inl_lsb=1.0, form="curve", first_dn=90.0, spacing_dn=9.0, curve=(0.0, 1.0, -0.5, 0.2, 0.8, 0.0)),
    Clipping(low=98, high=141),
    GainStitch(gain_change=0.05, level_dn=121.3),
    GainStitch(gain_change=-0.05, level_dn=118.0, origin_dn=115.0),
    OverdispersedCounts(relative_variance=0.1),
    OverdispersedCounts(relative_variance=0.4),
    OverdispersedCounts(relative_variance=0.4, exposures="lognormal"),
    BranchingCounts(branching=0.05),
    BranchingCounts(branching=0.4),
    OpticalCrosstalk(probability=0.1),
    SpuriousCharge(mean_e=0.3),
    ExposureDrift(drift=0.6),
    ExposureDrift(drift=0.6, settling_fraction=0.3),
    ExposureFlicker(rms=0.3, period_frames=5.3),
    ExposureFlicker(rms=0.3, levels=(1.0, 2.0)),
]


@pytest.mark.parametrize("effect", EFFECTS, ids=repr)
def test_the_law_is_that_of_the_samples(effect):
    parameters = (np.full(SHAPE, value) for value in (EXPOSURE, GAIN, BIAS, NOISE_E))
    truth = TruthMaps(*parameters, np.zeros(SHAPE, np.uint8))
    inside = taken(truth, effect, n_frames=N_FRAMES, seed=8)[:, 1:-1, 1:-1]  # fewer neighbours at the edge
    seen = np.bincount(inside.ravel(), minlength=CODES[-1] + 1)[CODES]
    assert seen.sum() == inside.size
    sigma = np.sqrt((NOISE_E / GAIN) ** 2 + 1 / 12)
    maps = PixelMaps.known([np.array([v]) for v in (EXPOSURE, GAIN, BIAS, sigma)], np.ones(1, bool))

    def misfit(model: SampleLaw) -> float:
        expected = sample_mass(model, maps, CODES)[0] * inside.size
        some = expected > 10
        chi2 = ((seen - expected)[some] ** 2 / expected[some]).sum()
        return float((chi2 - some.sum()) / np.sqrt(2 * some.sum()))

    model = effect.sample_law(SampleLaw(), maps)
    assert abs(misfit(model)) < 5
    assert model.neutral or misfit(SampleLaw()) > 20
