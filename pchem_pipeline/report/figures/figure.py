"""A figure: its words, its data as tables, and the chart that is drawn of them.

The tables are made from plain arrays before anything is drawn; CSV files beside figures for papers hold them
(:func:`csv_text`). Stacks of panels that several figures are made of follow: maps, histograms of pulls,
rows with a text each.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.wording import plain
from pchem_pipeline.report.charts.chart import (
    COLUMN_MM,
    LONGEST,
    Axis,
    Chart,
    Image,
    Line,
    Mark,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
)
from pchem_pipeline.report.style.palette import DIVERGING
from pchem_pipeline.report.style.ranges import finite

if TYPE_CHECKING:
    from pchem_pipeline.report.charts.on_paper import Drawing, Look


@dataclass(frozen=True)
class DataTable:
    """Named columns with units: of n rows, or maps of a sensor (y, x) of one shape."""

    columns: Mapping[str, Sequence[Any] | NDArray[Any]]  # name to values
    units: Mapping[str, str] = field(default_factory=dict)  # name to unit, of those that have one
    part: str = ""  # what of the figure it is, for the name of its file; empty for the main part
    index: tuple[str, str] = ("y (pixel)", "x (pixel)")  # names of the axes of maps
    origin: tuple[int, int] = (0, 0)  # place of their first value

    def __getitem__(self, name: str) -> NDArray[Any]:
        return np.asarray(self.columns[name])

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def get(self, name: str) -> NDArray[Any] | None:
        """Return a column, or None."""
        values = self.columns.get(name)
        return None if values is None else np.asarray(values)

    @property
    def size(self) -> int:
        """Numbers in all columns."""
        return sum(self[name].size for name in self.columns)

    def heading(self, name: str) -> str:
        """Return a column's name with its unit."""
        unit = self.units.get(name, "")
        return f"{name} ({unit})" if unit else name

    def flat(self) -> dict[str, NDArray[Any]]:
        """Return the columns by heading, those of maps with the place of each value before them."""
        columns = {self.heading(name): self[name] for name in self.columns}
        shapes = {values.shape for values in columns.values()}
        if len(shapes) != 1:
            raise ValueError(f"columns {', '.join(columns)} have different shapes: {shapes}")
        [shape] = shapes
        places = {}
        if len(shape) == 2:
            first = np.reshape(self.origin, (2, 1, 1))
            places = dict(zip(self.index, first + np.indices(shape), strict=True))
        return {name: values.ravel() for name, values in (places | columns).items()}


@dataclass(frozen=True)
class Figure:
    """One figure of a page."""

    name: str  # name of its files
    section: str  # id of the section that shows it
    title: str
    caption: str  # what is drawn and how to read it
    alt: str  # what a reader who does not see it should know, with the numbers
    tables: tuple[DataTable, ...]  # its data, the main part first
    chart: Chart
    width_mm: float = COLUMN_MM  # width at which it is saved

    def __repr__(self) -> str:
        return f"<Figure {self.name}: {self.title}>"

    @property
    def wide(self) -> bool:
        """Whether it takes the whole width of a page."""
        return self.width_mm > COLUMN_MM

    def draw(self, look: Look) -> Drawing:
        """Draw it with matplotlib."""
        # takes as long as all else that a small report imports
        from pchem_pipeline.report.charts.on_paper import draw_chart

        return draw_chart(look, self.chart)


def csv_text(table: DataTable) -> str:
    """Return a table as CSV: a line of headings, then rows; values that are not known are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = table.flat()
    writer.writerow(columns)
    writer.writerows(zip(*(_known(values.tolist()) for values in columns.values()), strict=True))
    return text.getvalue()


def _known(column: list[Any]) -> list[Any]:
    return ["" if isinstance(value, float) and value != value else value for value in column]


def is_strip(shape: tuple[int, ...]) -> bool:
    """Return whether a sensor is a line of channels, drawn as points instead of an image."""
    return min(shape) < 2


def place_of(
    shape: tuple[int, ...], origin: tuple[int, int] = (0, 0)
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of a map on the axes x and y; ``origin`` is row and column of its first pixel."""
    y, x = ((first - 0.5, first + n - 0.5) for first, n in zip(origin, shape, strict=True))
    return x, y


