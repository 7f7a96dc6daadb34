"""Figures of a comparison of runs: maps of differences, ensembles over each other, the camera over time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.wording import (
    capitalised,
    count,
    measured,
    plain,
    power_of_ten,
    short,
    signed,
    stored_unit,
    symbol,
    unit_text,
)
from pchem_pipeline.model.checks.run_differences import LIMIT, MapDifference
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Band,
    Chart,
    Dash,
    Level,
    Line,
    Panel,
    Points,
    Span,
    Stack,
)
from pchem_pipeline.report.comparison import HistoryRow, Pair, RunFacts
from pchem_pipeline.report.data import MAP_NAMES
from pchem_pipeline.report.figures.ensemble import HALVES
from pchem_pipeline.report.figures.figure import DataTable, Figure, pull_stack, sensor_stack
from pchem_pipeline.report.style.palette import DIVERGING
from pchem_pipeline.report.style.ranges import finite

#: Hues and styles of the ensembles of runs.
_HUES = ("ink", "blue", "vermilion", "green", "orange", "purple", "sky")
_LINES: tuple[Dash, ...] = ("-", "--", "-.", ":")


def difference_figures(pair: Pair) -> list[Figure]:
    """Return the maps of differences of two runs, those that are not zero throughout."""
    shown = {name: each for name, each in pair.maps.items() if np.nan_to_num(each.difference).any()}
    return [_difference(pair, name, each) for name, each in shown.items()]


def _difference(pair: Pair, name: str, each: MapDifference) -> Figure:
    _, words, unit = symbol(name)
    label = f"{words} ({unit})" if name.startswith("read_noise") else words
    alt = (
        f"Map and histogram of the difference in {label}: median "
        f"{measured(each.median, each.median_stderr, unit)} ({signed(each.median_z)} sigma of one pixel); "
        f"scatter {short(each.spread_z, 2)} sigma; {count(each.n_changed, 'good pixel')} changed."
    )
    caption = "Line: N(0, 1), expected from sampling noise alone."
    if pair.same_data:
        caption = "Both runs use the same frames, so there is no sampling noise."
    title = f"{label}: {pair.other.label} − {pair.one.label}"
    return Figure(
        f"difference_{name}_{pair.key}",
        "",
        capitalised(label),
        f"{pair.other.label} − {pair.one.label}, in standard errors of each pixel. {caption}",
        alt,
        (DataTable({"difference": each.z}, {"difference": "standard errors"}),),
        difference_chart(each.z, each.n_changed, title, same_data=pair.same_data),
    )


def ensembles_figures(runs: Sequence[RunFacts]) -> Iterator[Figure]:
    """Return the ensembles of runs over each other, where at least two have one."""
    runs = [run for run in runs if "density" in run.ensemble]
    tables = ensemble_tables(runs) if len(runs) > 1 else ()
    if not tables:
        return
    highest = (run.ensemble["dn"][int(np.argmax(run.ensemble["density"]))] for run in runs)
    peaks = ", ".join(f"{run.title}: {int(dn)} DN" for run, dn in zip(runs, highest, strict=True))
    yield Figure(
        "ensembles",
        "",
        "Ensemble histograms of the runs",
        "All pixels of each run together, raw and after two-point non-uniformity correction. Strips: "
        f"difference from {runs[0].label} in counting errors; gray band: ±2.",
        f"Ensemble histograms of the runs; highest peaks at {peaks}.",
        tables,
        ensembles_chart(tables),
        PAGE_MM,
    )


def ensemble_tables(runs: Sequence[RunFacts]) -> tuple[DataTable, ...]:
    """Return the ensembles of runs, raw and after correction where all have it; errors are of counting."""
    tables = []
    for part, axis, prefix, _, unit, *_ in HALVES:
        if not all(axis in run.ensemble and np.sum(run.ensemble[f"{prefix}counts"]) > 0 for run in runs):
            continue
        curves = [_curve(run, axis, prefix) for run in runs]
        names = np.concatenate([[run.title] * x.size for run, (x, _, _) in zip(runs, curves, strict=True)])
        x, density, error = (np.concatenate(each) for each in zip(*curves, strict=True))
        units = {"signal": unit, "density": f"1/{unit}", "standard error": f"1/{unit}"}
        columns = {"run": names, "signal": x, "density": density, "standard error": error}
        tables.append(DataTable(columns, units, part))
    return tuple(tables)


def difference_chart(z: FloatArray, n_changed: int, title: str, *, same_data: bool) -> Chart:
    """Return the difference of a map of two runs in standard errors ``z``, (y, x), and its histogram.

    Beside this is N(0, 1), but for fits of the same frames, which have no sampling noise.
    """
    known = finite(z)
    limit = _limit(known, 4.0 if not same_data else 0.0)
    # a power of ten in which the differences have few digits
    power = int(np.floor(np.log10(limit))) if limit < 0.01 else 0
    unit, label = 10.0**power, f"{power_of_ten(power)} standard errors".strip()
    end = limit / unit
    top = sensor_stack(z / unit, (-end, end), label, scale=DIVERGING, title=plain(title))
    edge = limit if same_data else max(limit, LIMIT)
    note = f"{count(n_changed, 'good pixel')} changed"
    pulls = pull_stack(known / unit, edge / unit, f"difference ({label})", note, normal=not same_data)
    return Chart((top, pulls))


def _limit(known: FloatArray, least: float) -> float:
    """Return where the colours end: the 99 % quantile (the largest where that is 0), at least ``least``."""
    sizes = np.abs(known)
    if sizes.size == 0 or sizes.max() == 0.0:
        return max(least, 1.0)
    quantile = float(np.quantile(sizes, 0.99))
    return max(least, quantile if quantile > 0 else float(sizes.max()))


def ensembles_chart(tables: Sequence[DataTable]) -> Chart:
    """Return the chart of :func:`ensemble_tables`: runs over each other, raw and NUCed (fig:ensemble_plot).

    The strip below each shows the difference to the first run in standard errors of counting.
    """
    titles = {half.part: half.title for half in HALVES}
    stacks = tuple(_one_half(table, unit_text(table.units["signal"]), titles[table.part]) for table in tables)
    return Chart(stacks)


def _one_half(table: DataTable, unit: str, title: str) -> Stack:
    low, high = np.inf, -np.inf
    names = list(dict.fromkeys(table["run"].tolist()))
    curves = {
        name: tuple(table[column][table["run"] == name] for column in ("signal", "density", "standard error"))
        for name in names
    }
    first = curves[names[0]]
    lines, differences = [], []
    for number, (name, (x, density, noise)) in enumerate(curves.items()):
        colour, dash, label = _HUES[number % len(_HUES)], _LINES[number % len(_LINES)], plain(name)
        seen = x[density > density.max() / 300.0]
        low, high = min(low, float(seen[0])), max(high, float(seen[-1]))
        lines.append(Line(x, density, colour=colour, dash=dash, label=label, step=True))
        if number:
            there = [np.interp(first[0], x, values, left=0.0, right=0.0) for values in (density, noise)]
            error = np.hypot(there[1], first[2])
            z = np.divide(there[0] - first[1], error, out=np.zeros_like(error), where=error > 0)
            differences.append(Line(first[0], z, colour=colour, width=0.8, label=label, listed=False))
    margin = 0.04 * (high - low)
    marks = (Span(-2.0, 2.0, colour="band"), *differences, Level(0.0, colour="ink", width=0.5))
    # beyond the band of two standard errors at least
    reach = max(3.0, *(1.1 * float(np.max(np.abs(line.y), initial=0.0)) for line in differences))
    panels = (
        Panel(Axis(f"density (1/{unit})", low=0.0), tuple(lines), 3.0, legend="upper right", room=(1.3, 1.3)),
        Panel(Axis("difference\n(std. errors)", -reach, reach), marks, 1.0),
    )
    return Stack(panels, Axis(f"signal ({unit})", low - margin, high + margin), title, height_mm=72.0)


def _curve(run: RunFacts, axis: str, prefix: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, density, counts = (
        np.asarray(run.ensemble[each], dtype=np.float64)
        for each in (axis, f"{prefix}density", f"{prefix}counts")
    )
    total = max(float(counts.sum()), 1.0)
    step = float(np.median(np.diff(x))) if x.size > 1 else 1.0
    return x, density, np.sqrt(np.maximum(counts, 0.0)) / (total * step)


def history_figures(rows: Sequence[HistoryRow]) -> Iterator[Figure]:
    """Return the medians of the maps of each run, by labels or dates; none for fewer than two runs."""
    parts = {"median": "median", "standard error": "median_stderr", "scatter": "scatter"}
    shown = [name for name in ("quanta_exposure", *MAP_NAMES) if any(row[f"{name}_median"] for row in rows)]
    if len(rows) < 2 or not shown:
        return
    labelled = all(row["label"] != row["date"] for row in rows)
    places = np.array([_place(row, labelled) for row in rows])
    ordered = bool(np.isfinite(places).all() and np.unique(places).size > 1)
    by_date = ordered and not labelled
    if by_date and np.ptp(places) < 0.04:  # runs within an hour are drawn in their order
        ordered = by_date = False
    at = places - (places.min() if by_date else 0.0) if ordered else np.arange(len(rows), dtype=np.float64)
    axis = "days since the first" if by_date else "label" if ordered else "run"
    heads = ("run", "label") if by_date else ("name", "text")
    columns: dict[str, Any] = {
        heads[0]: [row["run"] for row in rows],
        heads[1]: [row["label"] for row in rows],
    }
    columns[axis], units = at, {}
    for name in shown:
        for words, part in parts.items():
            columns[f"{name} {words}"] = [float(row[f"{name}_{part}"] or "nan") for row in rows]
            units[f"{name} {words}"] = stored_unit(name)
    table = DataTable(columns, units)
    order = np.argsort(at, kind="stable")
    panels = []
    for name in shown:
        median, error, scatter = (np.array(columns[f"{name} {words}"])[order] for words in parts)
        marks = (
            Band(at[order], median - scatter, median + scatter, alpha=0.15, label="scatter of the pixels"),
            Line(at[order], median),
            Points(at[order], median, size=3.0, error=np.stack([error, error]), label="median"),
        )
        sign, _, unit = symbol(name)
        panels.append(Panel(Axis(f"{sign} ({unit})"), marks))
    x = Axis(axis, ticks=() if ordered else _labels(rows))
    words = "; ".join(
        f"{noun} from {short(medians[0])} to {short(medians[-1])} {unit}"
        for medians, (_, noun, unit) in ((columns[f"{name} median"], symbol(name)) for name in shown)
    )
    yield Figure(
        "history",
        "",
        "The camera over time",
        "Medians of the maps with their standard errors; band: scatter of the pixels.",
        f"From {rows[0]['label']} to {rows[-1]['label']}: {words}.",
        (table,),
        Chart((Stack(tuple(panels), x, height_mm=26.0 * len(shown) + 10.0),)),
        PAGE_MM,
    )


def _place(row: HistoryRow, labelled: bool) -> float:
    """Return the number that the label of a run begins with, or its days since 1970; NaN for neither."""
    if labelled:
        match = re.match(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)", row["label"])
        return float(match[1]) if match else float("nan")
    return datetime.fromisoformat(row["date"]).timestamp() / 86400.0 if row["date"] else float("nan")


def _labels(rows: Sequence[HistoryRow]) -> tuple[tuple[float, str], ...]:
    """Return a tick for each run in its order, by its label where there is room, else by its number."""
    texts = [row["label"] for row in rows]
    if sum(map(len, texts)) > 48:  # an axis has no room for them
        texts = [str(i + 1) for i in range(len(rows))]
    every = -(-len(rows) // 12)
    return tuple((float(i), texts[i]) for i in range(0, len(rows), every))
