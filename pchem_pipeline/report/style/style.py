"""One look for all figures: print sizes, colours safe for the colour-blind, files that repeat to the byte.

Figures are made with matplotlib's objects alone (no ``pyplot``), so that drawing leaves no state behind.
Colours of lines are those of Okabe and Ito (2008); maps use ``viridis``, whose lightness rises evenly.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from typing import Any, ParamSpec

import matplotlib as mpl
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from pchem_pipeline.report.style.recolour import recolour

__all__ = [
    "BLACK",
    "BLUE",
    "COLUMN_MM",
    "GRAY",
    "GREEN",
    "MAP_COLOURS",
    "NO_VALUE",
    "ORANGE",
    "PAGE_MM",
    "PALETTE",
    "PURPLE",
    "SKY",
    "VERMILION",
    "Figure",
    "figure_bytes",
    "inches",
    "new_figure",
    "note",
    "plain",
    "small_png",
    "style_sheet",
    "styled",
]

#: Widths of one column and of a page of a journal, mm.
COLUMN_MM = 88.0
PAGE_MM = 180.0

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GRAY = "#B8B8B8"
#: Colour of pixels without a value in maps: outside the range of ``MAP_COLOURS`` in hue and saturation.
NO_VALUE = "#D9D9D9"
PALETTE = (BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE, YELLOW, BLACK)
MAP_COLOURS = "viridis"

_STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#333333",
    "axes.grid": False,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.prop_cycle": cycler(color=PALETTE),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.0,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.03,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "image.cmap": MAP_COLOURS,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.1,
    "mathtext.fontset": "dejavusans",
    "patch.linewidth": 0.5,
    "pdf.fonttype": 42,
    "savefig.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "pchem",
    "xtick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.labelsize": 7.0,
    "ytick.major.width": 0.6,
}

_METADATA: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": "pchem-pipeline"},
    "png": {"Software": "pchem-pipeline"},
    "pdf": {"CreationDate": None, "ModDate": None, "Creator": "pchem-pipeline", "Producer": None},
}

#: Of PNG files: those of maps are within 3 % as small as at levels 6 and 9, in three quarters of the time.
_COMPRESSION = 4

P = ParamSpec("P")

_SHEET: ContextVar[Mapping[str, Any] | None] = ContextVar("sheet", default=None)


@contextlib.contextmanager
def style_sheet(parameters: Mapping[str, Any] | None) -> Iterator[None]:
    """Let matplotlib parameters of the user prevail over the style of this package.

    Args:
        parameters: name to value, as a style sheet has them; None for none.
    """
    token = _SHEET.set(parameters)
    try:
        yield
    finally:
        _SHEET.reset(token)


@contextlib.contextmanager
def _style() -> Iterator[None]:
    """Hold the style of this package, whatever the user's settings; characters no font has are boxes."""
    with mpl.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        mpl.rcdefaults()
        sheet: Any = _SHEET.get() or {}
        mpl.rcParams.update({**_STYLE, **sheet})
        yield


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a drawing function: it draws in the style of this package and lays out once.

    The layout is then fixed, so that saving in several formats does not compute it again.
    """

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _style():
            figure = draw(*args, **kwargs)
            if "axes.prop_cycle" in (_SHEET.get() or {}):
                recolour(figure, PALETTE, mpl.rcParams["axes.prop_cycle"].by_key().get("color", []))
            _lay_out(figure)
            return figure

    return wrapper


def _lay_out(figure: Figure) -> None:
    """Let the layout engine place everything, and leave the figure without one.

    Nothing is drawn for it. Any engine that is left, one that does nothing too, would make each saving draw
    the figure twice.
    """
    engine = figure.get_layout_engine()
    if engine is None:
        return
    engine.execute(figure)
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


class StyledFigure(Figure):
    """A figure that is saved in the style of this package, and that notebooks show."""

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Save the figure, fonts embedded; see :meth:`matplotlib.figure.Figure.savefig`."""
        with _style():
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        """Return the figure as a notebook shows it."""
        return figure_bytes(self, "png", dpi=150)


def plain(text: str) -> str:
    """Return a text of others so that it is shown as it is, not read as a formula."""
    return text.replace("$", r"\$")


def inches(millimetres: float) -> float:
    """Return a length in inches."""
    return millimetres / 25.4


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """Return an empty figure of that size with a canvas of its own."""
    figure = StyledFigure(figsize=(inches(width_mm), inches(height_mm)), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def note(axes: Axes, text: str, *, where: str = "upper right") -> None:
    """Write a small note into a corner of the axes."""
    vertical, horizontal = where.split()
    axes.text(
        0.985 if horizontal == "right" else 0.015,
        0.975 if vertical == "upper" else 0.03,
        text,
        transform=axes.transAxes,
        ha="right" if horizontal == "right" else "left",
        va="top" if vertical == "upper" else "bottom",
        fontsize=6.5,
        color="#444444",
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0},
    )


# of an SVG: outlines of paths, decimals of their numbers beyond the second, and blanks that say nothing
_PATH = re.compile(rb' d="[^"]*"')
_DIGITS = re.compile(rb"(\.\d\d)\d+")
_BLANKS = re.compile(rb"(?<=[MLQC]) | ?\n")
_BETWEEN = re.compile(rb">\s+<")


def figure_bytes(figure: Figure, kind: str, *, dpi: int = 300, title: str = "") -> bytes:
    """Return a figure as a file of kind ``svg``, ``png`` or ``pdf``; the same figure gives the same bytes.

    Fonts are embedded: as outlines in SVG, as TrueType in PDF.
    """
    metadata = dict(_METADATA[kind])
    if title:
        metadata["Title"] = title
    buffer = io.BytesIO()
    with _style():
        options: dict[str, Any] = {"pil_kwargs": {"compress_level": _COMPRESSION}} if kind == "png" else {}
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata, **options)
    return _compact(buffer.getvalue()) if kind == "svg" else buffer.getvalue()


def _compact(svg: bytes) -> bytes:
    """Return an SVG in which paths are given to a hundredth of a point, without blanks: a quarter less."""
    short = _PATH.sub(lambda path: _BLANKS.sub(b"", _DIGITS.sub(rb"\1", path.group())), svg)
    return _BETWEEN.sub(b"><", short)


def small_png(png: bytes) -> bytes:
    """Return a PNG with a palette of 256 colours: a third of the size, no visible change."""
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, "PNG", compress_level=_COMPRESSION)
    return buffer.getvalue()
