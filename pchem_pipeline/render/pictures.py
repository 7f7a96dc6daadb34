"""Figures as the page holds them: drawn once at full width, once for small screens, as data URLs."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass

from pchem_pipeline.render.exhibits import Exhibit
from pchem_pipeline.render.settings import ReportSettings
from pchem_pipeline.render.style import COLUMN_MM, figure_bytes, small_png

__all__ = ["Picture", "draw_picture"]

#: SVG files beyond this size are embedded as PNG.
_LARGEST_SVG = 450_000


@dataclass(frozen=True)
class Picture:
    """A figure as the page shows it; ``narrow`` is the drawing for small screens."""

    exhibit: Exhibit
    source: str
    narrow: str
    width: int
    height: int


def draw_picture(exhibit: Exhibit, settings: ReportSettings, figures: dict[str, bytes]) -> Picture:
    """Draw a figure, add its files to ``figures``, and return it as data URLs.

    Args:
        exhibit: what to draw.
        settings: section ``report``: formats and resolution of the files.
        figures: file name to content; the files of this figure are added.
    """
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
    return Picture(exhibit, source, narrow, round(width), round(height))


def _line_drawing(svg: bytes, png: Callable[[], bytes]) -> str:
    return _data_url(svg, "svg") if len(svg) <= _LARGEST_SVG else _data_url(small_png(png()), "png")


def _data_url(content: bytes, kind: str) -> str:
    media = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{media};base64,{base64.b64encode(content).decode('ascii')}"
