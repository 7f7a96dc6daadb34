"""Figures as files and as the data URLs that a page embeds; each can be drawn in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from urllib.parse import quote

from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.settings import ReportSettings

_MM = 4.5  # px on a page of a millimetre on paper
_SAFE = " !$()*+,-./:;=?@[]^_`{|}~"  # needs no escape in a data URL within an attribute


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


#: Draws many figures at once and returns them by name.
DrawAll = Callable[[Sequence[Figure], ReportSettings], Mapping[str, Drawn]]


def draw_figure(figure: Figure, settings: ReportSettings) -> Drawn:
    """Draw a figure as a page embeds it, and the files of it that are asked for; pure.

    Text on the page stays text: it can be found, and takes half the room of outlines.

    Args:
        figure: the figure.
        settings: formats and resolution.
    """
    from pchem_pipeline.report.charts.on_paper import Look, drawing_bytes

    look = Look(figure.width_mm, dpi=settings.dpi)
    drawing = figure.draw(look)
    drawing.look = replace(look, sheet={"svg.fonttype": "none"})
    picture = drawing_bytes(drawing, "svg", dpi=settings.dpi)
    drawing.look = look
    files = {
        f"{figure.name}.{kind}": drawing_bytes(drawing, kind, dpi=settings.dpi, title=figure.title)
        for kind in settings.figure_formats
    }
    width, height = (round(_MM * 25.4 * side) for side in drawing.get_size_inches())
    return Drawn(f"data:image/svg+xml,{quote(picture, safe=_SAFE)}", width, height, files)


def draw_here(figures: Sequence[Figure], settings: ReportSettings) -> dict[str, Drawn]:
    """Draw figures one after the other, in this process."""
    return {figure.name: draw_figure(figure, settings) for figure in figures}
