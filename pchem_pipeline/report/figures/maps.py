"""Figures of the sensor: maps with their histograms (Appendix C), goodness of fit, and the fit status."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.wording import count, measured, percent, plain, short, stored_unit, symbol
from pchem_pipeline.model.arithmetic.statistics import misfit
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Bars,
    Chart,
    Image,
    Level,
    Mark,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
    y_window,
)
from pchem_pipeline.report.data import FEW_CHANNELS, LINE_MAPS, MAP_NAMES, ReportData, reasons_in
from pchem_pipeline.report.figures.figure import (
    DataTable,
    Figure,
    channel_axis,
    image_stack,
    is_strip,
    place_of,
    sensor_stack,
)
from pchem_pipeline.report.style.ranges import finite, histogram_edges, map_colours, robust_range

#: Bins of the histogram of a map at most; of a line of channels half as many.
_MOST_BINS = 128

#: Colours of the reasons of a fit status: a good fit, each reason in its order, not fitted yet.
_STATUS_COLOURS = (
    "band",
    "vermilion",
    "ink",
    "orange",
    "purple",
    "blue",
    "sky",
    "green",
    "yellow",
    "#8C8C8C",
)

_CAPTIONS = {
    "charge_rate": "Charge rate: quanta exposure / integration time; unknown source of the charge.",
    "dark_current": "Dark current: quanta exposure / integration time, in the dark.",
    "conversion_gain": "Conversion gain: electrons per digital number.",
    "bias": "Bias: the digital number at zero electrons.",
    "read_noise_e": "Read noise in electrons, quantisation included.",
    "spurious_charge": "Spurious charge: quanta exposure that does not grow with time.",
    "dark_signal": "Dark signal: quanta exposure at light level 0.",
    "charge_per_level": "Charge per light level: slope of the quanta exposure against the light level.",
}


def map_figures(data: ReportData) -> Iterator[Figure]:
    """Return a figure of each map of Appendix C, and of the line of several exposures, that has values."""
    what = "Values of the channels" if is_strip(data.shape) else "Histogram and map"
    for name in filter(data.has_values, (*MAP_NAMES, *LINE_MAPS)):
        known, summary, (_, words, unit) = data.ordered(name), data.summary(name), symbol(name)
        low, high = summary.percentiles[5.0], summary.percentiles[95.0]
        flagged = count(summary.n_left_out, f"flagged {data.noun}")
        tables = map_tables(data.maps[name], name, data.maps.get(f"{name}_stderr"), known)
        yield Figure(
            f"map_{name}",
            "summary" if name in ("read_noise_e", "conversion_gain") else "maps",
            words.capitalize(),
            _CAPTIONS[name],
            f"{what} of the {words}: median {measured(summary.median, summary.median_stderr, unit)}, "
            f"5 to 95 % of the {data.noun}s from {short(low)} to {short(high)} {unit}, "
            f"extremes {short(summary.minimum)} and {short(summary.maximum)} {unit}; "
            f"{count(summary.n_missing, data.noun)} without a value"
            + (f", {flagged} excluded." if summary.n_left_out else "."),
            tables,
            map_chart(tables, name, known),
        )


def status_figures(data: ReportData) -> Iterator[Figure]:
    """Return the map of the fit status."""
    status, rows = data.status, reasons_in(data.status)
    parts = [f"{count(int(((status == 0) & ~data.unfitted).sum()), data.noun)} with a good fit"]
    parts += [f"{count(n, data.noun)}: {text}" for _, text, n in rows]
    columns = zip(*((int(bit), text, n) for bit, text, n in rows), strict=True)
    reasons = dict(zip(("bit", "meaning", "pixels"), map(list, columns), strict=False))
    yield Figure(
        "fit_status",
        "status",
        "Fit status of the pixels",
        "Light gray: good fit. A pixel with several reasons has the colour of the first; the numbers count"
        " every reason.",
        "Map of the fit status. " + "; ".join(parts) + ".",
        (DataTable({"fit_status": status}), *([DataTable(reasons, part="reasons")] if rows else [])),
        status_chart(status, rows, data.unfitted),
    )


def goodness_figures(data: ReportData) -> Iterator[Figure]:
    """Return the p-values and the map of the goodness of fit."""
    names = ("p", "chi2", "dof", "q")
    if not data.misfits or any(f"goodness_{name}" not in data.fit for name in names):
        return
    tested, misfits, rate = (data.misfits[each] for each in ("tested", "misfits", "false_discovery_rate"))
    columns = {name: data.fit[f"goodness_{name}"] for name in names}
    columns["misfit"] = misfit(columns["chi2"], columns["dof"])
    table = DataTable(columns, {"misfit": "standard deviations"})
    bins, known = 20, finite(columns["p"])
    counts, edges = np.histogram(known, bins, (0.0, 1.0))
    mean = known.size / bins
    spread = np.sqrt(mean * (1.0 - 1.0 / bins))
    marks = (
        Span(mean - 2 * spread, mean + 2 * spread, colour="band"),
        Level(mean, colour="ink", width=0.6),
        Steps(edges, counts, width=1.2),
    )
    high = 1.05 * max(float(counts.max()), mean + 2 * spread)
    left = Stack((Panel(Axis("pixels", 0.0, high), marks),), Axis("p-value of the goodness of fit", 0.0, 1.0))
    found = columns["q"] <= rate
    ringed = found if is_strip(found.shape) or found.sum() <= 400 else None
    right = sensor_stack(
        columns["misfit"], (-4.0, 6.0), "misfit (σ)", ringed=ringed, ring="vermilion", whole=True
    )
    yield Figure(
        "goodness",
        "goodness",
        "Goodness of fit of all pixels",
        "p-values of the goodness of fit of all pixels (blue): uniform where the model holds (line; gray: 2 "
        "sigma), with a peak at 0 from pixels that the model does not describe. Map: chi-square as standard "
        f"normal deviate, clipped at −4 and 6; circles: misfits at a false-discovery rate of {rate:g}.",
        f"p-values and misfit of {count(tested, data.noun)}; {count(misfits, 'misfit')} at a false-discovery "
        f"rate of {rate:g}.",
        (table,),
        Chart((left, right), (1.0, 1.15)),
        PAGE_MM,
    )


def map_tables(
    values: NDArray[Any], name: str, stderr: NDArray[Any] | None, known: Ordered
) -> tuple[DataTable, ...]:
    """Return a map (y, x) with its standard errors, and the histogram of its known values if one is drawn."""
    unit = stored_unit(name)
    columns = {name: values} if stderr is None else {name: values, "standard error": stderr}
    table = DataTable(columns, dict.fromkeys(columns, unit))
    if not is_strip(values.shape):
        return table, _histogram_table(known, name, _MOST_BINS)
    return (table, _histogram_table(known, name, _MOST_BINS // 2)) if known.size >= FEW_CHANNELS else (table,)


def _histogram_table(known: Ordered, name: str, most: int) -> DataTable:
    """Return the histogram of a map as it is drawn: pixels in each of at most so many bins, and its ends."""
    edges = histogram_edges(known, robust_range(known), most=most)
    counts = known.histogram(edges)
    columns = {f"{name} from": edges[:-1], f"{name} to": edges[1:], "pixels": counts}
    return DataTable(columns, dict.fromkeys(list(columns)[:2], stored_unit(name)), "histogram")


def map_chart(tables: Sequence[DataTable], name: str, known: Ordered) -> Chart:
    """Return the chart of :func:`map_tables`: the histogram, the map below (Appendix C; fig:iD_map ...).

    A sensor of one row or column (ready-made histograms) is drawn as points with error bars.
    """
    full = tables[0][name]
    sign, words, unit = symbol(name)
    label = f"{words} {sign} ({unit})"
    if is_strip(full.shape):
        return _channels_chart(tables, full.ravel().astype(np.float64), label)
    edges, bar = map_colours(known)
    keys = (("no_value", f"no value: {count(known.n_missing, 'pixel')}"),) if known.n_missing else ()
    image = Image(full, *place_of(full.shape), edges=edges, bar=bar, unit=f"{sign} ({unit})")
    return Chart((_histogram_stack(known, tables[1], label), image_stack(image)), keys=keys)


def _histogram_stack(known: Ordered, bins: DataTable, label: str, height_mm: float = 34.0) -> Stack:
    shown = robust_range(known)
    left, right, counts = (bins[name] for name in bins.columns)
    x = Axis(label, shown.low, shown.high, log=shown.logarithmic)
    edges = np.append(left, right[-1])
    outline = Steps(edges, counts, filled=True, colour="bars", label="pixels", listed=False)
    median = (Level(known.median, "x", width=1.0, label="median", listed=False),) if known.size else ()
    words = shown.remark() if known.size else "no pixel has a value"
    # room for the words above the bars
    high = (1.3 if words else 1.05) * max(float(counts.max()), 1.0)
    panel = Panel(Axis("pixels", 0.0, high), (outline, *median), note=words)
    return Stack((panel,), x, height_mm=height_mm)


def _channels_chart(tables: Sequence[DataTable], values: FloatArray, label: str) -> Chart:
    """Return a line of channels as points with error bars, and their histogram if they are many."""
    many, shown = len(tables) > 1, robust_range(values)
    stderr = tables[0].get("standard error")
    inside = np.isfinite(values) & (values >= shown.low) & (values <= shown.high)
    errors = None
    if stderr is not None and not shown.logarithmic:
        errors = np.tile(np.nan_to_num(stderr.ravel()[inside], nan=0.0, posinf=0.0), (2, 1))
    size, cap = (1.5, 0.0) if many else (3.0, 2.0)
    channels = np.arange(values.size)
    points = Points(
        channels[inside], values[inside], size=size, error=errors, cap=cap, label=label, listed=False
    )
    y = Axis(label, log=shown.logarithmic)
    if many or shown.n_outside:
        margin = 0.06 * (shown.high - shown.low)
        low, high = shown.low - margin, shown.high + margin
        if shown.logarithmic:
            low, high = shown.low / 1.1, shown.high * 1.1
        y = replace(y, low=low, high=high)
    missing, remark = channels[~np.isfinite(values)], shown.remark()
    marks: tuple[Mark, ...] = (points,)
    if missing.size:
        low, high = y_window(Panel(y, marks))
        bottom = low * (high / low) ** 0.03 if y.log else low + 0.03 * (high - low)
        crosses = Points(missing, np.full(missing.size, bottom), mark="x", size=4.0, colour="vermilion")
        marks, remark, y = (points, crosses), f"{remark} (×)", replace(y, low=low, high=high)
    stack = Stack((Panel(y, marks, note=remark),), channel_axis(values.size), height_mm=52.0)
    if not many:
        return Chart((stack,))
    return Chart((_histogram_stack(Ordered.of(values), tables[1], label, 40.0), stack))


def status_chart(
    status: NDArray[Any], rows: Sequence[tuple[FitStatus, str, int]], unfitted: BoolArray | None = None
) -> Chart:
    """Return where fits failed or deserve caution, with a legend of sentences.

    A pixel with several bits has the colour of the first of them in the rows of :func:`reasons_in`; every bit
    counts in the legend. Pixels that no fit has reached yet have a colour of their own.
    """
    last = len(_STATUS_COLOURS) - 1
    missing = np.zeros(status.shape, bool) if unfitted is None else unfitted & (status == 0)
    colour_of_word = np.zeros(int(status.max(initial=0)) + 1, np.uint8)
    for index in range(len(rows), 0, -1):
        colour_of_word[(np.arange(colour_of_word.size) & int(rows[index - 1][0])) != 0] = min(index, last - 1)
    colour = colour_of_word[status]
    colour[missing] = last
    n_missing = int(missing.sum())
    keys = [("band", f"good fit: {_share(int((status == 0).sum()) - n_missing, status.size)}")]
    if unfitted is not None and unfitted.any():
        keys.append((_STATUS_COLOURS[last], f"not fitted yet: {_share(n_missing, status.size)}"))
    keys += [
        (_STATUS_COLOURS[min(i + 1, last - 1)], plain(f"{text}: {_share(n, status.size)}"))
        for i, (_, text, n) in enumerate(rows)
    ]
    if not is_strip(status.shape):
        edges = np.arange(last) + 0.5
        image = Image(colour, *place_of(status.shape), edges=edges, scale=_STATUS_COLOURS)
        return Chart((image_stack(image),), keys=tuple(keys))
    flat = colour.ravel()
    bars = []
    for found, text in keys:
        places = np.flatnonzero(flat == _STATUS_COLOURS.index(found))
        ends = np.zeros(places.size), np.ones(places.size)
        bars.append(Bars(places, *ends, broad=0.9, colour=found, label=text, listed=False))
    panel = Panel(Axis("", 0.0, 1.0, ticks=((-1.0, ""),)), tuple(bars))
    return Chart((Stack((panel,), channel_axis(status.size), height_mm=30.0),), keys=tuple(keys))


def _share(part: int, whole: int) -> str:
    return f"{part:,} ({percent(part, whole)})".replace(" ", "\N{NO-BREAK SPACE}")
