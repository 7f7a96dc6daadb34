"""What a figure shows, read back from its drawing: for figures without tables of their own."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch
from matplotlib.ticker import FixedFormatter
from numpy.typing import NDArray

from pchem_pipeline.report.figures.figure_data import DataTable

__all__ = ["drawn_tables"]


def drawn_tables(figure: Figure) -> list[DataTable]:
    """Return the points of all lines, bars and marks of a figure, and the values of its images.

    Args:
        figure: drawn by this package.

    Returns:
        One table of points (panel, labels of its axes, series, x, y and the words at y where it has any) and
        one for each image (row, column, value).
    """
    names = ("panel", "x is", "y is", "series", "x", "y", "y stands for")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    images: list[DataTable] = []
    for number, axes in enumerate(figure.axes, 1):
        panel = " ".join((axes.get_title("left") or axes.get_title() or str(number)).split())
        words = _words_at(axes)
        for series, x, y in _series(axes):
            for name, value in zip(names, (panel, _x_label(axes), axes.get_ylabel(), series), strict=False):
                columns[name] += [" ".join(value.split())] * x.size
            columns["x"] += x.tolist()
            columns["y"] += y.tolist()
            columns["y stands for"] += [words.get(float(value), "") for value in y]
        images += [_image(panel, image.get_array()) for image in axes.images]
    if not any(columns["y stands for"]):
        del columns["y stands for"]
    return [DataTable("", columns)] * bool(columns["x"]) + images


def _words_at(axes: Axes) -> dict[float, str]:
    """Return the words at the ticks of y, where they are words."""
    if not isinstance(axes.yaxis.get_major_formatter(), FixedFormatter):
        return {}
    labels = (" ".join(label.get_text().split()) for label in axes.get_yticklabels())
    return dict(zip((float(tick) for tick in axes.get_yticks()), labels, strict=False))


def _x_label(axes: Axes) -> str:
    """Return the label of x, which stands below the lowest of panels that share it."""
    siblings = axes.get_shared_x_axes().get_siblings(axes)
    return next((each.get_xlabel() for each in (axes, *siblings) if each.get_xlabel()), "")


def _image(panel: str, shown: Any) -> DataTable:
    values: NDArray[Any] = np.ma.filled(np.ma.asarray(shown, dtype=float), np.nan)
    row, column = np.indices(values.shape[:2])
    part = re.sub(r"[^a-z0-9]+", "_", f"image {panel}".lower()).strip("_")
    return DataTable(part, {"row": row.ravel(), "column": column.ravel(), "value": values.ravel()})


def _series(axes: Axes) -> list[tuple[str, NDArray[Any], NDArray[Any]]]:
    found: list[tuple[str, NDArray[Any], NDArray[Any]]] = []
    for container in axes.containers:
        if isinstance(container, BarContainer):
            x, y = _bars(container)
            found.append((_name(container.get_label(), "bars"), x, y))
    for artist in axes.get_children():
        if isinstance(artist, Line2D) and artist.get_transform() == axes.transData:
            x, y = (np.asarray(v, dtype=float) for v in artist.get_data())
            found.append((_name(artist.get_label(), "line"), x, y))
        elif isinstance(artist, StepPatch):
            values, edges, _ = artist.get_data()
            centre = 0.5 * (np.asarray(edges)[1:] + np.asarray(edges)[:-1])
            found.append((_name(artist.get_label(), "bars"), centre, np.asarray(values, dtype=float)))
        elif isinstance(artist, PathCollection):
            x, y = np.asarray(artist.get_offsets(), dtype=float).reshape(-1, 2).T
            found.append((_name(artist.get_label(), "marks"), x, y))
        elif isinstance(artist, LineCollection):
            ends = [np.asarray(path.vertices, dtype=float)[-1:] for path in artist.get_paths()]
            x, y = np.concatenate([*ends, np.empty((0, 2))]).T
            found.append((_name(artist.get_label(), "ends of lines"), x, y))
    return [(name, x, y) for name, x, y in found if x.size and x.size == y.size]


def _bars(container: BarContainer) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where the bars stand and how long they are; lying bars the other way round."""
    boxes = np.array(
        [(*patch.get_center(), patch.get_width(), patch.get_height()) for patch in container.patches]
    )
    if container.orientation == "horizontal":
        return boxes[:, 2], boxes[:, 1]
    return boxes[:, 0], boxes[:, 3]


def _name(label: Any, kind: str) -> str:
    text = str(label)
    return kind if not text or text.startswith("_") else text
