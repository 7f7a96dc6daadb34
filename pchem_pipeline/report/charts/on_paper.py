"""Charts drawn with matplotlib, for files and papers."""

from __future__ import annotations

import re
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator, ScalarFormatter

from pchem_pipeline.report.charts.chart import (
    Axis,
    Band,
    Bars,
    Chart,
    Dash,
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
)
from pchem_pipeline.report.style.palette import Palette
from pchem_pipeline.report.style.style import Drawing, Look, colours_of, look_of, note, styled

#: Height of a further line of a title, mm; letters of a title on a millimetre.
_LINE_MM, _LETTERS = 3.5, 0.66
_DASHES: dict[Dash, Any] = {"-...": (0, (5, 1, 1, 1, 1, 1)), "..": (0, (1, 1))}
#: Points beyond which they are an image in a vector file.
_MOST_POINTS = 1000
#: What a legend shows of a mark.
Handle = Any
_MATH = re.compile(r"\$[^$]*\$")


@styled
def draw_chart(look: Look, chart: Chart) -> Drawing:
    """Draw a chart: stacks side by side on a page, one above the other in a column.

    Args:
        look: width and colours.
        chart: what is drawn.
    """
    columns = len(chart.widths) if look.wide else 1
    stacks = [stack for stack in chart.stacks if look.wide or not stack.wide]
    rows = [stacks[i : i + columns] for i in range(0, len(stacks), columns)]
    titles = {id(stack): _broken(stack.title, look.width_mm / columns) for stack in stacks}
    heights = [
        max(stack.height_mm + _LINE_MM * titles[id(stack)].count("\n") for stack in row) for row in rows
    ]
    drawing = look.empty(sum(heights) or 40.0)
    if not rows:
        axes = drawing.add_subplot()
        axes.text(0.5, 0.5, chart.empty, ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return drawing
    widths = chart.widths if columns > 1 else (1.0,)
    grid = drawing.add_gridspec(len(rows), columns, height_ratios=heights, width_ratios=widths)
    handles: dict[str, Handle] = {}
    for place, stack in ((grid[i, j], stack) for i, row in enumerate(rows) for j, stack in enumerate(row)):
        inner = place.subgridspec(
            len(stack.panels), 1, height_ratios=[panel.height for panel in stack.panels]
        )
        first: Axes | None = None
        for i, panel in enumerate(stack.panels):
            axes = drawing.add_subplot(inner[i, 0], sharex=first)
            handles |= _draw_panel(axes, panel, stack, last=i == len(stack.panels) - 1)
            if first is None:
                axes.set_title(titles[id(stack)], fontsize=7.0 if "\n" in titles[id(stack)] else None)
            first = first or axes
    if any(chart.legend) and handles:
        drawing.legend(
            list(handles.values()), list(handles), loc="outside lower center",
            ncols=chart.legend[0 if look.wide else 1],
        )  # fmt: skip
    return drawing


def _broken(title: str, width_mm: float) -> str:
    """Break the lines of a title that are too long, at three blanks; a formula is about two letters wide."""
    lines = []
    for line in title.split("\n"):
        fits = len(_MATH.sub("MM", line)) < _LETTERS * width_mm
        lines += [line] if fits else line.split("   ")
    return "\n".join(lines)


def _draw_panel(axes: Axes, panel: Panel, stack: Stack, *, last: bool) -> dict[str, Handle]:
    """Draw a panel and return what its legend shows by label; one of its own is drawn here."""
    _scale(axes, "x", stack.x)
    _scale(axes, "y", panel.y)
    drawn = [(mark, _draw_mark(axes, mark, i)) for i, mark in enumerate(panel.marks)]
    _end(axes, "x", stack.x)
    _end(axes, "y", panel.y)
    handles = {mark.label: artist for mark, artist in drawn if mark.label and mark.listed}
    room = panel.room[0 if look_of(axes).wide else 1]
    if room != 1.0:
        axes.set_ylim(top=room * axes.get_ylim()[1])
    axes.set(ylabel=panel.y.label)
    if last:
        axes.set(xlabel=stack.x.label)
    else:
        axes.tick_params(labelbottom=False)
    if panel.note:
        note(axes, panel.note, where=panel.corner)
    if panel.legend:
        axes.legend(list(handles.values()), list(handles), loc=cast(Any, panel.legend), ncols=panel.columns)
        return {}
    return handles


def _scale(axes: Axes, name: str, axis: Axis) -> None:
    """Set scale and ticks of an axis."""
    one, set_scale = getattr(axes, f"{name}axis"), getattr(axes, f"set_{name}scale")
    if axis.log:
        set_scale("log")
    elif axis.linear_to:
        set_scale("symlog", linthresh=axis.linear_to, linscale=1.5)
    if axis.ticks:
        places, texts = zip(*axis.ticks, strict=True)
        one.set_ticks(places, labels=texts)
        one.set_minor_locator(NullLocator())
    elif axis.whole:
        one.set_major_locator(MaxNLocator(8, integer=True))
    if not axis.ticks and isinstance(one.get_major_formatter(), ScalarFormatter):
        one.get_major_formatter().set_useOffset(False)


def _end(axes: Axes, name: str, axis: Axis) -> None:
    """Set the ends of an axis that are given; the others follow the marks."""
    if axis.low is not None or axis.high is not None:
        getattr(axes, f"set_{name}lim")(axis.low, axis.high)


def _style(mark: Mark, colours: Palette) -> dict[str, Any]:
    return {
        "color": colour_of(mark.colour, colours),
        "linewidth": mark.width,
        "linestyle": _DASHES.get(mark.dash, mark.dash),
        "alpha": None if mark.alpha == 1.0 else mark.alpha,
    }


def colour_of(name: str, colours: Palette) -> str:
    """Return the colour of that name in a palette; others are colours already."""
    return str(getattr(colours, name, name))


def _draw_mark(axes: Axes, mark: Mark, order: int) -> Handle:
    """Draw a mark over those before it and return what a legend shows of it."""
    colours = colours_of(axes)
    style: dict[str, Any] = {
        **_style(mark, colours),
        "label": mark.label or None,
        "zorder": 1.0 + 0.01 * order,
    }
    area = {
        "color": style["color"],
        "alpha": style["alpha"],
        "label": style["label"],
        "zorder": style["zorder"],
    }
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
            return axes.bar(mark.x, heights, width=mark.broad, bottom=mark.low, linewidth=0, **area)[0]
        case Sticks():
            options = {"colors": style.pop("color"), "linestyles": style.pop("linestyle")}
            return axes.vlines(mark.x, 0.0, mark.y, **options, **style)
        case Points():
            # many points would make a vector file large
            style |= {"linestyle": "none", "marker": mark.mark, "rasterized": mark.y.size > _MOST_POINTS}
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
        case Words():
            axes.text(
                mark.x, mark.up, mark.text, ha=mark.align, va="bottom", fontsize=7.0, color=style["color"],
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
    return Line2D([], [])
