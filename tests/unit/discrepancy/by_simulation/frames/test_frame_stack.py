"""What the frames of a window of the sensor can tell of its lines."""

from __future__ import annotations

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.effects.analog.empirical_response import EmpiricalResponse, ResponseTerm


@pytest.mark.parametrize(
    ("rows", "columns", "whole"),
    [
        ((0, 8), (0, 6), {"row", "column"}),
        ((2, 6), (0, 6), {"row"}),
        ((0, 8), (1, 6), {"column"}),
        ((0, 7), (0, 5), set()),
    ],
)
def test_the_shape_of_a_line_is_known_where_the_window_has_it_from_end_to_end(
    rows: tuple[int, int], columns: tuple[int, int], whole: set[str]
) -> None:
    stack = np.zeros((400, rows[1] - rows[0], columns[1] - columns[0]), np.uint16)
    window = SensorWindow(rows, columns, (8, 6))
    frames = FrameStack.of(
        stack, np.arange(400), None, n_run=None, bit_depth=12, integration_time=1.0, window=window
    )
    assert frames.whole_lines == whole


def test_what_is_measured_in_a_window_is_told_on_the_sensor() -> None:
    stack = np.zeros((400, 4, 5), np.uint16)
    taken = {"n_run": None, "bit_depth": 12, "integration_time": 1.0}
    measured = EmpiricalResponse(response=0.1, terms=(ResponseTerm(place=(0, 0, -1), columns=(0, 2)),))
    window = SensorWindow((2, 6), (1, 6), (8, 6))
    of_window = FrameStack.of(stack, np.arange(400), None, **taken, window=window)  # type: ignore[arg-type]
    found = of_window.on_sensor(measured)
    assert isinstance(found, EmpiricalResponse)
    assert found.terms[0].columns == (1, 3)
    assert of_window.effects([found]) == (measured,)
    whole = FrameStack.of(stack, np.arange(400), None, **taken, window=None)  # type: ignore[arg-type]
    assert whole.on_sensor(measured) == measured
