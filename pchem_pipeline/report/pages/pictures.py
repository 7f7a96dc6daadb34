"""Figures as the data URLs that a page embeds; each can be drawn in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from pchem_pipeline.report.figures.figure import Figure

_MM = 4.5  # px on a page of a millimetre on paper
_SAFE = " !$()*+,-./:;=?@[]^_`{|}~"  # needs no escape in a data URL within an attribute


@dataclass(frozen=True)
class Drawn:
    """A figure as a page embeds it.

    Attributes:
        source: data URL.
        width, height: size on the page, px.
    """

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
    picture = drawing_bytes(drawing, "svg")
    width, height = (round(_MM * 25.4 * side) for side in drawing.get_size_inches())
    return Drawn(f"data:image/svg+xml,{quote(picture, safe=_SAFE)}", width, height)


def draw_here(figures: Sequence[Figure]) -> dict[str, Drawn]:
    """Draw figures one after the other, in this process."""
    return {figure.name: draw_figure(figure) for figure in figures}
