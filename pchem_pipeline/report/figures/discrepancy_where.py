"""Disagreement of data and model: maps of statistics of each pixel, rows and columns, codes, frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, FloatArray
from pchem_pipeline.base.wording import count, short
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.discrepancy.where import PAIRS, map_of
from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Band,
    Chart,
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
)
from pchem_pipeline.report.data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.figures.figure import (
    DataTable,
    Figure,
    is_strip,
    place_of,
    pull_axis,
    pull_stack,
    sensor_stack,
)
from pchem_pipeline.report.style.palette import DIVERGING
from pchem_pipeline.report.style.ranges import finite

#: Colours end at least at so many standard deviations.
_LEAST = 4.0
#: Pixels that stand out are counted, and ringed if they are no more.
_MOST_RINGS = 60


_SCORE_WORDS = {
    "C2": "charge: variance beyond Poisson",
    "C3": "charge: skew beyond Poisson",
    "He3": "readout: skew",
    "He4": "readout: heavy tails",
    "He2C1": "peaks widen with electron number",
    "He1C2": "peak spacing grows with electron number",
    "He2C2": "peak width grows faster at high electron numbers",
    "He3C1": "peak skewness grows with electron number",
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
    words, shown, below = [], [], []
    for each in maps:
        known, inside, outliers = finite(each.z), _inside(each, origin), count(each.outliers, "pixel")
        words.append(
            f"{each.title}: mean {known.mean():+.2f}, standard deviation {known.std():.2f} "
            f"(expected 0 and 1), {outliers} beyond 5"
            + (f", mainly in {each.region.describe()}" if each.region is not None else "")
        )
        shown.append(_map_stack(each, inside, flagged, origin))
        edge = float(np.clip(np.abs(known).max(), 5.0, 15.0))
        part = None if inside is None else each.z[inside]
        below.append(pull_stack(known, edge, "standard deviations", f"{outliers} beyond ±5", part=part))
    columns = {each.title: each.z for each in maps}
    table = DataTable(columns, dict.fromkeys(columns, "standard deviations"), origin=origin)
    yield Figure(
        "discrepancy_maps",
        "where",
        "On the sensor",
        "Statistics of each pixel: those with a deviating region (outlined), then goodness of fit and the "
        "most deviating ones. Below each map: histogram of all pixels (gray), of the outlined region (red) "
        "and a Gaussian of standard deviation 1 (line). A shift of the whole histogram is an effect in all "
        "pixels, long tails an effect in few; these are ringed in the map.",
        "Maps in sigma. " + "; ".join(words).replace("-", "−") + ".",
        (table,),
        Chart((*shown, *below), (1.0,) * len(maps)),
        PAGE_MM,
    )


def line_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the means of rows and columns, and their scatter."""
    tables: list[DataTable] = []
    words: list[str] = []
    stacks: list[Stack] = []
    for line, axis, first in zip(LINE_WORDS, "yx", data.found.examined.origin, strict=True):
        rms, image = (np.asarray(data.arrays.get(f"{line}_{name}", ())) for name in ("rms", "image"))
        if rms.size:
            columns = {axis: first + np.arange(rms.shape[1])}
            columns |= {f"{each}: rms / expected rms": row for each, row in zip(CHANNELS, rms, strict=False)}
            tables.append(DataTable(columns, {axis: "pixel"}, f"{line}_scatter"))
            if image.size:
                means = dict(zip(CHANNELS, image, strict=False))
                units = dict.fromkeys(means, "standard deviations")
                index = ("frame", f"{axis} (pixel)")
                tables.append(DataTable(means, units, f"{line}_means", index, (0, first)))
            channels = zip(CHANNELS, map(finite, rms), strict=False)
            numbers = [f"{c} median {np.median(v):.2f}, largest {v.max():.2f}" for c, v in channels if v.size]
            words.append(f"{LINE_WORDS[line]}: {' and '.join(numbers) or 'not known'}")
            for channel in ("readout", "charge"):
                shown = image[CHANNELS.index(channel)] if image.size else None
                stacks.append(_frames(shown, line, channel, first))
            stacks.append(_scatter(rms, line, first))
    if not tables:
        return
    yield Figure(
        "discrepancy_lines",
        "where",
        "Rows and columns",
        "Left and middle: means of rows and of columns of the first frames. Right: scatter of each row or "
        "column over all frames, relative to independent pixels (1). Hints: stripes in the readout, row or "
        "column noise; slanted lines, periodic pickup.",
        "Scatter of the means over the frames, relative to independent pixels (1). " + "; ".join(words) + ".",
        tuple(tables),
        Chart(tuple(stacks), (1.0, 1.0, 1.0)),
        PAGE_MM,
    )


