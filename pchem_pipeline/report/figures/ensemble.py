"""Figures of the whole sensor: ensemble distributions, electron numbers, component widths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.pixels import shown_bins
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, note, styled
from pchem_pipeline.report.style.wording import power_of_ten, scientific, short

FloatArray = NDArray[np.float64]

#: Suffix of a prediction to (name in the legend, hue, line style).
_PREDICTIONS: dict[str, tuple[str, str, str]] = {
    "independent": ("independent parameters", "vermilion", ":"),
    "dependent": ("dependent parameters", "blue", "--"),
    "exact": ("exact mean over pixels", "ink", "-"),
}
#: Parts of the figure: (part, axis, prefix of the data, prefix of the predictions, unit).
_HALVES = (("raw", "dn", "", "epcd_", "DN"), ("nuced", "electrons", "nuced_", "nuced_", "e-"))

_ENSEMBLE_CAPTION = (
    "Histogram of all pixels over the chosen frames (gray), raw at the top and after two-point non-"
    "uniformity correction at the bottom, where the peaks lie at whole electrons. Lines: prediction "
    "from the fitted parameters, as the exact mean over the pixels, with the parameters' joint "
    "histogram (dependent), and with the product of their four histograms (independent). Strips: data"
    " minus prediction, with two standard deviations of the sampling noise in gray. An RMSE close to "
    "that of the sampling noise alone means that the model explains the data."
)
_ELECTRONS_CAPTION = (
    "Gray: share of each electron number among the estimates. Dots: mass p(k) predicted from the map "
    "of H. Crosses: mass that the estimator itself should show, which errs between neighbouring "
    "numbers. Below: estimate minus prediction, with two standard deviations of the "
    "sampling noise in gray."
)
_COMPONENTS_CAPTION = (
    "Standard deviation of the component of electron number k, raw (left or top) and after non-"
    "uniformity correction (right or bottom). Each line holds a set of parameters constant over the "
    "pixels; gray lines are the remaining ones of the sixteen sets. Flat lines keep the peaks "
    "resolved at every signal."
)

_SYMBOLS = {"mu": "μ", "sigma": "σ", "sigma2": "σ²"}
#: Cases of Appendix B that are drawn in colour.
_HIGHLIGHTED = ("none", "g", "H, g", "g, μ, σ²", "H, g, μ, σ²")


def ensemble_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the ensemble histograms with their predictions."""
    tables = ensemble_tables(data.ensemble)
    if not tables:
        return []
    rmse = dict(data.ensemble_facts.get("rmse", {}))
    numbers = ", ".join(f"{name.replace('_', ' ')} {scientific(value)}" for name, value in rmse.items())
    return [
        Figure(
            "ensemble",
            "summary",
            "Ensemble histogram and its prediction",
            _ENSEMBLE_CAPTION,
            "Ensemble histogram before and after non-uniformity correction with predictions. "
            f"RMSE: {numbers}.",
            tables,
            partial(draw_ensemble, tables=tables, rmse=rmse, n_frames=data.ensemble_facts.get("n_frames")),
            PAGE_MM,
        )
    ]


def electron_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the estimated electron numbers against their prediction."""
    arrays = data.ensemble
    if "electron_mass" not in arrays:
        return []
    mass, pmf = arrays["electron_mass"], arrays["electron_pmf"]
    first = ", ".join(f"k = {k}: {mass[k]:.4f} against {pmf[k]:.4f}" for k in range(min(5, mass.size)))
    names = ("k", "electron_counts", "electron_mass", "electron_pmf", "electron_pmf_map")
    table = DataTable({name: arrays[name] for name in names if name in arrays}, {"k": "e-"})
    return [
        Figure(
            "electron_numbers",
            "electrons",
            "Estimated electron numbers",
            _ELECTRONS_CAPTION,
            f"Share of each electron number among the estimates against the prediction; {first}.",
            (table,),
            partial(draw_electrons, table=table),
        )
    ]


def component_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the widths of the components of the ensemble (Appendix B)."""
    variance = data.ensemble.get("component_variance")
    if variance is None or variance.size == 0:
        return []
    cases = data.component_cases or [f"case {i}" for i in range(variance.shape[0])]
    table = component_table(variance, cases, data.ensemble.get("nuced_component_variance"))
    width = table[_held(cases[0])]
    return [
        Figure(
            "component_widths",
            "components",
            "Width of the components of the ensemble",
            _COMPONENTS_CAPTION,
            "Standard deviation of the ensemble's component k, nothing held constant: "
            f"{short(float(width[0]))} DN at k = 0, "
            f"{short(float(width[-1]))} DN at k = {variance.shape[1] - 1}.",
            (table,),
            partial(draw_components, table=table, highlight=[c for c in _HIGHLIGHTED if c in cases]),
            PAGE_MM,
        )
    ]


