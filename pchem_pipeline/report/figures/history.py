"""Figure of runs over time: medians and scatter of the maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pchem_pipeline.report.charts.chart import PAGE_MM, Axis, Band, Chart, Line, Panel, Points, Stack
from pchem_pipeline.report.comparison import Against, HistoryRow
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.style.wording import short, symbol

_SHOWN = ("quanta_exposure", "charge_rate", "dark_current", "conversion_gain", "bias", "read_noise_e")


#: Letters of the labels of all runs that an axis has room for, and ticks at most.
_LETTERS, _MOST_TICKS = 48, 12
#: Days of a history that is drawn against time.
_SHORTEST = 0.04
_AXES = {"date": "days since the first", "temperature": "sensor temperature, °C", "label": "label"}


def history_figures(rows: Sequence[HistoryRow], against: Against) -> Iterator[Figure]:
    """Return the medians of the maps of each run; none for fewer than two runs."""
    shown = [name for name in _SHOWN if all(name in row.run.summary for row in rows)]
    if len(rows) < 2 or not shown:
        return
    places = np.array([row.place for row in rows])
    ordered = bool(np.isfinite(places).all() and np.unique(places).size > 1)
    by_date = ordered and against == "date"
    if by_date and np.ptp(places) < _SHORTEST:  # runs within an hour are drawn in their order
        ordered = by_date = False
    at = places - (places.min() if by_date else 0.0) if ordered else np.arange(len(rows), dtype=np.float64)
    axis = _AXES[against] if ordered else "run"
    columns: dict[str, object] = {
        "run": [row.run.name for row in rows],
        "label": [row.label for row in rows],
        axis: at,
    }
    if axis in ("run", "label"):
        columns = {"name": columns["run"], "text": columns["label"], axis: at}
    units = {}
    for name in shown:
        for part, key in enumerate(("median", "standard error", "scatter")):
            heading = f"{name} {key}"
            columns[heading] = [row.run.summary[name][part] for row in rows]
            units[heading] = symbol(name)[2].replace("e⁻", "e-")
    table = DataTable(columns, units)  # type: ignore[arg-type]
    first, last = rows[0], rows[-1]
    words = "; ".join(
        f"{symbol(name)[1]} from {short(first.run.summary[name][0])} to {short(last.run.summary[name][0])} "
        f"{symbol(name)[2]}"
        for name in shown
    )
    yield Figure(
        "history",
        "",
        "The camera over time",
        "Medians of the maps with their standard errors; band: scatter of the pixels.",
        f"From {first.label} to {last.label}: {words}.",
        (table,),
        _history_chart(table, tuple(shown), axis, () if ordered else _labels(rows)),
        PAGE_MM,
    )


def _labels(rows: Sequence[HistoryRow]) -> tuple[tuple[float, str], ...]:
    """Return a tick for each run in its order, by its label where there is room, else by its letter."""
    texts = [row.label for row in rows]
    if sum(map(len, texts)) > _LETTERS:
        texts = [row.run.label for row in rows]
    every = -(-len(rows) // _MOST_TICKS)
    return tuple((float(i), texts[i]) for i in range(0, len(rows), every))


def _history_chart(
    table: DataTable, names: tuple[str, ...], axis: str, ticks: tuple[tuple[float, str], ...] = ()
) -> Chart:
    """Return the chart with a panel for each map: median with its error, and the scatter of the pixels."""
    order = np.argsort(table[axis], kind="stable")
    at = table[axis].astype(np.float64)[order]
    panels = []
    for name in names:
        median, error, scatter = (
            table[f"{name} {part}"].astype(np.float64)[order]
            for part in ("median", "standard error", "scatter")
        )
        marks = (
            Band(at, median - scatter, median + scatter, alpha=0.15, label="scatter of the pixels"),
            Line(at, median),
            Points(at, median, size=3.0, error=np.stack([error, error]), label="median"),
        )
        sign, _, unit = symbol(name)
        panels.append(Panel(Axis(f"{sign} ({unit})"), marks))
    return Chart((Stack(tuple(panels), Axis(axis, ticks=ticks), height_mm=26.0 * len(names) + 10.0),))
