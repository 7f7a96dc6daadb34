"""Where on the sensor a model fails: maps of what each pixel shows, and pictures of rows and columns."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.where import PAIRS, map_of
from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.report.data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.maps import is_strip
from pchem_pipeline.report.style.palette import DIVERGING
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, note, styled
from pchem_pipeline.report.style.wording import count

FloatArray = NDArray[np.float64]

#: Colours end at least, and at most, at so many standard deviations.
_LEAST, _MOST = 4.0, 12.0
#: A pixel beyond this is counted, and ringed if such pixels are few.
_STANDS_OUT, _MOST_RINGS = 5.0, 60

_MAPS_CAPTION = (
    "The quantities of the pixels in which a part of the sensor stands out (outlined), then goodness of fit "
    "and those farthest from chance. Below each map: its histogram (gray), that of the outlined part (red) "
    "and that of chance (line). A shift of the whole histogram is an effect of all pixels, long tails are "
    "one of few; these are ringed in the map where they are few."
)
_LINES_CAPTION = (
    "Left and middle: means of rows and of columns of the first frames. Right: scatter of each row or "
    "column over all frames; 1 is what independent pixels give. Stripes in the readout are noise common "
    "to a row or column, slanted lines are periodic pickup."
)

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

_PAIR_WORDS = {
    f"{axis}.{pair}": f"{words}, along {axis}"
    for axis in ("x", "y")
    for pair, words in (
        ("kk", "charge: neighbours alike"),
        ("rr", "readout: neighbours alike"),
        ("rk", "readout follows the neighbour's charge"),
    )
}

#: How the means of rows and columns are called, by name of their array.
LINE_WORDS = {"row": "rows", "column": "columns"}


def sensor_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the maps of what each pixel shows."""
    maps = [each for each in largest_maps(data.arrays, regions_of(data)) if finite(each.z).size]
    if not maps:
        return []
    origin = data.found.examined.origin
    flagged = [pixel for place in data.found.where for pixel in place.pixels]
    words = []
    for each in maps:
        known = finite(each.z)
        words.append(
            f"{each.title}: mean {known.mean():+.2f}, standard deviation {known.std():.2f} (by chance 0 "
            f"and 1), {count(each.outliers, 'pixel')} beyond 5"
            + (f", most in {each.region.words()}" if each.region is not None else "")
        )
    columns = {each.title: each.z for each in maps}
    table = DataTable(columns, dict.fromkeys(columns, "standard deviations"), origin=origin)
    return [
        Figure(
            "discrepancy_maps",
            "where",
            "On the sensor",
            _MAPS_CAPTION,
            "Maps in standard deviations of chance. " + "; ".join(words).replace("-", "−") + ".",
            (table,),
            partial(draw_sensor, maps=maps, flagged=flagged, origin=origin),
            PAGE_MM,
        )
    ]


