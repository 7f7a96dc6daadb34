"""Figures of the whole sensor: ensemble distributions, electron numbers, component widths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.report.figures.pixel_figures import shown_bins
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    GREEN,
    ORANGE,
    PAGE_MM,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    note,
    styled,
)
from pchem_pipeline.report.style.wording import power_of_ten, scientific

__all__ = ["component_widths", "electron_numbers", "ensemble"]

FloatArray = NDArray[np.float64]

#: Suffix of an array to (name in the legend, colour, line style).
_PREDICTIONS: dict[str, tuple[str, str, str]] = {
    "independent": ("independent parameters", VERMILION, ":"),
    "dependent": ("dependent parameters", BLUE, "--"),
    "exact": ("exact mean over pixels", BLACK, "-"),
}


@styled
def ensemble(
    arrays: Mapping[str, NDArray[Any]],
    rmse: Mapping[str, float],
    *,
    n_frames: int | None = None,
    width_mm: float = PAGE_MM,
) -> Figure:
    """Draw the ensemble histogram with the three EPCDs, raw and NUCed (fig:ensemble_plot).

    The strip below each shows data minus prediction; its gray band is two standard deviations of the
    sampling noise of the data. On a page, a panel at the right shows all values on a logarithmic axis.

    Args:
        arrays: group ``ensemble`` of the store: ``dn``, ``counts``, ``density``, ``epcd_exact``, ... and
            ``electrons``, ``nuced_counts``, ``nuced_density``, ``nuced_exact``, ...; either half may lack.
        rmse: RMSE of each prediction under its name, and ``noise_floor``, ``nuced_noise_floor``.
        n_frames: frames in the histogram, for the legend.
        width_mm: width of the figure.
    """
    halves = [
        half
        for half in (("dn", "", "epcd_", "DN"), ("electrons", "nuced_", "nuced_", "e⁻"))
        if half[0] in arrays and f"{half[1]}density" in arrays and np.sum(arrays[f"{half[1]}counts"]) > 0
    ]
    figure = new_figure(width_mm, max(78.0 * len(halves), 40.0))
    if not halves:
        axes = figure.add_subplot()
        axes.text(0.5, 0.5, "no ensemble histogram", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return figure
    wide = width_mm > 1.5 * COLUMN_MM
    grid = figure.add_gridspec(
        2 * len(halves),
        2 if wide else 1,
        height_ratios=[3.2, 1.0] * len(halves),
        width_ratios=(2.4, 1.0) if wide else None,
    )
    for i, (axis_name, data, model, unit) in enumerate(halves):
        half = _half(arrays, axis_name, data, model, unit)
        top = figure.add_subplot(grid[2 * i, 0])
        strip = figure.add_subplot(grid[2 * i + 1, 0], sharex=top)
        _ensemble_bulk(top, half, rmse, n_frames)
        top.set_ylim(0.0, (1.3 if wide else 1.75) * top.get_ylim()[1])
        _ensemble_strip(strip, half)
        top.tick_params(labelbottom=False)
        if wide:
            _ensemble_tail(figure.add_subplot(grid[2 * i : 2 * i + 2, 1]), half)
    return figure


@dataclass(frozen=True)
class _Half:
    """One half of the figure: data and predictions on one axis."""

    raw: bool
    unit: str
    x: FloatArray
    step: float
    counts: FloatArray
    density: FloatArray
    models: dict[str, FloatArray]

    def edges(self, where: slice) -> FloatArray:
        x = self.x[where]
        return np.append(x - self.step / 2, x[-1] + self.step / 2)


def _half(arrays: Mapping[str, NDArray[Any]], axis_name: str, data: str, model: str, unit: str) -> _Half:
    x = np.asarray(arrays[axis_name], dtype=np.float64)
    return _Half(
        axis_name == "dn",
        unit,
        x,
        float(np.median(np.diff(x))) if x.size > 1 else 1.0,
        np.asarray(arrays[f"{data}counts"], dtype=np.float64),
        np.asarray(arrays[f"{data}density"], dtype=np.float64),
        {
            suffix: np.asarray(arrays[model + suffix], dtype=np.float64)
            for suffix in _PREDICTIONS
            if model + suffix in arrays
        },
    )


def _bulk(half: _Half) -> slice:
    """Return the bins that can be seen on a linear axis: above 1/300 of the peak, the last 0.2 % left out."""
    rest = np.cumsum(half.counts) / half.counts.sum()
    seen = np.flatnonzero((half.density > half.density.max() / 300.0) & (rest > 5e-4) & (rest < 0.998))
    if seen.size == 0:
        seen = np.flatnonzero(half.density == half.density.max())
    margin = max(2, int(seen[-1] - seen[0]) // 14)
    return slice(max(int(seen[0]) - margin, 0), int(seen[-1]) + margin + 1)


def _ensemble_bulk(top: Axes, half: _Half, rmse: Mapping[str, float], n_frames: int | None) -> None:
    where = _bulk(half)
    data_name = "raw data" if half.raw else "NUCed data"
    if n_frames:
        data_name += f", {n_frames:,} frames"
    edges = half.edges(where)
    top.stairs(half.density[where], edges, fill=True, color=GRAY, label=data_name)
    for suffix, model in half.models.items():
        words, colour, line = _PREDICTIONS[suffix]
        name = ("epcd_" if half.raw else "nuced_") + suffix
        label = f"{words}, RMSE {scientific(rmse[name])}" if name in rmse else words
        top.plot(half.x[where], model[where], color=colour, linestyle=line, label=label)
    floor = rmse.get("noise_floor" if half.raw else "nuced_noise_floor")
    if floor is not None:
        top.plot([], [], color="none", label=f"sampling noise alone, RMSE {scientific(floor)}")
    top.set(ylabel=f"density (1/{half.unit})", xlim=(edges[0], edges[-1]))
    top.set_title("raw ensemble" if half.raw else "after non-uniformity correction")
    top.legend(loc="upper right")


def _ensemble_strip(strip: Axes, half: _Half) -> None:
    where = _bulk(half)
    density, x = half.density[where], half.x[where]
    noise = np.sqrt(np.maximum(density, 0.0) / (max(float(half.counts.sum()), 1.0) * half.step))
    differences = {suffix: density - model[where] for suffix, model in half.models.items()}
    power = _power([2.0 * noise, *differences.values()])
    scale = 10.0**-power
    strip.fill_between(x, -2.0 * scale * noise, 2.0 * scale * noise, color="#DDDDDD", linewidth=0, step="mid")
    for suffix, difference in differences.items():
        _, colour, line = _PREDICTIONS[suffix]
        strip.plot(x, scale * difference, color=colour, linestyle=line, linewidth=0.8)
    strip.axhline(0.0, color=BLACK, linewidth=0.5)
    strip.set(
        xlabel=f"signal ({half.unit})", ylabel=f"data − model\n({power_of_ten(power) or 1}/{half.unit})"
    )


def _power(values: Sequence[FloatArray]) -> int:
    """Return the power of ten in which values are drawn, so that tick labels have few digits."""
    largest = max((float(np.max(np.abs(v), initial=0.0)) for v in values), default=0.0)
    return int(np.floor(np.log10(largest))) if largest > 0 else 0


def _ensemble_tail(axes: Axes, half: _Half) -> None:
    """Draw the whole range on a logarithmic axis, down to less than one count."""
    where = shown_bins(half.counts, tail=0.0)
    total = float(half.counts.sum())
    axes.stairs(half.density[where], half.edges(where), fill=True, color=GRAY, baseline=1e-300)
    for suffix, model in half.models.items():
        _, colour, line = _PREDICTIONS[suffix]
        axes.plot(
            half.x[where], np.maximum(model[where], 1e-300), color=colour, linestyle=line, linewidth=0.9
        )
    axes.set_yscale("log")
    axes.set_ylim(0.3 / (total * half.step), 3.0 * float(half.density.max()))
    axes.set(xlabel=f"signal ({half.unit})", title="all values, logarithmic")


@styled
def electron_numbers(
    k: NDArray[Any],
    mass: NDArray[Any],
    pmf: NDArray[Any],
    *,
    pmf_map: NDArray[Any] | None = None,
    counts: NDArray[Any] | None = None,
    width_mm: float = COLUMN_MM,
) -> Figure:
    """Draw estimated electron numbers against the predicted mass (fig:poisson_demarg, eq. K_ensemble_pmf).

    Args:
        k: electron numbers, shape (n,).
        mass: share of each among the estimates, shape (n,).
        pmf: mass predicted from the map of H, shape (n,).
        pmf_map: mass that the estimator itself should show, shape (n,).
        counts: number of estimates at each k, for the sampling noise in the strip.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 74.0)
    top, strip = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
    last = _last_shown(np.asarray(mass), np.asarray(pmf))
    k, mass, pmf = (np.asarray(a, dtype=np.float64)[: last + 1] for a in (k, mass, pmf))
    top.bar(k, mass, width=0.85, color=GRAY, label="estimated electron numbers")
    top.plot(k, pmf, "o", color=BLACK, markersize=3.2, label=r"predicted mass $p_{K_e}$")
    power = _power([mass - pmf])
    scale = 10.0**-power
    if counts is not None and np.sum(counts) > 0:
        noise = 2.0 * scale * np.sqrt(mass / float(np.sum(counts)))
        strip.bar(k, 2.0 * noise, bottom=-noise, width=0.85, color="#DDDDDD", linewidth=0)
    strip.plot(k, scale * (mass - pmf), "o", color=BLACK, markersize=3.0)
    if pmf_map is not None:
        expected = np.asarray(pmf_map, dtype=np.float64)[: last + 1]
        top.plot(
            k, expected, "x", color=VERMILION, markersize=4.0, label="mass that the estimator should show"
        )
        strip.plot(k, scale * (mass - expected), "x", color=VERMILION, markersize=4.0)
    strip.axhline(0.0, color=BLACK, linewidth=0.5)
    strip.margins(y=0.15)
    top.set(ylabel="probability", ylim=(0.0, 1.4 * max(float(np.nanmax(mass, initial=0.0)), 1e-12)))
    strip.set(
        xlabel="electron number k (e⁻)",
        ylabel=f"difference\n({power_of_ten(power) or 1})",
        xlim=(-0.6, last + 0.6),
    )
    strip.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    handles, labels = top.get_legend_handles_labels()
    top.legend(handles[-1:] + handles[:-1], labels[-1:] + labels[:-1], loc="upper right")
    return figure