class PixelMap(NamedTuple):
    """A statistic of every pixel in sigma, (y, x), with its overall significance."""

    title: str
    z: FloatArray
    far: float  # departure from N(0, 1), see :func:`_pixel_map`
    outliers: int  # pixels beyond 5
    region: Region | None = None  # deviating part of the sensor; None: uniform


def regions_of(data: DiscrepancyData) -> dict[str, Region | None]:
    """Return maps that deviate in a region, by name, the most significant first; None: elsewhere as much."""
    placed = [each for each in data.found.where if each.region is not None and map_of(each.statistic)]
    # a statistic of a part has no p-value of its region: it is not known to stand out
    placed.sort(key=lambda each: each.region_p if math.isfinite(each.region_p) else 1.0)
    found: dict[str, Region | None] = {}
    for each in placed:
        outlined = math.isfinite(each.region_p)
        found.setdefault(map_of(each.statistic), Region.model_validate(each.region) if outlined else None)
    return found


def largest_maps(arrays: Arrays, regions: Mapping[str, Region | None] | None = None) -> list[PixelMap]:
    """Return three maps: any with a deviating region, then goodness of fit, then the most deviating ones."""
    regions = regions or {}
    named = _named_maps(arrays)
    maps = {name: _pixel_map(words, values, regions.get(name)) for name, (words, values) in named.items()}
    placed = [maps.pop(name) for name in regions if name in maps]
    first = [maps.pop("goodness")] if "goodness" in maps else []
    # of neighbours only maps with a region: uniform correlations show better in rows and columns
    others = [each for name, each in maps.items() if np.isfinite(each.far) and name not in PAIRS]
    return (placed + first + sorted(others, key=lambda each: -each.far))[:3]


def _named_maps(arrays: Arrays) -> dict[str, tuple[str, NDArray[Any]]]:
    """Return title and values of all maps, by the names in :mod:`pchem_pipeline.discrepancy.where`."""
    found: dict[str, tuple[str, NDArray[Any]]] = {}
    if "goodness" in arrays:
        found["goodness"] = ("goodness of fit (large: poor)", arrays["goodness"])
    for name, values in zip(SCORES, arrays.get("score", ()), strict=False):
        found[f"score.{name}"] = (_SCORE_WORDS[name], values)
    for array, name, words in (
        ("block_spread", "spread", "block means vary"),
        ("trend", "trend", "block means rise"),
        ("lag1", "lag", "successive frames correlated"),
    ):
        for channel, values in zip(CHANNELS, arrays.get(array, ()), strict=False):
            found[f"{name}.{channel}"] = (f"{channel}: {words}", values)
    for name, values in zip(PAIRS, arrays.get("neighbour", ()), strict=False):
        found[name] = (_PAIR_WORDS[name], values)
    return found


def _pixel_map(words: str, values: NDArray[Any], region: Region | None) -> PixelMap:
    """Return a map with the largest departure of mean, mean square or outliers, in its standard errors."""
    z = np.asarray(values, dtype=np.float64)
    known = finite(z)
    n, outliers = known.size, int((np.abs(known) > BEYOND_DOUBT).sum())
    if not n:
        return PixelMap(words, z, math.nan, 0, region)
    # fewer than one pixel in a million is beyond 5 sigma by sampling noise: each counts fully
    departures = (
        abs(float(known.mean())) * np.sqrt(n),
        abs(float((np.clip(known, -8, 8) ** 2).mean()) - 1.0) * np.sqrt(n / 2.0),
        6.0 * np.sqrt(outliers),
    )
    return PixelMap(words, z, float(max(departures)), outliers, region)


def _map_stack(
    each: PixelMap, inside: BoolArray | None, flagged: Sequence[tuple[int, int]], origin: tuple[int, int]
) -> Stack:
    limit = float(np.clip(np.quantile(np.abs(finite(each.z)), 0.995), _LEAST, 12.0))
    beyond: BoolArray = np.abs(np.nan_to_num(each.z)) > BEYOND_DOUBT
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


def _inside(each: PixelMap, origin: tuple[int, int]) -> BoolArray | None:
    """Return the pixels of a map in its region, which may extend beyond the map; None without a region."""
    region = each.region
    if region is None:
        return None
    y, x = (slice(first, first + n) for first, n in zip(origin, each.z.shape, strict=True))
    rows = max((y.stop, *(last for _, last in region.rows), *(row + 1 for row, _, _ in region.pixels)))
    columns = max((x.stop, *(last for _, last in region.columns), *(last for _, _, last in region.pixels)))
    return region.mask((rows, columns))[y, x]


