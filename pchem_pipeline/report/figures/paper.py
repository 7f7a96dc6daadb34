"""Figures as files for papers, each with its numbers beside it as CSV."""

from __future__ import annotations

from dataclasses import dataclass

from pchem_pipeline.report.charts.on_paper import Look, drawing_bytes
from pchem_pipeline.report.figures.figure import Figure, csv_text

#: File formats of figures for papers.
FORMATS = ("pdf", "svg", "png")


@dataclass(frozen=True)
class PaperFigure:
    """A figure and how it is wanted.

    Attributes:
        figure: the figure.
        formats: any of ``FORMATS``.
        width_mm: width; None: the figure's own.
        dpi: resolution of PNG, and of maps inside the other formats, dots per inch.
    """

    figure: Figure
    formats: tuple[str, ...]
    width_mm: float | None = None
    dpi: int = 600


def draw_paper_figure(wanted: PaperFigure) -> dict[str, bytes]:
    """Draw a figure and return its files and those of its tables by name; pure."""
    figure, files = wanted.figure, {}
    drawing = figure.draw(Look(wanted.width_mm or figure.width_mm, dpi=wanted.dpi))
    for kind in wanted.formats:
        content = drawing_bytes(drawing, kind, dpi=wanted.dpi, title=figure.title)
        files[f"{figure.name}.{kind}"] = content
    for table in figure.tables:
        part = f"_{table.part}" if table.part else ""
        files[f"{figure.name}{part}.csv"] = csv_text(table).encode()
    return files