def _last_shown(mass: NDArray[Any], pmf: NDArray[Any]) -> int:
    """Return the last electron number with a mass that can be seen, at least 1."""
    seen = np.flatnonzero(np.nan_to_num(np.maximum(mass, pmf)) > 1e-3)
    return int(max(seen[-1] + 1 if seen.size else 1, 1)) if mass.size > 1 else 0


_CASE_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)


@styled
def component_widths(
    k: NDArray[Any],
    variance: NDArray[Any],
    cases: Sequence[str],
    *,
    nuced_variance: NDArray[Any] | None = None,
    highlight: Sequence[str] = (),
    width_mm: float = PAGE_MM,
) -> Figure:
    """Draw the width of the EPCD's components against the electron number (Appendix B).

    Args:
        k: electron numbers, shape (n_k,).
        variance: Var(E | K_e = k), DN^2, shape (n_cases, n_k).
        cases: names of the rows: the parameters held constant.
        nuced_variance: Var(E' | K_e = k), e-^2, shape (n_k,).
        highlight: cases drawn in colour, at most six; the others are gray.
        width_mm: width of the figure.
    """
    wide = width_mm > 1.5 * COLUMN_MM
    panels = 1 if nuced_variance is None else 2
    figure = new_figure(width_mm, 62.0 * (1 if wide else panels) + (14.0 if wide else 26.0))
    grid = figure.subplots(1 if wide else panels, panels if wide else 1, squeeze=False)
    axes = grid.ravel()
    chosen = list(highlight)[: len(_CASE_COLOURS)]
    width = np.sqrt(np.maximum(np.asarray(variance, dtype=np.float64), 0.0))
    for row, case in enumerate(cases):
        if case not in chosen:
            axes[0].plot(k, width[row], color="#CFCFCF", linewidth=0.7, zorder=1)
    for row, case in enumerate(cases):
        if case in chosen:
            colour = _CASE_COLOURS[chosen.index(case)]
            style = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))[chosen.index(case)]
            axes[0].plot(k, width[row], color=colour, linestyle=style, label=f"constant: {case}", zorder=3)
    axes[0].set(xlabel="electron number k (e⁻)", ylabel="component width, sd (DN)", title="raw ensemble")
    if nuced_variance is not None:
        nuced = np.sqrt(np.maximum(np.asarray(nuced_variance, dtype=np.float64), 0.0))
        axes[1].plot(k, nuced, color=BLACK, marker="o", markersize=2.5)
        axes[1].set(
            xlabel="electron number k (e⁻)", ylabel="component width, sd (e⁻)", title="NUCed ensemble"
        )
    for panel in axes:
        low, high = panel.get_ylim()
        panel.set_ylim(0.0 if low < 0.5 * high else low - 0.1 * abs(low), 1.08 * max(high, 1e-12))
        panel.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    if chosen:
        figure.legend(loc="outside lower center", ncols=3 if wide else 2)
    else:
        note(axes[0], "every line: one set of parameters held constant")
    return figure