def _outline(inside: BoolArray, origin: tuple[int, int]) -> Line:
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


def _frames(image: NDArray[Any] | None, line: str, channel: str, first: int) -> Stack:
    title, axis = f"{channel}: means of {LINE_WORDS[line]}", "y (pixel)" if line == "row" else "x (pixel)"
    x = Axis("frame (the first ones examined)", whole=True)
    panel = Panel(Axis(axis, whole=True), (), note="not kept")
    if image is not None:
        across, down = place_of(image.T.shape, (first, 0))
        mark = Image(image.T, across, down, scale=DIVERGING, ends=(-_LEAST, _LEAST), unit="sigma")
        panel = Panel(Axis(axis, *down, whole=True, down=True), (mark,))
        x = replace(x, low=across[0], high=across[1])
    return Stack((panel,), x, title, height_mm=46.0)


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
    # the legend above the points needs a third more
    y = Axis("rms / expected rms", bottom, max(1.25, bottom + 1.35 * (high - bottom)))
    panel = Panel(y, tuple(marks), legend="upper right", columns=2)
    x = Axis(f"{'y' if line == 'row' else 'x'} (pixel)", whole=True)
    return Stack((panel,), x, f"scatter of the {LINE_WORDS[line]}", height_mm=46.0)


#: Factor and unit in which frames are shown, by what is shown of them, and the label of the axis.
_SCALES = {
    "charge": (100.0, "%", "charge: exposure (%)"),
    "readout": (1.0, "DN", "readout: mean (DN)"),
    "noise": (1.0, "sigma", "noise (sigma)"),
}


def code_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the counts of each DN and their residuals."""
    if not _has(data, "code_dn", "code_observed", "code_expected"):
        return
    table = code_table(data.arrays)
    dn, residual = table["dn"], table["residual"]
    if dn.size == 0:
        return
    order = np.argsort(-np.abs(residual))[:3]
    largest = ", ".join(f"{residual[i]:+.1f} at {dn[i]:.0f} DN" for i in order).replace("-", "−")
    even = dn % 2 == 0
    comb = "not known"
    if even.any() and (~even).any():
        comb = f"{residual[even].mean():+.2f} on even and {residual[~even].mean():+.2f} on odd DN"
    yield Figure(
        "discrepancy_codes",
        "where",
        "Along the digital numbers",
        "All usable pixels together. Top: samples at each DN (gray) and expectation from the fitted PCDs "
        "(black; with added effects: purple). Bottom: difference from the plain model in sigma, even and "
        "odd DN in two colours; the gray band is 2 sigma. Hints: a tall line at an end, clipping; "
        "alternating colours, differential nonlinearity of the ADC; a slow wave, integral nonlinearity. "
        "Yellow: codes named in the verdict.",
        f"Counts from {dn[0]:.0f} to {dn[-1]:.0f} DN and their residuals in standard deviations: root mean "
        f"square {np.sqrt(np.mean(residual**2)):.2f} (expected below 1); largest {largest}; mean "
        f"{comb.replace('-', '−')}.",
        (table,),
        _codes_chart(table, data.found.where),
        PAGE_MM,
    )


def frame_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the means of the frames along the run."""
    if not _has(data, "frame_number", "frame_charge", "frame_readout"):
        return
    arrays, units = data.arrays, dict[str, str]()
    number = np.asarray(arrays["frame_number"], dtype=np.float64)
    columns, means = {"frame": number}, dict[str, FloatArray]()
    for channel, (scale, unit, _) in _SCALES.items():
        if f"frame_{channel}" not in arrays:
            continue
        columns[channel] = scale * np.asarray(arrays[f"frame_{channel}"], dtype=np.float64)
        centre, means[channel], n = trends(number, columns[channel])
        path = arrays.get(f"frame_{channel}_model")
        if path is not None and path.size:
            columns[_model(channel)] = scale * np.asarray(path, dtype=np.float64)
        units |= dict.fromkeys((channel, _model(channel)), unit)
    frames = DataTable(columns, units)
    stretches = DataTable({"frame": centre, "frames": n, **means}, units, "stretches")
    by_channel = data.arrays.get("frame_sd", np.full(2, np.nan)).tolist()
    sds = dict(zip((*CHANNELS, "noise"), (*by_channel, 1.0), strict=True))
    sds = {shown: sd for shown, sd in sds.items() if shown in frames}
    words = []
    for channel, sd in sds.items():
        (scale, unit, _), values = _SCALES[channel], frames[channel]
        centre, mean = stretches["frame"], stretches[channel]
        drift = float(np.polyfit(centre, mean, 1)[0] * np.ptp(centre)) if centre.size > 2 else math.nan
        chance = f" (expected {short(scale * sd)})" if np.isfinite(sd) else ""
        words.append(
            f"{channel}: standard deviation {short(float(values.std()))} {unit}{chance}, change "
            f"along the run {short(drift)} {unit}"
        )
    drawn = "; the time course of the named effects is drawn over them" if _model("readout") in frames else ""
    yield Figure(
        "discrepancy_frames",
        "where",
        "Along time",
        "Dots: frame means over all usable pixels, and the excess of squared residuals of each frame "
        "(noise). Blue: means over stretches of the run; the gray band is 2 sigma of their sampling noise. "
        "Dashed: time course of the named effects, if deterministic. Yellow: frames named in the verdict.",
        f"Means of {count(int(frames['frame'].size), 'frame')}. {'; '.join(words)}{drawn}.",
        (frames, stretches),
        _frames_chart(frames, stretches, sds, data.found.where),
        PAGE_MM,
    )


