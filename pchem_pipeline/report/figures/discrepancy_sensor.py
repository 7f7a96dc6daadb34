"""Disagreement of data and model on the sensor: maps of statistics of each pixel, and of rows and columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.where import PAIRS, map_of
from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Image,
    Level,
    Line,
    Mark,
    Panel,
    Points,
    Shape,
    Stack,
)
from pchem_pipeline.report.data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.stacks import is_strip, place_of, pull_stack, sensor_stack
from pchem_pipeline.report.style.palette import DIVERGING
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count

FloatArray = NDArray[np.float64]

#: Colours end at least, and at most, at so many standard deviations.
_LEAST, _MOST = 4.0, 12.0
#: Pixels that stand out are counted, and ringed if they are no more.
_MOST_RINGS = 60


_SCORE_WORDS = {
    "C2": "charge: variance beyond Poisson (C2)",
    "C3": "charge: skew beyond Poisson (C3)",
    "He3": "readout: skew (He3)",
    "He4": "readout: heavy tails (He4)",
    "He2C1": "peaks widen with k (He2C1)",
    "He1C2": "peak spacing grows with k (He1C2)",
    "He2C2": "peak width grows faster at high k (He2C2)",
    "He3C1": "peak skewness grows with k (He3C1)",
}

_PAIR_WORDS = {
    f"{axis}.{pair}": f"{words}, along {axis}"
    for axis in ("x", "y")
    for pair, words in (
        ("kk", "charge: neighbours correlated"),
        ("rr", "readout: neighbours correlated"),
        ("rk", "readout rises with the neighbour's charge"),
    )
}

#: Rows and columns in words, by name of their array.
LINE_WORDS = {"row": "rows", "column": "columns"}


def sensor_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the maps of statistics of each pixel."""
    maps = [each for each in largest_maps(data.arrays, regions_of(data)) if finite(each.z).size]
    if not maps:
        return
    origin = data.found.examined.origin
    flagged = [pixel for place in data.found.where for pixel in place.pixels]
    words = []
    for each in maps:
        known = finite(each.z)
        words.append(
            f"{each.title}: mean {known.mean():+.2f}, standard deviation {known.std():.2f} "
            f"(expected 0 and 1), {count(each.outliers, 'pixel')} beyond 5"
            + (f", mainly in {each.region.describe()}" if each.region is not None else "")
        )
    columns = {each.title: each.z for each in maps}
    table = DataTable(columns, dict.fromkeys(columns, "standard deviations"), origin=origin)
    yield Figure(
        "discrepancy_maps",
        "where",
        "On the sensor",
        "Statistics of each pixel: those with a deviating region (outlined), then goodness of fit and the "
        "most deviating ones. Below each map: histogram of all pixels (gray), of the outlined region (red) "
        "and under the model (line). A shift of the whole histogram is an effect in all pixels, long tails "
        "an effect in few; these are ringed in the map.",
        "Maps in sigma. " + "; ".join(words).replace("-", "−") + ".",
        (table,),
        _sensor_chart(maps, flagged, origin),
        PAGE_MM,
    )


def line_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the means of rows and columns, and their scatter."""
    origin = data.found.examined.origin
    tables = _line_tables(data.arrays, origin)
    if not tables:
        return
    words = [_line_text(line, np.asarray(data.arrays[f"{line}_rms"])) for line in _lines(data.arrays)]
    yield Figure(
        "discrepancy_lines",
        "where",
        "Rows and columns",
        "Left and middle: means of rows and of columns of the first frames. Right: scatter of each row or "
        "column over all frames, relative to independent pixels (1). Stripes in the readout are row or "
        "column noise, slanted lines are periodic pickup.",
        "Scatter of the means over the frames, relative to independent pixels (1). " + "; ".join(words) + ".",
        tables,
        _lines_chart(data.arrays, origin),
        PAGE_MM,
    )


def _lines(arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    return [line for line in LINE_WORDS if arrays.get(f"{line}_rms", np.empty(0)).size]


def _line_tables(arrays: Mapping[str, NDArray[Any]], origin: tuple[int, int]) -> tuple[DataTable, ...]:
    """Return the scatter of each row and column, and their means in the first frames."""
    tables = []
    for line in _lines(arrays):
        axis, first = ("y", origin[0]) if line == "row" else ("x", origin[1])
        rms, image = np.asarray(arrays[f"{line}_rms"]), arrays.get(f"{line}_image")
        columns = {axis: first + np.arange(rms.shape[1])}
        columns |= {f"{each}: rms / expected rms": row for each, row in zip(CHANNELS, rms, strict=False)}
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
    """A statistic of every pixel in sigma, with its overall significance.

    Attributes:
        title: the statistic in words.
        z: map (y, x), NaN where there is no value.
        far: the largest of three departures from N(0, 1), each in its own standard errors: of the mean, of
            the mean square, and of the number of pixels beyond 5.
        outliers: pixels beyond 5.
        region: deviating part of the sensor; None: uniform.
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
        found.setdefault(map_of(each.statistic), Region.model_validate(each.region))
    return found


