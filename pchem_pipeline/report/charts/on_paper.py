"""Charts drawn with matplotlib, for files, papers and pages without scripts; files repeat to the byte.

They are made with matplotlib's objects alone (no ``pyplot``), so that drawing leaves no state behind.
"""

from __future__ import annotations

import base64
import contextlib
import io
import re
import textwrap
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
import PIL.Image
from matplotlib.artist import setp
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure as MatplotlibFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator, ScalarFormatter

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.wording import power_of_ten
from pchem_pipeline.report.charts.chart import (
    COLUMN_MM,
    SHADES,
    Axis,
    Band,
    Bars,
    Chart,
    Dash,
    Image,
    Level,
    Line,
    Mark,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
    Sticks,
    Words,
    height_of,
    tick_rows,
)
from pchem_pipeline.report.style.palette import LIGHT, MAP_COLOURS

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
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.1,
    "mathtext.fontset": "dejavusans",
    "patch.linewidth": 0.5,
    "pdf.fonttype": 42,
    "svg.hashsalt": "pchem",
    "xtick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.labelsize": 7.0,
    "ytick.major.width": 0.6,
    "axes.edgecolor": LIGHT.edge,
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), LIGHT.ink),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), LIGHT.paper),
}

_METADATA: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": "pchem-pipeline"},
    "png": {"Software": "pchem-pipeline"},
    "pdf": {"CreationDate": None, "ModDate": None, "Creator": "pchem-pipeline", "Producer": None},
}

#: Of PNG files: those of maps are within 3 % as small as at levels 6 and 9, in three quarters of the time.
_COMPRESSION = 4


@dataclass(frozen=True)
class Look:
    """How a figure is drawn."""

    width_mm: float = COLUMN_MM  # width; panels stand side by side on a page, one above the other on a column
    svg_text: bool = False  # whether text of SVG stays text; else it becomes outlines
    dpi: int = 300  # dots per inch that images are drawn for at most
    style: str = ""  # style sheet of matplotlib over the package's own, a name or a file; empty: none

    @property
    def wide(self) -> bool:
        """Whether panels have room side by side."""
        return self.width_mm > 1.5 * COLUMN_MM


