"""The figure of the comparison of methods: relative error of the gain against the read noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pchem_pipeline.report.pages.method_words import bound_crossing
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GREEN,
    ORANGE,
    PAGE_MM,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    styled,
)

__all__ = ["gain_error"]

_LOOKS = {
    "pchem_em": (BLUE, "o"),
    "plain_em": (SKY, "v"),
    "pchem_em_joint": ("#003A5C", "d"),
    "dark_and_bright_mle": (GREEN, "D"),
    "photon_transfer": (VERMILION, "s"),
    "photon_transfer_series": (ORANGE, "^"),
    "emva1288": (BLACK, "*"),
    "cumulants": (PURPLE, "P"),
    "peak_valley": ("#8C6D1F", "X"),
}
_OTHER = ("#666666", "h")
_RANGE = (0.03, 60.0)  # %


@styled
def gain_error(result: Mapping[str, Any], *, width_mm: float = PAGE_MM) -> Figure:
    """Draw the error of the gain against the read noise (simulated), and that on the run's own pixels.

    Args:
        result: content of ``methods.json``.
        width_mm: width of the figure; panels stand side by side on a page, one above the other on a column.
    """
    study, known = result["study"], [m for m in result["methods"] if m["errors"]]
    panels = [draw for draw, there in ((_study, study), (_run, known)) if there]
    wide = width_mm > 1.5 * COLUMN_MM and len(panels) == 2
    heights = [86.0 if draw is _study else 16.0 + 7.0 * len(known) for draw in panels]
    figure = new_figure(width_mm, max(heights) if wide else max(sum(heights), 40.0))
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
    noise = np.array([point["read_noise_e"] for point in study])
    for name, method in study[0]["methods"].items():
        colour, marker = _LOOKS.get(name, _OTHER)
        rmse, share = _curve(study, name)
        many = share >= 0.9
        axes.plot(noise, rmse, color=colour, linewidth=0.8, alpha=0.75)
        axes.plot(noise[many], rmse[many], marker, color=colour, markersize=4, label=method["title"])
        axes.plot(noise[~many], rmse[~many], marker, color=colour, markersize=4, markerfacecolor="white")
    bounds = (
        ("one sample", "-", "bound, one sample"),
        ("a dark and a bright sample", "--", "bound, dark and bright"),
    )
    for name, dashes, label in bounds:
        values = [point["bounds"][name] for point in study]
        axes.plot(noise, [np.nan if v is None else 100 * v for v in values], dashes, color=BLACK, label=label)
    crossing = bound_crossing(study)
    if crossing is not None:
        axes.axvline(crossing, ymax=0.75, color="#999999", linewidth=0.7, linestyle=":")
        axes.text(crossing, _RANGE[0] * 1.15, f" {crossing:.2f} e⁻", fontsize=6.5, color="#444444")
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
    rows = np.arange(len(known))[::-1]
    for row, method in zip(rows, known, strict=True):
        gain = method["errors"]["conversion_gain"]
        colour, marker = _LOOKS.get(method["name"], _OTHER)
        if gain["rmse"] is not None:
            axes.plot(100 * gain["rmse"], row, marker, color=colour, markersize=5)
        if gain["robust_sd"]:
            axes.plot(
                100 * gain["robust_sd"], row, marker, color=colour, markersize=5, markerfacecolor="white"
            )
        if gain["bound"] is not None:
            axes.plot(100 * gain["bound"], row, "|", color=BLACK, markersize=9, markeredgewidth=1.4)
    axes.set_yticks(rows, [method["title"] for method in known], fontsize=6.5)
    axes.set(xscale="log", ylim=(-0.6, len(known) - 0.4), xlabel="error of the gain (%)")
    # a method that repeats the reference has no scatter against it
    axes.set_xlim(left=max(axes.get_xlim()[0], 0.03))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.5)
    axes.set_title(f"{letter} this run's pixels".strip())
