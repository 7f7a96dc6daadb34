"""The report: one HTML file without network access, ``report.json`` and the files of the figures."""

from __future__ import annotations

import base64
import importlib.resources
from collections.abc import Callable
from dataclasses import dataclass, field

import jinja2

from pchem_pipeline.render.captions import MAP_READING, SECTIONS
from pchem_pipeline.render.data import ReportData
from pchem_pipeline.render.discrepancy_page import DISCREPANCY_PAGE, DiscrepancyView, discrepancy_view
from pchem_pipeline.render.exhibits import Exhibit, exhibits
from pchem_pipeline.render.report_json import report_json
from pchem_pipeline.render.settings import ReportSettings
from pchem_pipeline.render.style import COLUMN_MM, figure_bytes, small_png
from pchem_pipeline.render.tables import Table, provenance_tables, result_tables
from pchem_pipeline.render.verdict import flags, key_numbers, sentence

__all__ = ["RenderedReport", "render_report"]

#: SVG files beyond this size are embedded as PNG.
_LARGEST_SVG = 450_000

_FLAG_WORDS = {"good": "Good", "note": "Note", "caution": "Caution", "serious": "Serious"}
_FLAG_SIGNS = {"good": "✓", "note": "ℹ", "caution": "▲", "serious": "✕"}

#: Where each table of results is shown: the id of a section with figures, or ``tables``.
_TABLE_PLACE = {
    "rmse": "ensemble",
    "moments": "ensemble",
    "electron-table": "electrons",
    "failures": "status",
}


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


@dataclass(frozen=True)
class _Picture:
    """A figure as the page shows it; ``narrow`` is the drawing for small screens."""

    exhibit: Exhibit
    source: str
    narrow: str
    width: int
    height: int


@dataclass(frozen=True)
class _Section:
    id: str
    title: str
    intro: str
    missing: tuple[str, ...]
    pictures: list[_Picture]
    tables: list[Table]


def render_report(data: ReportData, settings: ReportSettings | None = None) -> RenderedReport:
    """Draw everything and return the files of the report; nothing is written.

    Args:
        data: what the run found.
        settings: section ``report``; None for the defaults.
    """
    settings = settings or ReportSettings()
    figures: dict[str, bytes] = {}
    pictures = [_picture(exhibit, settings, figures) for exhibit in exhibits(data, settings)]
    tables = result_tables(data)
    view: DiscrepancyView[_Picture] | None = None
    if data.discrepancy is not None:
        view = discrepancy_view(data.discrepancy, lambda exhibit: _picture(exhibit, settings, figures))
    page = _template("report.html.j2").render(
        title=data.title,
        data=data,
        sentence=sentence(data),
        numbers=key_numbers(data),
        flags=flags(data),
        flag_words=_FLAG_WORDS,
        flag_signs=_FLAG_SIGNS,
        sections=_sections(data, settings, pictures, tables),
        tables=[table for table in tables if table.id not in _TABLE_PLACE],
        provenance=provenance_tables(data),
        view=view,
        how_to_discover=f"pchem discrepancy {data.run.get('store', 'RUN')}",
    )
    pages = {} if view is None else {DISCREPANCY_PAGE: _discrepancy_page(data, view)}
    return RenderedReport(page, report_json(data), figures, pages)


def _discrepancy_page(data: ReportData, view: DiscrepancyView[_Picture]) -> str:
    about = "" if data.shape[0] == 1 else f"{data.shape[0]} × {data.shape[1]} pixels"
    if data.n_frames:
        about += f"{', ' if about else ''}{data.n_frames:,} frames"
    return _template("discrepancy.html.j2").render(
        title=data.title, about=about, view=view, flag_words=_FLAG_WORDS, flag_signs=_FLAG_SIGNS
    )


def _template(name: str) -> jinja2.Template:
    folder = importlib.resources.files("pchem_pipeline.render") / "templates"
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda each: (folder / each).read_text(encoding="utf-8")),
    )
    environment.filters["together"] = _together
    return environment.get_template(name)


def _together(text: str) -> str:
    """Keep numbers and their units on one line."""
    for unit in ("%", "e⁻", "DN", "±"):
        text = text.replace(f" {unit}", f"\u00a0{unit}")
    return text.replace("± ", "±\u00a0")


def _picture(exhibit: Exhibit, settings: ReportSettings, figures: dict[str, bytes]) -> _Picture:
    """Draw a figure, add its files, and return it as data URLs."""
    figure = exhibit.draw(exhibit.width_mm)
    for kind in settings.figure_formats:
        figures[f"{exhibit.name}.{kind}"] = figure_bytes(figure, kind, dpi=settings.dpi, title=exhibit.title)
    have = {kind: figures.get(f"{exhibit.name}.{kind}") for kind in ("svg", "png")}
    if exhibit.raster:
        source = _data_url(small_png(have["png"] or figure_bytes(figure, "png", dpi=settings.dpi)), "png")
    else:
        source = _line_drawing(
            have["svg"] or figure_bytes(figure, "svg"), lambda: figure_bytes(figure, "png", dpi=200)
        )
    narrow = ""
    if exhibit.width_mm > COLUMN_MM:
        small = exhibit.draw(COLUMN_MM)
        narrow = _line_drawing(figure_bytes(small, "svg"), lambda: figure_bytes(small, "png", dpi=250))
    width, height = figure.get_size_inches() * 96.0
    return _Picture(exhibit, source, narrow, round(width), round(height))


def _line_drawing(svg: bytes, png: Callable[[], bytes]) -> str:
    return _data_url(svg, "svg") if len(svg) <= _LARGEST_SVG else _data_url(small_png(png()), "png")


def _data_url(content: bytes, kind: str) -> str:
    media = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"


def _sections(
    data: ReportData, settings: ReportSettings, pictures: list[_Picture], tables: list[Table]
) -> list[_Section]:
    """Put figures and tables into their sections; one without any says why."""
    reading = MAP_READING["channels" if min(data.shape) < 2 else settings.map_stretch]
    found = []
    for id_, title, intro, parts in SECTIONS:
        shown = [picture for picture in pictures if picture.exhibit.section == id_]
        rows = [table for table in tables if _TABLE_PLACE.get(table.id) == id_]
        why = [data.missing[part] for part in parts if part in data.missing]
        if id_ == "read-noise" and data.few_channels and not shown:
            why.append("few channels have no histogram; their values are with the parameter maps")
        if not shown and not rows and not why:
            why = ["this run has no data for it."]
        if id_ == "maps":
            intro = f"{intro} {reading}"
        found.append(_Section(id_, title, intro, tuple(why), shown, rows))
    return found