def image_stack(image: Image, *others: Mark, title: str = "") -> Stack:
    """Return a map of the sensor, square pixels unless it is very long, with other marks over it."""
    rows, columns = image.values.shape
    x, y = Axis("x (pixel)", *image.x, whole=True), Axis("y (pixel)", *image.y, whole=True, down=True)
    square = 1.0 / LONGEST <= rows / columns <= LONGEST
    return Stack((Panel(y, (image, *others), square=square),), x, title, height_mm=76.0)


def channel_axis(n_channels: int) -> Axis:
    """Return the axis of a line of channels; of a few each has a tick."""
    ticks = tuple((float(i), str(i)) for i in range(n_channels)) if n_channels <= 12 else ()
    return Axis("channel", -0.5, n_channels - 0.5, whole=True, ticks=ticks)


def sensor_stack(
    values: NDArray[Any],
    ends: tuple[float, float],
    label: str,
    *others: Mark,
    ringed: BoolArray | None = None,
    ring: str = "ink",
    origin: tuple[int, int] = (0, 0),
    title: str = "",
    **colours: Any,
) -> Stack:
    """Return a value of each pixel as a map with a bar of its colours, of a line of channels as points.

    Over the map are the other marks, and rings of colour ``ring`` at some pixels. Maps are (y, x) with the
    first pixel at the row and column ``origin``; ``ends`` have the first and the last colour; ``colours`` are
    ``scale`` and ``whole`` of :class:`Image`.
    """
    rings = np.zeros(values.shape, bool) if ringed is None else ringed
    style: dict[str, Any] = {"size": 5.0, "face": "none", "colour": ring}
    if is_strip(values.shape):
        flat, x = values.ravel(), np.flatnonzero(rings)
        points = Points(np.arange(flat.size), flat, size=3.0, label=label, listed=False)
        found = (Points(x, flat[x], **style),) if x.size else ()
        band = (Span(-2.0, 2.0, colour="band"),) if colours.get("scale") == DIVERGING else ()
        return Stack((Panel(Axis(label), (*band, points, *found)),), channel_axis(flat.size), title)
    y, x = np.nonzero(rings)
    found = (Points(origin[1] + x, origin[0] + y, **style),) if x.size else ()
    image = Image(values, *place_of(values.shape, origin), ends=ends, unit=label, **colours)
    return image_stack(image, *others, *found, title=title)


def pull_stack(
    pulls: FloatArray,
    edge: float,
    label: str,
    note: str,
    *,
    normal: bool = True,
    part: FloatArray | None = None,
) -> Stack:
    """Return the histogram of standardised values, beside N(0, 1) and over it that of some of them, ``part``.

    Values beyond ±``edge`` are in the last bins; NaN are left out.
    """
    known = finite(pulls)
    counts, edges = np.histogram(np.clip(known, -edge, edge), 60, (-edge, edge))
    marks: list[Mark] = [Steps(edges, counts, filled=True, colour="bars")]
    highest = float(np.max(counts, initial=1))
    if part is not None:
        some = np.histogram(np.clip(finite(part), -edge, edge), edges)[0]
        marks.append(Steps(edges, some, colour="vermilion", width=0.9))
    if normal:
        x = np.linspace(-edge, edge, 301)
        expected = known.size * (edges[1] - edges[0]) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
        marks.append(Line(x, expected, width=0.9))
        highest = max(highest, float(expected.max()))
    panel = Panel(Axis("pixels", 0.5, 5.0 * highest, log=True), tuple(marks), note=note)
    return Stack((panel,), Axis(label, -edge, edge), height_mm=34.0)


def row_stack(labels: Sequence[str], marks: Sequence[Mark], x: Axis, title: str = "") -> Stack:
    """Return marks in rows that have a text each, from top to bottom."""
    rows = tuple((float(row), plain(label)) for row, label in enumerate(labels))
    y = Axis("", -0.6, len(labels) - 0.5, ticks=rows, down=True)
    return Stack((Panel(y, tuple(marks)),), x, title, height_mm=30.0)


def pull_axis(label: str, reach: float) -> Axis:
    """Return an axis of standardised values up to ``reach``; one beyond 12 is logarithmic beyond 4."""
    if reach <= 12.0:
        return Axis(label, -reach, reach)
    some = [tick for tick in (4, 10, 100, 1000, 10_000, 100_000) if tick <= reach]
    ticks = [*(-tick for tick in reversed(some)), 0, *some]
    texts = tuple((float(tick), f"{tick:g}".replace("-", "−")) for tick in ticks)
    return Axis(label, -reach, reach, linear_to=4.0, ticks=texts)
