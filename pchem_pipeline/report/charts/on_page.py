"""Charts as the numbers that the page's script draws."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, replace
from typing import Any

import numpy as np

from pchem_pipeline.base.wording import without_formulas
from pchem_pipeline.report.charts.chart import (
    Axis,
    Chart,
    Image,
    Line,
    Mark,
    Points,
    Stack,
    Steps,
    Values,
    extremes,
    fewer_steps,
    x_window,
    y_window,
)
from pchem_pipeline.report.style.palette import DARK, LIGHT

#: Columns of a curve that the page keeps, with two values each, and steps of a histogram.
_COLUMNS, _STEPS = 2000, 4000
#: Parts of an axis to which numbers are kept: some hundred to a dot of a screen.
_PARTS = 5

Ends = tuple[float, float]


def page_charts(charts: Mapping[str, Chart]) -> dict[str, Any]:
    """Return charts by figure, and the colours for light and dark paper, as plain data."""
    return {
        "colours": {"light": asdict(LIGHT), "dark": asdict(DARK)},
        "charts": {name: page_chart(chart) for name, chart in charts.items()},
    }


def page_chart(chart: Chart) -> dict[str, Any]:
    """Return a chart as plain data: numbers rounded to what a screen shows, long curves thinned."""
    return {"widths": list(chart.widths), "stacks": [_stack(stack) for stack in chart.stacks]}


def _stack(stack: Stack) -> dict[str, Any]:
    ends = x_window(stack)
    return {
        "title": without_formulas(stack.title),
        "height": stack.height_mm,
        "x": _axis(stack.x, ends),
        "panels": [
            {"height": panel.height, "y": _axis(panel.y, up)}
            | ({"note": without_formulas(panel.note), "corner": panel.corner} if panel.note else {})
            | {"marks": [_mark(mark, (ends, stack.x.log), (up, panel.y.log)) for mark in panel.marks]}
            for panel in stack.panels
            for up in [y_window(panel)]
        ],
    }


def _axis(axis: Axis, ends: Ends) -> dict[str, Any]:
    """Return an axis; what it has as every other is left out."""
    ticks = [[place, without_formulas(text)] for place, text in axis.ticks]
    rest = {"log": axis.log, "linear": axis.linear_to, "whole": axis.whole, "ticks": ticks}
    return {
        "label": without_formulas(axis.label),
        "ends": rounded(np.asarray(ends), ends, axis.log),
        **{name: value for name, value in rest.items() if value},
    }


def _places(values: Values, ends: Ends, log: bool) -> list[float | None] | dict[str, float]:
    """Return places along an axis; evenly spaced ones as the first, the step and their number."""
    if values.size > 3:
        step = (values[-1] - values[0]) / (values.size - 1)
        even = values[0] + step * np.arange(values.size)
        if step and np.abs(values - even).max() < 1e-6 * abs(step):
            return {"from": float(values[0]), "step": float(f"{step:.12g}"), "n": values.size}
    return rounded(values, ends, log)


def rounded(values: Values, ends: Ends, log: bool = False) -> list[float | None]:
    """Return numbers with the decimals that an axis between these ends can show; None where there is none."""
    if log:
        return [float(f"{value:.{_PARTS}g}") if math.isfinite(value) else None for value in values.tolist()]
    decimals = _PARTS - math.floor(math.log10(ends[1] - ends[0]))
    found = (np.round(values, decimals) + 0.0).tolist()
    return [value if math.isfinite(value) else None for value in found]


def _mark(mark: Mark, x: tuple[Ends, bool], y: tuple[Ends, bool]) -> dict[str, Any]:
    """Return what the page draws of a mark between axes (ends, logarithmic); what all have is left out."""
    if isinstance(mark, Image):
        raise TypeError("the page cannot draw an Image")
    mark = _fewer(mark)
    found: dict[str, Any] = {"kind": type(mark).__name__.lower()}
    for field in fields(mark):
        name, value = _NAMES.get(field.name, field.name), getattr(mark, field.name)
        if field.name == "error":
            found |= {} if value is None else {name: [rounded(each, *y) for each in np.nan_to_num(value)]}
        elif isinstance(value, np.ndarray):
            values = value.astype(np.float64)
            found[name] = _places(values, *x) if name == "x" else rounded(values, *y)
        elif field.name in _ON_PAPER or value == getattr(Mark, field.name, None):
            continue
        elif value or field.default is MISSING:
            found[field.name] = without_formulas(value) if isinstance(value, str) else value
    return found


#: What the page's script calls arrays of a mark, and what paper alone shows of one.
_NAMES, _ON_PAPER = {"edges": "x", "values": "y", "high": "y"}, ("listed", "face", "cap")


def _fewer(mark: Mark) -> Mark:
    """Return a mark with no more numbers than a screen shows."""
    match mark:
        case Line():
            kept = extremes(mark.x, mark.y, _COLUMNS)
            return replace(mark, x=mark.x[kept], y=mark.y[kept])
        case Points() if mark.y.size > _STEPS:
            # with every k-th between them the cloud is as dense as before
            some = np.arange(0, mark.y.size, -(-2 * mark.y.size // _STEPS))
            kept = np.union1d(some, extremes(mark.x, mark.y, _STEPS // 4))
            error = None if mark.error is None else mark.error[:, kept]
            return replace(mark, x=mark.x[kept], y=mark.y[kept], error=error)
        case Steps():
            edges, values = fewer_steps(mark.edges, mark.values, _STEPS)
            return replace(mark, edges=edges, values=values)
    return mark
