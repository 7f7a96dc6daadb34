"""What all pages share: sections, frame and style, scripts, the figures' numbers, charts, the glossary."""

from __future__ import annotations

import base64
import gzip
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import jinja2
from markupsafe import Markup, escape

from pchem_pipeline.base.wording import short_name, visible
from pchem_pipeline.report.charts.on_page import page_charts
from pchem_pipeline.report.figures.figure import DataTable, Figure, csv_text
from pchem_pipeline.report.inspector import content_policy, json_for_html, text_of
from pchem_pipeline.report.style.palette import dark_rules

if TYPE_CHECKING:
    from pchem_pipeline.report.pages.summary import Flag
    from pchem_pipeline.report.pages.tables import Table


#: Words of the field, each as it is written in texts (first its name), to what they mean.
GLOSSARY = {tuple(key.split(" | ")): text for key, text in tomllib.loads(text_of("glossary.toml")).items()}


def anchor_of(name: str) -> str:
    """Return the anchor of an entry of the glossary."""
    return "term-" + re.sub(r"\W+", "-", name.lower()).strip("-")


_BY_SPELLING = {spelling.lower(): anchor_of(term[0]) for term in GLOSSARY for spelling in term}
_ANY = re.compile(
    rf"(?<![\w-])(?:{'|'.join(map(re.escape, sorted(_BY_SPELLING, key=len, reverse=True)))})(?![\w-])",
    re.IGNORECASE,
)


def explained(text: str) -> Markup:
    """Return a text as HTML in which the first of each word of the glossary leads to its entry."""
    seen = set()

    def link(found: re.Match[str]) -> str:
        anchor = _BY_SPELLING[found[0].lower()]
        if anchor in seen:
            return found[0]
        seen.add(anchor)
        return f'<a class="term" href="#{anchor}">{found[0]}</a>'

    return Markup(_ANY.sub(link, str(escape(text))))


#: Folder of the library that draws charts.
_LIBRARY = "vendor/uplot"


@dataclass(frozen=True)
class KeyFact:
    """A number below a finding, with up to three lines below it."""

    label: str
    value: str
    more: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """The result that a section states: its level, a word, a sentence, the samples examined, key numbers.

    ``level`` is a class of the style sheet; ``remarks`` are evidence for and against the result.
    """

    level: str
    name: str
    sentence: str
    about: str = ""
    facts: Sequence[KeyFact] = ()
    remarks: Sequence[Flag] = ()


@dataclass(frozen=True)
class Section:
    """A section of a page: its result, tables, figures, further tables."""

    id: str  # anchor in the page
    title: str
    intro: str = ""
    empty: str = "Not shown: no data in this run."  # where there is nothing; empty: it is left out
    name: str = ""  # in the table of contents; empty: the title
    verdict: Finding | None = None  # what came out
    missing: Sequence[str] = ()  # sentences on what is not shown, and why
    first: Sequence[Table] = ()  # tables above the figures
    figures: Sequence[Figure] = ()  # between these and the others
    tables: Sequence[Table] = ()  # tables below the figures
    kind: str = ""  # of its own kind: the template ``section_<kind>.html.j2`` shows it
    content: Any = None  # what that template shows
    folded: bool = False  # whether it is closed until somebody opens it

    def filled(self, **content: Any) -> Section | None:
        """Return the section with what it shows; without anything it says so, or is None."""
        found = replace(self, **content)
        if found.figures or found.tables or found.missing or found.kind:
            return found
        return replace(found, missing=(found.empty,)) if found.empty else None


@dataclass(frozen=True)
class Drawn:
    """A figure as a page embeds it: data URL, and size on the page, px."""

    source: str
    width: int
    height: int


#: Draws many figures at once and returns them by name.
DrawAll = Callable[[Sequence[Figure]], Mapping[str, Drawn]]


def draw_figure(figure: Figure) -> Drawn:
    """Draw a figure as a page embeds it; pure.

    Text on the page stays text: it can be found, and takes half the room of outlines.
    """
    from pchem_pipeline.report.charts.on_paper import Look, drawing_bytes

    drawing = figure.draw(Look(figure.width_mm, svg_text=True))
    svg = drawing_bytes(drawing, "svg").replace(b"</style>", f"{dark_rules()}</style>".encode(), 1)
    # what needs no escape in a data URL within an attribute
    picture = quote(svg, safe=" !$()*+,-./:;=?@[]^_`{|}~")
    # 4.5 px for a millimetre on paper
    width, height = (round(4.5 * 25.4 * side) for side in drawing.get_size_inches())
    return Drawn(f"data:image/svg+xml,{picture}", width, height)


def draw_here(figures: Sequence[Figure]) -> dict[str, Drawn]:
    """Draw figures one after the other, in this process."""
    return {figure.name: draw_figure(figure) for figure in figures}


def render_page(
    name: str, sections: Sequence[Section], drawn: Mapping[str, Drawn], /, *scripts: str, **content: Any
) -> str:
    """Return a page as HTML, complete in itself; its template extends ``page.html.j2``.

    ``drawn`` are the figures by name, ``scripts`` further ones in the template, ``content`` what it shows.
    """
    figures = [figure for section in sections for figure in section.figures]
    charts = {figure.name: figure.chart for figure in figures if not figure.chart.still}
    scripted = bool(charts or scripts)  # the inspector draws charts, too
    always = (text_of("page.js"), *((chart_script(),) if scripted else ()))
    return _template(name).render(
        policy=content_policy(*always, *scripts),
        page_scripts=[Markup(script) for script in always],
        charts=json_for_html(page_charts(charts)) if scripted else "",
        chart_style=Markup(text_of("uPlot.min.css", _LIBRARY)) if scripted else "",
        tables=json_for_html(figure_tables(figures)),
        glossary=GLOSSARY,
        sections=sections,
        drawn=drawn,
        **content,
    )


def chart_script() -> str:
    """Return the script that draws charts, behind its library with the library's licence."""
    licence, library = (text_of(name, _LIBRARY) for name in ("LICENSE", "uPlot.iife.min.js"))
    return f"/*!\n{licence}\n*/\n{library}\n{text_of('charts.js')}"


def figure_tables(figures: Sequence[Figure]) -> dict[str, list[tuple[str, str]]]:
    """Return the tables of figures as the page keeps them: by figure, part and gzip of the CSV in base64.

    Maps of large sensors are not among them: ``pchem export`` and ``pchem figures`` write these.
    """

    def packed(table: DataTable) -> str:
        return base64.b64encode(gzip.compress(csv_text(table).encode(), 6, mtime=0)).decode("ascii")

    return {
        figure.name: [(each.part, packed(each)) for each in figure.tables if each.size <= 6_000]
        for figure in figures
    }


def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True,
        finalize=_shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(text_of),
    )
    environment.filters["together"] = _together
    environment.filters["explained"] = lambda text: explained(_together(visible(text)))
    environment.filters["name"] = short_name
    environment.filters["anchor"] = anchor_of
    environment.globals["flag_signs"] = {"good": "✓", "note": "ℹ", "caution": "▲", "serious": "✕"}
    return environment.get_template(name)


def _shown(value: Any) -> Any:
    """Let no text that comes from files change how the page around it looks."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _together(text: str) -> str:
    """Keep numbers and their units on one line."""
    for unit in ("%", "e⁻", "DN", "±"):
        text = text.replace(f" {unit}", f"\u00a0{unit}")
    return text.replace("± ", "±\u00a0")
