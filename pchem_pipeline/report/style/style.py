"""One look for all figures on paper: type, colours, and files that repeat to the byte.

They are made with matplotlib's objects alone (no ``pyplot``), so that drawing leaves no state behind.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Concatenate, ParamSpec

import matplotlib as mpl
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure as MatplotlibFigure
from PIL import Image

from pchem_pipeline.report.charts.chart import COLUMN_MM
from pchem_pipeline.report.style.palette import CYCLE, DARK, LIGHT, MAP_COLOURS, Palette

_STYLE: Any = {
    "axes.axisbelow": True,
    "axes.grid": False,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.0,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.03,
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


@dataclass(frozen=True)
class Look:
    """How a figure is drawn.

    Attributes:
        width_mm: width; panels stand side by side on a page, one above the other on a column.
        palette: colours.
        sheet: parameters of matplotlib that prevail over the style of this package.
        dpi: dots per inch that images are drawn for at most.
    """

    width_mm: float = COLUMN_MM
    palette: Palette = LIGHT
    sheet: Mapping[str, Any] = field(default_factory=dict)
    dpi: int = 300

    @classmethod
    def of_sheet(cls, width_mm: float, sheet: Mapping[str, Any], dpi: int = 300) -> Look:
        """Return the look that a user's style sheet asks for."""
        return cls(width_mm, palette_of(sheet), sheet, dpi)

    @property
    def wide(self) -> bool:
        """Whether panels have room side by side."""
        return self.width_mm > 1.5 * COLUMN_MM

    def empty(self, height_mm: float) -> Drawing:
        """Return an empty drawing of that height with a canvas of its own."""
        size = (inches(self.width_mm), inches(height_mm))
        drawing = Drawing(figsize=size, layout="constrained")
        drawing.look = self
        FigureCanvasAgg(drawing)
        return drawing

    def parameters(self) -> Any:
        """Return the parameters of matplotlib that make this look."""
        colours = {**self.palette.parameters(), "axes.prop_cycle": cycler(color=self.palette.cycle)}
        return {**_STYLE, **colours, **self.sheet}


class Drawing(MatplotlibFigure):
    """A drawn figure that is saved in its own look, and that notebooks show."""

    look: Look = Look()

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Save the figure, fonts embedded; see :meth:`matplotlib.figure.Figure.savefig`."""
        with _in(self.look):
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        """Return the figure as a notebook shows it."""
        return drawing_bytes(self, "png", dpi=150)


def palette_of(sheet: Mapping[str, Any]) -> Palette:
    """Return the palette of a matplotlib style sheet: its paper and text, its cycle of colours.

    Args:
        sheet: name to value; what it does not say is that of ``LIGHT``, of ``DARK`` where its paper is dark.
    """
    paper = sheet.get("axes.facecolor", sheet.get("figure.facecolor", LIGHT.paper))
    red, green, blue = to_rgb(paper)
    base = DARK if 0.3 * red + 0.59 * green + 0.11 * blue < 0.5 else LIGHT
    names = {"text.color": ("ink", "faint"), "axes.edgecolor": ("edge",)}
    found = {name: to_hex(sheet[key]) for key, names_ in names.items() if key in sheet for name in names_} | (
        {"paper": to_hex(paper)} if base is DARK or paper != LIGHT.paper else {}
    )
    cycle = sheet["axes.prop_cycle"].by_key().get("color", []) if "axes.prop_cycle" in sheet else []
    if cycle:
        found |= {name: to_hex(cycle[i % len(cycle)]) for i, name in enumerate(CYCLE[:-1])}
    return replace(base, **found)


@contextlib.contextmanager
def _in(look: Look) -> Iterator[None]:
    """Hold a look, whatever the user's settings; characters that no font has are boxes."""
    with mpl.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        mpl.rcdefaults()
        mpl.rcParams.update(look.parameters())
        yield


def styled(draw: Callable[Concatenate[Look, P], Drawing]) -> Callable[Concatenate[Look, P], Drawing]:
    """Decorate a drawing function, whose first argument is the look: it draws in it and lays out once.

    The layout is then fixed, so that saving in several formats does not compute it again.
    """

    @functools.wraps(draw)
    def wrapper(look: Look, /, *args: P.args, **kwargs: P.kwargs) -> Drawing:
        with _in(look):
            drawing = draw(look, *args, **kwargs)
            _lay_out(drawing)
            return drawing

    return wrapper


