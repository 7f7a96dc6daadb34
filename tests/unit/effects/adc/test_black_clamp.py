"""Black-level clamp: the forward model, its moments, and what the estimator makes of it and of relatives."""

import numpy as np
import pytest
from helpers.small_sensors import drawn_truth, seen, taken
from hidden.chain import hide

from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.couple import BlackClamp
from pchem_pipeline.model.law.sample_law import SampleLaw


@pytest.mark.parametrize("place", [{}, {"columns": (0, 3)}, {"rows": (9, 12)}])
def test_frames_move_against_the_clamp_s_pixels(place):
    truth, effect = drawn_truth((12, 8)), BlackClamp(follow=0.8, **place)
    plain, clamped = taken(truth, n_frames=300), taken(truth, effect, n_frames=300)
    part = np.s_[:, slice(*effect.rows or (None,)), slice(*effect.columns or (None,))]
    usual = truth.bias + truth.quanta_exposure / truth.conversion_gain
    deviation = plain[part].mean(axis=(1, 2)) - usual[part[1:]].mean()
    moved = (clamped - plain.astype(float)).mean(axis=(1, 2))
    np.testing.assert_allclose(moved, -0.8 * deviation, atol=5 * 0.8 / np.sqrt(12 * 3))
    assert moved.std() > 1.0


def test_a_window_has_its_part_of_the_clamp():
    shape, window = (40, 60), ((10, 30), (0, 20))
    found = BlackClamp(follow=0.3, columns=(0, 4)).to_sensor(*window, shape)
    assert (found.rows, found.columns) == ((10, 30), (0, 4))
    seen_again = found.to_window(*window, shape)
    assert (seen_again.rows, seen_again.columns, seen_again.follow) == ((0, 20), (0, 4), 0.3)
    assert found.to_window((10, 30), (20, 40), shape).follow == 0.0
    part = Part(Region(rows=((5, 15),)))
    looked_at = SensorWindow(*window, shape)
    placed = looked_at.found(BlackClamp(follow=0.3, rows=(0, 4)), Part(looked_at.on_sensor(part.region)))
    assert (placed.rows, placed.columns, placed.region) == ((15, 19), (0, 20), Region(rows=((15, 25),)))
    [acting] = looked_at.effects([placed])
    assert (acting.rows, acting.columns) == ((5, 9), (0, 20))
    whole = BlackClamp(follow=0.3, rows=(0, 4))
    assert whole.to_sensor((0, 40), (0, 60), shape) == whole


def test_the_law_has_the_variance_of_the_clamp():
    maps = PixelMaps(np.array([2.0]), np.array([0.1]), np.array([100.0]), np.array([3.0]), np.ones(1, bool))
    law = BlackClamp(follow=0.5, pixels=20).sample_law(SampleLaw(), maps)
    assert law.extra_variance_dn2[0] == pytest.approx(0.25 * (9.0 + 200.0) / 20)
    assert BlackClamp(follow=0.5).sample_law(SampleLaw(), maps).neutral


# of the whole frame, of columns, of rows
@pytest.mark.parametrize("seed", [180100, 180101, 180104])
@pytest.mark.parametrize("level", [4.0, 30.0])
def test_an_independent_camera_s_clamp_is_found(seed, level):
    hiding = hide(("black_clamp",), level, seed, (24, 24), 1500)
    (hidden,) = hiding.effects
    [found] = BlackClamp.estimate(seen(hiding.frames))
    where = hidden.parameters["where"]
    assert 0.4 < found.follow / hidden.strength < 2.5
    if where != "all" and level > 10:
        assert getattr(found, where) == (0, 3)
        assert 70 <= found.pixels <= 72  # without a pixel that has no fit
    if where == "all":
        assert found.pixels > 400
