"""The report: one HTML file without network access, ``report.json`` and the files of the figures."""

from __future__ import annotations

import base64
import gzip
import importlib.resources
from collections.abc import Sequence
from dataclasses import dataclass, field

import jinja2
from markupsafe import Markup

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import discrepancy_figures, report_figures
from pchem_pipeline.report.figures.figure import Figure, csv_text
from pchem_pipeline.report.inspector.inspector import content_policy, embedded, json_for_html, script, text_of
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE, DiscrepancyView, discrepancy_view
from pchem_pipeline.report.pages.emva import emva_tables
from pchem_pipeline.report.pages.glossary import explained
from pchem_pipeline.report.pages.methods import method_tables
from pchem_pipeline.report.pages.pictures import DrawAll, Picture, draw_here
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.sections import Material, page_sections
from pchem_pipeline.report.pages.tables import result_tables
from pchem_pipeline.report.settings import ReportSettings

#: Numbers of a table that the page keeps.
_LARGEST_TABLE = 6_000
_FLAG_WORDS = {"good": "Good", "note": "Note", "caution": "Caution", "serious": "Serious"}
_FLAG_SIGNS = {"good": "✓", "note": "ℹ", "caution": "▲", "serious": "✕"}


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
    pictures, evidence = (
        [Picture(figure, drawn[figure.name]) for figure in each] for each in (shown, others)
    )
    view = None if data.discrepancy is None else discrepancy_view(data.discrepancy, evidence)
    tables = [*result_tables(data), *method_tables(data), *emva_tables(data)]
    inspector = embedded(data)
    page = template("report.html.j2").render(
        title=data.title,
        data=data,
        flag_words=_FLAG_WORDS,
        flag_signs=_FLAG_SIGNS,
        inspector=inspector,
        policy=content_policy(page_script(), *([script()] if inspector else [])),
        page_script=Markup(page_script()),
        tables=json_for_html(figure_tables([*shown, *others])),
        sections=page_sections(Material(data, settings, pictures, tables, view)),
    )
    pages = {} if view is None else {DISCREPANCY_PAGE: _discrepancy_page(data, view)}
    return RenderedReport(page, report_json(data), figures, pages)


def _discrepancy_page(data: ReportData, view: DiscrepancyView) -> str:
    about = "" if data.shape[0] == 1 else f"{data.shape[0]} × {data.shape[1]} pixels"
    if data.n_frames:
        about += f"{', ' if about else ''}{data.n_frames:,} frames"
    return template("discrepancy.html.j2").render(
        title=data.title, about=about, view=view, flag_words=_FLAG_WORDS, flag_signs=_FLAG_SIGNS
    )


def page_script() -> str:
    """Return the script of files, words and folded parts."""
    return text_of("page.js")


def figure_tables(figures: Sequence[Figure]) -> dict[str, list[tuple[str, str]]]:
    """Return the tables of figures as the page keeps them: by figure, part and gzip of the CSV in base64.

    Maps of large sensors are not among them: ``pchem export`` and ``pchem figures`` write these.
    """
    return {
        figure.name: [
            (
                table.part,
                base64.b64encode(gzip.compress(csv_text(table).encode(), 6, mtime=0)).decode("ascii"),
            )
            for table in figure.tables
            if table.size <= _LARGEST_TABLE
        ]
        for figure in figures
    }


def template(name: str) -> jinja2.Template:
    """Return a template of this package's pages."""
    folder = importlib.resources.files("pchem_pipeline.report") / "templates"
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda each: (folder / each).read_text(encoding="utf-8")),
    )
    environment.filters["together"] = _together
    # other pages have no glossary to lead to
    environment.filters["explained"] = _explained if name == "report.html.j2" else _together
    return environment.get_template(name)


def _explained(text: str) -> Markup:
    return explained(_together(text))


def _together(text: str) -> str:
    """Keep numbers and their units on one line."""
    for unit in ("%", "e⁻", "DN", "±"):
        text = text.replace(f" {unit}", f"\u00a0{unit}")
    return text.replace("± ", "±\u00a0")
