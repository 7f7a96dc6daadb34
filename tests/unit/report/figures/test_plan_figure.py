"""The contours of the frames that are needed, and their labels."""

import numpy as np
import pytest

from pchem_pipeline.report.charts.chart import Words
from pchem_pipeline.report.figures.figure import DataTable
from pchem_pipeline.report.figures.plan import frames_chart
from pchem_pipeline.report.style.wording import power_of_ten


def test_labels_of_contours_lie_on_them_and_none_is_cut() -> None:
    """On the drawn axes these contours are straight lines, from corner to corner."""
    noise, exposure = np.meshgrid(np.linspace(0.1, 1.1, 41), np.logspace(-1.0, 1.0, 41), indexing="ij")
    frames = 10.0 ** (2.0 + 4.0 * noise - 2.0 * np.log10(exposure))
    columns = {"read_noise_e": noise, "quanta_exposure": exposure, "frames for bias to 1 %": frames}
    (stack,) = frames_chart(
        DataTable({name: values.ravel() for name, values in columns.items()}), None
    ).stacks
    (panel,) = stack.panels
    labels = [mark for mark in panel.marks if isinstance(mark, Words)]
    assert len(labels) > 3
    powers = {power_of_ten(power): power for power in range(9)}
    for label in labels:
        across, up = float(label.x), float(label.up)
        assert 0.04 < (across + 1.0) / 2.0 < 0.96
        assert 0.0 < up < 0.96
        there = 2.0 + 4.0 * (0.1 + up * 1.0) - 2.0 * across
        # the words stand on the line: a tenth of the picture is 0.4 decades
        assert there == pytest.approx(powers[label.text], abs=0.2)
