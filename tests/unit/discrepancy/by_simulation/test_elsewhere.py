"""A model that was found in one window is looked at again in another."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import serial
from pchem_pipeline.discrepancy.by_simulation.elsewhere import deviation
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.offsets import RowNoise

FRAMES, SIDE, WIDTH = 900, 16, 40


def tilted(rms: float) -> NDArray[np.uint16]:
    """A slope along each row of forty pixels, DN rms at its ends, drawn anew in every frame."""
    rng, shape = np.random.default_rng(4), (FRAMES, SIDE, WIDTH)
    plain = 100.0 + 12.0 * (rng.poisson(2.0, shape) + 0.25 * rng.standard_normal(shape))
    slope = np.linspace(-1.0, 1.0, WIDTH) * rng.standard_normal((FRAMES, SIDE, 1))
    return np.rint(plain + rms * slope).astype(np.uint16)


def said(stack: NDArray[np.uint16], columns: tuple[int, int], model: tuple[Effect, ...]) -> str:
    window = SensorWindow((0, SIDE), columns, (SIDE, WIDTH))
    frames = FrameStack.of(
        stack[:, :, slice(*columns)], np.arange(FRAMES), None,
        n_run=FRAMES, bit_depth=12, integration_time=1.0, window=window,
    )  # fmt: skip
    return deviation(Simulations(ObservedFrames.of(frames), serial, 1, Effort(None)), model)


@pytest.mark.parametrize(("columns", "holds"), [((24, 40), True), ((0, 16), False)])
def test_one_end_of_a_slope_along_rows_is_noise_of_rows_but_not_at_the_other(columns, holds):
    right = RowNoise(row_noise_dn=0.62, region=Region(columns=((24, 40),)))
    words = said(tilted(1.0), columns, (right,))
    assert (words == "") is holds
    assert holds or "row means of the readout residuals scatter" in words


def test_frames_without_anything_agree_with_the_plain_model():
    assert said(tilted(0.0), (0, 16), ()) == ""
