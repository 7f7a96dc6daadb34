"""Where pixels are not identified perfect frames are not called wrong, and gross disagreements are found."""

import numpy as np
import pytest
from helpers.plain_camera import LAYOUTS, PlainCamera

from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.estimators.codes import few_shifts
from pchem_pipeline.effects.framework.evidence import PixelMaps

NOISY = PlainCamera(0.62, 1.2, 9.0, (16, 16), 600)
QUICK = DiscrepancySettings(replicates=20, extended_replicates=12, candidates=("row_noise",))


@pytest.fixture(scope="module")
def perfect():
    return find_discrepancies(NOISY.frames(11), settings=QUICK)


def test_perfect_frames_of_a_noisy_sensor_cannot_tell_and_what_would_help_is_said(perfect):
    found = perfect.verdict
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
    """A third of the read noise of 5.6 DN, 14 errors of the variance of row means."""
    rng = np.random.default_rng(21)
    frames = NOISY.frames(21).astype(np.int64)
    frames += np.rint(1.9 * rng.standard_normal((*frames.shape[:2], 1))).astype(np.int64)
    found = find_discrepancies(np.maximum(frames, 0).astype(np.uint16), settings=QUICK).verdict
    assert found.verdict in ("named", "named_in_part")
    assert found.effects == ("row_noise",)
    assert found.limit == ""


def test_what_rests_on_the_parameters_does_not_count_where_they_are_not_identified(perfect):
    names = ("shape.C3.mean", "space.row.readout.variance", "code.smooth", "code.rough", "code.period4")
    # of electrons that are four codes apart the parameters bend codes of that period, too
    for step, told in ((12.0, [True, True]), (4.6, [True, False]), (3.9, [False, False])):
        maps = PixelMaps.known(
            [np.full((2, 2), v) for v in (1.0, 1.0 / step, 100.0, 2.0)], np.full((2, 2), True)
        )
        assert free_of_parameters(names, maps).tolist() == [False, True, False, *told]
    counted = perfect.statistics[0]
    assert "space.row.readout.variance" in counted
    assert not {"shape.C3.mean", "code.smooth"} & set(counted)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_codes_hold_no_edges(n):
    assert few_shifts(np.full(n, 0.01), np.full(n, 200.0)) is None
