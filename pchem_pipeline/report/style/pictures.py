"""Figures as files and as the data URLs that a page embeds; each can be drawn in a process of its own."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from pchem_pipeline.report.figures.exhibits import Exhibit
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.style import COLUMN_MM, figure_bytes, small_png

__all__ = ["DrawAll", "Drawn", "Picture", "draw_exhibit", "draw_picture", "longest_first", "ready_picture"]

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
    """A figure as the page shows it; ``narrow`` is the drawing for small screens."""

    exhibit: Exhibit
    source: str
    narrow: str
    width: int
    height: int


#: Draws many figures at once and returns them by name.
DrawAll = Callable[[Sequence[Exhibit], ReportSettings], Mapping[str, Drawn]]


def draw_exhibit(exhibit: Exhibit, settings: ReportSettings) -> Drawn:
    """Draw a figure with its files; pure.

    Args:
        exhibit: the figure.
        settings: formats and resolution.
    """
    figure = exhibit.draw(exhibit.width_mm)
    files = {
        f"{exhibit.name}.{kind}": figure_bytes(figure, kind, dpi=settings.dpi, title=exhibit.title)
        for kind in settings.figure_formats
    }
    svg, png = (files.get(f"{exhibit.name}.{kind}") for kind in ("svg", "png"))
    if exhibit.raster:
        source = _data_url(small_png(png or figure_bytes(figure, "png", dpi=settings.dpi)), "png")
    else:
        source = _line_drawing(
            svg or figure_bytes(figure, "svg"), lambda: figure_bytes(figure, "png", dpi=200)
        )
    narrow = ""
    if exhibit.width_mm > COLUMN_MM:
        small = exhibit.draw(COLUMN_MM)
        narrow = _line_drawing(figure_bytes(small, "svg"), lambda: figure_bytes(small, "png", dpi=250))
    width, height = figure.get_size_inches() * 96.0
    return Drawn(source, narrow, round(width), round(height), files)


def draw_picture(exhibit: Exhibit, settings: ReportSettings, figures: dict[str, bytes]) -> Picture:
    """Draw a figure, add its files to ``figures``, and return it as data URLs.

    Args:
        exhibit: what to draw.
        settings: section ``report``: formats and resolution of the files.
        figures: file name to content; the files of this figure are added.
    """
    return ready_picture(exhibit, draw_exhibit(exhibit, settings), figures)


def ready_picture(exhibit: Exhibit, drawn: Drawn, figures: dict[str, bytes]) -> Picture:
    """Return a figure that is drawn already as the page shows it, and add its files to ``figures``."""
    figures.update(drawn.files)
    return Picture(exhibit, drawn.source, drawn.narrow, drawn.width, drawn.height)


def longest_first(exhibits: Sequence[Exhibit]) -> list[Exhibit]:
    """Return the figures in the order in which several workers finish soonest: wide ones are drawn twice."""
    return sorted(exhibits, key=lambda exhibit: -exhibit.width_mm)


def _line_drawing(svg: bytes, png: Callable[[], bytes]) -> str:
    return _data_url(svg, "svg") if len(svg) <= _LARGEST_SVG else _data_url(small_png(png()), "png")


def _data_url(content: bytes, kind: str) -> str:
    media = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"
