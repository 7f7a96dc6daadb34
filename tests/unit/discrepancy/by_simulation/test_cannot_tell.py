"""What frames cannot tell, or tell in one window only."""

import numpy as np
import pytest
from helpers.plain_camera import LAYOUTS, PlainCamera
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import serial
from pchem_pipeline.discrepancy.by_simulation.elsewhere import deviation
from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.estimators.codes import few_shifts
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.offsets import RowNoise

NOISY = PlainCamera(0.62, 1.2, 9.0, (10, 12), 600)
QUICK = DiscrepancySettings(replicates=20, extended_replicates=12, candidates=("row_noise",))


def test_perfect_frames_of_a_noisy_sensor_cannot_tell_and_what_would_help_is_said():
    perfect = find_discrepancies(NOISY.frames(11), settings=QUICK)
    found, counted = perfect.verdict, perfect.statistics[0]
    assert "space.row.readout.variance" in counted
    assert not {"shape.C3.mean", "code.smooth"} & set(counted)
    assert found.verdict == "cannot_tell"
    assert found.effects == ()
    assert "pchem joint" in found.doubt
    assert found.doubt in found.sentence
    assert found.word == "cannot tell"


@pytest.mark.long
@pytest.mark.parametrize("layout", LAYOUTS)
def test_perfect_frames_of_a_sensor_of_any_layout_are_not_called_wrong(layout):
    camera = PlainCamera(0.25, 2.5, 10.0, (48, 64), 1500, (0.01, 0.01, 0.08, 3.0), layout)
    found = find_discrepancies(camera.frames(21)).verdict
    assert found.verdict == "consistent", found.sentence


def test_row_noise_is_found_on_a_noisy_sensor():
    """Four tenths of the read noise of 5.6 DN, 12 errors of the variance of row means."""
    rng = np.random.default_rng(21)
    frames = NOISY.frames(21).astype(np.int64)
    frames += np.rint(2.2 * rng.standard_normal((*frames.shape[:2], 1))).astype(np.int64)
    found = find_discrepancies(np.maximum(frames, 0).astype(np.uint16), settings=QUICK).verdict
    assert found.verdict in ("named", "named_in_part")
    assert found.effects == ("row_noise",)
    assert found.limit == ""


def test_what_rests_on_the_parameters_does_not_count_where_they_are_not_identified():
    names = ("shape.C3.mean", "space.row.readout.variance", "code.smooth", "code.rough", "code.period4")
    # of electrons that are four codes apart the parameters bend codes of that period, too
    for step, told in ((12.0, [True, True]), (4.6, [True, False]), (3.9, [False, False])):
        values = [np.full((2, 2), v) for v in (1.0, 1.0 / step, 100.0, 2.0)]
        maps = PixelMaps.known(values, np.full((2, 2), True))
        assert free_of_parameters(names, maps).tolist() == [False, True, False, *told]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_codes_hold_no_edges(n):
    assert few_shifts(np.full(n, 0.01), np.full(n, 200.0)) is None


FRAMES, SIDE, WIDTH = 600, 12, 40


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
    assert holds or said(tilted(0.0), columns, ()) == ""  # frames without anything agree with the plain model
