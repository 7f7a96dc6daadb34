"""The report: one HTML file without network access, ``report.json`` and the files of the figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import discrepancy_figures, report_figures
from pchem_pipeline.report.inspector.inspector import embedded, script
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE, evidence, finding
from pchem_pipeline.report.pages.emva import emva_tables
from pchem_pipeline.report.pages.methods import method_tables
from pchem_pipeline.report.pages.page import Finding, Section, render_page
from pchem_pipeline.report.pages.pictures import DrawAll, Picture, draw_here
from pchem_pipeline.report.pages.provenance import provenance_tables
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.sections import Material, page_sections
from pchem_pipeline.report.pages.tables import result_tables
from pchem_pipeline.report.settings import ReportSettings


@dataclass(frozen=True)
class RenderedReport:
    """The files of a report.

    Attributes:
        html: the page.
        json: the numbers.
        figures: file name to content, for the folder ``figures``.
        pages: further pages, by file name.
    """

    html: str
    json: str
    figures: dict[str, bytes] = field(default_factory=dict)
    pages: dict[str, str] = field(default_factory=dict)


def render_report(
    data: ReportData, settings: ReportSettings | None = None, draw: DrawAll | None = None
) -> RenderedReport:
    """Draw everything and return the files of the report; nothing is written.

    Args:
        data: what the run found.
        settings: section ``report``; None for the defaults.
        draw: draws all figures at once, for example by several workers; None: one after the other, here.
    """
    settings = settings or ReportSettings()
    every, others = report_figures(data, settings), discrepancy_figures(data.discrepancy)
    shown = [figure for figure in every if figure.section]
    drawn = (draw or draw_here)([*(every if settings.figure_formats else shown), *others], settings)
    figures = {name: content for each in drawn.values() for name, content in each.files.items()}
    pictures, proofs = ([Picture(figure, drawn[figure.name]) for figure in each] for each in (shown, others))
    verdict = None if data.discrepancy is None else finding(data.discrepancy)
    parts = [] if data.discrepancy is None else evidence(data.discrepancy, proofs)
    makers = (result_tables, method_tables, emva_tables, provenance_tables)
    tables = [table for make in makers for table in make(data)]
    sections = page_sections(Material(data, settings, pictures, tables, verdict, parts))
    pages = {} if verdict is None else {DISCREPANCY_PAGE: _discrepancy_page(data, verdict, parts)}
    numbers, inspector = report_json(data), embedded(data)
    page = render_page(
        "report.html.j2",
        sections,
        [*shown, *others],
        *([script()] if inspector else []),
        title=data.title,
        data=data,
        inspector=inspector,
    )
    return RenderedReport(page, numbers, figures, pages)


def _discrepancy_page(data: ReportData, verdict: Finding, parts: Sequence[Section]) -> str:
    about = "" if data.shape[0] == 1 else f"{data.shape[0]} × {data.shape[1]} pixels"
    if data.n_frames:
        about += f"{', ' if about else ''}{data.n_frames:,} frames"
    figures = [picture.figure for part in parts for picture in part.pictures]
    sections = [Section(id="verdict", title="Verdict", verdict=verdict), *parts]
    return render_page("discrepancy.html.j2", sections, figures, title=data.title, about=about)
