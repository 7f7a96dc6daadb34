"""Figures of a comparison of runs: maps of differences in standard errors, and ensembles over each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.model.checks.run_differences import FAR, MapDifference
from pchem_pipeline.report.pages.compare_data import RunFacts
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    GREEN,
    NO_VALUE,
    ORANGE,
    PAGE_MM,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    note,
    plain,
    styled,
)
from pchem_pipeline.report.style.wording import count, power_of_ten

__all__ = ["difference_map", "ensembles"]

FloatArray = NDArray[np.float64]

#: Diverging colours whose ends differ in lightness order for every kind of colour vision.
_DIVERGING = "RdBu_r"
_COLOURS = (BLACK, BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
_LINES = ("-", "--", "-.", ":")
#: Colours end at the 99 % quantile of the differences, at least here, standard errors.
_LEAST = 4.0


@styled
def difference_map(
    found: MapDifference, title: str, *, same_data: bool, width_mm: float = COLUMN_MM
) -> Figure:
    """Draw the difference of a map of two runs in standard errors, and its histogram beside chance.

    Args:
        found: the difference.
        title: what is subtracted from what.
        same_data: both are fits of the same frames, for which N(0, 1) is not what chance gives.
        width_mm: width of the figure.
    """
    ny, nx = found.z.shape
    known = finite(found.z)
    limit = _limit(known, _LEAST if not same_data else 0.0)
    unit, label = _unit(limit)
    strip = min(ny, nx) < 2
    square = 0.25 <= ny / nx <= 4.0
    map_mm = 40.0 if strip else float(np.clip((width_mm - 24.0) * (ny / nx if square else 0.6), 26.0, 130.0))
    figure = new_figure(width_mm, map_mm + 46.0)
    top, bottom = figure.subplots(2, 1, height_ratios=(map_mm, 28.0))
    if strip:
        z = found.z.ravel() / unit
        top.axhspan(-2.0, 2.0, color=GRAY, alpha=0.4, linewidth=0)
        top.plot(np.arange(z.size), z, "o", color=BLUE, markersize=3)
        top.set(xlabel="channel", ylabel=label, xlim=(-0.5, z.size - 0.5))
    else:
        top.set_facecolor(NO_VALUE)
        image = top.imshow(
            found.z / unit, cmap=_DIVERGING, vmin=-limit / unit, vmax=limit / unit,
            interpolation="nearest", aspect="equal" if square else "auto",
        )  # fmt: skip
        top.set(xlabel="x (pixel)", ylabel="y (pixel)")
        for axis in (top.xaxis, top.yaxis):
            axis.set_major_locator(MaxNLocator(5, integer=True))
        bar = figure.colorbar(image, ax=top, fraction=0.05, pad=0.02, aspect=25, extend="both")
        bar.set_label(label)
    top.set_title(plain(title), fontsize=7.5)
    edge = limit if same_data else max(limit, FAR)
    _distribution(bottom, found.z / unit, edge / unit, chance=not same_data)
    bottom.set_xlabel(f"difference ({label})")
    note(bottom, f"{count(found.n_far, 'good pixel')} beyond ±{FAR:g}")
    return figure


def _unit(limit: float) -> tuple[float, str]:
    """Return a power of ten in which differences up to ``limit`` have few digits, and its words."""
    power = int(np.floor(np.log10(limit))) if limit < 0.01 else 0
    return 10.0**power, f"{power_of_ten(power)} standard errors".strip()


def _limit(known: FloatArray, least: float) -> float:
    """Return where the colours end: the 99 % quantile (the largest where that is 0), at least ``least``."""
    sizes = np.abs(known)
    if sizes.size == 0 or sizes.max() == 0.0:
        return max(least, 1.0)
    quantile = float(np.quantile(sizes, 0.99))
    return max(least, quantile if quantile > 0 else float(sizes.max()))


def _distribution(axes: Axes, z: FloatArray, edge: float, *, chance: bool) -> None:
    known = finite(z)
    edges = np.linspace(-edge, edge, 61)
    counts = np.histogram(np.clip(known, -edge, edge), edges)[0]
    axes.stairs(counts, edges, fill=True, color=GRAY)
    highest = float(np.max(counts, initial=1))
    if chance:
        x = np.linspace(-edge, edge, 601)
        normal = known.size * (edges[1] - edges[0]) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
        axes.plot(x, normal, color=BLUE, linewidth=0.9)
        highest = max(highest, float(normal.max()))
    axes.set_yscale("log")
    axes.set(xlim=(-edge, edge), ylim=(0.5, 5.0 * highest), ylabel="pixels")


@styled
def ensembles(runs: Sequence[RunFacts], *, width_mm: float = PAGE_MM) -> Figure:
    """Draw the ensemble histograms of runs over each other, raw and NUCed (fig:ensemble_plot).

    The strip below each shows the difference to the first run in standard errors of counting.

    Args:
        runs: those with an ensemble.
        width_mm: width of the figure.
    """
    halves = [
        (axis, name, unit, title)
        for axis, name, unit, title in (
            ("dn", "", "DN", "raw ensemble"),
            ("electrons", "nuced_", "e⁻", "after non-uniformity correction"),
        )
        if all(axis in run.ensemble and np.sum(run.ensemble[f"{name}counts"]) > 0 for run in runs)
    ]
    figure = new_figure(width_mm, max(72.0 * len(halves), 30.0))
    if not halves:
        axes = figure.add_subplot()
        axes.text(0.5, 0.5, "no ensemble histograms", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return figure
    grid = figure.subplots(2 * len(halves), 1, height_ratios=[3.0, 1.0] * len(halves), squeeze=False)[:, 0]
    for i, (axis, name, unit, title) in enumerate(halves):
        _one_half(grid[2 * i], grid[2 * i + 1], runs, (axis, name, unit))
        grid[2 * i].set_title(title)
    return figure


def _one_half(top: Axes, strip: Axes, runs: Sequence[RunFacts], half: tuple[str, str, str]) -> None:
    axis, name, unit = half
    low, high = np.inf, -np.inf
    first = _curve(runs[0], axis, name)
    for number, run in enumerate(runs):
        x, density, noise = _curve(run, axis, name)
        colour, line = _COLOURS[number % len(_COLOURS)], _LINES[number % len(_LINES)]
        seen = x[density > density.max() / 300.0]
        low, high = min(low, float(seen[0])), max(high, float(seen[-1]))
        top.plot(x, density, color=colour, linestyle=line, label=plain(run.words), drawstyle="steps-mid")
        if number:
            there = [np.interp(first[0], x, values, left=0.0, right=0.0) for values in (density, noise)]
            error = np.hypot(there[1], first[2])
            z = np.divide(there[0] - first[1], error, out=np.zeros_like(error), where=error > 0)
            strip.plot(first[0], z, color=colour, linewidth=0.8)
    strip.axhspan(-2.0, 2.0, color="#EDEDED", linewidth=0, zorder=0)
    strip.axhline(0.0, color=BLACK, linewidth=0.5)
    margin = 0.04 * (high - low)
    for axes in (top, strip):
        axes.set_xlim(low - margin, high + margin)
    top.tick_params(labelbottom=False)
    top.set(ylabel=f"density (1/{unit})", ylim=(0.0, 1.3 * top.get_ylim()[1]))
    top.legend(loc="upper right")
    strip.set(xlabel=f"signal ({unit})", ylabel="difference\n(std. errors)")


def _curve(run: RunFacts, axis: str, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the axis, the density and its standard error by counting."""
    x, density, counts = (
        np.asarray(run.ensemble[each], dtype=np.float64) for each in (axis, f"{name}density", f"{name}counts")
    )
    total = max(float(counts.sum()), 1.0)
    step = float(np.median(np.diff(x))) if x.size > 1 else 1.0
    return x, density, np.sqrt(np.maximum(counts, 0.0)) / (total * step)