def case_name(constant: Sequence[str]) -> str:
    """Return the name of a case of Appendix B: the parameters held constant, or ``none``."""
    return ", ".join(_SYMBOLS.get(symbol, symbol) for symbol in constant) or "none"


def ensemble_tables(arrays: Mapping[str, NDArray[Any]]) -> tuple[DataTable, ...]:
    """Return data and predictions of the ensemble, raw and after correction; either may lack.

    Args:
        arrays: group ``ensemble`` of the store: ``dn``, ``counts``, ``density``, ``epcd_exact``, ... and
            ``electrons``, ``nuced_counts``, ``nuced_density``, ``nuced_exact``, ...
    """
    tables = []
    for part, axis, data, model, unit in _HALVES:
        if axis not in arrays or f"{data}density" not in arrays:
            continue
        columns = {axis: arrays[axis], "counts": arrays[f"{data}counts"]}
        names = (f"{data}density", *(f"{model}{each}" for each in (*_PREDICTIONS, "stderr")))
        columns |= {name: arrays[name] for name in names if name in arrays}
        tables.append(DataTable(columns, dict.fromkeys(names, f"1/{unit}") | {axis: unit}, part))
    return tuple(tables)


def component_table(
    variance: NDArray[Any], cases: Sequence[str], nuced_variance: NDArray[Any] | None = None
) -> DataTable:
    """Return the standard deviations of the components by electron number.

    Args:
        variance: Var(E | K_e = k), DN^2, shape (n_cases, n_k).
        cases: names of the rows: the parameters held constant.
        nuced_variance: Var(E' | K_e = k), e-^2, shape (n_k,).
    """
    width = np.sqrt(np.maximum(np.asarray(variance, np.float64), 0.0))
    columns = {"k": np.arange(width.shape[1])} | dict(zip(map(_held, cases), width, strict=True))
    units = dict.fromkeys(columns, "DN") | {"k": "e-", "sd after correction": "e-"}
    if nuced_variance is not None:
        columns["sd after correction"] = np.sqrt(np.maximum(np.asarray(nuced_variance, np.float64), 0.0))
    return DataTable(columns, units)


def _held(case: str) -> str:
    return f"sd, constant: {case}"