def largest_maps(
    arrays: Mapping[str, NDArray[Any]], regions: Mapping[str, Region] | None = None, most: int = 3
) -> list[PixelMap]:
    """Return the maps with a deviating region, then goodness of fit, then the most deviating ones.

    Args:
        arrays: group ``discrepancy`` of the store.
        regions: deviating part of the sensor by map.
        most: largest number of maps.
    """
    regions = regions or {}
    named = _named_maps(arrays)
    maps = {name: _pixel_map(words, values, regions.get(name)) for name, (words, values) in named.items()}
    placed = [maps.pop(name) for name in regions if name in maps]
    first = [maps.pop("goodness")] if "goodness" in maps else []
    # of neighbours only maps with a region: uniform correlations show better in rows and columns
    others = [each for name, each in maps.items() if np.isfinite(each.far) and name not in PAIRS]
    return (placed + first + sorted(others, key=lambda each: -each.far))[:most]


def _named_maps(arrays: Mapping[str, NDArray[Any]]) -> dict[str, tuple[str, NDArray[Any]]]:
    """Return title and values of all maps, by the names in :mod:`pchem_pipeline.discrepancy.where`."""
    found: dict[str, tuple[str, NDArray[Any]]] = {}
    if "goodness" in arrays:
        found["goodness"] = ("goodness of fit (large: poor)", arrays["goodness"])
    for name, values in zip(SCORES, arrays.get("score", ()), strict=False):
        found[f"score.{name}"] = (_SCORE_WORDS.get(name, name), values)
    for array, short, words in (
        ("block_spread", "spread", "block means vary"),
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
    outliers = int((np.abs(known) > BEYOND_DOUBT).sum())
    if known.size == 0:
        return PixelMap(words, z, float("nan"), 0, region)
    # fewer than one pixel in a million is beyond 5 sigma by sampling noise: each counts fully
    departures = (
        abs(float(known.mean())) * np.sqrt(n),
        abs(float((np.clip(known, -8, 8) ** 2).mean()) - 1.0) * np.sqrt(n / 2.0),
        6.0 * np.sqrt(outliers),
    )
    return PixelMap(words, z, float(max(departures)), outliers, region)


def _sensor_chart(
    maps: Sequence[PixelMap], flagged: Sequence[tuple[int, int]] = (), origin: tuple[int, int] = (0, 0)
) -> Chart:
    """Return maps of statistics of each pixel, and below their histograms with that under the model."""
    shown, below = [], []
    for each in maps:
        inside = _inside(each, origin)
        known = finite(each.z)
        edge = float(np.clip(np.abs(known).max() if known.size else 5.0, 5.0, 15.0))
        part = None if inside is None else each.z[inside]
        note = f"{count(each.outliers, 'pixel')} beyond ±5"
        shown.append(_map_stack(each, inside, flagged, origin))
        below.append(pull_stack(known, edge, "standard deviations", note, part=part))
    return Chart((*shown, *below), (1.0,) * len(maps))


def _map_stack(
    each: PixelMap,
    inside: NDArray[np.bool_] | None,
    flagged: Sequence[tuple[int, int]],
    origin: tuple[int, int],
) -> Stack:
    limit = _LEAST
    if each.far > 0:
        limit = float(np.clip(np.quantile(np.abs(finite(each.z)), 0.995), _LEAST, _MOST))
    beyond: NDArray[np.bool_] = np.abs(np.nan_to_num(each.z)) > BEYOND_DOUBT
    rings = np.zeros_like(beyond)
    for y, x in ((y - origin[0], x - origin[1]) for y, x in flagged):
        if 0 <= y < rings.shape[0] and 0 <= x < rings.shape[1]:
            rings[y, x] = True
    if beyond.sum() <= _MOST_RINGS:
        rings |= beyond
    return sensor_stack(
        each.z, (-limit, limit), "sigma", *(() if inside is None else (_outline(inside, origin),)),
        ringed=rings if rings.sum() <= _MOST_RINGS and not is_strip(rings.shape) else None,
        origin=origin, title=each.title, scale=DIVERGING,
    )  # fmt: skip


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


def _outline(inside: NDArray[np.bool_], origin: tuple[int, int]) -> Line:
    """Return the edges of a set of pixels."""
    padded = np.pad(inside, 1)
    y, x = origin
    # each edge of a pixel that parts inside from outside is a line of its own, between gaps
    down, across = np.nonzero(padded[:, 1:] != padded[:, :-1])
    upright = np.stack([x + across - 0.5] * 3), np.stack([y + down - 1.5, y + down - 0.5, down * np.nan])
    down, across = np.nonzero(padded[1:] != padded[:-1])
    level = (
        np.stack([x + across - 1.5, x + across - 0.5, x + across]),
        np.stack([y + down - 0.5] * 2 + [down * np.nan]),
    )
    xs, ys = (np.concatenate([a.T.ravel(), b.T.ravel()]) for a, b in zip(upright, level, strict=True))
    return Line(xs, ys, colour="ink", width=1.1)


def _lines_chart(arrays: Mapping[str, NDArray[Any]], origin: tuple[int, int] = (0, 0)) -> Chart:
    """Return the means of rows and columns: the first frames as a picture, and the scatter of each line."""
    stacks = []
    for line in _lines(arrays):
        image, first = arrays.get(f"{line}_image"), origin[0 if line == "row" else 1]
        for channel in ("readout", "charge"):
            shown = None if image is None else image[CHANNELS.index(channel)]
            stacks.append(_frames(shown, line, channel, first))
        stacks.append(_scatter(np.asarray(arrays[f"{line}_rms"]), line, first))
    return Chart(tuple(stacks), (1.0, 1.0, 1.0))


def _frames(image: NDArray[Any] | None, line: str, channel: str, first: int) -> Stack:
    """Return the means of the rows or columns of the first frames as a picture."""
    title, axis = f"{channel}: means of {LINE_WORDS[line]}", "y (pixel)" if line == "row" else "x (pixel)"
    x, y = Axis("frame (the first ones examined)", whole=True), Axis(axis, whole=True)
    if image is None or image.size == 0:
        return Stack((Panel(y, (), note="not kept"),), x, title, height_mm=46.0)
    across, down = place_of(image.T.shape, (first, 0))
    marks = (Image(image.T, across, down, scale=DIVERGING, ends=(-_LEAST, _LEAST), unit="sigma"),)
    x = replace(x, low=across[0], high=across[1])
    panel = Panel(replace(y, low=down[0], high=down[1], down=True), marks)
    return Stack((panel,), x, title, height_mm=46.0)


#: By how much an axis reaches beyond its largest point, so that a legend above covers none.
_LEGEND_ROOM = 1.35


def _scatter(rms: FloatArray, line: str, first: int) -> Stack:
    marks: list[Mark] = []
    shapes: tuple[tuple[str, str, Shape], ...] = (("readout", "vermilion", "o"), ("charge", "blue", "s"))
    for channel, colour, shape in shapes:
        values = rms[CHANNELS.index(channel)]
        places = first + np.arange(values.size)
        marks.append(Points(places, values, shape, 2.2, colour=colour, label=channel))
    marks.append(Level(1.0, colour="ink", width=0.8))
    known = finite(rms) if np.isfinite(rms).any() else np.ones(1)
    bottom, high = min(0.85, float(known.min()) - 0.05), float(known.max())
    y = Axis("rms / expected rms", bottom, max(1.25, bottom + _LEGEND_ROOM * (high - bottom)))
    panel = Panel(y, tuple(marks), legend="upper right", columns=2)
    x = Axis(f"{'y' if line == 'row' else 'x'} (pixel)", whole=True)
    return Stack((panel,), x, f"scatter of the {LINE_WORDS[line]}", height_mm=46.0)