class Drawing(MatplotlibFigure):
    """A figure of matplotlib that is saved in its own look, and that notebooks show."""

    look: Look = Look()

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Save the figure, fonts embedded; see :meth:`matplotlib.figure.Figure.savefig`."""
        with _in(self.look):
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        return drawing_bytes(self, "png", dpi=150)


@contextlib.contextmanager
def _in(look: Look) -> Iterator[None]:
    """Hold a look, whatever the user's settings; characters that no font has are boxes.

    Raises:
        ConfigError: its style sheet cannot be read.
    """
    with mpl.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        mpl.rcParams["svg.fonttype"] = "none" if look.svg_text else "path"
        if look.style:
            from matplotlib import style  # reads all sheets of matplotlib

            try:
                style.use(look.style)
            except OSError:
                words = "neither a file nor a style of matplotlib that can be read"
                raise ConfigError(f"--style {look.style}: {words}") from None
        yield


def _lay_out(drawing: Drawing) -> None:
    """Let the layout engine place everything, and leave the drawing without one.

    Nothing is drawn for it. With any engine left each saving would draw the figure twice.
    """
    engine = drawing.get_layout_engine()
    if engine is None:
        return
    for spine in (each for axes in drawing.axes for each in axes.spines.values()):
        spine.set_in_layout(False)  # within the labels, but each would find all ticks of its axis once more
    square: Any = [axes for axes in drawing.axes if axes.get_aspect() != "auto"]
    setp(square, aspect="auto")  # maps take all of their room, lest its margins depend on their size
    engine.execute(drawing)
    setp(square, aspect="equal")
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        drawing.set_layout_engine(None)


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
    with PIL.Image.open(io.BytesIO(png)) as image:
        if image.mode == "RGBA" and image.getchannel("A").getextrema()[0] != 255:
            return png  # a palette has no transparent colours
        few = image.convert("RGB").quantize(
            256, method=PIL.Image.Quantize.MAXCOVERAGE, dither=PIL.Image.Dither.NONE
        )
    buffer = io.BytesIO()
    few.save(buffer, "PNG", compress_level=_COMPRESSION)
    return buffer.getvalue()


#: Height of a further line of a title or of a legend, mm; letters of a title on a millimetre.
_LINE_MM, _LETTERS = 3.5, 0.66
_DASHES: dict[Dash, Any] = {"-...": (0, (5, 1, 1, 1, 1, 1)), "..": (0, (1, 1))}
#: What a legend shows of a mark.
Handle = Any
_MATH = re.compile(r"\$[^$]*\$")


def draw_chart(look: Look, chart: Chart) -> Drawing:
    """Draw a chart: stacks side by side on a page, one above the other in a column.

    The layout is then fixed, so that saving in several formats does not compute it again.
    """
    with _in(look):
        drawing = _drawn(look, chart)
        _lay_out(drawing)
    return drawing


def draw_panels(given: Any, chart: Chart) -> None:
    """Draw the panels of a chart into axes of another figure, in the style of that figure.

    Axes are one or an array of any shape: one for each panel, in order.

    Raises:
        ConfigError: they are no axes, or not as many as the chart has panels.
    """
    panels = [(stack, panel) for stack in chart.stacks for panel in stack.panels]
    several = np.ravel(np.asarray(given, dtype=object)).tolist()
    if len(several) != len(panels) or not all(isinstance(axes, Axes) for axes in several):
        what = ", ".join(type(axes).__name__ for axes in several) or "nothing"
        raise ConfigError(
            f"ax: {what}; give {len(panels)} axes of matplotlib, such as plt.subplots({len(panels)})[1]"
        )
    for axes, (stack, panel) in zip(several, panels, strict=True):
        inch = axes.figure.dpi
        width = 25.4 * axes.get_window_extent().width / inch
        look = Look(25.4 * axes.figure.bbox.width / inch)
        with mpl.rc_context({"legend.fontsize": "small", "legend.frameon": False}):
            handles = _draw_panel(axes, panel, stack, look, width)
            if keys := _keys(chart, width):
                axes.legend([*keys.values()], [*keys], loc="upper left", bbox_to_anchor=(0.0, -0.2))
            elif any(chart.legend) and handles:
                axes.legend([*handles.values()], [*handles])
        if panel is stack.panels[0] and stack.title:
            axes.set_title(stack.title, loc="left", fontsize="small")


def _drawn(look: Look, chart: Chart) -> Drawing:
    columns = len(chart.widths) if look.wide else 1
    width = look.width_mm / columns
    stacks = [
        replace(stack, title=_broken(stack.title, width - 12.0))  # 12 mm are left of the panel
        for stack in chart.stacks
        if look.wide or not stack.wide
    ]
    rows = [stacks[i : i + columns] for i in range(0, len(stacks), columns)]
    heights = [
        max(height_of(each, width) + _LINE_MM * each.title.count("\n") for each in row) for row in rows
    ]
    keys = _keys(chart, look.width_mm)
    lines = sum(1 + text.count("\n") for text in keys)
    height_mm = sum(heights) + (5.0 + _LINE_MM * lines if keys else 0.0)
    drawing = Drawing(figsize=(look.width_mm / 25.4, height_mm / 25.4), layout="constrained")
    drawing.look = look
    FigureCanvasAgg(drawing)  # a canvas of its own
    widths = chart.widths if columns > 1 else (1.0,)
    grid = drawing.add_gridspec(len(rows), columns, height_ratios=heights, width_ratios=widths)
    handles: dict[str, Handle] = {}
    for place, stack in ((grid[i, j], stack) for i, row in enumerate(rows) for j, stack in enumerate(row)):
        shares = [panel.height for panel in stack.panels]
        # a panel alone is laid out with those of the other stacks
        inner = place.subgridspec(len(shares), 1, height_ratios=shares) if len(shares) > 1 else [place]
        first: Axes | None = None
        for i, panel in enumerate(stack.panels):
            axes = drawing.add_subplot(inner[i], sharex=first)
            handles |= _draw_panel(axes, panel, stack, look, width)
            if first is None:
                axes.set_title(stack.title, fontsize=7.0 if "\n" in stack.title else None)
            first = first or axes
    if keys:
        drawing.legend(handles=[*keys.values()], labels=[*keys], loc="outside lower left")
    if any(chart.legend) and handles:
        drawing.legend(
            list(handles.values()), list(handles), loc="outside lower center",
            ncols=chart.legend[0 if look.wide else 1],
        )  # fmt: skip
    return drawing


def _keys(chart: Chart, width_mm: float) -> dict[str, Handle]:
    """Return what the legend shows of colours that have a meaning, by this in lines that fit."""
    keys = ((textwrap.fill(text, int(_LETTERS * width_mm)), colour) for colour, text in chart.keys)
    return {text: Patch(facecolor=colour_of(colour), edgecolor="#888888") for text, colour in keys}


def _broken(title: str, width_mm: float) -> str:
    """Break the lines of a title that are too long, at three blanks if any; a formula is two letters wide."""
    lines = []
    for line in title.split("\n"):
        fits = len(_MATH.sub("MM", line)) < _LETTERS * width_mm
        broken = line.split("   ") if "   " in line else textwrap.wrap(line, int(_LETTERS * width_mm))
        lines += [line] if fits else broken
    return "\n".join(lines)


def _draw_panel(axes: Axes, panel: Panel, stack: Stack, look: Look, width_mm: float) -> dict[str, Handle]:
    """Draw a panel and return what the legend shows by label; a legend of the panel alone is drawn here."""
    most = 5 if any(isinstance(mark, Image) for mark in panel.marks) else 8
    both = (("x", stack.x), ("y", tick_rows(panel.y, width_mm)))
    for name, axis in both:
        _scale(axes, name, axis, most if name == "y" or look.wide else 5)
        if axis.low is not None and axis.high is not None:
            _end(axes, name, axis)  # so that no mark is asked for its ends
    if panel.square:
        axes.set_aspect("equal")
        for side in ("top", "right"):
            axes.spines[side].set_visible(True)
    drawn = [(mark, _draw_mark(axes, mark, look, i)) for i, mark in enumerate(panel.marks)]
    for name, axis in both:
        _end(axes, name, axis)
    handles = {mark.label: artist for mark, artist in drawn if mark.label and mark.listed}
    room = panel.room[0 if look.wide else 1]
    if room != 1.0:
        axes.set_ylim(top=room * axes.get_ylim()[1])
    axes.set(ylabel=panel.y.label)
    if panel is stack.panels[-1]:
        axes.set(xlabel=stack.x.label)
    else:
        axes.tick_params(labelbottom=False)
    if panel.note:
        _note(axes, panel.note, panel.corner)
    if panel.legend:
        axes.legend(list(handles.values()), list(handles), loc=cast(Any, panel.legend), ncols=panel.columns)
        return {}
    return handles


def _note(axes: Axes, text: str, corner: str) -> None:
    vertical, horizontal = corner.split()
    x, va = 0.985 if horizontal == "right" else 0.015, "top" if vertical == "upper" else "bottom"
    y = 0.975 if vertical == "upper" else 0.03
    box = {"facecolor": LIGHT.paper, "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
    style: Any = {"fontsize": 6.5, "color": LIGHT.faint, "bbox": box, "ha": horizontal, "va": va}
    axes.text(x, y, text, transform=axes.transAxes, **style)


def _decade(place: float, _: object) -> str:  # a lambda could not be pickled
    return power_of_ten(round(np.log10(place))) or "1"


def _scale(axes: Axes, name: str, axis: Axis, most: int) -> None:
    """Set scale and ticks of an axis; of whole numbers, and along x, at most so many."""
    one, set_scale = getattr(axes, f"{name}axis"), getattr(axes, f"set_{name}scale")
    if axis.log:
        set_scale("log")
        one.set_major_formatter(_decade)  # characters: a formula takes ten times as long
    elif axis.linear_to:
        set_scale("symlog", linthresh=axis.linear_to, linscale=1.5)
    if axis.ticks:
        places, texts = zip(*axis.ticks, strict=True)
        one.set_ticks(places, labels=texts)
        one.set_minor_locator(NullLocator())
    elif axis.whole:
        one.set_major_locator(MaxNLocator(most, integer=True))
    if not axis.ticks and isinstance(one.get_major_formatter(), ScalarFormatter):
        one.get_major_formatter().set_useOffset(False)
        if name == "x":
            one.get_major_locator().set_params(nbins=most)


def _end(axes: Axes, name: str, axis: Axis) -> None:
    """Set the ends of an axis that are given and differ; the others follow the marks."""
    ends = (axis.high, axis.low) if axis.down else (axis.low, axis.high)
    if ends[0] != ends[1]:
        getattr(axes, f"set_{name}lim")(*ends)


def colour_of(name: str) -> str:
    """Return the colour of that name in the palette; others are colours already."""
    return str(getattr(LIGHT, name, name))


def _draw_mark(axes: Axes, mark: Mark, look: Look, order: int) -> Handle:
    """Draw a mark over those before it and return what a legend shows of it."""
    area: dict[str, Any] = {
        "color": colour_of(mark.colour),
        "alpha": None if mark.alpha == 1.0 else mark.alpha,
        "label": mark.label or None,
        "zorder": 1.0 + 0.01 * order,
    }
    style: dict[str, Any] = {"linewidth": mark.width, "linestyle": _DASHES.get(mark.dash, mark.dash), **area}
    match mark:
        case Line():
            dots: dict[str, Any] = {"marker": "o", "markersize": mark.dots} if mark.dots else {}
            drawstyle = "steps-mid" if mark.step else "default"
            [line] = axes.plot(mark.x, mark.y, drawstyle=drawstyle, **dots, **style)
            return line
        case Steps() if mark.filled:
            # on a logarithmic axis the area goes down to its end
            base = 1e-300 if axes.get_yscale() == "log" else 0.0
            return axes.stairs(mark.values, mark.edges, fill=True, baseline=base, **area)
        case Steps():
            return axes.stairs(mark.values, mark.edges, **style)
        case Bars():
            heights = np.asarray(mark.high) - np.asarray(mark.low)
            axes.bar(mark.x, heights, width=mark.broad, bottom=mark.low, linewidth=0, **area)
            return Patch(linewidth=0, **area)
        case Sticks():
            options = {"colors": style.pop("color"), "linestyles": style.pop("linestyle")}
            return axes.vlines(mark.x, 0.0, mark.y, **options, **style)
        case Points():
            # many points would make a vector file large
            style |= {"linestyle": "none", "marker": mark.mark, "rasterized": mark.y.size > 1000}
            if mark.face:
                style |= {"markerfacecolor": colour_of(mark.face), "markeredgewidth": 0.8}
            if mark.error is None:
                [points] = axes.plot(mark.x, mark.y, markersize=mark.size, **style)
                return points
            error = np.nan_to_num(mark.error)
            lines: dict[str, Any] = {"capsize": mark.cap, "elinewidth": 0.8}
            return axes.errorbar(mark.x, mark.y, error, markersize=mark.size, **lines, **style)
        case Band():
            step: Any = "mid" if mark.step else None
            return axes.fill_between(mark.x, mark.low, mark.high, linewidth=0, step=step, **area)
        case Level():
            return (axes.axhline if mark.axis == "y" else axes.axvline)(mark.at, **style)
        case Span():
            return (axes.axhspan if mark.axis == "y" else axes.axvspan)(
                mark.low, mark.high, linewidth=0, **area
            )
        case Image():
            _draw_image(axes, mark, look)
        case Words():
            axes.text(
                mark.x, mark.up, mark.text, ha=mark.align, va="bottom", fontsize=7.0, color=style["color"],
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
    return Line2D([], [])


def _draw_image(axes: Axes, mark: Image, look: Look) -> None:
    """Draw a map with its bar of colours; those pixels that the resolution can show."""
    beside = axes.get_subplotspec()
    columns = 1 if beside is None else beside.get_topmost_subplotspec().get_gridspec().ncols
    values, x, y = mark.shown(look.width_mm / 25.4 * look.dpi / columns)
    if isinstance(mark.scale, str):
        scale: Colormap = mpl.colormaps[colour_of(mark.scale) or MAP_COLOURS].resampled(SHADES)
    else:
        scale = ListedColormap([colour_of(each) for each in mark.scale])
    colours = scale.with_extremes(bad=LIGHT.no_value)
    low, high = mark.ends
    axes.set_facecolor(LIGHT.no_value)
    # a vector file keeps the pixels as they are, but for more of them than it can show
    kept = "none" if max(mark.values.shape) <= 800 else "nearest"
    image = axes.imshow(
        mark.levels(values).astype(np.float32), colours, vmin=low, vmax=high, origin="upper",
        interpolation=kept, aspect=axes.get_aspect(), extent=(*x, *y[::-1]),
    )  # fmt: skip
    if mark.unit:
        places, texts = [place for place, _ in mark.bar], [text for _, text in mark.bar]
        ticks: Any = places or MaxNLocator(5, integer=mark.whole)
        bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), ticks=ticks)
        if texts:
            bar.ax.set_yticklabels(texts)
        bar.ax.minorticks_off()
        bar.set_label(mark.unit)
