"""The law of the samples under effects with a place and a time, against frames made by plain numpy."""

import numpy as np
import pytest
from helpers.small_sensors import make

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

SHAPE, FRAMES = (2, 4), 400
REGION, WHEN = Region(columns=((2, 4),)), When(range=((100, 200),))
EXPOSURE, GAIN, BIAS, SIGMA = 1.5, 0.1, 100.0, 3.0
CODES = np.arange(70, 220)


def maps(n=8):
    return pixel_maps([np.full(n, v) for v in (EXPOSURE, GAIN, BIAS, SIGMA)], np.ones(n, bool))


def places():
    return PixelPlaces.of_block(None, SHAPE, np.arange(FRAMES))


def mass(effects, at=None):
    law = sample_law(effects, maps(), places=at if at is not None else places())
    return sample_mass(law, maps(), CODES)


#: One of each way in which effects change the law: noise, levels, counts, exposures, edges, outliers.
EFFECTS = [
    make("row_noise", row_noise_dn=2.0),
    make("heavy_tailed_noise", share=0.02),
    make("nonlinearity", step_change=0.01),
    make("signal_dependent_noise", noise_e=0.07),
    make("overdispersed_counts", relative_variance=0.1),
    make("branching_counts", branching=0.05),
    make("exposure_flicker", rms=0.3),
    make("adc_inl", inl_lsb=0.3),
]


@pytest.mark.parametrize("other", EFFECTS, ids=lambda e: e.tag)
def test_laws_of_several_effects_join_in_any_order_where_they_are_and_nowhere_else(other):
    first = EFFECTS[0] if other.tag == "overdispersed_counts" else EFFECTS[4]
    both = [first.at_place(Region(columns=((1, 3),))), other.at_place(REGION)]
    found = mass(both)
    assert np.abs(found[3] - found[0]).max() > 1e-4
    for column, effects in enumerate(([], [first], [first, other], [other])):
        np.testing.assert_allclose(found[column], mass(effects)[column], atol=1e-12, err_msg=str(effects))
    again = sample_law(both, maps(), places=places()).of(np.array([2, 7]))
    np.testing.assert_allclose(sample_mass(again, maps(2), CODES), found[[2, 7]], atol=1e-12)


def test_limits_and_edges_of_some_pixels_only():
    clip, edges = make("clipping", low=98), EFFECTS[-1]
    below = Region(rows=((1, 2),))
    found = mass([clip.at_place(REGION), edges.at_place(below)])
    within, under = REGION.mask(SHAPE).ravel(), below.mask(SHAPE).ravel()
    parts = (([], ~within & ~under), ([clip], within & ~under), ([edges], ~within & under))
    for effects, some in (*parts, ([clip, edges], within & under)):
        np.testing.assert_allclose(found[some], mass(effects)[some], atol=1e-12)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.tag)
def test_a_share_of_the_frames_mixes_the_laws(effect):
    share = WHEN.share(np.arange(FRAMES))
    assert share == 0.25
    exact = (1.0 - share) * mass([]) + share * mass([effect])
    found = mass([effect.at_place(None, WHEN)])
    change = np.abs(exact - mass([])).max()
    # noise and exposures are exact mixtures, the others right to first order
    exactly = effect.tag in ("row_noise", "heavy_tailed_noise", "exposure_flicker")
    assert np.abs(found - exact).max() < (1e-6 if exactly else 0.2 * change)
    np.testing.assert_allclose(mass([effect.at_place(None, When(range=((0, FRAMES),)))]), mass([effect]))


def test_what_cannot_be_said_is_refused_in_one_line():
    clip = make("clipping", low=98)
    with pytest.raises(ConfigError, match=r"clipping in frames 100 to 199 .* limit of the ADC"):
        mass([clip.at_place(None, WHEN)])
    with pytest.raises(ConfigError, match=r"row_noise in columns 2 to 3 .* not known"):
        sample_law([EFFECTS[0].at_place(REGION)], maps())
    with pytest.raises(ConfigError, match="no frame order"):
        mass([EFFECTS[0].at_place(None, WHEN)], PixelPlaces.of_block(None, SHAPE, np.arange(0)))
    with pytest.raises(ConfigError, match="the sensor has 4 columns"):
        mass([EFFECTS[0].at_place(Region(columns=((2, 9),)))])


def test_free_satellites_are_looked_for_inside_only():
    effect = next(iter(effect_class("rts_noise").typical())).at_place(REGION)
    law = sample_law([effect], maps(), places=places())
    np.testing.assert_array_equal(law.may_have_satellites, REGION.mask(SHAPE).ravel())
    assert law.free_satellites
    rng = np.random.default_rng(5)
    n = 4000
    x = BIAS + rng.poisson(EXPOSURE, (n, *SHAPE)) / GAIN + rng.normal(0.0, SIGMA, (n, *SHAPE))
    trap = rng.choice([-1.0, 0.0, 1.0], p=[0.1, 0.8, 0.1], size=(n, *SHAPE))
    histograms = histogram_frames(np.rint(x + 1.5 / GAIN * trap).astype(np.uint16))
    start = np.tile([EXPOSURE, GAIN, BIAS, SIGMA], (8, 1))
    counts = histograms.counts.reshape(8, -1)
    found = fit_histograms(counts, histograms.origin.ravel(), law=law, start=start)
    inside = REGION.mask(SHAPE).ravel()
    assert (found.satellite_weight[inside] > 0.1).all()
    assert (np.nan_to_num(found.satellite_weight[~inside]) == 0.0).all()


def test_a_neutral_law_stays_one():
    assert SampleLaw.joined([(np.arange(4), SampleLaw()), (np.arange(4, 8), SampleLaw())], 8).neutral
