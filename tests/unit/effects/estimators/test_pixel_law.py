"""The exact law of single pixels: its scores are those of the evidence, its mass that of the extended law."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sensor_of_modes import drawn_truth, seen, taken

from pchem_pipeline.effects.analog.noise_skew import NoiseSkew
from pchem_pipeline.effects.analog.nonlinearity import Nonlinearity
from pchem_pipeline.effects.estimators.pixel_law import PixelLaw, refitted, typical_pixels
from pchem_pipeline.effects.estimators.response import strength_of
from pchem_pipeline.effects.framework.evidence import SCORES, PixelMaps
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

N_FRAMES = 1200
FRAMES = taken(drawn_truth((6, 6)), n_frames=N_FRAMES)
EVIDENCE = seen(FRAMES)


def maps_of(exposure, gain, bias, noise_dn) -> PixelMaps:
    values = np.broadcast_arrays(*(np.atleast_1d(v).astype(float) for v in (exposure, gain, bias, noise_dn)))
    return PixelMaps(*values, np.ones(values[0].size, bool))


@pytest.mark.parametrize("pixel", [1, 7, 35])
def test_scores_are_those_of_the_evidence(pixel):
    # noise of another shape, so that the scores are large
    frames = taken(drawn_truth((6, 6)), NoiseSkew(share=-0.9), n_frames=N_FRAMES)
    evidence = seen(frames)
    law = PixelLaw(evidence.maps, pixel, N_FRAMES)
    codes = frames.reshape(N_FRAMES, -1)[:, pixel].astype(float)
    inside = int(np.isin(codes, law.codes).sum())
    assert inside < N_FRAMES
    change = law.on_codes(codes, np.ones(N_FRAMES)) - law.mass
    scores = {name: law.score_shift(name, change) * np.sqrt(inside) for name in SCORES}
    for name, score in scores.items():
        # those of the evidence are corrected for what the fit does to them in second order
        assert score == pytest.approx(evidence.scores[name].flat[pixel], rel=1e-3, abs=0.15)
    assert max(np.abs(list(scores.values()))) > 7
    for table, deviation in ((law.charge, evidence.charge_std), (law.readout, evidence.readout_std)):
        spread = np.sqrt(table**2 @ law.mass - (table @ law.mass) ** 2)
        assert spread == pytest.approx(deviation.flat[pixel], rel=1e-4)


def test_the_mass_is_that_of_the_extended_law_and_all_of_it():
    law = PixelLaw(EVIDENCE.maps, 3, N_FRAMES)
    assert law.mass.sum() == pytest.approx(1.0, abs=1e-9)
    expected = sample_mass(SampleLaw(), law.maps, law.codes)[0]
    np.testing.assert_allclose(law.mass, expected / expected.sum(), atol=1e-14)
    assert abs(law.change(SampleLaw())).max() < 1e-14
    below = sample_mass(SampleLaw(), law.maps, np.arange(law.codes[0] - 300, law.codes[0]))[0].sum()
    assert law.below(SampleLaw()) == pytest.approx(below, rel=1e-6)
    assert below * N_FRAMES < 1e-2


def test_narrow_peaks_and_faint_pixels_do_no_harm():
    maps = maps_of([0.01, 3.0, 60.0], [0.05, 0.05, 1.0], 100.0, [0.3, 0.3, 0.8])
    for pixel in range(3):
        law = PixelLaw(maps, pixel, 1000)
        np.testing.assert_array_equal(np.diff(law.codes), 1)
        change = law.change(Nonlinearity(step_change=0.01).sample_law(SampleLaw(), law.maps))
        assert all(np.isfinite(law.score_shift(name, change)) for name in SCORES)
        assert np.isfinite(law.goodness(change, 1000))


def test_a_refit_of_the_pcd_is_the_pcd():
    law = PixelLaw(maps_of(1.5, 0.1, 100.0, 3.0), 0, N_FRAMES)
    [again] = refitted([law], [law.mass_of(SampleLaw())], N_FRAMES)
    assert again.maps.conversion_gain[0] == pytest.approx(0.1, rel=1e-3)
    # a comb of twice the gain is another PCD, and is found
    [double] = refitted([law], [law.mass_of(law.scaled(2.0))], N_FRAMES)
    assert double.maps.conversion_gain[0] == pytest.approx(0.05, rel=1e-3)


def test_a_fit_that_fails_leaves_the_law():
    law = PixelLaw(maps_of(1.5, 0.1, 100.0, 3.0), 0, N_FRAMES)
    one = np.zeros(law.codes.size)
    one[5] = 1.0
    assert refitted([law], [(law.codes, one)], N_FRAMES) == [law]


def test_typical_pixels_stand_for_all_usable_ones():
    usable = np.ones((6, 6), bool)
    usable[2] = False
    maps = EVIDENCE.maps
    some = PixelMaps(maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn, usable)
    chosen, groups = typical_pixels(some, 4)
    assert sorted(np.concatenate(groups)) == list(np.flatnonzero(usable))
    medians = [np.median(maps.quanta_exposure.flat[group]) for group in groups]
    assert medians == sorted(medians)
    assert all(pixel in group for pixel, group in zip(chosen, groups, strict=True))
    none = PixelMaps(
        maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn, np.zeros((6, 6), bool)
    )
    assert typical_pixels(none)[0].size == 0


def test_strength_needs_a_direction_and_a_significance():
    small = Nonlinearity(step_change=1e-3)
    assert strength_of(EVIDENCE, small, "He1C2", sigmas=50.0, signed=True) == []
    [found] = strength_of(EVIDENCE, small, "He1C2", sigmas=0.0, signed=True)
    opposite = Nonlinearity(step_change=-1e-3 if found.step_change > 0 else 1e-3)
    assert strength_of(EVIDENCE, opposite, "He1C2", sigmas=0.0) == []
