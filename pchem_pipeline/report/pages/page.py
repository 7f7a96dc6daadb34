"""What all pages share: frame and style, the scripts, the figures' numbers, the charts, the glossary."""

from __future__ import annotations

import base64
import gzip
import importlib.resources
from collections.abc import Sequence
from typing import Any

import jinja2
from markupsafe import Markup

from pchem_pipeline.report.charts.on_page import page_charts
from pchem_pipeline.report.figures.figure import Figure, csv_text
from pchem_pipeline.report.inspector.inspector import content_policy, json_for_html, text_of
from pchem_pipeline.report.pages.glossary import GLOSSARY, explained
from pchem_pipeline.report.style.wording import short_name, visible

#: Numbers of a table that the page keeps.
_LARGEST_TABLE = 6_000
#: Folder of the library that draws charts.
_LIBRARY = "vendor/uplot"
_FLAG_WORDS = {"good": "Good", "note": "Note", "caution": "Caution", "serious": "Serious"}
_FLAG_SIGNS = {"good": "✓", "note": "ℹ", "caution": "▲", "serious": "✕"}


def render_page(name: str, figures: Sequence[Figure], /, *scripts: str, **content: Any) -> str:
    """Return a page as HTML, complete in itself.

    Args:
        name: of its template, which extends ``page.html.j2``.
        figures: those that it shows; their numbers can be saved from it.
        scripts: further ones that its template holds.
        content: what its template shows.
    """
    charts = {figure.name: figure.chart for figure in figures if not figure.chart.still}
    always = (page_script(), *((chart_script(),) if charts else ()))
    return _template(name).render(
        policy=content_policy(*always, *scripts),
        page_scripts=[Markup(script) for script in always],
        charts=json_for_html(page_charts(charts)) if charts else "",
        chart_style=Markup(text_of("uPlot.min.css", _LIBRARY)) if charts else "",
        tables=json_for_html(figure_tables(figures)),
        glossary=GLOSSARY,
        flag_words=_FLAG_WORDS,
        flag_signs=_FLAG_SIGNS,
        **content,
    )


def page_script() -> str:
    """Return the script of files, words and folded parts."""
    return text_of("page.js")


def chart_script() -> str:
    """Return the script that draws charts, behind its library with the library's licence."""
    licence, library = (text_of(name, _LIBRARY) for name in ("LICENSE", "uPlot.iife.min.js"))
    return f"/*!\n{licence}\n*/\n{library}\n{text_of('charts.js')}"


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


def _template(name: str) -> jinja2.Template:
    folder = importlib.resources.files("pchem_pipeline.report") / "templates"
    environment = jinja2.Environment(
        autoescape=True,
        finalize=_shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda each: (folder / each).read_text(encoding="utf-8")),
    )
    environment.filters["together"] = _together
    environment.filters["explained"] = lambda text: explained(_together(visible(text)))
    environment.filters["name"] = short_name
    return environment.get_template(name)


def _shown(value: Any) -> Any:
    """Let no text that comes from files change how the page around it looks."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _together(text: str) -> str:
    """Keep numbers and their units on one line."""
    for unit in ("%", "e⁻", "DN", "±"):
        text = text.replace(f" {unit}", f"\u00a0{unit}")
    return text.replace("± ", "±\u00a0")