def _lay_out(drawing: Drawing) -> None:
    """Let the layout engine place everything, and leave the drawing without one.

    Nothing is drawn for it. Any engine that is left, one that does nothing too, would make each saving draw
    the figure twice.
    """
    engine = drawing.get_layout_engine()
    if engine is None:
        return
    for spine in (each for axes in drawing.axes for each in axes.spines.values()):
        spine.set_in_layout(False)  # within the labels, but each would find all ticks of its axis once more
    for _ in range(2):  # once more, now that maps, whose sides are in proportion, have their size
        engine.execute(drawing)
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        drawing.set_layout_engine(None)


def inches(millimetres: float) -> float:
    """Return a length in inches."""
    return millimetres / 25.4


def look_of(axes: Axes) -> Look:
    """Return the look in which the axes are drawn."""
    figure = axes.figure
    while not isinstance(figure, Drawing):
        figure = figure.figure  # from a part of a figure to the whole
    return figure.look


def colours_of(axes: Axes) -> Palette:
    """Return the palette in which the axes are drawn."""
    return look_of(axes).palette


def note(axes: Axes, text: str, *, where: str = "upper right") -> None:
    """Write a small note into a corner of the axes."""
    colours = colours_of(axes)
    vertical, horizontal = where.split()
    axes.text(
        0.985 if horizontal == "right" else 0.015,
        0.975 if vertical == "upper" else 0.03,
        text,
        transform=axes.transAxes,
        ha="right" if horizontal == "right" else "left",
        va="top" if vertical == "upper" else "bottom",
        fontsize=6.5,
        color=colours.faint,
        bbox={"facecolor": colours.paper, "alpha": 0.75, "edgecolor": "none", "pad": 1.0},
    )


# of an SVG: outlines of paths, decimals of their numbers beyond the second, and blanks that say nothing
_PATH = re.compile(rb' d="[^"]*"')
_DIGITS = re.compile(rb"(\.\d\d)\d+")
_BLANKS = re.compile(rb"(?<=[MLQC]) | ?\n")
_BETWEEN = re.compile(rb">\s+<")
_CLIP = re.compile(rb'<clipPath id="(p[0-9a-f]{10})"')
_IMAGE = re.compile(rb"(?<=data:image/png;base64,)[A-Za-z0-9+/=\s]+")


def drawing_bytes(drawing: Drawing, kind: str, *, dpi: int = 300, title: str = "") -> bytes:
    """Return a drawing as a file of kind ``svg``, ``png`` or ``pdf``; the same drawing gives the same bytes.

    Fonts are embedded: as outlines in SVG, as TrueType in PDF.
    """
    metadata = dict(_METADATA[kind])
    if title:
        metadata["Title"] = title
    buffer = io.BytesIO()
    options: dict[str, Any] = {"pil_kwargs": {"compress_level": _COMPRESSION}} if kind == "png" else {}
    drawing.savefig(buffer, format=kind, dpi=dpi, metadata=metadata, **options)
    return _compact(buffer.getvalue()) if kind == "svg" else buffer.getvalue()


def _compact(svg: bytes) -> bytes:
    """Return an SVG with paths to 0.01 pt, images of 256 colours, no blanks: a quarter less.

    Clip paths are numbered: matplotlib's names for them depend on which objects were collected.
    """
    for number, name in enumerate(_CLIP.findall(svg)):
        svg = svg.replace(name, b"clip%d" % number)
    svg = _IMAGE.sub(lambda image: base64.b64encode(small_png(base64.b64decode(image.group()))), svg)
    short = _PATH.sub(lambda path: _BLANKS.sub(b"", _DIGITS.sub(rb"\1", path.group())), svg)
    return _BETWEEN.sub(b"><", short)


def small_png(png: bytes) -> bytes:
    """Return a PNG with a palette of 256 colours: a third of the size, no visible change."""
    with Image.open(io.BytesIO(png)) as image:
        if image.mode == "RGBA" and image.getchannel("A").getextrema()[0] != 255:
            return png  # a palette has no transparent colours
        few = image.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, "PNG", compress_level=_COMPRESSION)
    return buffer.getvalue()