def line_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the means of rows and columns, and their scatter."""
    origin = data.found.examined.origin
    tables = line_tables(data.arrays, origin)
    if not tables:
        return []
    words = [_line_text(line, np.asarray(data.arrays[f"{line}_rms"])) for line in _lines(data.arrays)]
    return [
        Figure(
            "discrepancy_lines",
            "where",
            "Rows and columns",
            _LINES_CAPTION,
            "Scatter of the means over the frames, relative to chance (1). " + "; ".join(words) + ".",
            tables,
            partial(draw_lines, arrays=_line_arrays(data.arrays), origin=origin),
            PAGE_MM,
        )
    ]


def _lines(arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    return [line for line in LINE_WORDS if arrays.get(f"{line}_rms", np.empty(0)).size]


def _line_arrays(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    names = [f"{line}_{what}" for line in _lines(arrays) for what in ("rms", "image")]
    return {name: arrays[name] for name in names if name in arrays}


def line_tables(arrays: Mapping[str, NDArray[Any]], origin: tuple[int, int]) -> tuple[DataTable, ...]:
    """Return the scatter of each row and column, and their means in the first frames.

    Args:
        arrays: group ``discrepancy`` of the store.
        origin: row and column of the sensor of the first of them.
    """
    tables = []
    for line in _lines(arrays):
        axis, first = ("y", origin[0]) if line == "row" else ("x", origin[1])
        rms, image = np.asarray(arrays[f"{line}_rms"]), arrays.get(f"{line}_image")
        columns = {axis: first + np.arange(rms.shape[1])}
        columns |= {f"{each}: rms / rms of chance": row for each, row in zip(CHANNELS, rms, strict=False)}
        tables.append(DataTable(columns, {axis: "pixel"}, f"{line}_scatter"))
        if image is not None and image.size:
            means = dict(zip(CHANNELS, image, strict=False))
            units = dict.fromkeys(means, "standard deviations")
            tables.append(DataTable(means, units, f"{line}_means", ("frame", f"{axis} (pixel)"), (0, first)))
    return tuple(tables)


def _line_text(line: str, rms: np.ndarray[Any, Any]) -> str:
    found = []
    for channel, values in zip(CHANNELS, rms, strict=False):
        known = finite(values)
        if known.size:
            found.append(f"{channel} median {np.median(known):.2f}, largest {known.max():.2f}")
    return f"{LINE_WORDS[line]}: {' and '.join(found) or 'not known'}"


@dataclass(frozen=True)
class PixelMap:
    """One quantity of every pixel in standard deviations of chance, with how far it is from chance.

    Attributes:
        title: what it is.
        z: map (y, x), NaN where there is no value.
        far: the largest of three departures from N(0, 1), each in its own standard errors: of the mean, of
            the mean square, and of the number of pixels beyond 5.
        outliers: pixels beyond 5.
        region: part of the sensor where it stands out; None: everywhere alike.
    """

    title: str
    z: FloatArray
    far: float
    outliers: int
    region: Region | None = None


def regions_of(data: DiscrepancyData) -> dict[str, Region]:
    """Return by the name of a map the region that the verdict has for it, the most significant map first."""
    placed = [each for each in data.found.where if each.region is not None and map_of(each.statistic)]
    placed.sort(key=lambda each: each.region_p)
    found: dict[str, Region] = {}
    for each in placed:
        found.setdefault(map_of(each.statistic) or "", Region.model_validate(each.region))
    return found


def largest_maps(
    arrays: Mapping[str, NDArray[Any]], regions: Mapping[str, Region] | None = None, most: int = 3
) -> list[PixelMap]:
    """Return the maps with a place, then goodness of fit whatever it shows, then those farthest from chance.

    Args:
        arrays: group ``discrepancy`` of the store.
        regions: of maps that stand out in a part of the sensor.
        most: at most so many.
    """
    regions = regions or {}
    named = _named_maps(arrays)
    maps = {name: _pixel_map(words, values, regions.get(name)) for name, (words, values) in named.items()}
    placed = [maps.pop(name) for name in regions if name in maps]
    first = [maps.pop("goodness")] if "goodness" in maps else []
    # of neighbours only what has a place: where they all are alike, rows and columns show it better
    others = [each for name, each in maps.items() if np.isfinite(each.far) and name not in PAIRS]
    return (placed + first + sorted(others, key=lambda each: -each.far))[:most]


def _named_maps(arrays: Mapping[str, NDArray[Any]]) -> dict[str, tuple[str, NDArray[Any]]]:
    """Return words and values of all maps, by the names that :mod:`pchem_pipeline.discrepancy.where` has."""
    found: dict[str, tuple[str, NDArray[Any]]] = {}
    if "goodness" in arrays:
        found["goodness"] = ("goodness of fit (large: poor)", arrays["goodness"])
    for name, values in zip(SCORES, arrays.get("score", ()), strict=False):
        found[f"score.{name}"] = (_SCORE_WORDS.get(name, name), values)
    for array, short, words in (
        ("block_spread", "spread", "block means wander"),
        ("trend", "trend", "block means rise"),
        ("lag1", "lag", "successive frames correlated"),
    ):
        for channel, values in zip(CHANNELS, arrays.get(array, ()), strict=False):
            found[f"{short}.{channel}"] = (f"{channel}: {words}", values)
    for name, values in zip(PAIRS, arrays.get("neighbour", ()), strict=False):
        found[name] = (_PAIR_WORDS[name], values)
    return found


def _pixel_map(words: str, values: NDArray[Any], region: Region | None = None) -> PixelMap:
    z = np.asarray(values, dtype=np.float64)
    known = finite(z)
    n = max(known.size, 1)
    outliers = int((np.abs(known) > _STANDS_OUT).sum())
    if known.size == 0:
        return PixelMap(words, z, float("nan"), 0, region)
    # beyond 5, chance puts less than one pixel in a million: each counts fully
    departures = (
        abs(float(known.mean())) * np.sqrt(n),
        abs(float((np.clip(known, -8, 8) ** 2).mean()) - 1.0) * np.sqrt(n / 2.0),
        6.0 * np.sqrt(outliers),
    )
    return PixelMap(words, z, float(max(departures)), outliers, region)


@styled
def draw_sensor(
    look: Look,
    *,
    maps: Sequence[PixelMap],
    flagged: Sequence[tuple[int, int]] = (),
    origin: tuple[int, int] = (0, 0),
) -> Drawing:
    """Draw maps of what each pixel shows, each over its histogram beside that of chance.

    Args:
        look: width and colours; a column stacks the maps.
        maps: as :func:`largest_maps` returns them.
        flagged: pixels (y, x) of the sensor that the verdict points to; they are ringed.
        origin: row and column of the sensor of the maps' first pixel.
    """
    shown = list(maps)
    beside = len(shown) if look.wide else 1
    stacked = -(-len(shown) // beside)
    ny, nx = shown[0].z.shape
    panel_mm = look.width_mm / beside - 14.0
    ratio = ny / nx
    square = 0.25 <= ratio <= 4.0
    map_mm = float(np.clip(panel_mm * (ratio if square else 0.5), 22.0, 1.4 * panel_mm))
    figure = look.empty(stacked * (map_mm + 36.0))
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
        if is_strip(each.z.shape):
            _draw_line(top, each)
        else:
            _draw_map(figure, top, each, limit, flagged, origin)
        _draw_distribution(bottom, each, _inside(each, origin))
        top.set_title(textwrap.fill(each.title, 26), fontsize=7.0)
    return figure


def _draw_map(
    figure: Drawing,
    axes: Axes,
    each: PixelMap,
    limit: float,
    flagged: Sequence[tuple[int, int]],
    origin: tuple[int, int],
) -> None:
    colours = colours_of(axes)
    (y0, x0), (ny, nx) = origin, each.z.shape
    axes.set_facecolor(colours.no_value)
    extent = (x0 - 0.5, x0 + nx - 0.5, y0 + ny - 0.5, y0 - 0.5)
    image = axes.imshow(
        each.z, cmap=DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest", origin="upper",
        extent=extent, aspect="equal" if 0.25 <= ny / nx <= 4.0 else "auto",
    )  # fmt: skip
    inside = _inside(each, origin)
    if inside is not None:
        _outline(axes, inside, origin)
    rings = {(y, x) for y, x in flagged if y0 <= y < y0 + ny and x0 <= x < x0 + nx}
    beyond = np.argwhere(np.abs(np.nan_to_num(each.z)) > _STANDS_OUT)
    if len(beyond) <= _MOST_RINGS:
        rings |= {(y0 + int(y), x0 + int(x)) for y, x in beyond}
    if 0 < len(rings) <= _MOST_RINGS:
        ys, xs = np.array(sorted(rings)).T
        axes.plot(
            xs,
            ys,
            "o",
            markersize=5,
            markerfacecolor="none",
            markeredgecolor=colours.ink,
            markeredgewidth=0.6,
        )
        axes.set(xlim=extent[:2], ylim=extent[2:])
    axes.set(xlabel="x (pixel)", ylabel="y (pixel)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    bar = figure.colorbar(image, ax=axes, fraction=0.05, pad=0.02, aspect=25, extend="both")
    bar.set_label("sd of chance")


def _inside(each: PixelMap, origin: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return the pixels of a map that its region holds, (y, x); None without a region.

    The region may go on beyond the map.
    """
    region = each.region
    if region is None:
        return None
    y, x = (slice(first, first + n) for first, n in zip(origin, each.z.shape, strict=True))
    rows = max((y.stop, *(last for _, last in region.rows), *(row + 1 for row, _, _ in region.pixels)))
    columns = max((x.stop, *(last for _, last in region.columns), *(last for _, _, last in region.pixels)))
    return region.mask((rows, columns))[y, x]


