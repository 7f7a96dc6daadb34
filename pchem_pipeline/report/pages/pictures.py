"""Figures as files and as the data URLs that a page embeds; each can be drawn in a process of its own."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.style import COLUMN_MM, Look, drawing_bytes, small_png, without_collector

#: SVG files beyond this size are embedded as PNG, which is drawn once more.
_LARGEST_SVG = 260_000


@dataclass(frozen=True)
class Drawn:
    """A figure as a page embeds it, and its files.

    Attributes:
        source: data URL.
        narrow: data URL of the drawing for small screens; empty where the first serves.
        width, height: size on the page, px.
        files: file name to content.
    """

    source: str
    narrow: str
    width: int
    height: int
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """A figure with its drawing, as a page shows it."""

    figure: Figure
    drawn: Drawn


#: Draws many figures at once and returns them by name.
DrawAll = Callable[[Sequence[Figure], ReportSettings], Mapping[str, Drawn]]


@without_collector()
def draw_figure(figure: Figure, settings: ReportSettings) -> Drawn:
    """Draw a figure with its files; pure.

    Args:
        figure: the figure.
        settings: formats and resolution.
    """
    drawing = figure.draw(Look(figure.width_mm))
    files = {
        f"{figure.name}.{kind}": drawing_bytes(drawing, kind, dpi=settings.dpi, title=figure.title)
        for kind in settings.figure_formats
    }
    svg, png = (files.get(f"{figure.name}.{kind}") for kind in ("svg", "png"))
    if figure.raster:
        source = _data_url(small_png(png or drawing_bytes(drawing, "png", dpi=settings.dpi)), "png")
    else:
        source = _line_drawing(
            svg or drawing_bytes(drawing, "svg"), lambda: drawing_bytes(drawing, "png", dpi=200)
        )
    narrow = ""
    if figure.width_mm > COLUMN_MM:
        small = figure.draw(Look(COLUMN_MM))
        narrow = _line_drawing(drawing_bytes(small, "svg"), lambda: drawing_bytes(small, "png", dpi=250))
    width, height = drawing.get_size_inches() * 96.0
    return Drawn(source, narrow, round(width), round(height), files)


def draw_here(figures: Sequence[Figure], settings: ReportSettings) -> dict[str, Drawn]:
    """Draw figures one after the other, in this process."""
    return {figure.name: draw_figure(figure, settings) for figure in figures}


def longest_first(figures: Sequence[Figure]) -> list[Figure]:
    """Return the figures in the order in which several workers finish soonest: wide ones are drawn twice."""
    return sorted(figures, key=lambda figure: -figure.width_mm)


def _line_drawing(svg: bytes, png: Callable[[], bytes]) -> str:
    return _data_url(svg, "svg") if len(svg) <= _LARGEST_SVG else _data_url(small_png(png()), "png")


def _data_url(content: bytes, kind: str) -> str:
    media = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"
