"""What the frames of a window of the sensor can tell of its lines."""

from __future__ import annotations

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.observe.places import SensorWindow


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
