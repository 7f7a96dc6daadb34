"""Sensors that a search learns from the frames under a model."""

import numpy as np
from helpers.plain_camera import PlainCamera
from helpers.sensor_of_modes import context_of

from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import serial
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import learn_sensor
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.splits import block_length, split_frames
from pchem_pipeline.effects.readout.pixel_correction import PixelCorrection


def test_what_stands_in_for_replaced_samples_is_drawn_from_the_model():
    """Where a tenth of the samples are replaced, medians of what was seen lie too low: 0.04 in log H."""
    shape, n = (20, 20), 1500
    camera = PlainCamera(0.25, 1.5, 12.0, shape, n, (0.25, 0.015, 0.06, 3.0))
    exposure, *_ = camera.maps(np.random.default_rng(6))
    effect, numbers = PixelCorrection(threshold_dn=24), np.arange(n)
    frames = effect.apply(camera.frames(6), context_of(shape, n))
    splits = split_frames(numbers, block_length(n, None))
    observed = ObservedFrames.of(FrameStack(frames, numbers, splits, n, 10, 1.0))
    work = Simulations(observed, serial, 1, Effort(None))
    found = work.mapped((effect,))
    # one stack for what stands in, one whose fits are compared with those of the frames
    assert work.effort.replicates == 2
    seen = work.frames.seen_stack, work.frames.seen_numbers
    by_seen = learn_sensor(*seen, found.fit, (effect,), observed.plain.ambiguous, work.lost)

    def off(sensor):
        some = sensor.drawn.copy()
        some[[0, -1]] = some[:, [0, -1]] = False
        ratio = np.log(sensor.draw(1).quanta_exposure[some] / exposure[some])
        return abs(np.median(ratio)), 5 * 1.25 * ratio.std() / np.sqrt(ratio.size)

    median, limit = off(found.sensor)
    assert median < limit
    assert off(by_seen)[0] > 1.5 * limit
