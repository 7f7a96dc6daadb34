"""The figure of the comparison of methods: relative error of the gain against the read noise."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.palette import Palette
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, styled
from pchem_pipeline.report.style.wording import short

_CAPTION = (
    "Left or top: simulated pixels at the exposure and gain of this run, as many frames in total for "
    "every method; hollow symbols: more than a tenth of the pixels got no answer. Lines without symbols "
    "are the smallest errors possible (Cramer-Rao), from one sample and from a dark and a bright one; the "
    "dotted line is where photon transfer begins to beat that of one sample. Right or bottom: pixels of "
    "this run; filled: root mean square error, hollow: robust scatter, bar: bound. "
    "Errors above 180 % are drawn there."
)

#: Method to the hue, or colour, of its line, and its marker.
_MARKS = {
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
_RANGE = (0.03, 60.0)  # %


def method_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the figure of the comparison, where one was made."""
    result = data.methods
    if result is None:
        return []
    known = [method for method in result["methods"] if method["errors"]]
    words = [
        f"{method['title']}: {percent_text(method['errors']['conversion_gain'].get('rmse'))} %"
        for method in known
    ]
    crossing = f" {crossing_text(result['study'])}." if result["study"] else ""
    return [
        Figure(
            "methods_gain_error",
            "methods",
            "Error of the conversion gain by each method",
            _CAPTION,
            f"Root mean square error of the gain on this run's pixels. {'; '.join(words)}.{crossing}",
            method_tables(result),
            partial(draw_methods, result=result),
            PAGE_MM,
        )
    ]


def method_tables(result: Mapping[str, Any]) -> tuple[DataTable, ...]:
    """Return the errors on simulated pixels, where there are any, and on the pixels of the run.

    Args:
        result: content of ``methods.json``.
    """
    tables = []
    if result["study"]:
        study = result["study"]
        columns: dict[str, Any] = {"read_noise_e": [point["read_noise_e"] for point in study]}
        for name in study[0]["methods"]:
            gain = [point["methods"][name]["errors"]["conversion_gain"] for point in study]
            columns[f"{name}: rms error of g"] = [_number(each["rmse"]) for each in gain]
        for name in study[0]["bounds"]:
            columns[f"limit, {name}"] = [_number(point["bounds"][name]) for point in study]
        tables.append(DataTable(columns, {"read_noise_e": "e-"}, "simulated"))
    known = [method for method in result["methods"] if method["errors"]]
    gain = [method["errors"]["conversion_gain"] for method in known]
    numbers = {key: [_number(each[key]) for each in gain] for key in ("bias", "rmse", "robust_sd", "bound")}
    return (*tables, DataTable({"method": [method["name"] for method in known], **numbers}, part="run"))


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def percent_text(value: float | None) -> str:
    """Return a share in percent with three digits; a dash where it is not known."""
    return "-" if value is None else f"{100 * value:.3g}"


def _mark(colours: Palette, name: str) -> tuple[str, str]:
    """Return the colour and the marker of a method."""
    hue, marker = _MARKS.get(name, ("#666666", "h"))
    return (hue if hue.startswith("#") else getattr(colours, hue)), marker


@styled
def draw_methods(look: Look, *, result: Mapping[str, Any]) -> Drawing:
    """Draw the error of the gain against the read noise (simulated), and that on the run's own pixels.

    Args:
        look: width and colours.
        result: content of ``methods.json``.
    """
    study, known = result["study"], [m for m in result["methods"] if m["errors"]]
    panels = [draw for draw, there in ((_study, study), (_run, known)) if there]
    wide = look.wide and len(panels) == 2
    heights = [86.0 if draw is _study else 16.0 + 7.0 * len(known) for draw in panels]
    figure = look.empty(max(heights) if wide else max(sum(heights), 40.0))
    if not panels:
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.text(0.5, 0.5, "nothing to compare", ha="center", va="center")
        return figure
    layout: dict[str, Any] = {"width_ratios": (1.5, 1.0)} if wide else {"height_ratios": heights}
    rows, columns = (1, len(panels)) if wide else (len(panels), 1)
    grid = figure.subplots(rows, columns, squeeze=False, **layout).ravel()
    for axes, draw, letter in zip(grid, panels, "ab", strict=False):
        draw(axes, study if draw is _study else known, f"({letter})" if len(panels) > 1 else "")
    return figure


