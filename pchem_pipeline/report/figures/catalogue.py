"""All figures of a run in the order of its pages: the one list that pages, files and notebooks take from.

A new figure is a function that yields it, or nothing where the run has no data for it, and a row here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pchem_pipeline.report.data import DiscrepancyData, ReportData
from pchem_pipeline.report.figures import (
    discrepancy_gap,
    discrepancy_where,
    ensemble,
    maps,
    methods,
    pixels,
    samples,
)
from pchem_pipeline.report.figures.figure import Figure

#: Makers of the figures of the report.
REPORT_FIGURES: tuple[Callable[[ReportData], Iterable[Figure]], ...] = (
    pixels.cell_figures,
    pixels.pixel_figures,
    samples.exposure_figures,
    samples.transfer_figures,
    maps.goodness_figures,
    maps.map_figures,
    lambda data: data.stability,
    ensemble.ensemble_figures,
    ensemble.electron_figures,
    ensemble.component_figures,
    maps.status_figures,
    methods.method_figures,
)

#: Makers of the figures of a verdict; ``section`` is the id of a part of its page.
DISCREPANCY_FIGURES: tuple[Callable[[DiscrepancyData], Iterable[Figure]], ...] = (
    discrepancy_where.sensor_figures,
    discrepancy_where.code_figures,
    discrepancy_where.frame_figures,
    discrepancy_where.line_figures,
    discrepancy_gap.gap_figures,
    discrepancy_gap.pull_figures,
)


def report_figures(data: ReportData) -> list[Figure]:
    """Return the figures of the report that the data allow."""
    return [figure for make in REPORT_FIGURES for figure in make(data)]


def discrepancy_figures(data: DiscrepancyData | None) -> list[Figure]:
    """Return the figures of a verdict that the data allow; none where nobody looked."""
    return [] if data is None else [figure for make in DISCREPANCY_FIGURES for figure in make(data)]


def run_figures(data: ReportData) -> list[Figure]:
    """Return all figures of a run."""
    return [*report_figures(data), *discrepancy_figures(data.discrepancy)]
