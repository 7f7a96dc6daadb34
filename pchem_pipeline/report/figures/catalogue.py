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
    plan,
    samples,
    trust,
)
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.settings import ReportSettings

#: Makers of the figures of the report, each with the names that it can give.
REPORT_FIGURES: tuple[
    tuple[Callable[[ReportData, ReportSettings], Iterable[Figure]], tuple[str, ...]], ...
] = (
    (pixels.cell_figures, ("cluster_edges_example", "cluster_edges_pixel")),
    (pixels.pixel_figures, ("pixel_fits",)),
    (samples.exposure_figures, ("exposures",)),
    (samples.transfer_figures, ("photon_transfer",)),
    (trust.goodness_figures, ("goodness",)),
    (trust.left_out_figures, ("left_out",)),
    (maps.read_noise_figures, ("read_noise_histogram",)),
    (maps.map_figures, tuple(f"map_{name}" for name in maps.DRAWN_MAPS)),
    (lambda data, _: data.stability, ("frame_means", "profiles", "spatial_spectra")),
    (ensemble.ensemble_figures, ("ensemble",)),
    (ensemble.electron_figures, ("electron_numbers",)),
    (ensemble.component_figures, ("component_widths",)),
    (trust.uncertainty_figures, ("uncertainty",)),
    (trust.rounding_figures, ("rounding",)),
    (maps.status_figures, ("fit_status",)),
    (methods.method_figures, ("methods_gain_error",)),
    (plan.plan_figures, ("frames_needed",)),
)

#: Makers of the figures of a verdict; ``section`` is the id of a part of its page.
DISCREPANCY_FIGURES: tuple[tuple[Callable[[DiscrepancyData], Iterable[Figure]], str], ...] = (
    (discrepancy_where.sensor_figures, "discrepancy_maps"),
    (discrepancy_where.code_figures, "discrepancy_codes"),
    (discrepancy_where.frame_figures, "discrepancy_frames"),
    (discrepancy_where.line_figures, "discrepancy_lines"),
    (discrepancy_gap.gap_figures, "discrepancy_gap"),
    (discrepancy_gap.pull_figures, "discrepancy_pulls"),
)

#: Names of all figures that a run can have.
FIGURE_NAMES = (
    *(name for _, names in REPORT_FIGURES for name in names),
    *(name for _, name in DISCREPANCY_FIGURES),
)


def report_figures(data: ReportData, settings: ReportSettings) -> list[Figure]:
    """Return the figures of the report that the data allow."""
    return [figure for make, _ in REPORT_FIGURES for figure in make(data, settings)]


def discrepancy_figures(data: DiscrepancyData | None) -> list[Figure]:
    """Return the figures of a verdict that the data allow; none where nobody looked."""
    return [] if data is None else [figure for make, _ in DISCREPANCY_FIGURES for figure in make(data)]


def run_figures(data: ReportData, settings: ReportSettings) -> list[Figure]:
    """Return all figures of a run."""
    return [*report_figures(data, settings), *discrepancy_figures(data.discrepancy)]