@styled
def draw_ensemble(
    look: Look, *, tables: Sequence[DataTable], rmse: Mapping[str, float], n_frames: int | None = None
) -> Drawing:
    """Draw the ensemble histogram with the three EPCDs, raw and NUCed (fig:ensemble_plot).

    The strip below each shows data minus prediction; its gray band is two standard deviations of the
    sampling noise of the data. On a page, a panel at the right shows all values on a logarithmic axis.

    Args:
        look: width and colours.
        tables: of :func:`ensemble_tables`.
        rmse: RMSE of each prediction under its name, and ``noise_floor``, ``nuced_noise_floor``.
        n_frames: frames in the histogram, for the legend.
    """
    halves = [_Half(table) for table in tables if table["counts"].sum() > 0]
    figure = look.empty(max(78.0 * len(halves), 40.0))
    if not halves:
        axes = figure.add_subplot()
        axes.text(0.5, 0.5, "no ensemble histogram", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return figure
    wide = look.wide
    grid = figure.add_gridspec(
        2 * len(halves),
        2 if wide else 1,
        height_ratios=[3.2, 1.0] * len(halves),
        width_ratios=(2.4, 1.0) if wide else None,
    )
    for i, half in enumerate(halves):
        top = figure.add_subplot(grid[2 * i, 0])
        strip = figure.add_subplot(grid[2 * i + 1, 0], sharex=top)
        _ensemble_bulk(top, half, rmse, n_frames)
        top.set_ylim(0.0, (1.3 if wide else 1.75) * top.get_ylim()[1])
        _ensemble_strip(strip, half)
        top.tick_params(labelbottom=False)
        if wide:
            _ensemble_tail(figure.add_subplot(grid[2 * i : 2 * i + 2, 1]), half)
    return figure


class _Half:
    """One half of the figure: data and predictions on one axis."""

    def __init__(self, table: DataTable) -> None:
        _, axis, data, model, unit = next(half for half in _HALVES if half[0] == table.part)
        self.raw = table.part == "raw"
        self.unit = unit.replace("e-", "e⁻")
        self.x = table[axis].astype(np.float64)
        self.step = float(np.median(np.diff(self.x))) if self.x.size > 1 else 1.0
        self.counts = table["counts"].astype(np.float64)
        self.density = table[f"{data}density"].astype(np.float64)
        self.models = {each: table[model + each] for each in _PREDICTIONS if model + each in table}

    def edges(self, where: slice) -> FloatArray:
        x = self.x[where]
        return np.append(x - self.step / 2, x[-1] + self.step / 2)


def _bulk(half: _Half) -> slice:
    """Return the bins that can be seen on a linear axis: above 1/300 of the peak, the last 0.2 % left out."""
    rest = np.cumsum(half.counts) / half.counts.sum()
    seen = np.flatnonzero((half.density > half.density.max() / 300.0) & (rest > 5e-4) & (rest < 0.998))
    if seen.size == 0:
        seen = np.flatnonzero(half.density == half.density.max())
    margin = max(2, int(seen[-1] - seen[0]) // 14)
    return slice(max(int(seen[0]) - margin, 0), int(seen[-1]) + margin + 1)


def _ensemble_bulk(top: Axes, half: _Half, rmse: Mapping[str, float], n_frames: int | None) -> None:
    where, colours = _bulk(half), colours_of(top)
    data_name = "raw data" if half.raw else "NUCed data"
    if n_frames:
        data_name += f", {n_frames:,} frames"
    edges = half.edges(where)
    top.stairs(half.density[where], edges, fill=True, color=colours.bars, label=data_name)
    for suffix, model in half.models.items():
        words, hue, line = _PREDICTIONS[suffix]
        name = ("epcd_" if half.raw else "nuced_") + suffix
        label = f"{words}, RMSE {scientific(rmse[name])}" if name in rmse else words
        top.plot(half.x[where], model[where], color=getattr(colours, hue), linestyle=line, label=label)
    floor = rmse.get("noise_floor" if half.raw else "nuced_noise_floor")
    if floor is not None:
        top.plot([], [], color="none", label=f"sampling noise alone, RMSE {scientific(floor)}")
    top.set(ylabel=f"density (1/{half.unit})", xlim=(edges[0], edges[-1]))
    top.set_title("raw ensemble" if half.raw else "after non-uniformity correction")
    top.legend(loc="upper right")


def _ensemble_strip(strip: Axes, half: _Half) -> None:
    where, colours = _bulk(half), colours_of(strip)
    density, x = half.density[where], half.x[where]
    noise = np.sqrt(np.maximum(density, 0.0) / (max(float(half.counts.sum()), 1.0) * half.step))
    differences = {suffix: density - model[where] for suffix, model in half.models.items()}
    power = _power([2.0 * noise, *differences.values()])
    scale = 10.0**-power
    strip.fill_between(
        x, -2.0 * scale * noise, 2.0 * scale * noise, color=colours.band, linewidth=0, step="mid"
    )
    for suffix, difference in differences.items():
        _, hue, line = _PREDICTIONS[suffix]
        strip.plot(x, scale * difference, color=getattr(colours, hue), linestyle=line, linewidth=0.8)
    strip.axhline(0.0, color=colours.ink, linewidth=0.5)
    strip.set(
        xlabel=f"signal ({half.unit})", ylabel=f"data − model\n({power_of_ten(power) or 1}/{half.unit})"
    )


def _power(values: Sequence[FloatArray]) -> int:
    """Return the power of ten in which values are drawn, so that tick labels have few digits."""
    largest = max((float(np.max(np.abs(v), initial=0.0)) for v in values), default=0.0)
    return int(np.floor(np.log10(largest))) if largest > 0 else 0


def _ensemble_tail(axes: Axes, half: _Half) -> None:
    """Draw the whole range on a logarithmic axis, down to less than one count."""
    where, colours = shown_bins(half.counts, tail=0.0), colours_of(axes)
    total = float(half.counts.sum())
    axes.stairs(half.density[where], half.edges(where), fill=True, color=colours.bars, baseline=1e-300)
    for suffix, model in half.models.items():
        _, hue, line = _PREDICTIONS[suffix]
        shown = np.maximum(model[where], 1e-300)
        axes.plot(half.x[where], shown, color=getattr(colours, hue), linestyle=line, linewidth=0.9)
    axes.set_yscale("log")
    axes.set_ylim(0.3 / (total * half.step), 3.0 * float(half.density.max()))
    axes.set(xlabel=f"signal ({half.unit})", title="all values, logarithmic")


@styled
def draw_electrons(look: Look, *, table: DataTable) -> Drawing:
    """Draw estimated electron numbers against the predicted mass (fig:poisson_demarg, eq. K_ensemble_pmf).

    Args:
        look: width and colours.
        table: electron numbers ``k``, their share ``electron_mass`` among the estimates, the mass
            ``electron_pmf`` predicted from the map of H; where known the mass ``electron_pmf_map`` that the
            estimator itself should show, and ``electron_counts`` for the sampling noise in the strip.
    """
    figure, colours = look.empty(74.0), look.palette
    top, strip = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
    last = _last_shown(table["electron_mass"], table["electron_pmf"])
    k, mass, pmf = (table[name][: last + 1] for name in ("k", "electron_mass", "electron_pmf"))
    top.bar(k, mass, width=0.85, color=colours.bars, label="estimated electron numbers")
    top.plot(k, pmf, "o", color=colours.ink, markersize=3.2, label=r"predicted mass $p_{K_e}$")
    power = _power([mass - pmf])
    scale = 10.0**-power
    if "electron_counts" in table and table["electron_counts"].sum() > 0:
        noise = 2.0 * scale * np.sqrt(mass / float(table["electron_counts"].sum()))
        strip.bar(k, 2.0 * noise, bottom=-noise, width=0.85, color=colours.band, linewidth=0)
    strip.plot(k, scale * (mass - pmf), "o", color=colours.ink, markersize=3.0)
    if "electron_pmf_map" in table:
        expected = table["electron_pmf_map"][: last + 1]
        top.plot(
            k,
            expected,
            "x",
            color=colours.vermilion,
            markersize=4.0,
            label="mass that the estimator should show",
        )
        strip.plot(k, scale * (mass - expected), "x", color=colours.vermilion, markersize=4.0)
    strip.axhline(0.0, color=colours.ink, linewidth=0.5)
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


#: Hue and line style of the cases drawn in colour.
_CASES = (
    ("blue", "-"),
    ("vermilion", "--"),
    ("green", "-."),
    ("orange", ":"),
    ("purple", (0, (5, 1, 1, 1, 1, 1))),
    ("sky", (0, (1, 1))),
)


@styled
def draw_components(look: Look, *, table: DataTable, highlight: Sequence[str] = ()) -> Drawing:
    """Draw the width of the EPCD's components against the electron number (Appendix B).

    Args:
        look: width and colours.
        table: of :func:`component_table`.
        highlight: cases drawn in colour, at most six; the others are gray.
    """
    wide, colours = look.wide, look.palette
    nuced = "sd after correction" in table
    panels = 2 if nuced else 1
    figure = look.empty(62.0 * (1 if wide else panels) + (14.0 if wide else 26.0))
    axes = figure.subplots(1 if wide else panels, panels if wide else 1, squeeze=False).ravel()
    chosen = dict(zip(map(_held, highlight), _CASES, strict=False))
    k, first = table["k"], axes[0]
    for name in table.columns:
        if name in chosen:
            hue, line = chosen[name]
            label = name.removeprefix("sd, ")
            first.plot(k, table[name], color=getattr(colours, hue), linestyle=line, label=label, zorder=3)
        elif name.startswith("sd, "):
            first.plot(k, table[name], color=colours.no_value, linewidth=0.7, zorder=1)
    axes[0].set(xlabel="electron number k (e⁻)", ylabel="component width, sd (DN)", title="raw ensemble")
    if nuced:
        axes[1].plot(k, table["sd after correction"], color=colours.ink, marker="o", markersize=2.5)
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
