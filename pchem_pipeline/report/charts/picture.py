"""Charts as plain SVG pictures: what a page shows without scripts and in print."""

from __future__ import annotations

import base64
import struct
import textwrap
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.report.charts.chart import (
    COLUMN_MM,
    NO_COLOUR,
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
    Shape,
    Span,
    Stack,
    Steps,
    Sticks,
    Words,
    fewer_steps,
    height_of,
    some_points,
    thinned,
    tick_rows,
    x_window,
    y_window,
)
from pchem_pipeline.report.charts.ticks import scaled, ticks
from pchem_pipeline.report.style.palette import LIGHT, MAP_COLOURS, shades
from pchem_pipeline.report.style.wording import without_formulas

#: Dots of a millimetre on paper, size of the letters, their mean width and that of bold ones, all px; columns
#: of a curve.
_MM, _LETTER, _WIDE, _BOLD, _COLUMNS = 4.5, 11, 6.8, 7.6, 300
#: Room beside and below panels, between them, and of a line of the legend, px.
_LEFT, _RIGHT, _BELOW, _BETWEEN, _LINE = 68.0, 10.0, 38.0, 8.0, 15.0
_POINT = 1.35  # px
#: Dots of a map on a px of the picture; width of the bar of its colours and room around it, px.
_DOTS, _BAR, _ROOM = 2.5, 11.0, 8.0
#: Packing of PNG files: maps are within 3 % as small as at levels 6 and 9, in three quarters of the time.
_COMPRESSION = 4
_DASHES: dict[Dash, str] = {
    "--": "5 3",
    ":": "1.5 2.5",
    "-.": "6 3 1.5 3",
    "-...": "7 2 1.5 2 1.5 2",
    "..": "1.5 1.5",
}
#: Of the shapes of points: tips, how far in the corners between them lie (0: there are none), and the turn.
_SHAPES: dict[Shape, tuple[int, float, float]] = {
    "s": (4, 0.0, 45.0),
    "D": (4, 0.0, 0.0),
    "d": (4, 0.0, 0.0),
    "^": (3, 0.0, 0.0),
    "v": (3, 0.0, 180.0),
    "<": (3, 0.0, -90.0),
    "h": (6, 0.0, 0.0),
    "*": (5, 0.4, 0.0),
    "P": (4, 0.5, 0.0),
    "X": (4, 0.5, 45.0),
    "x": (4, 0.1, 45.0),
    "|": (2, 0.1, 0.0),
}

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """A panel's place in the picture, px, and the ends of its axes."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[Axis, float, float]
    y: tuple[Axis, float, float]

    def across(self, values: ArrayLike) -> FloatArray:
        """Return places from the panel's left edge, px, of values of x."""
        return np.asarray(self.width * scaled(values, *self.x))

    def down(self, values: ArrayLike) -> FloatArray:
        """Return places from the panel's upper edge, px, of values of y, none far outside."""
        return np.asarray(self.height * (1.0 - np.clip(scaled(values, *self.y), -5.0, 6.0)))


def chart_picture(chart: Chart, width_mm: float) -> tuple[bytes, int, int]:
    """Return a chart as SVG with its width and height, px.

    Args:
        chart: what is drawn.
        width_mm: width on paper; stacks stand side by side if it is more than a column.
    """
    wide = width_mm > 1.5 * COLUMN_MM
    shares = chart.widths if wide else chart.widths[:1]
    stacks = [stack for stack in chart.stacks if wide or not stack.wide]
    whole, top = width_mm * _MM, 0.0
    parts: list[str] = []
    for start in range(0, len(stacks), len(shares)):
        left, tallest = 0.0, 0.0
        row = [
            (stack, whole * share / sum(shares))
            for share, stack in zip(shares, stacks[start : start + len(shares)], strict=False)
        ]
        titles = [_title(stack, width) for stack, width in row]
        for (stack, width), title in zip(row, titles, strict=True):
            drawn, height = _stack(stack, title, max(map(len, titles)), left, top, width)
            parts += drawn
            left, tallest = left + width, max(tallest, height)
        top += tallest
    keys, high = _legend(
        {without_formulas(text): _named(colour) for colour, text in chart.keys}, _LEFT, top, whole
    )
    parts, top = [*parts, *keys], top + high
    if not stacks:
        parts, top = [_text(whole / 2, 60.0, chart.empty, "middle")], 120.0
    size = f'width="{whole:.0f}" height="{top:.0f}"'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 {whole:.0f} {top:.0f}" '
        f'font-family="DejaVu Sans,Arial,sans-serif" font-size="{_LETTER}" fill="{LIGHT.ink}">'
    )
    svg = f'{head}<rect width="100%" height="100%" fill="{LIGHT.paper}"/>{"".join(parts)}</svg>'
    return svg.encode(), round(whole), round(top)


