"""What a chart shows: marks in panels, panels over each other in stacks, stacks in columns.

A figure is described once, in these words. ``on_paper`` draws it with matplotlib, for files and for pages
without scripts; ``on_page`` writes it as the numbers that the page's script draws. A colour is the name of
one in the ``Palette``, or ``#rrggbb``; texts may hold mathtext.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray

Values = NDArray[Any]
Dash = Literal["-", "--", "-.", ":", "-...", ".."]
Shape = Literal["o", "s", "x", "D", "d", "^", "v", "<", "P", "X", "*", "h", "|"]

#: Widths of one column and of a page of a journal, mm; columns stand side by side beyond half as much again.
COLUMN_MM, PAGE_MM = 88.0, 180.0
#: Colours of a scale.
SHADES = 255
#: Height of a map over its width, at most; ratio of its sides beyond which pixels are not square.
TALLEST, LONGEST = 1.6, 4.0
#: Letters of a tick's text for a millimetre of a stack's width; height of a row with a text, and of each
#: further line, mm.
_TICK_LETTERS, _ROW_MM, _LINE_MM = 0.31, 6.2, 3.2
#: Margin of an axis whose end is not given, of what it shows.
_MARGIN = 0.05


@dataclass(frozen=True)
class Axis:
    """An axis."""

    label: str  # with the unit
    low: float | None = None  # None: that of the marks and a margin
    high: float | None = None  # the same
    log: bool = False  # logarithmic
    linear_to: float = 0.0  # logarithmic to both sides beyond this, linear between; 0: not so
    whole: bool = False  # ticks at whole numbers alone
    ticks: tuple[tuple[float, str], ...] = ()  # places and texts; empty: as the renderer finds them
    down: bool = False  # its values grow downwards; both ends are given


@dataclass(frozen=True, kw_only=True)
class Mark:
    """What all marks have."""

    colour: str = "blue"
    label: str = ""  # in the legend; on the page its values are shown below it
    listed: bool = True  # whether the legend on paper has it too
    width: float = 1.1  # of its line, points (1/72 inch)
    dash: Dash = "-"  # style of its line
    alpha: float = 1.0  # 1 where nothing shines through


@dataclass(frozen=True)
class Line(Mark):
    """A curve through points (n,), with a gap where y is NaN."""

    x: Values
    y: Values
    dots: float = 0.0  # diameter of a dot at each point, points
    step: bool = False  # each value holds half-way to its neighbours


@dataclass(frozen=True)
class Steps(Mark):
    """A histogram: the outline, or the filled area, of n values between n + 1 edges."""

    edges: Values
    values: Values
    filled: bool = False


@dataclass(frozen=True)
class Bars(Mark):
    """Bars from ``low`` to ``high``, ``broad`` on the axis of x; all (n,)."""

    x: Values
    low: Values
    high: Values
    broad: float = 0.85


@dataclass(frozen=True)
class Sticks(Mark):
    """Lines from zero to each value (n,)."""

    x: Values
    y: Values


@dataclass(frozen=True)
class Points(Mark):
    """Points (n,)."""

    x: Values
    y: Values
    mark: Shape = "o"  # its shape, as matplotlib calls it; the page's script draws disks, squares and crosses
    size: float = 3.5  # diameter, points
    face: str = ""  # colour within an outline, ``none`` of nothing; empty: filled
    error: Values | None = None  # lengths of the error bars below and above, (2, n); None: there are none
    cap: float = 0.0  # length of the bars' ends, points


@dataclass(frozen=True)
class Band(Mark):
    """The area between two curves (n,)."""

    x: Values
    low: Values
    high: Values
    step: bool = False


@dataclass(frozen=True)
class Level(Mark):
    """A line across the panel at a value of an axis."""

    at: float
    axis: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class Span(Mark):
    """An area across the panel between two values of an axis."""

    low: float
    high: float
    axis: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class Words(Mark):
    """A text in the panel: over ``x``, at a part ``up`` of its height."""

    x: float
    up: float
    text: str
    align: Literal["left", "center"] = "center"


@dataclass(frozen=True)
class Image(Mark):
    """A map: the values of pixels (row, column) as colours; of many rows and columns some are drawn."""

    values: Values  # of the pixels, NaN where there is none
    x: tuple[float, float]  # left and right end on the axis of x
    y: tuple[float, float]  # end of the first and of the last row on the upright axis
    scale: str | tuple[str, ...] = ""  # name of a scale, or the colours, one more than edges
    ends: tuple[float, float] = (0.0, 1.0)  # values of the first and the last colour; others have the nearest
    edges: Values | None = None  # instead of these the values between one colour and the next, rising
    bar: tuple[tuple[float, str], ...] = ()  # places (0 to 1) and texts along a bar of colours; empty: found
    unit: str = ""  # what the bar shows; empty: no bar
    whole: bool = False  # ticks of the bar at whole numbers alone

    def shown(self, dots: float) -> tuple[Values, tuple[float, float], tuple[float, float]]:
        """Return the rows and columns that so many dots from left to right can show, and the ends of these.

        Every k-th is taken; k is odd, so that what differs from one row or column to the next is seen.
        """
        rows, columns = self.values.shape
        step = max(1, int(columns / dots), int(rows / (TALLEST * dots)))
        step -= 1 - step % 2
        some = self.values[::step, ::step]
        ends = (
            (first, first + (last - first) * step * n / whole)
            for (first, last), n, whole in zip((self.y, self.x), some.shape, (rows, columns), strict=True)
        )
        y, x = ends
        return some, x, y

    def levels(self, values: Values) -> Values:
        """Return values as they are coloured: themselves, or with edges the middle of the colour, 0 to 1."""
        if self.edges is None:
            return values
        index = np.searchsorted(self.edges, values, side="right").astype(np.float32)
        return np.where(np.isnan(values), np.nan, (index + 0.5) / (len(self.edges) + 1))


@dataclass(frozen=True)
class Panel:
    """Marks between two axes."""

    y: Axis  # the upright axis; that of x is the stack's
    marks: tuple[Mark, ...]  # what is drawn, the lowest first
    height: float = 1.0  # share of the stack
    legend: str = ""  # place on paper of a legend of its own; empty: none
    columns: int = 1  # of that legend
    room: tuple[float, float] = (1.0, 1.0)  # factor on the upper end of y for it, on a page and in a column
    note: str = ""  # small words in a corner
    corner: str = "upper right"  # which one
    square: bool = False  # one is as long on both axes; the height of its stack follows from its width


@dataclass(frozen=True)
class Stack:
    """Panels over each other that share the axis of x."""

    panels: tuple[Panel, ...]  # from top to bottom
    x: Axis  # their common axis
    title: str = ""  # over the first one; lines that are too long for a width are broken at three blanks
    height_mm: float = 60.0  # on paper
    wide: bool = False  # shown only where panels have room side by side


@dataclass(frozen=True)
class Chart:
    """What a figure draws."""

    stacks: tuple[Stack, ...]  # from left to right and from top to bottom, at least one
    widths: tuple[float, ...] = (1.0,)  # shares of the columns where stacks have room side by side
    legend: tuple[int, int] = (0, 0)  # its columns below all, on a page and in a column; 0: none
    keys: tuple[tuple[str, str], ...] = ()  # colours and what they mean, in lines below all

    @property
    def still(self) -> bool:
        """Whether it is a plain picture on the page, too: a map, or rows, with no value to read along x."""
        panels = [panel for stack in self.stacks for panel in stack.panels]
        return any(panel.y.down or any(isinstance(m, Image) for m in panel.marks) for panel in panels)


def points_of(mark: Mark) -> tuple[Values, Values]:
    """Return the places and the values that a mark reaches, for the ends of axes; none for those across."""
    match mark:
        case Line() | Sticks():
            return mark.x, mark.y
        case Points():
            reach = np.zeros((2, mark.y.size)) if mark.error is None else np.nan_to_num(mark.error)
            return np.tile(mark.x, 2), np.concatenate([mark.y - reach[0], mark.y + reach[1]])
        case Steps():
            return mark.edges, mark.values
        case Bars():
            ends = np.concatenate([mark.x - mark.broad / 2, mark.x + mark.broad / 2])
            return ends, np.concatenate([mark.low, mark.high])
        case Band():
            return np.tile(mark.x, 2), np.concatenate([mark.low, mark.high])
        case Image():
            return np.array(mark.x), np.array(mark.y)
    return np.empty(0), np.empty(0)


def window(axis: Axis, values: Iterator[Values], base: float | None = None) -> tuple[float, float]:
    """Return the ends of an axis that shows these values: those given, else the values' with a margin.

    Values have any shapes; the axis ends at ``base`` if none is beyond it.
    """
    parts = [np.asarray(each, dtype=np.float64).ravel() for each in values]
    known = np.concatenate(parts) if parts else np.empty(0)
    known = known[np.isfinite(known) & ((known > 0) | (not axis.log))]
    low, high = (float(known.min()), float(known.max())) if known.size else (1.0, 10.0)
    if axis.log:
        margin = (high / low) ** _MARGIN if high > low else 2.0
        ends = low / margin, high * margin
    else:
        if base is not None:
            low, high = min(low, base), max(high, base)
        margin = _MARGIN * (high - low) or max(abs(low) * _MARGIN, 0.5)
        ends = low - margin, high + margin
        if base is not None:
            ends = (low if low == base else ends[0]), (high if high == base < low else ends[1])
    given = (axis.low, axis.high)
    found = [
        end if own is None or not np.isfinite(own) else own for end, own in zip(ends, given, strict=True)
    ]
    return found[0], found[1] if found[0] < found[1] else found[0] + abs(found[0]) + 1.0


def x_window(stack: Stack) -> tuple[float, float]:
    """Return the ends of the common axis of a stack."""
    return window(stack.x, (points_of(mark)[0] for panel in stack.panels for mark in panel.marks))


def y_window(panel: Panel) -> tuple[float, float]:
    """Return the ends of the upright axis of a panel."""
    solid = any(
        isinstance(mark, Bars | Sticks) or (isinstance(mark, Steps) and mark.filled) for mark in panel.marks
    )
    return window(panel.y, (points_of(mark)[1] for mark in panel.marks), 0.0 if solid else None)


def height_of(stack: Stack, width_mm: float) -> float:
    """Return the height of a stack on paper, mm; of square pixels and of rows it follows from the width."""
    panel = stack.panels[-1] if stack.panels else None
    if panel is not None and panel.square:
        (left, right), (low, high) = x_window(stack), y_window(panel)
        inner = max(width_mm - 24.0, 0.75 * width_mm)
        return float(np.clip(inner * (high - low) / (right - left), 22.0, TALLEST * inner)) + 10.0
    rows = [] if panel is None else tick_rows(panel.y, width_mm).ticks
    needed = sum(_LINE_MM * text.count("\n") + _ROW_MM for _, text in rows)
    return max(stack.height_mm, needed + 18.0)


def tick_rows(axis: Axis, width_mm: float) -> Axis:
    """Return an axis whose ticks have texts in lines that fit beside a stack of some width."""
    ticks = ((place, textwrap.fill(text, int(_TICK_LETTERS * width_mm))) for place, text in axis.ticks)
    return replace(axis, ticks=tuple(ticks))


def extremes(x: Values, y: Values, columns: int) -> IntArray:
    """Return the indices of the lowest and the highest of each of so many stretches of points, in order.

    Drawn that wide or narrower they look like all points, which are kept where they are no more than two a
    stretch, or do not go from left to right. A stretch without a value (NaN) stays a gap.
    """
    if x.size <= 2 * columns or np.any(np.diff(x) < 0):
        return np.arange(x.size)
    starts = np.linspace(0, x.size, columns + 1).astype(np.int64)
    known = np.isfinite(y)
    both = (np.where(known, values, np.inf) for values in (y, -y))
    found = [a + int(values[a:b].argmin()) for values in both for a, b in pairwise(starts.tolist())]
    return np.sort(np.array(found))


def fewer_steps(edges: Values, values: Values, most: int) -> tuple[Values, Values]:
    """Return a histogram of at most so many steps: the largest of neighbours where there are more."""
    together = -(-values.size // most) if values.size else 1
    if together <= 1:
        return edges, values
    starts = np.arange(0, values.size, together)
    return np.append(edges[starts], edges[-1]), np.fmax.reduceat(values, starts)