def _outline(axes: Axes, inside: NDArray[np.bool_], origin: tuple[int, int]) -> None:
    """Draw the edges of a set of pixels."""
    padded = np.pad(inside, 1)
    across, down = padded[:, 1:] != padded[:, :-1], padded[1:] != padded[:-1]
    y, x = origin
    # each edge of a pixel that parts inside from outside is a line of its own
    lines = [[(x + j - 0.5, y + i - 1.5), (x + j - 0.5, y + i - 0.5)] for i, j in np.argwhere(across)]
    lines += [[(x + j - 1.5, y + i - 0.5), (x + j - 0.5, y + i - 0.5)] for i, j in np.argwhere(down)]
    axes.add_collection(LineCollection(lines, colors=colours_of(axes).ink, linewidths=1.1))


def _draw_line(axes: Axes, each: PixelMap) -> None:
    """Draw a line of channels."""
    colours = colours_of(axes)
    z = each.z.ravel()
    axes.axhspan(-2, 2, color=colours.bars, alpha=0.4, linewidth=0)
    axes.plot(np.arange(z.size), z, "o", color=colours.blue, markersize=3)
    axes.set(xlabel="channel", ylabel="standard deviations", xlim=(-0.5, z.size - 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))


def _draw_distribution(axes: Axes, each: PixelMap, inside: NDArray[np.bool_] | None = None) -> None:
    colours = colours_of(axes)
    known = finite(each.z)
    edge = float(np.clip(np.abs(known).max() if known.size else 5.0, 5.0, 15.0))
    edges = np.linspace(-edge, edge, 61)
    axes.stairs(np.histogram(np.clip(known, -edge, edge), edges)[0], edges, fill=True, color=colours.bars)
    if inside is not None:
        part = np.clip(finite(each.z[inside]), -edge, edge)
        axes.stairs(np.histogram(part, edges)[0], edges, color=colours.vermilion, linewidth=0.9)
    x = np.linspace(-edge, edge, 301)
    chance = known.size * (edges[1] - edges[0]) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    axes.plot(x, chance, color=colours.blue, linewidth=0.9)
    axes.set_yscale("log")
    axes.set_ylim(0.5, max(3.0 * chance.max(), 3.0))
    axes.set(xlim=(-edge, edge), xlabel="standard deviations", ylabel="pixels")
    note(axes, f"{count(each.outliers, 'pixel')} beyond ±5")