def _study(axes: Axes, study: Sequence[Mapping[str, Any]], letter: str) -> None:
    noise, colours = np.array([point["read_noise_e"] for point in study]), colours_of(axes)
    for name, method in study[0]["methods"].items():
        colour, marker = _mark(colours, name)
        rmse, share = _curve(study, name)
        many = share >= 0.9
        axes.plot(noise, rmse, color=colour, linewidth=0.8, alpha=0.75)
        axes.plot(noise[many], rmse[many], marker, color=colour, markersize=4, label=method["title"])
        axes.plot(
            noise[~many], rmse[~many], marker, color=colour, markersize=4, markerfacecolor=colours.paper
        )
    bounds = (
        ("one sample", "-", "bound, one sample"),
        ("a dark and a bright sample", "--", "bound, dark and bright"),
    )
    for name, dashes, label in bounds:
        values = [point["bounds"][name] for point in study]
        shown = [np.nan if v is None else 100 * v for v in values]
        axes.plot(noise, shown, dashes, color=colours.ink, label=label)
    crossing = bound_crossing(study)
    if crossing is not None:
        axes.axvline(crossing, ymax=0.75, color="#999999", linewidth=0.7, linestyle=":")
        axes.text(crossing, _RANGE[0] * 1.15, f" {crossing:.2f} e⁻", fontsize=6.5, color=colours.faint)
    axes.set(yscale="log", ylim=_RANGE, xlabel="read noise (e⁻)", ylabel="rms error of the gain (%)")
    axes.set_title(f"{letter} simulated pixels, as many frames for each".strip())
    axes.legend(
        fontsize=6.0, loc="upper left", ncols=2, handlelength=1.2, columnspacing=0.8, labelspacing=0.25
    )
    axes.set_ylim(_RANGE[0], 40 * _RANGE[1])
    axes.set_yticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])


def _curve(
    study: Sequence[Mapping[str, Any]], name: str
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the rms error of the gain in % and the share of pixels with an answer, at every read noise."""
    rmse, share = [], []
    for point in study:
        method = point["methods"][name]
        value = method["errors"]["conversion_gain"]["rmse"]
        part = method["n_answered"] / max(method["n_pixels"], 1)
        rmse.append(np.nan if value is None or part < 0.05 else min(100 * value, 3 * _RANGE[1]))
        share.append(part)
    return np.array(rmse), np.array(share)


def _run(axes: Axes, known: Sequence[Mapping[str, Any]], letter: str) -> None:
    rows, colours = np.arange(len(known))[::-1], colours_of(axes)
    for row, method in zip(rows, known, strict=True):
        gain = method["errors"]["conversion_gain"]
        colour, marker = _mark(colours, method["name"])
        if gain["rmse"] is not None:
            axes.plot(100 * gain["rmse"], row, marker, color=colour, markersize=5)
        if gain["robust_sd"]:
            axes.plot(
                100 * gain["robust_sd"],
                row,
                marker,
                color=colour,
                markersize=5,
                markerfacecolor=colours.paper,
            )
        if gain["bound"] is not None:
            axes.plot(100 * gain["bound"], row, "|", color=colours.ink, markersize=9, markeredgewidth=1.4)
    axes.set_yticks(rows, [method["title"] for method in known], fontsize=6.5)
    axes.set(xscale="log", ylim=(-0.6, len(known) - 0.4), xlabel="error of the gain (%)")
    # a method that repeats the reference has no scatter against it
    axes.set_xlim(left=max(axes.get_xlim()[0], 0.03))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(axis="y", color=colours.grid, linewidth=0.5)
    axes.set_title(f"{letter} this run's pixels".strip())


def gain_rmse(point: Mapping[str, Any], name: str) -> float | None:
    """Return the rms error of the gain by a method; None where it answered for less than half the pixels."""
    method = point["methods"][name]
    # of few answered pixels the easy ones are left
    if method["n_answered"] < 0.5 * method["n_pixels"]:
        return None
    found = method["errors"]["conversion_gain"]["rmse"]
    return None if found is None else float(found)


def bound_crossing(study: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the read noise, e-, at which photon transfer's error falls below the bound of one sample."""
    return _crossing(
        study,
        [point["bounds"]["one sample"] for point in study],
        [point["bounds"]["photon_transfer"] for point in study],
    )


def measured_crossing(study: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the same from the simulated pixels: PCH-EM of one sample against two-sample photon transfer."""
    return _crossing(
        study,
        [gain_rmse(point, "pchem_em") for point in study],
        [gain_rmse(point, "photon_transfer") for point in study],
    )


def _crossing(
    study: Sequence[Mapping[str, Any]], one: Sequence[float | None], other: Sequence[float | None]
) -> float | None:
    """Interpolate where ``one`` grows above ``other``; None where it does not, or is above from the start."""
    known = sorted(
        (point["read_noise_e"], np.log(a / b))
        for point, a, b in zip(study, one, other, strict=True)
        if a and b
    )
    for (x0, y0), (x1, y1) in itertools.pairwise(known):
        if y0 < 0 <= y1:
            return float(x0 + (x1 - x0) * y0 / (y0 - y1))
    return None


def crossing_text(study: Sequence[Mapping[str, Any]]) -> str:
    """Say up to which read noise one-sample PCH-EM beats photon transfer with as many frames."""
    expected, measured = bound_crossing(study), measured_crossing(study)
    if expected is None and measured is None:
        return "one-sample PCH-EM and two-sample photon transfer do not cross in the read noises simulated"
    parts = []
    if expected is not None:
        parts.append(f"{short(expected, 2)} e- by the Cramer-Rao bound")
    if measured is not None:
        parts.append(f"{short(measured, 2)} e- on the simulated pixels")
    return (
        "one-sample PCH-EM knows the gain better than two-sample photon transfer with as many frames up to a "
        f"read noise of {', '.join(parts)}; above it, take several exposures"
    )
