"""Figures as files and as the data URLs that a page embeds; each can be drawn in a process of its own."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from string import ascii_letters, digits

from pchem_pipeline.report.charts.chart import Chart
from pchem_pipeline.report.charts.picture import chart_picture
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.style import (
    COLUMN_MM,
    Drawing,
    Look,
    drawing_bytes,
    small_png,
    without_collector,
)

#: SVG files beyond this size are embedded as PNG, which is drawn once more.
_LARGEST_SVG = 900_000
#: Dots per inch of the PNG, and of images of more pixels than a page can show.
_PAGE_DPI = 200
#: Characters that need no escape in a data URL within an attribute.
_AS_IT_IS = frozenset(" !$()*+,-./:;=?@[]^_`{|}~" + ascii_letters + digits)


@dataclass(frozen=True)
class Drawn:
    """A figure as a page embeds it, and its files.

    Attributes:
        source: data URL.
        width, height: size on the page, px.
        files: file name to content.
    """

    source: str
    width: int
    height: int
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """A figure with its drawing, as a page shows it."""

    figure: Figure
    drawn: Drawn

    @property
    def wide(self) -> bool:
        """Whether it takes the whole width of a page."""
        return self.figure.width_mm > COLUMN_MM


#: Draws many figures at once and returns them by name.
DrawAll = Callable[[Sequence[Figure], ReportSettings], Mapping[str, Drawn]]


@without_collector()
def draw_figure(figure: Figure, settings: ReportSettings) -> Drawn:
    """Draw a figure with its files; pure.

    Args:
        figure: the figure.
        settings: formats and resolution.
    """
    return (
        _draw_map(figure, settings) if figure.chart is None else _draw_chart(figure, figure.chart, settings)
    )


def _draw_chart(figure: Figure, chart: Chart, settings: ReportSettings) -> Drawn:
    """Draw a plain picture, as the page's script draws the rest, and the files that are asked for."""
    picture, width, height = chart_picture(chart, figure.width_mm)
    files = _files(figure.draw(Look(figure.width_mm)), figure, settings) if settings.figure_formats else {}
    return Drawn(f"data:image/svg+xml,{escaped(picture)}", width, height, files)


def _draw_map(figure: Figure, settings: ReportSettings) -> Drawn:
    """Draw what matplotlib alone can draw."""
    # the SVG is both a file and what the page embeds, where files are asked for
    dpi = settings.dpi if settings.figure_formats else _PAGE_DPI
    drawing = figure.draw(Look(figure.width_mm, dpi=dpi))
    files = _files(drawing, figure, settings)
    svg = files.get(f"{figure.name}.svg") or drawing_bytes(drawing, "svg", dpi=_PAGE_DPI)
    if len(svg) <= _LARGEST_SVG:
        # as text: base64 would take a third more, of images in it twice
        source = f"data:image/svg+xml,{escaped(svg)}"
    else:
        png = small_png(drawing_bytes(drawing, "png", dpi=_PAGE_DPI))
        source = f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
    width, height = drawing.get_size_inches() * 96.0
    return Drawn(source, round(width), round(height), files)


def _files(drawing: Drawing, figure: Figure, settings: ReportSettings) -> dict[str, bytes]:
    """Return the files of a drawing, by name."""
    return {
        f"{figure.name}.{kind}": drawing_bytes(drawing, kind, dpi=settings.dpi, title=figure.title)
        for kind in settings.figure_formats
    }


def escaped(content: bytes) -> str:
    """Return bytes as the text of a data URL: as `urllib.parse.quote`, in a fifth of the time."""
    text = content.decode("latin-1")
    # the escapes' own sign first
    for character in ("%", *(set(text) - _AS_IT_IS - {"%"})):
        text = text.replace(character, f"%{ord(character):02X}")
    return text


def draw_here(figures: Sequence[Figure], settings: ReportSettings) -> dict[str, Drawn]:
    """Draw figures one after the other, in this process."""
    return {figure.name: draw_figure(figure, settings) for figure in figures}