def _title(stack: Stack, width: float) -> list[tuple[str, bool]]:
    """Return the lines of a title, broken where they are wider than the stack, and which are bold."""
    most = max(12, int((width - 4.0) / _BOLD))
    lines = [line for line in without_formulas(stack.title).split("\n") if line]
    return [(part, i == 0) for i, line in enumerate(lines) for part in textwrap.wrap(line, most)]


def _stack(
    stack: Stack, lines: Sequence[tuple[str, bool]], above: int, left: float, top: float, width: float
) -> tuple[list[str], float]:
    """Draw the panels of a stack with title and legend; return the elements and the height.

    Args:
        stack: what is drawn.
        lines: of its title.
        above: lines of title in its row, at most.
        left: of its place, px.
        top: likewise.
        width: likewise.
    """
    panels = tuple(replace(panel, y=tick_rows(panel.y, width / _MM)) for panel in stack.panels)
    stack = replace(stack, panels=panels)
    start = left + _beside(stack)
    # a title too long to begin with the panel begins left of it
    title = max(
        left + 2.0, min(start, left + width - _BOLD * max(map(len, (line for line, _ in lines)), default=0))
    )
    parts = [_text(title, top + 13.0 + i * 14.0, line, bold=bold) for i, (line, bold) in enumerate(lines)]
    at = top + 8.0 + 14.0 * above
    across = left + width - _RIGHT - start - max(map(_bar_room, stack.panels), default=0.0)
    room = height_of(stack, width / _MM) * _MM - _BELOW - _BETWEEN * len(stack.panels)
    shares = sum(panel.height for panel in stack.panels)
    x = (stack.x, *x_window(stack))
    for i, panel in enumerate(stack.panels):
        y, height = (panel.y, *y_window(panel)), room * panel.height / shares
        if panel.square:
            dot = min(across / (x[2] - x[1]), height / (y[2] - y[1]))
            across, height = dot * (x[2] - x[1]), dot * (y[2] - y[1])
        frame = Frame(start, at, across, height, x, y)
        parts += _panel(panel, frame, named=i == len(stack.panels) - 1)
        at += frame.height + _BETWEEN
    at += _BELOW - _BETWEEN
    parts += [_text(start + across / 2, at - 8.0, stack.x.label, "middle")]
    labels: dict[str, Mark | str] = {}
    for mark in (mark for panel in stack.panels for mark in panel.marks if mark.label and mark.listed):
        labels.setdefault(without_formulas(mark.label), mark)
    legend, height = _legend(labels, start, at + 8.0, left + width)
    return [*parts, *legend], at + height + 10.0 - top


def _beside(stack: Stack) -> float:
    """Return the room left of the panels of a stack, px: that of the longest text of their ticks."""
    texts = [line for panel in stack.panels for _, text in panel.y.ticks for line in text.split("\n")]
    named = any(panel.y.label for panel in stack.panels)
    longest = _WIDE * max(map(len, texts), default=0) + (30.0 if named else 10.0)
    return max(_LEFT, longest)


def _bar_room(panel: Panel) -> float:
    """Return the room right of a panel for a bar of colours, px."""
    texts = [text for mark in panel.marks if isinstance(mark, Image) for _, text in mark.bar]
    return _ROOM + _BAR + 6.0 + _WIDE * max(map(len, texts)) + 16.0 if texts else 0.0


