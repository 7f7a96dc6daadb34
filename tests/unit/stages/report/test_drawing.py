"""Figures that are drawn by several processes, or by this one."""

from __future__ import annotations

from helpers.report_material import report_data

from pchem_pipeline.compute.executor import SerialExecutor
from pchem_pipeline.report.figures.catalogue import report_figures
from pchem_pipeline.report.pages.pictures import Drawn, draw_figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.stages.report.drawing import draw_by_workers, drawing_executor

QUICK = ReportSettings(figure_formats=("png",), dpi=72)


def test_figures_are_the_same_whoever_draws_them() -> None:
    shown = [
        each
        for each in report_figures(report_data((12, 16)), QUICK)
        if each.name in ("fit_status", "component_widths")
    ]
    here = {figure.name: draw_figure(figure, QUICK) for figure in shown}
    reporter = Reporter("off", quiet=True)
    assert draw_by_workers(2, reporter, "report")(shown, QUICK) == here
    assert all(isinstance(drawn, Drawn) and drawn.files for drawn in here.values())


def test_one_worker_draws_here() -> None:
    assert isinstance(drawing_executor(1, 9), SerialExecutor)
    assert isinstance(drawing_executor(8, 1), SerialExecutor)
