"""The law of a pixel's samples with an effect, against samples that its forward model makes."""

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor, context_of, make, offsets, taken
from scipy.special import ndtri

from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

EXPOSURE, GAIN, BIAS, NOISE_E = 1.5, 0.1, 100.3, 0.3
SHAPE, N_FRAMES = (34, 34), 400
CODES = np.arange(50, 700)

EFFECTS = [
    make("analog_memory", memory=0.05),
    make("analog_memory", memory=0.2, saturation_e=1.5),
    make("flicker_noise", share=0.5, correlation_frames=1.0),
    make("heavy_tailed_noise", share=0.05, factor=3.0),
    make("noise_skew", share=0.5),
    make("noise_skew", share=-0.7),
    make("nonlinearity", step_change=0.02),
    make("nonlinearity", step_change=-0.02, noise="bent"),
    make("signal_dependent_noise", noise_e=0.1),
    make("signal_dependent_noise", noise_e=0.05, growth="linear"),
    make("interpixel_capacitance", coupling=0.01, anisotropy=0.5),
    make("gain_drift", drift=0.12, shape="path", path=(0.5, -0.5, 0.5)),
    make("adc_dnl", dnl_lsb=0.2, pattern="bit", bit=1),
    make("adc_dnl", dnl_lsb=0.3, pattern="edges", first_code=100, edges=(0.5, -1.0, 0.8, 0.3)),
    make("adc_dnl", dnl_lsb=1.0, pattern="edges", first_code=108, edges=(1.0, 0.0, 0.5, -0.5)),
    make("adc_inl", inl_lsb=1.0, period_dn=37.0, phase=1.0),
    make(
        "adc_inl", inl_lsb=1.0, form="curve", first_dn=90.0, spacing_dn=9.0, curve=(0, 1, -0.5, 0.2, 0.8, 0)
    ),
    make("clipping", low=98, high=141),
    make("gain_stitch", gain_change=0.05, level_dn=121.3),
    make("gain_stitch", gain_change=-0.05, level_dn=118.0, origin_dn=115.0),
    make("overdispersed_counts", relative_variance=0.1),
    make("overdispersed_counts", relative_variance=0.4),
    make("overdispersed_counts", relative_variance=0.4, exposures="lognormal"),
    make("branching_counts", branching=0.05),
    make("branching_counts", branching=0.4),
    make("trapping", capture=0.5, release=0.3),
    make("optical_crosstalk", probability=0.1),
    make("spurious_charge", mean_e=0.3),
    make("charge_lag", fraction=0.3),
    make("charge_diffusion", fraction=0.3),
    make("exposure_drift", drift=0.6),
    make("exposure_drift", drift=0.6, settling_fraction=0.3),
    make("exposure_flicker", rms=0.3, period_frames=5.3),
    make("exposure_flicker", rms=0.3, levels=(1.0, 2.0)),
    make("empirical", share=0.2, moves=[{"shift_dn": -9, "weight": 3.0}, {"shift_dn": 5}]),
    make("empirical_electrons", chance=0.1, modes=[{"fate": "lost"}]),
    make("empirical_electrons", chance=0.1, modes=[{"fate": "emptied"}]),
    make("empirical_noise", noise_dn=1.0, modes=[{"of": "sample", "share": 1.0}]),
]


def maps_of(bias):
    sigma = np.sqrt((NOISE_E / GAIN) ** 2 + 1 / 12)
    return PixelMaps.known(
        np.broadcast_arrays(EXPOSURE, GAIN, np.ravel(bias), sigma), np.ones(np.size(bias), bool)
    )


@pytest.mark.parametrize("effect", EFFECTS, ids=repr)
def test_the_law_is_that_of_the_samples(effect):
    truth = a_uniform_sensor(SHAPE, EXPOSURE, GAIN, BIAS, NOISE_E)
    inside = taken(truth, effect, n_frames=N_FRAMES, seed=8)[:, 1:-1, 1:-1]  # fewer neighbours at the edge
    seen = np.bincount(inside.ravel(), minlength=CODES[-1] + 1)[CODES]
    assert seen.sum() == inside.size
    maps = maps_of(BIAS)

    def misfit(model):
        expected = sample_mass(model, maps, CODES)[0] * inside.size
        some = expected > 10
        chi2 = ((seen - expected)[some] ** 2 / expected[some]).sum()
        return float((chi2 - some.sum()) / np.sqrt(2 * some.sum()))

    model = effect.sample_law(SampleLaw(), maps)
    assert abs(misfit(model)) < 5
    assert model.neutral or misfit(SampleLaw()) > 20


def assert_smeared(effect, added):
    """The law with an effect is the mean of the plain law over offsets, DN."""
    plain, exact = (
        sample_mass(SampleLaw(), maps_of(BIAS + each), CODES).mean(axis=0) for each in (0.0, added)
    )
    law = sample_mass(effect.sample_law(SampleLaw(), maps_of(BIAS)), maps_of(BIAS), CODES)[0]
    assert np.abs(law - exact).max() < 0.06 * np.abs(exact - plain).max()


@pytest.mark.parametrize("scale", [0.2, 3.0])
@pytest.mark.parametrize(
    "effect",
    [
        make("bias_drift", drift_dn=2.0),
        make("bias_drift", drift_dn=-2.0, shape="path", path=(0.0, 0.2, 1.0, -0.1)),
        make("bias_drift", drift_dn=2.0, shape="settling", settling_fraction=0.3),
        make("periodic_pickup", amplitude_dn=1.0, cycles_per_frame=0.2137),
        make("readout_alternation", alternation_dn=-0.8),
        make("bias_jumps", amplitude_dn=1.0, rate=0.4, levels=5),
        make("bias_jumps", amplitude_dn=1.0, path=(((0, 1.0), (700, -0.5), (1400, 0.8)),) * 4),
    ],
    ids=repr,
)
def test_offsets_smear_the_law_as_they_smear_the_samples(effect, scale):
    effect = effect.scaled(scale)
    assert_smeared(effect, offsets(effect, context_of((1, 1), 2100))[:, 0, 0])


@pytest.mark.parametrize("size", [0.2, 2.0])
@pytest.mark.parametrize("tag", ["frame_noise", "row_noise", "column_noise"])
def test_gaussian_offsets_widen_the_law(tag, size):
    quantiles = ndtri((np.arange(2000) + 0.5) / 2000)
    assert_smeared(make(tag, **{f"{tag}_dn": size}), quantiles / quantiles.std() * size)