def _text(
    x: float, y: float, text: str, anchor: str = "start", *, bold: bool = False, colour: str = ""
) -> str:
    more = (f' text-anchor="{anchor}"' if anchor != "start" else "") + (' font-weight="600"' if bold else "")
    more += f' fill="{colour}"' if colour else ""
    return f'<text x="{x:.1f}" y="{y:.1f}"{more}>{escape(without_formulas(text))}</text>'


def _panel(panel: Panel, frame: Frame, *, named: bool) -> list[str]:
    """Draw the marks of a panel, its axes with ticks, and its note."""
    marks = "".join(_mark(mark, frame) for mark in panel.marks)
    place = f'x="{frame.left:.1f}" y="{frame.top:.1f}" width="{frame.width:.1f}" height="{frame.height:.1f}"'
    bottom, right = frame.top + frame.height, frame.left + frame.width
    parts = [f'<svg {place} overflow="hidden">{marks}</svg>']
    parts += [each for mark in panel.marks if isinstance(mark, Image) for each in _bar(mark, frame)]
    path = f"M{frame.left:.1f} {frame.top:.1f}V{bottom:.1f}H{right:.1f}"
    if panel.square:
        path += f"V{frame.top:.1f}H{frame.left:.1f}"
    for place_, text in ticks(*frame.x, most=max(2, int(frame.width // 55))):
        across = frame.left + float(frame.across(place_))
        path += f"M{across:.1f} {bottom:.1f}v4"
        if named:
            parts.append(_text(across, bottom + 15.0, text, "middle"))
    for place_, text in ticks(*frame.y, most=max(3, int(frame.height // 28))):
        down = frame.top + float(frame.down(place_))
        path += f"M{frame.left:.1f} {down:.1f}h-4"
        lines = text.split("\n")
        start = down + 4.0 - 6.0 * (len(lines) - 1)
        parts += [_text(frame.left - 6.0, start + 12.0 * i, line, "end") for i, line in enumerate(lines)]
    parts.append(f'<path d="{path}" fill="none" stroke="{LIGHT.edge}"/>')
    words = without_formulas(panel.y.label).split("\n")
    for i, line in enumerate(words):
        at, middle = frame.left - 46.0 + 12.0 * (i - len(words) + 1), frame.top + frame.height / 2
        turned = f'transform="translate({at:.1f} {middle:.1f}) rotate(-90)"'
        parts.append(f'<text {turned} text-anchor="middle">{escape(line)}</text>')
    upright, side = panel.corner.split()
    lines = without_formulas(panel.note).split("\n") if panel.note else []
    start = frame.top + 12.0 if upright == "upper" else bottom - 6.0 - 13.0 * (len(lines) - 1)
    for i, line in enumerate(lines):
        across, anchor = (right - 4.0, "end") if side == "right" else (frame.left + 6.0, "start")
        parts.append(_text(across, start + 13.0 * i, line, anchor, colour=LIGHT.faint))
    return parts


def _legend(
    labels: Mapping[str, Mark | str], left: float, top: float, right: float
) -> tuple[list[str], float]:
    """Draw the labels of marks, or of colours, in lines, and return the height."""
    width = right - left
    parts, across, down, high = [], 0.0, 0.0, 0.0
    for label, what in labels.items():
        lines = textwrap.wrap(label, max(12, int((width - 26.0) / _WIDE)))
        length = 26.0 + _WIDE * max(map(len, lines))
        if across and across + length > width:
            across, down, high = 0.0, down + high, 0.0
        parts.append(_handle(what, left + across, top + down))
        parts += [
            _text(left + across + 20.0, top + down + 4.0 + 13.0 * i, each) for i, each in enumerate(lines)
        ]
        across, high = across + length, max(high, _LINE + 13.0 * (len(lines) - 1))
    return parts, down + high


def _handle(what: Mark | str, at: float, middle: float) -> str:
    """Return what a legend shows of a mark, or of a colour."""
    box = f'<rect x="{at:.1f}" y="{middle - 4.5:.1f}" width="13" height="9" '
    if isinstance(what, str):
        return f'{box}fill="{what}" stroke="#888888" stroke-width="0.6"/>'
    if what.colour == "none":
        return ""
    if isinstance(what, Bars | Band | Span) or (isinstance(what, Steps) and what.filled):
        return f"{box}{_fill(what)}/>"
    if isinstance(what, Points):
        return f'<path d="M{at + 7.0:.1f} {middle:.1f}{_outline(what, 3.0)}" {_paint(what)}/>'
    return f'<path d="M{at:.1f} {middle:.1f}h15" {_stroke(what, 1.8)}/>'


def _named(colour: str) -> str:
    return str(getattr(LIGHT, colour, colour))


def _stroke(mark: Mark, width: float | None = None) -> str:
    dash = f' stroke-dasharray="{_DASHES[mark.dash]}"' if mark.dash in _DASHES else ""
    alpha = f' stroke-opacity="{mark.alpha:g}"' if mark.alpha != 1.0 else ""
    thick = _POINT * mark.width if width is None else width
    return f'fill="none" stroke="{_named(mark.colour)}" stroke-width="{thick:.1f}"{dash}{alpha}'


def _fill(mark: Mark) -> str:
    alpha = f' fill-opacity="{mark.alpha:g}"' if mark.alpha != 1.0 else ""
    return f'fill="{_named(mark.colour)}"{alpha}'


def _image(mark: Image, frame: Frame) -> str:
    """Return a map as an element: a picture of a colour for each of the pixels that it can show."""
    values, x, y = mark.shown(_DOTS * frame.width)
    (left, right), (top, bottom) = frame.across(x).tolist(), frame.down(y).tolist()
    if top > bottom:
        values, top, bottom = values[::-1], bottom, top
    place = f'x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{bottom - top:.2f}"'
    href = _png_url(mark.index(values), np.vstack([_colours(mark), _rgb((_named(mark.none),))]))
    return f'<image {place} preserveAspectRatio="none" style="image-rendering:pixelated" href="{href}"/>'


def _colours(mark: Image) -> NDArray[np.uint8]:
    """Return the colours of a map, those that it does not have at the end of the list too."""
    if isinstance(mark.scale, str):
        return shades(_named(mark.scale) if mark.scale else MAP_COLOURS, NO_COLOUR)
    own = _rgb([_named(each) for each in mark.scale])
    return np.vstack([own, np.zeros((NO_COLOUR - len(own), 3), np.uint8)])


def _rgb(colours: Sequence[str]) -> NDArray[np.uint8]:
    return np.array([list(bytes.fromhex(each[1:])) for each in colours], np.uint8)


def _bar(mark: Image, frame: Frame) -> list[str]:
    """Draw the bar of a map's colours, right of the panel."""
    if not mark.bar:
        return []
    left, top, high = frame.left + frame.width + _ROOM, frame.top, frame.height
    href = _png_url(np.arange(NO_COLOUR, dtype=np.uint8)[::-1, None], _colours(mark))
    place = f'x="{left:.1f}" y="{top:.1f}" width="{_BAR}" height="{high:.1f}"'
    parts = [
        f'<image {place} preserveAspectRatio="none" href="{href}"/>',
        f'<rect {place} fill="none" stroke="{LIGHT.edge}" stroke-width="0.6"/>',
    ]
    right, path = left + _BAR, ""
    for part, text in mark.bar:
        down = top + high * (1.0 - part)
        path += f"M{right:.1f} {down:.1f}h3"
        parts.append(_text(right + 6.0, down + 4.0, text))
    parts.append(f'<path d="{path}" stroke="{LIGHT.edge}"/>')
    at = right + 6.0 + _WIDE * max(len(text) for _, text in mark.bar) + 12.0
    turned = f'transform="translate({at:.1f} {top + high / 2:.1f}) rotate(-90)"'
    parts.append(f'<text {turned} text-anchor="middle">{escape(without_formulas(mark.unit))}</text>')
    return parts


def _mark(mark: Mark, frame: Frame) -> str:
    """Return a mark as elements, from the corner of its panel."""
    match mark:
        case Line():
            x, y = thinned(mark.x, mark.y, _COLUMNS)
            if mark.step:
                x, y = _held(x, y)
            dots = _dots(frame, mark, mark.x, mark.y, _POINT * mark.dots / 2) if mark.dots else ""
            return f'<path d="{_path(frame, x, y)}" {_stroke(mark)}/>{dots}'
        case Steps():
            edges, values = fewer_steps(mark.edges, mark.values, _COLUMNS)
            x, y = np.repeat(edges, 2)[1:-1], np.repeat(values, 2)
            if not mark.filled:
                return f'<path d="{_path(frame, x, y)}" {_stroke(mark)}/>'
            floor = frame.y[1] if frame.y[0].log else 0.0
            x, y = np.concatenate([edges[:1], x, edges[-1:]]), np.concatenate([[floor], y, [floor]])
            return f'<path d="{_path(frame, x, y)}Z" {_fill(mark)}/>'
        case Bars():
            left, right = frame.across(mark.x - mark.broad / 2), frame.across(mark.x + mark.broad / 2)
            low, high = frame.down(mark.low), frame.down(mark.high)
            boxes = zip(left.tolist(), right.tolist(), low.tolist(), high.tolist(), strict=True)
            path = "".join(f"M{a:.1f} {c:.1f}H{b:.1f}V{d:.1f}H{a:.1f}Z" for a, b, c, d in boxes)
            return f'<path d="{path}" {_fill(mark)}/>'
        case Sticks():
            known = np.isfinite(mark.y)
            across, ends, base = (
                frame.across(mark.x[known]),
                frame.down(mark.y[known]),
                float(frame.down(0.0)),
            )
            path = "".join(
                f"M{a:.1f} {base:.1f}V{b:.1f}" for a, b in zip(across.tolist(), ends.tolist(), strict=True)
            )
            return f'<path d="{path}" {_stroke(mark)}/>'
        case Points():
            return _points(mark, frame)
        case Image():
            return _image(mark, frame)
        case Band():
            x, low, high = mark.x, mark.low, mark.high
            if mark.step:
                (x, low), (_, high) = _held(x, low), _held(x, high)
            path = _path(frame, np.append(x, x[::-1]), np.append(low, high[::-1]))
            return f'<path d="{path}Z" {_fill(mark)}/>'
        case Level():
            at = float(frame.across(mark.at) if mark.axis == "x" else frame.down(mark.at))
            path = f"M{at:.1f} 0v{frame.height:.1f}" if mark.axis == "x" else f"M0 {at:.1f}h{frame.width:.1f}"
            return f'<path d="{path}" {_stroke(mark)}/>'
        case Span():
            place = frame.across if mark.axis == "x" else frame.down
            start, end = sorted((float(place(mark.low)), float(place(mark.high))))
            along, whole = ("x", "width"), ("height", frame.height)
            if mark.axis == "y":
                along, whole = ("y", "height"), ("width", frame.width)
            size = f'{along[0]}="{start:.1f}" {along[1]}="{end - start:.1f}" {whole[0]}="{whole[1]:.1f}"'
            return f"<rect {size} {_fill(mark)}/>"
        case Words():
            anchor = "start" if mark.align == "left" else "middle"
            return _text(
                float(frame.across(mark.x)),
                max(frame.height * (1.0 - mark.up), float(_LETTER)),  # not cut at the top of a low panel
                mark.text,
                anchor,
                colour=_named(mark.colour),
            )
    raise TypeError(f"no picture of a {type(mark).__name__}")


def _points(mark: Points, frame: Frame) -> str:
    mark, half = some_points(mark, 4 * _COLUMNS), max(_POINT * mark.size / 2, 1.2)
    parts = ""
    if mark.error is not None:
        reach = np.nan_to_num(mark.error)
        low, high = frame.down(mark.y - reach[0]).tolist(), frame.down(mark.y + reach[1]).tolist()
        bars = zip(frame.across(mark.x).tolist(), low, high, strict=True)
        path = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in bars if b == b)
        parts = f'<path d="{path}" fill="none" stroke="{_named(mark.colour)}"/>'
    if mark.mark == "o" and not mark.face:
        return parts + _dots(frame, mark, mark.x, mark.y, half)
    shape = _outline(mark, half)
    places = zip(frame.across(mark.x).tolist(), frame.down(mark.y).tolist(), strict=True)
    path = "".join(f"M{a:.1f} {b:.1f}{shape}" for a, b in places if b == b)
    return f'{parts}<path d="{path}" {_paint(mark)}/>'


def _outline(mark: Points, half: float) -> str:
    """Return the outline of a point, from its centre."""
    if mark.mark == "o":
        arc = f"a{half:.1f} {half:.1f} 0 1 0"
        return f"m-{half:.1f} 0{arc} {2 * half:.1f} 0{arc} -{2 * half:.1f} 0z"
    tips, inner, turn = _SHAPES[mark.mark]
    angle = np.radians(turn + np.arange(0.0, 360.0, 180.0 / tips if inner else 360.0 / tips))
    radius = 1.25 * half * np.resize([1.0, inner] if inner else [1.0], angle.size)
    x, y = (0.7 if mark.mark == "d" else 1.0) * radius * np.sin(angle), -radius * np.cos(angle)
    steps = zip(np.diff(x, prepend=0.0).tolist(), np.diff(y, prepend=0.0).tolist(), strict=True)
    return "".join(f"{'l' if i else 'm'}{a:.1f} {b:.1f}" for i, (a, b) in enumerate(steps)) + "z"


def _paint(mark: Points) -> str:
    edge = f'stroke="{_named(mark.colour)}"'
    return f'fill="{_named(mark.face)}" {edge}' if mark.face else _fill(mark)


def _dots(frame: Frame, mark: Mark, x: FloatArray, y: FloatArray, half: float) -> str:
    """Return disks: the round ends of lines that have no length."""
    places = zip(frame.across(x).tolist(), frame.down(y).tolist(), strict=True)
    path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in places if b == b)
    thick = f'stroke-width="{2 * half:.1f}" stroke-linecap="round"'
    return f'<path d="{path}" fill="none" stroke="{_named(mark.colour)}" {thick}/>'


def _held(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a curve that holds each value half-way to its neighbours."""
    middle = (x[1:] + x[:-1]) / 2
    return np.concatenate([x[:1], np.repeat(middle, 2), x[-1:]]), np.repeat(y, 2)


def _path(frame: Frame, x: FloatArray, y: FloatArray) -> str:
    """Return the outline of a curve; it begins anew after each gap."""
    across, down = frame.across(x), frame.down(y)
    known = np.isfinite(down)
    new = known & np.concatenate([[True], ~known[:-1]])
    places = zip(across[known].tolist(), down[known].tolist(), new[known].tolist(), strict=True)
    return "".join(f"{'M' if first else 'L'}{a:.1f} {b:.1f}" for a, b, first in places)


def png_of(index: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    """Return a picture as a PNG file.

    Args:
        index: number of the colour of each dot, (row, column).
        colours: red, green and blue, shape (n, 3), n up to 256.
    """
    rows, columns = index.shape
    # before each row the number of the filter: none
    lines = np.zeros((rows, columns + 1), np.uint8)
    lines[:, 1:] = index
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)),
        (b"PLTE", colours.tobytes()),
        (b"IDAT", zlib.compress(lines.tobytes(), _COMPRESSION)),
        (b"IEND", b""),
    )
    written = (
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(written)


def _png_url(index: NDArray[np.uint8], colours: NDArray[np.uint8]) -> str:
    """Return a picture as a data URL; see :func:`png_of`."""
    return f"data:image/png;base64,{base64.b64encode(png_of(index, colours)).decode('ascii')}"
