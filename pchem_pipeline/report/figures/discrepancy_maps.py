"""Where on the sensor a model fails: maps of what each pixel shows, and pictures of rows and columns."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.report.pages.discrepancy_data import CHANNELS
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    NO_VALUE,
    PAGE_MM,
    VERMILION,
    new_figure,
    note,
    styled,
)
from pchem_pipeline.report.style.wording import count

__all__ = ["LINE_WORDS", "PixelMap", "line_pictures", "pixel_maps", "telling_maps"]

FloatArray = NDArray[np.float64]

#: Diverging colours whose ends differ in lightness order for every kind of colour vision.
_DIVERGING = "RdBu_r"
#: Colours end at least, and at most, at so many standard deviations.
_LEAST, _MOST = 4.0, 12.0
#: A pixel beyond this is counted, and ringed if such pixels are few.
_STANDS_OUT, _MOST_RINGS = 5.0, 60

_SCORE_WORDS = {
    "C2": "charge: variance beyond Poisson (C2)",
    "C3": "charge: skew beyond Poisson (C3)",
    "He3": "readout: skew (He3)",
    "He4": "readout: heavy tails (He4)",
    "He2C1": "peaks widen with k (He2C1)",
    "He1C2": "spacing of the peaks grows (He1C2)",
    "He2C2": "widening grows with k (He2C2)",
    "He3C1": "skew grows with k (He3C1)",
}

#: How the means of rows and columns are called, by name of their array.
LINE_WORDS = {"row": "rows", "column": "columns"}


@dataclass(frozen=True)
class PixelMap:
    """One quantity of every pixel in standard deviations of chance, with how far it is from chance.

    Attributes:
        words: what it is.
        z: map (y, x), NaN where there is no value.
        far: the largest of three departures from N(0, 1), each in its own standard errors: of the mean, of
            the mean square, and of the number of pixels beyond 5.
        outliers: pixels beyond 5.
    """

    words: str
    z: FloatArray
    far: float
    outliers: int


def telling_maps(arrays: Mapping[str, NDArray[Any]], most: int = 3) -> list[PixelMap]:
    """Return the maps that are farthest from chance, goodness of fit first whatever it shows.

    Args:
        arrays: group ``discrepancy`` of the store.
        most: at most so many.
    """
    first = [_pixel_map("goodness of fit (large: poor)", arrays["goodness"])] if "goodness" in arrays else []
    others: list[PixelMap] = []
    if "score" in arrays:
        others += [
            _pixel_map(_SCORE_WORDS.get(name, name), values)
            for name, values in zip(SCORES, arrays["score"], strict=False)
        ]
    for name, words in (("block_spread", "block means wander"), ("lag1", "successive frames correlated")):
        if name in arrays:
            others += [
                _pixel_map(f"{channel}: {words}", values)
                for channel, values in zip(CHANNELS, arrays[name], strict=False)
            ]
    others = sorted((each for each in others if np.isfinite(each.far)), key=lambda each: -each.far)
    return (first + others)[:most]


def _pixel_map(words: str, values: NDArray[Any]) -> PixelMap:
    z = np.asarray(values, dtype=np.float64)
    known = finite(z)
    n = max(known.size, 1)
    outliers = int((np.abs(known) > _STANDS_OUT).sum())
    if known.size == 0:
        return PixelMap(words, z, float("nan"), 0)
    # beyond 5, chance puts less than one pixel in a million: each counts fully
    departures = (
        abs(float(known.mean())) * np.sqrt(n),
        abs(float((np.clip(known, -8, 8) ** 2).mean()) - 1.0) * np.sqrt(n / 2.0),
        6.0 * np.sqrt(outliers),
    )
    return PixelMap(words, z, float(max(departures)), outliers)


@styled
def pixel_maps(
    maps: Sequence[PixelMap],
    *,
    flagged: Sequence[tuple[int, int]] = (),
    origin: tuple[int, int] = (0, 0),
    width_mm: float = PAGE_MM,
) -> Figure:
    """Draw maps of what each pixel shows, each over its histogram beside that of chance.

    Args:
        maps: as :func:`telling_maps` returns them.
        flagged: pixels (y, x) of the sensor that the verdict points to; they are ringed.
        origin: row and column of the sensor of the maps' first pixel.
        width_mm: width; a column's width stacks the maps.
    """
    shown = list(maps)
    beside = len(shown) if width_mm > 1.5 * COLUMN_MM else 1
    stacked = -(-len(shown) // beside)
    ny, nx = shown[0].z.shape
    panel_mm = width_mm / beside - 14.0
    ratio = ny / nx
    square = 0.25 <= ratio <= 4.0
    map_mm = float(np.clip(panel_mm * (ratio if square else 0.5), 22.0, 1.4 * panel_mm))
    figure = new_figure(width_mm, stacked * (map_mm + 36.0))
    grid = figure.add_gridspec(2 * stacked, beside, height_ratios=[map_mm, 20.0] * stacked)
    for i, each in enumerate(shown):
        row, column = divmod(i, beside)
        top = figure.add_subplot(grid[2 * row, column])
        bottom = figure.add_subplot(grid[2 * row + 1, column])
        limit = (
            float(np.clip(np.quantile(np.abs(finite(each.z)), 0.995), _LEAST, _MOST))
            if each.far > 0
            else _LEAST
        )
        if min(each.z.shape) < 2:
            _draw_line(top, each)
        else:
            _draw_map(figure, top, each, limit, flagged, origin)
        _draw_distribution(bottom, each)
        top.set_title(textwrap.fill(each.words, 26), fontsize=7.0)
    return figure


def _draw_map(
    figure: Figure,
    axes: Axes,
    each: PixelMap,
    limit: float,
    flagged: Sequence[tuple[int, int]],
    origin: tuple[int, int],
) -> None:
    (y0, x0), (ny, nx) = origin, each.z.shape
    axes.set_facecolor(NO_VALUE)
    extent = (x0 - 0.5, x0 + nx - 0.5, y0 + ny - 0.5, y0 - 0.5)
    image = axes.imshow(
        each.z, cmap=_DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest", origin="upper",
        extent=extent, aspect="equal" if 0.25 <= ny / nx <= 4.0 else "auto",
    )  # fmt: skip
    rings = {(y, x) for y, x in flagged if y0 <= y < y0 + ny and x0 <= x < x0 + nx}
    beyond = np.argwhere(np.abs(np.nan_to_num(each.z)) > _STANDS_OUT)
    if len(beyond) <= _MOST_RINGS:
        rings |= {(y0 + int(y), x0 + int(x)) for y, x in beyond}
    if 0 < len(rings) <= _MOST_RINGS:
        ys, xs = np.array(sorted(rings)).T
        axes.plot(
            xs, ys, "o", markersize=5, markerfacecolor="none", markeredgecolor=BLACK, markeredgewidth=0.6
        )
        axes.set(xlim=extent[:2], ylim=extent[2:])
    axes.set(xlabel="x (pixel)", ylabel="y (pixel)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    bar = figure.colorbar(image, ax=axes, fraction=0.05, pad=0.02, aspect=25, extend="both")
    bar.set_label("sd of chance")


def _draw_line(axes: Axes, each: PixelMap) -> None:
    """Draw a line of channels."""
    z = each.z.ravel()
    axes.axhspan(-2, 2, color=GRAY, alpha=0.4, linewidth=0)
    axes.plot(np.arange(z.size), z, "o", color=BLUE, markersize=3)
    axes.set(xlabel="channel", ylabel="standard deviations", xlim=(-0.5, z.size - 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))


def _draw_distribution(axes: Axes, each: PixelMap) -> None:
    known = finite(each.z)
    edge = float(np.clip(np.abs(known).max() if known.size else 5.0, 5.0, 15.0))
    edges = np.linspace(-edge, edge, 61)
    axes.stairs(np.histogram(np.clip(known, -edge, edge), edges)[0], edges, fill=True, color=GRAY)
    x = np.linspace(-edge, edge, 301)
    chance = known.size * (edges[1] - edges[0]) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    axes.plot(x, chance, color=BLUE, linewidth=0.9)
    axes.set_yscale("log")
    axes.set_ylim(0.5, max(3.0 * chance.max(), 3.0))
    axes.set(xlim=(-edge, edge), xlabel="standard deviations", ylabel="pixels")
    note(axes, f"{count(each.outliers, 'pixel')} beyond ±5")


@styled
def line_pictures(
    arrays: Mapping[str, NDArray[Any]], *, origin: tuple[int, int] = (0, 0), width_mm: float = PAGE_MM
) -> Figure:
    """Draw the means of rows and of columns: the first frames as a picture, and the scatter of each line.

    Args:
        arrays: ``row_image``, ``row_rms``, ``column_image``, ``column_rms`` of group ``discrepancy``.
        origin: row and column of the sensor of the first of them.
        width_mm: width; a column's width stacks the panels.
    """
    lines = [line for line in LINE_WORDS if f"{line}_rms" in arrays]
    wide = width_mm > 1.5 * COLUMN_MM
    columns = 3 if wide else 1
    stacked = len(lines) if wide else 3 * len(lines)
    figure = new_figure(width_mm, stacked * (50.0 if wide else 44.0))
    grid = figure.add_gridspec(stacked, columns)
    for i, line in enumerate(lines):
        places = [(i, j) if wide else (3 * i + j, 0) for j in range(3)]
        image, first = arrays.get(f"{line}_image"), origin[0 if line == "row" else 1]
        for j, channel in enumerate(("readout", "charge")):
            axes = figure.add_subplot(grid[places[j]])
            shown = None if image is None else image[CHANNELS.index(channel)]
            _draw_frames(figure, axes, shown, line, channel, first)
        _draw_scatter(figure.add_subplot(grid[places[2]]), np.asarray(arrays[f"{line}_rms"]), line, first)
    return figure


def _draw_frames(
    figure: Figure, axes: Axes, image: NDArray[Any] | None, line: str, channel: str, first: int
) -> None:
    axes.set_title(f"{channel}: means of {LINE_WORDS[line]}")
    axes.set(xlabel="frame (the first ones examined)", ylabel=f"{'y' if line == 'row' else 'x'} (pixel)")
    if image is None or image.size == 0:
        note(axes, "not kept")
        return
    axes.set_facecolor(NO_VALUE)
    n_frames, n_lines = image.shape
    drawn = axes.imshow(
        image.T,
        extent=(-0.5, n_frames - 0.5, first + n_lines - 0.5, first - 0.5),
        cmap=_DIVERGING,
        vmin=-_LEAST,
        vmax=_LEAST,
        interpolation="nearest",
        aspect="auto",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    bar = figure.colorbar(drawn, ax=axes, fraction=0.05, pad=0.02, aspect=25, extend="both")
    bar.set_label("sd of chance")


def _draw_scatter(axes: Axes, rms: FloatArray, line: str, first: int) -> None:
    for channel, colour, marker in (("readout", VERMILION, "o"), ("charge", BLUE, "s")):
        values = rms[CHANNELS.index(channel)]
        axes.plot(first + np.arange(values.size), values, marker, markersize=2.2, color=colour, label=channel)
    axes.axhline(1.0, color=BLACK, linewidth=0.8)
    top = float(np.nanmax(rms)) if np.isfinite(rms).any() else 1.0
    low = float(np.nanmin(rms)) if np.isfinite(rms).any() else 1.0
    axes.set_ylim(min(0.85, low - 0.05), max(1.25, 1.0 + 1.25 * (top - 1.0)))
    axes.set(
        xlabel=f"{'y' if line == 'row' else 'x'} (pixel)", ylabel="rms / rms of chance",
        title=f"scatter of the {LINE_WORDS[line]}",
    )  # fmt: skip
    axes.legend(loc="upper right", ncols=2)
