"""A figure: its words, its data as tables, and the chart that is drawn of them.

The tables are made from plain arrays before anything is drawn; CSV files beside figures for papers hold them
(:func:`csv_text`).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.report.charts.chart import COLUMN_MM, Chart

if TYPE_CHECKING:
    from pchem_pipeline.report.style.style import Drawing, Look


@dataclass(frozen=True)
class DataTable:
    """Named columns with units: of n rows, or maps of a sensor (y, x) of one shape.

    Attributes:
        columns: name to values.
        units: name to unit, of those that have one.
        part: what of the figure it is, for the name of its file; empty for the main part.
        index: names of the axes of maps.
        origin: place of their first value.
    """

    columns: Mapping[str, Sequence[Any] | NDArray[Any]]
    units: Mapping[str, str] = field(default_factory=dict)
    part: str = ""
    index: tuple[str, str] = ("y (pixel)", "x (pixel)")
    origin: tuple[int, int] = (0, 0)

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
    """One figure of a page.

    Attributes:
        name: name of its files.
        section: id of the section that shows it; empty for one that only ``pchem figures`` draws.
        title: heading on the page.
        caption: what is drawn and how to read it.
        alt: what a reader who does not see it should know, with the numbers.
        tables: its data, the main part first.
        chart: what is drawn.
        width_mm: width at which it is saved.
    """

    name: str
    section: str
    title: str
    caption: str
    alt: str
    tables: tuple[DataTable, ...]
    chart: Chart
    width_mm: float = COLUMN_MM

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