def _has(data: DiscrepancyData, *names: str) -> bool:
    return all(name in data.arrays and data.arrays[name].size for name in names)


def code_table(arrays: Arrays) -> DataTable:
    """Return the counts of the codes and their residuals, (observed - expected) / sqrt(expected).

    They are made of ``code_dn``, ``code_observed``, ``code_expected``, and ``code_extended`` where effects
    were named, from the first to the last code where a count is seen or expected.
    """
    dn, observed, expected = (
        np.asarray(arrays[f"code_{name}"], dtype=np.float64) for name in ("dn", "observed", "expected")
    )
    residual = (observed - expected) / np.sqrt(np.maximum(expected, 1.0))
    seen = np.flatnonzero((observed > 0) | (expected >= 1.0))
    kept = slice(int(seen[0]), int(seen[-1]) + 1) if seen.size else slice(0, 0)
    columns = {"dn": dn, "observed": observed, "expected": expected, "residual": residual}
    if "code_extended" in arrays:
        columns[_NAMED] = np.asarray(arrays["code_extended"], dtype=np.float64)
    units = {"dn": "DN", "residual": "standard deviations"}
    return DataTable({name: values[kept] for name, values in columns.items()}, units)


_NAMED = "expected with added effects"


def _model(channel: str) -> str:
    return f"{channel}, named effects"


def _codes_chart(table: DataTable, marked: Sequence[Place]) -> Chart:
    dn, observed, expected, residual = (table[name] for name in ("dn", "observed", "expected", "residual"))
    edges = np.append(dn - 0.5, dn[-1] + 0.5)
    shaded = [
        Span(place.dn[0] - 0.5, place.dn[1] + 0.5, axis="x", colour="mark", alpha=0.5)
        for place in marked
        if place.dn is not None and place.dn[1] - place.dn[0] < 0.8 * dn.size
    ]
    above: list[Mark] = [
        *shaded,
        Steps(edges, observed, filled=True, colour="bars", label="observed"),
        Steps(edges, expected, colour="ink", width=0.9, label="expected from the fitted PCDs"),
    ]
    if _NAMED in table:
        above.append(Steps(edges, table[_NAMED], colour="purple", width=0.9, label="with added effects"))
    highest = max(float(observed.max()), 1.0)
    top = Panel(
        Axis("samples per DN", 0.5, 4.0 * highest, log=True), tuple(above), 1.0, legend="upper right",
        room=(1.0, 50.0),
    )  # fmt: skip
    even = dn % 2 == 0
    below: list[Mark] = [Span(-2.0, 2.0, colour="band"), *shaded]
    # in points, so that lines do not touch on a page
    width = float(np.clip(0.62 * (PAGE_MM - 22.0) / 25.4 * 72.0 / dn.size, 0.35, 4.0))
    for where, colour, label in ((even, "blue", "even DN"), (~even, "vermilion", "odd DN")):
        below.append(Sticks(dn[where], residual[where], colour=colour, width=width, label=label))
    largest = int(np.argmax(np.abs(residual)))
    reach = 1.25 * max(float(np.abs(residual).max()), 4.0)
    y = pull_axis("(obs. − exp.) / √exp.", reach)
    note = f"largest: {residual[largest]:+.1f} at {dn[largest]:.0f} DN".replace("-", "−")
    bottom = Panel(
        y, tuple(below), 1.25, legend="upper right", columns=2, room=(1.6, 1.6), note=note,
        corner="lower left",
    )  # fmt: skip
    return Chart((Stack((top, bottom), Axis("DN", float(edges[0]), float(edges[-1])), height_mm=86.0),))