@styled
def draw_lines(
    look: Look, *, arrays: Mapping[str, NDArray[Any]], origin: tuple[int, int] = (0, 0)
) -> Drawing:
    """Draw the means of rows and of columns: the first frames as a picture, and the scatter of each line.

    Args:
        look: width and colours; a column stacks the panels.
        arrays: ``row_image``, ``row_rms``, ``column_image``, ``column_rms`` of group ``discrepancy``.
        origin: row and column of the sensor of the first of them.
    """
    lines, wide = _lines(arrays), look.wide
    columns = 3 if wide else 1
    stacked = len(lines) if wide else 3 * len(lines)
    figure = look.empty(stacked * (50.0 if wide else 44.0))
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
    figure: Drawing, axes: Axes, image: NDArray[Any] | None, line: str, channel: str, first: int
) -> None:
    colours = colours_of(axes)
    axes.set_title(f"{channel}: means of {LINE_WORDS[line]}")
    axes.set(xlabel="frame (the first ones examined)", ylabel=f"{'y' if line == 'row' else 'x'} (pixel)")
    if image is None or image.size == 0:
        note(axes, "not kept")
        return
    axes.set_facecolor(colours.no_value)
    n_frames, n_lines = image.shape
    drawn = axes.imshow(
        image.T,
        extent=(-0.5, n_frames - 0.5, first + n_lines - 0.5, first - 0.5),
        cmap=DIVERGING,
        vmin=-_LEAST,
        vmax=_LEAST,
        interpolation="nearest",
        aspect="auto",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    bar = figure.colorbar(drawn, ax=axes, fraction=0.05, pad=0.02, aspect=25, extend="both")
    bar.set_label("sd of chance")


#: By how much an axis reaches beyond its largest point, so that a legend above covers none.
_LEGEND_ROOM = 1.35


def _draw_scatter(axes: Axes, rms: FloatArray, line: str, first: int) -> None:
    colours = colours_of(axes)
    for channel, colour, marker in (("readout", colours.vermilion, "o"), ("charge", colours.blue, "s")):
        values = rms[CHANNELS.index(channel)]
        axes.plot(first + np.arange(values.size), values, marker, markersize=2.2, color=colour, label=channel)
    axes.axhline(1.0, color=colours.ink, linewidth=0.8)
    top = float(np.nanmax(rms)) if np.isfinite(rms).any() else 1.0
    low = float(np.nanmin(rms)) if np.isfinite(rms).any() else 1.0
    bottom = min(0.85, low - 0.05)
    axes.set_ylim(bottom, max(1.25, bottom + _LEGEND_ROOM * (top - bottom)))
    axes.set(
        xlabel=f"{'y' if line == 'row' else 'x'} (pixel)", ylabel="rms / rms of chance",
        title=f"scatter of the {LINE_WORDS[line]}",
    )  # fmt: skip
    axes.legend(loc="upper right", ncols=2)
