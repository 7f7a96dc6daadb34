"""The contours of the frames that are needed, and their labels."""

import numpy as np
import pytest

from pchem_pipeline.report.figures.figure import DataTable
from pchem_pipeline.report.figures.plan import draw_frames_needed
from pchem_pipeline.report.style.style import Look


def test_labels_of_contours_lie_along_them_and_none_is_cut() -> None:
    """On the drawn axes these contours are straight lines, from corner to corner."""
    noise, exposure = np.meshgrid(np.linspace(0.1, 1.1, 41), np.logspace(-1.0, 1.0, 41), indexing="ij")
    frames = 10.0 ** (2.0 + 4.0 * noise - 2.0 * np.log10(exposure))
    columns = {"read_noise_e": noise, "quanta_exposure": exposure, "frames for bias to 1 %": frames}
    table = DataTable({name: values.ravel() for name, values in columns.items()})
    figure = draw_frames_needed(Look(), table=table)
    (axes,) = figure.axes
    figure.canvas.draw()
    labels = [text for text in axes.texts if text.get_text().startswith("10")]
    assert len(labels) > 3
    box = axes.get_window_extent()
    # 4 decades of frames along 1 e- of read noise, and along 2 decades of exposure
    slope = np.degrees(np.arctan2(box.height, box.width))
    for text in labels:
        assert (text.get_rotation() + 90) % 180 - 90 == pytest.approx(slope, abs=3.0)
        x, y = axes.transAxes.inverted().transform(axes.transData.transform(text.get_position()))
        assert 0.04 < x < 0.96
        assert 0.04 < y < 0.96
