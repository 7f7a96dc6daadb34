"""A search has a limit, in work that is counted: it ends well there, and says so."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from helpers.plain_camera import PlainCamera
from helpers.small_sensors import seen as seen_in

from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError, refit_maps
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.couple import InterpixelCapacitance
from pchem_pipeline.effects.operators.drifts import ExposureFlicker
from pchem_pipeline.effects.operators.noise import NoiseSkew, RtsNoise
from pchem_pipeline.effects.operators.offsets import PeriodicPickup
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_work_is_counted_and_refused_once_the_limit_is_reached():
    effort = Effort(1.0)
    effort.simulate(10**9, 1e8)
    effort.check("nothing")  # before the null distribution is there, there is no limit
    effort.begin()
    null = effort.spent
    effort.check("a")
    effort.evaluate(1e12, 1, ["row_noise"])
    with pytest.raises(EffortSpentError, match="b"):
        effort.check("b")
    assert effort.tried == {"row_noise"}
    # a quarter is kept for what is measured
    effort.spent = null + 0.8 * 6.0 * null
    with pytest.raises(EffortSpentError):
        effort.check("c")
    effort.measure()
    effort.check("d")
    # also where what has no limit went beyond
    effort.begin()
    effort.spent, kept = effort.most + null, effort.kept
    effort.measure()
    assert kept > 0.0
    assert effort.most - effort.spent == pytest.approx(kept)
    effort.spent, kept = effort.most, effort.for_choice
    effort.choose()
    effort.check("e")
    effort.choose()  # once
    assert effort.most - effort.spent == pytest.approx(kept)


def test_a_small_search_has_its_least_and_one_without_a_limit_none():
    small, double, free = Effort(1.0), Effort(2.0), Effort(None)
    for effort in (small, double, free):
        effort.begin()
        effort.measure()
        effort.choose()
    assert double.most == 2.0 * small.most > 0.0
    assert math.isinf(free.most)


def test_however_much_the_candidates_cost_some_is_left_to_fit_them():
    """Of a strong glow in bursts 115 guesses were simulated, and none was fitted."""
    effort = Effort(1.0)
    effort.begin()
    limit = effort.most + effort.kept
    effort.leave_for_fits()
    assert effort.most + effort.kept == limit  # enough is left
    effort.spent = effort.most + 50.0
    effort.leave_for_fits()
    effort.check("a candidate was fitted")
    effort.spent += 0.4 * limit
    with pytest.raises(EffortSpentError):
        effort.check("the next")
    short = Effort(0.1)  # as it was asked for
    short.begin()
    short.spent = short.most
    short.leave_for_fits()
    with pytest.raises(EffortSpentError):
        short.check("a candidate was fitted")


def spent(work: Callable[[Effort], None]) -> float:
    effort = Effort(1.0)
    work(effort)
    return effort.spent


def test_work_costs_what_makes_it_long():
    plain = spent(lambda e: e.evaluate(1e9, 1, []))
    mixed = SampleLaw().with_noise([0.9, 0.05, 0.05], shift_e=[0.0, -1.0, 1.0])
    assert (SampleLaw().components, mixed.components) == (1, 3)
    assert spent(lambda e: e.evaluate(1e9, mixed.components, [])) == pytest.approx(2.0 * plain)
    # a sensor that is learnt, from so many pixels at most
    assert spent(lambda e: e.learn(1000, 15)) == spent(lambda e: e.learn(10**6, 15)) > 1.0
    assert 0.1 < spent(lambda e: e.ask(10**6)) < 1.0


def test_a_law_that_differs_by_pixel_costs_no_more_for_that():
    """Flicker in some rows only: as many components a pixel, not as many as all pixels have together."""
    shape = (12, 16)
    maps = pixel_maps([np.full(shape, value) for value in (1.5, 0.1, 100.0, 3.0)], np.ones(shape, bool))
    flicker = ExposureFlicker(rms=0.1)
    everywhere = sample_law((flicker,), maps)
    places = PixelPlaces.of_block(None, shape, np.arange(100))
    placed = sample_law((flicker.at_place(Region(rows=((2, 5),)), None),), maps, None, places)
    assert 1 < placed.components <= 2 * everywhere.components


def test_a_law_that_fits_hardly_a_pixel_is_given_up_after_some_and_one_of_too_many_peaks_is_not_begun_with():
    frames = PlainCamera(0.3, 4.0, 12.0, (16, 16), 600).frames(1)
    seen = seen_in(frames)
    little = refit_maps(frames, seen.maps, [InterpixelCapacitance(coupling=0.01)], seen.covariance)
    assert little.maps.usable.all()
    occupied = np.count_nonzero(histogram_frames(frames).counts)
    assert 1.0 < little.evaluated / occupied < 15.0
    # noise in two states, of which there are none, takes many times as long to fit
    states = RtsNoise(fraction=1.0, amplitude_e=1.5, probability=0.5)
    poor = refit_maps(frames, seen.maps, [states], seen.covariance)
    assert poor.components > 1
    assert poor.evaluated > 3.0 * little.evaluated
    # so much coupling between neighbours would widen the peaks more than they are
    with pytest.raises(NotFittedError):
        refit_maps(frames, seen.maps, [InterpixelCapacitance(coupling=0.1)], seen.covariance)
    # a stack with noise of three kinds, strong in all, took minutes over a set that left nearly all
    wave = PeriodicPickup(amplitude_dn=1.0, cycles_per_row=0.36)
    with pytest.raises(NotFittedError, match="would have 80"):
        refit_maps(frames, seen.maps, [NoiseSkew(share=0.83), wave], seen.covariance)


def test_a_simulated_stack_costs_what_its_fits_evaluate():
    """Plain fits of what they cannot explain take many times as long, and counted as little."""
    camera = PlainCamera(0.2, 1.5, 10.0, (16, 16), 1000)
    frames, numbers = camera.frames(1), np.arange(1000)
    wide = frames + np.random.default_rng(2).integers(0, 200, frames.shape).astype(frames.dtype)
    usual, poor = (observe(each, numbers, n_run=1000, block_frames=100).evaluated for each in (frames, wide))
    assert poor > 5.0 * usual > 0.0
    stack, *both = (spent(lambda e, n=n: e.simulate(0, n)) for n in (0.0, usual, poor))
    assert both[1] - stack > 5.0 * (both[0] - stack) > 0.0
