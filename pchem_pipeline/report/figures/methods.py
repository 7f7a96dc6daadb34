"""The figure of the comparison of methods: relative error of the gain against the read noise."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.wording import short
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Dash,
    Level,
    Line,
    Mark,
    Panel,
    Points,
    Shape,
    Stack,
    Words,
    x_window,
)
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure, row_stack

#: Points of a study at several read noises, or methods with their errors, as in ``methods.json``.
_Rows = Sequence[Mapping[str, Any]]

#: Method to the hue, or colour, of its line, and its marker.
_MARKS: dict[str, tuple[str, Shape]] = {
    "pchem_em": ("blue", "o"),
    "plain_em": ("sky", "v"),
    "pchem_em_joint": ("#003A5C", "d"),
    "dark_and_bright_mle": ("green", "D"),
    "photon_transfer": ("vermilion", "s"),
    "photon_transfer_series": ("orange", "^"),
    "emva1288": ("ink", "*"),
    "cumulants": ("purple", "P"),
    "peak_valley": ("#8C6D1F", "X"),
}
_BOUNDS: tuple[tuple[str, Dash, str], ...] = (
    ("one sample", "-", "bound, one sample"),
    ("a dark and a bright sample", "--", "bound, dark and bright"),
)
_OTHER: tuple[str, Shape] = ("#666666", "h")
_RANGE = (0.03, 60.0)  # %


def method_figures(data: ReportData) -> Iterator[Figure]:
    """Return the figure of the comparison, where one was made."""
    if (result := data.methods) is None:
        return
    study, known = result["study"], [method for method in result["methods"] if method["errors"]]
    if not (known or study):
        return
    words = [
        f"{method['title']}: {percent_text(method['errors']['conversion_gain']['rmse'])} %"
        for method in known
    ]
    crossing = f" {crossing_text(study)}." if study else ""
    letters = ("(a) ", "(b) ") if study and known else ("", "")
    stacks = [_study(study, letters[0])] if study else []
    stacks += [_run(known, letters[1])] if known else []
    tables = []
    if study:
        columns: dict[str, Any] = {"read_noise_e": [point["read_noise_e"] for point in study]}
        for name in study[0]["methods"]:
            gain = [point["methods"][name]["errors"]["conversion_gain"] for point in study]
            columns[f"{name}: rms error of g"] = _numbers(each["rmse"] for each in gain)
        for name in study[0]["bounds"]:
            columns[f"limit, {name}"] = _numbers(point["bounds"][name] for point in study)
        tables.append(DataTable(columns, {"read_noise_e": "e-"}, "simulated"))
    gain = [method["errors"]["conversion_gain"] for method in known]
    numbers = {key: _numbers(each[key] for each in gain) for key in ("bias", "rmse", "robust_sd", "bound")}
    tables.append(DataTable({"method": [method["name"] for method in known], **numbers}, part="run"))
    yield Figure(
        "methods_gain_error",
        "methods",
        "Error of the conversion gain by each method",
        "Left or top: simulated pixels at the exposure and gain of this run, same total number of frames "
        "for every method; hollow symbols: no answer for more than a tenth of the pixels. Lines without "
        "symbols: smallest possible errors (Cramer-Rao bound) from one sample, and from a dark and a bright "
        "one; dotted line: above this read noise photon transfer is more precise than one sample. Right or "
        "bottom: pixels of this run; filled: root mean square error, hollow: robust scatter, bar: bound. "
        "Errors are clipped at 180 %.",
        f"Root mean square error of the gain on this run's pixels. {'; '.join(words)}.{crossing}",
        tuple(tables),
        Chart(tuple(stacks), (2.3, 1.0) if len(stacks) > 1 else (1.0,)),
        PAGE_MM,
    )


def _numbers(values: Iterable[float | None]) -> FloatArray:
    return np.array(list(values), np.float64)  # None becomes NaN


def percent_text(value: float | None) -> str:
    """Return a share in percent with three digits; a dash where it is not known."""
    return "-" if value is None else f"{100 * value:.3g}"


def _study(study: _Rows, letter: str) -> Stack:
    noise = np.array([point["read_noise_e"] for point in study])
    marks: list[Mark] = []
    for name, method in study[0]["methods"].items():
        colour, shape = _MARKS.get(name, _OTHER)
        rmse, share = _curve(study, name)
        many = share >= 0.9
        marks += [
            Line(noise, rmse, colour=colour, width=0.8, alpha=0.75),
            Points(noise[many], rmse[many], shape, 4.0, colour=colour, label=method["title"]),
            Points(noise[~many], rmse[~many], shape, 4.0, face="paper", colour=colour),
        ]
    for name, dash, label in _BOUNDS:
        bound = 100 * _numbers(point["bounds"][name] for point in study)
        marks.append(Line(noise, bound, colour="ink", dash=dash, label=label))
    crossing = bound_crossing(study)
    if crossing is not None:
        words = Words(crossing, 0.02, f" {crossing:.2f} e⁻", "left", colour="faint")
        marks += [Level(crossing, "x", colour="#999999", width=0.7, dash=":"), words]
    ticks = ((0.1, "0.1"), (1.0, "1"), (10.0, "10"), (100.0, "100"))
    y = Axis("rms error of the gain (%)", _RANGE[0], 150 * _RANGE[1], log=True, ticks=ticks)
    panel = Panel(y, tuple(marks), legend="upper left", columns=2)
    title = f"{letter}simulated pixels, as many frames for each"
    return Stack((panel,), Axis("read noise (e⁻)"), title, height_mm=86.0)


def _curve(study: _Rows, name: str) -> tuple[FloatArray, FloatArray]:
    """Return the rms error of the gain in % and the share of pixels with an answer, at every read noise."""
    rmse, share = [], []
    for point in study:
        method = point["methods"][name]
        value = method["errors"]["conversion_gain"]["rmse"]
        part = method["n_answered"] / max(method["n_pixels"], 1)
        rmse.append(np.nan if value is None or part < 0.05 else min(100 * value, 3 * _RANGE[1]))
        share.append(part)
    return np.array(rmse), np.array(share)


def _run(known: _Rows, letter: str) -> Stack:
    marks: list[Mark] = [Level(float(row), colour="grid", width=0.5) for row in range(len(known))]
    for row, method in enumerate(known):
        gain = method["errors"]["conversion_gain"]
        colour, shape = _MARKS.get(method["name"], _OTHER)
        for value, what in (
            (gain["rmse"], {"mark": shape, "size": 5.0, "colour": colour}),
            (gain["robust_sd"] or None, {"mark": shape, "size": 5.0, "colour": colour, "face": "paper"}),
            (gain["bound"], {"mark": "|", "size": 9.0, "colour": "ink"}),
        ):
            if value is not None:
                marks.append(Points(np.array([100 * value]), np.array([row]), **what))
    titles = [method["title"] for method in known]
    stack = row_stack(titles, marks, Axis("error of the gain (%)", log=True), f"{letter}this run's pixels")
    # a method that repeats the reference has no scatter against it
    low, high = x_window(stack)
    return replace(stack, x=replace(stack.x, low=max(low, _RANGE[0]), high=high))


def bound_crossing(study: _Rows) -> float | None:
    """Return the read noise, e-, at which photon transfer's error falls below the bound of one sample."""
    bounds = ((point["read_noise_e"], point["bounds"]) for point in study)
    return _crossing((noise, bound["one sample"], bound["photon_transfer"]) for noise, bound in bounds)