def trends(number: NDArray[Any], values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean frame number, mean value and number of frames of each stretch of the run.

    No stretch spans a gap between the n frames, whose numbers increase.
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(number) > 1) + 1, [number.size]])
    wanted = max(number.size // 24, 4)
    pieces = [np.linspace(a, b, max((b - a) // wanted, 1) + 1)[:-1] for a, b in itertools.pairwise(starts)]
    edges = np.append(np.unique(np.concatenate(pieces).astype(np.int64)), number.size)
    n = np.diff(edges).astype(np.float64)
    centre, mean = (
        np.add.reduceat(np.asarray(v, dtype=np.float64), edges[:-1]) / n for v in (number, values)
    )
    return centre, mean, n


def parity_difference(number: NDArray[Any], values: FloatArray, sd: float) -> float:
    """Return the mean of the even frames minus that of the odd ones, in standard errors."""
    even = number % 2 == 0
    n_even, n_odd = int(even.sum()), int((~even).sum())
    if not n_even or not n_odd or not sd > 0:
        return 0.0
    error = sd * np.sqrt(1.0 / n_even + 1.0 / n_odd)
    return float((values[even].mean() - values[~even].mean()) / error)


def _frames_chart(
    frames: DataTable, stretches: DataTable, sds: Mapping[str, float], marked: Sequence[Place]
) -> Chart:
    panels = []
    for channel, sd in sds.items():
        shaded = [
            span
            for place in marked
            if place.channel in ("readout" if channel == "noise" else channel, "cross", "")
            for span in _marked(place.frames, frames["frame"])
        ]
        scale, _, label = _SCALES[channel]
        marks, ends, note = _channel(frames, stretches, channel, scale * sd)
        panels.append(Panel(Axis(label, *ends), (*shaded, *marks), note=note, corner="lower right"))
    stack = Stack(tuple(panels), Axis("frame"), height_mm=len(panels) * 42.0 + 12.0)
    return Chart((stack,), legend=(5, 2))


def _channel(
    frames: DataTable, stretches: DataTable, channel: str, sd: float
) -> tuple[list[Mark], tuple[float, float], str]:
    """Return the marks of a channel, the ends of its axis, and how many frames lie beyond them."""
    number, values = frames["frame"], frames[channel]
    path, even = frames.get(_model(channel)), number % 2 == 0
    groups = [(np.ones(even.size, bool), "bars", "frames")]
    if abs(parity_difference(number, values, sd)) > 4.0:
        groups = [(even, "sky", "even frames"), (~even, "orange", "odd frames")]
    marks: list[Mark] = [
        Points(number[where], values[where], colour=colour, size=0.8, label=label)
        for where, colour, label in groups
    ]
    centre, mean, n = (stretches[name] for name in ("frame", channel, "frames"))
    if np.isfinite(sd):
        half = 2.0 * sd / np.sqrt(n)
        marks.append(Band(centre, -half, half, colour="edge", alpha=0.18, label="±2 sigma"))
    # no line across frames that are not there
    steps = np.diff(centre)
    apart = np.flatnonzero(steps > 2.0 * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    x, y = np.insert(centre, apart, centre[apart]), np.insert(mean, apart, np.nan)
    marks.append(Line(x, y, width=1.2, dots=1.8, label="mean of a stretch"))
    if path is not None:
        marks.append(Line(number, path, colour="vermilion", width=1.4, dash="--", label="named effects"))
    extremes = [*np.quantile(values, [0.001, 0.999]), *mean]
    extremes += [] if path is None else [path.min(), path.max()]
    margin = 0.08 * max(float(max(extremes) - min(extremes)), 1e-12)
    ends = float(min(extremes)) - margin, float(max(extremes)) + margin
    outside = int(((values < ends[0]) | (values > ends[1])).sum())
    return marks, ends, f"{outside} beyond the axis" if outside else ""


def _marked(frames: Sequence[int], number: FloatArray) -> list[Span]:
    """Return what shades the frames, successive ones together, unless they are most of the run."""
    if not frames or len(frames) > 0.8 * number.size:
        return []
    ordered = np.unique(np.asarray(frames))
    width = max(float(number[-1] - number[0]) / 400.0, 1.0)
    return [
        Span(float(run[0]) - width / 2, float(run[-1]) + width / 2, axis="x", colour="mark", alpha=0.6)
        for run in np.split(ordered, np.flatnonzero(np.diff(ordered) > width) + 1)[:50]
    ]