def measured_crossing(study: _Rows) -> float | None:
    """Return the same from the simulated pixels: PCH-EM of one sample against two-sample photon transfer."""
    methods = ((point["read_noise_e"], point["methods"]) for point in study)
    return _crossing(
        (noise, _gain_rmse(found["pchem_em"]), _gain_rmse(found["photon_transfer"]))
        for noise, found in methods
    )


def _gain_rmse(method: Mapping[str, Any]) -> float | None:
    """Return the rms error of the gain; None where only the easy pixels, less than half, have a value."""
    found: float | None = method["errors"]["conversion_gain"]["rmse"]
    return found if method["n_answered"] >= 0.5 * method["n_pixels"] else None


def _crossing(rows: Iterable[tuple[float, float | None, float | None]]) -> float | None:
    """Interpolate the read noise at which one error grows above another; None if they do not cross."""
    known = sorted((noise, np.log(one / other)) for noise, one, other in rows if one and other)
    for (x0, y0), (x1, y1) in itertools.pairwise(known):
        if y0 < 0 <= y1:
            return float(x0 + (x1 - x0) * y0 / (y0 - y1))
    return None


def crossing_text(study: _Rows) -> str:
    """Say up to which read noise one-sample PCH-EM beats photon transfer with as many frames."""
    expected, measured = bound_crossing(study), measured_crossing(study)
    both = ((expected, "by the Cramer-Rao bound"), (measured, "on the simulated pixels"))
    parts = [f"{short(noise, 2)} e- {words}" for noise, words in both if noise is not None]
    if not parts:
        return "the errors of one-sample PCH-EM and two-sample photon transfer do not cross in this range"
    return (
        "one-sample PCH-EM is more precise in the gain than two-sample photon transfer with the same number "
        f"of frames up to a read noise of {', '.join(parts)}; above it, take several exposures"
    )
