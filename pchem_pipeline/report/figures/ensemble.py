"""Figures of the whole sensor: ensemble distributions, electron numbers, component widths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray
from pchem_pipeline.base.wording import measured, percent, power_of_ten, scientific, short, unit_text
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Band,
    Bars,
    Chart,
    Dash,
    Level,
    Line,
    Mark,
    Panel,
    Points,
    Stack,
    Steps,
)
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.pixels import shown_bins

#: Suffix of a prediction to (name in the legend, hue, line style).
PREDICTIONS: dict[str, tuple[str, str, Dash]] = {
    "independent": ("independent parameters", "vermilion", ":"),
    "dependent": ("dependent parameters", "blue", "--"),
    "exact": ("exact mean over pixels", "ink", "-"),
}


class Half(NamedTuple):
    """An ensemble of a run: its part of the figure, axis, prefixes of data and predictions, unit, words."""

    part: str
    axis: str
    data: str
    model: str
    unit: str
    words: str
    title: str


HALVES = (
    Half("raw", "dn", "", "epcd_", "DN", "raw data", "raw ensemble"),
    Half("nuced", "electrons", "nuced_", "nuced_", "e-", "NUCed data", "after non-uniformity correction"),
)


_SYMBOLS = {"mu": "μ", "sigma": "σ", "sigma2": "σ²"}
#: Cases of Appendix B that are drawn in colour.
_HIGHLIGHTED = ("none", "g", "H, g", "g, μ, σ²", "H, g, μ, σ²")


def ensemble_figures(data: ReportData) -> Iterator[Figure]:
    """Return the ensemble histograms with their predictions."""
    tables = ensemble_tables(data.ensemble)
    if not tables:
        return
    rmse = dict(data.ensemble_facts.get("rmse", {}))
    numbers = ", ".join(f"{name.replace('_', ' ')} {scientific(value)}" for name, value in rmse.items())
    yield Figure(
        "ensemble",
        "summary",
        "Ensemble histogram and its prediction",
        "Histogram of all pixels over the chosen frames (gray), raw at the top and after two-point non-"
        "uniformity correction at the bottom, with peaks at whole electrons. Lines: prediction "
        "from the fitted parameters, as the exact mean over the pixels, with the parameters' joint "
        "histogram (dependent), and with the product of their four histograms (independent). Strips: data"
        " minus prediction; gray: 2 sigma of sampling noise. The model describes the data if the RMSE is "
        "close to the sampling noise.",
        f"Ensemble histogram before and after non-uniformity correction with predictions. RMSE: {numbers}.",
        tables,
        ensemble_chart(tables, rmse, data.ensemble_facts.get("n_frames")),
        PAGE_MM,
    )


def electron_figures(data: ReportData) -> Iterator[Figure]:
    """Return the estimated electron numbers against their prediction."""
    arrays = data.ensemble
    if "electron_mass" not in arrays:
        return
    mass, pmf = arrays["electron_mass"], arrays["electron_pmf"]
    words, facts = "", data.ensemble_facts
    if facts.get("error_rate") is not None:
        rate, error = (100.0 * float(facts.get(key) or 0.0) for key in ("error_rate", "error_rate_stderr"))
        words += f" Wrong estimates (truth known): {measured(rate, error, '%')}."
    if facts.get("expected_error_rate") is not None:
        words += f" Expected from the fit: {percent(float(facts['expected_error_rate']))} wrong."
    first = ", ".join(f"k = {k}: {mass[k]:.4f} against {pmf[k]:.4f}" for k in range(min(5, mass.size)))
    names = ("k", "electron_counts", "electron_mass", "electron_pmf", "electron_pmf_map")
    table = DataTable({name: arrays[name] for name in names if name in arrays}, {"k": "e-"})
    yield Figure(
        "electron_numbers",
        "electrons",
        "Estimated electron numbers",
        "Gray: share of each estimated electron number. Dots: probability p(k) from the map of H. Crosses: "
        "expected share of the estimates, which confuse neighbouring numbers. Below: estimate minus "
        f"expectation; gray: 2 sigma of sampling noise.{words}",
        f"Share of each electron number among the estimates against the prediction; {first}.",
        (table,),
        electrons_chart(table),
    )


def component_figures(data: ReportData) -> Iterator[Figure]:
    """Return the widths of the components of the ensemble (Appendix B)."""
    variance = data.ensemble.get("component_variance")
    if variance is None or not np.isfinite(variance).any():
        return
    cases = data.component_cases
    table = component_table(variance, cases, data.ensemble.get("nuced_component_variance"))
    width = table[_held(cases[0])]
    yield Figure(
        "component_widths",
        "components",
        "Width of the components of the ensemble",
        "Standard deviation of the component of electron number k, raw (left or top) and after non-"
        "uniformity correction (right or bottom). For each line a set of parameters is constant over the "
        "pixels; gray: the remaining of the sixteen sets. Where a line is flat the peaks are resolved at "
        "every signal.",
        "Standard deviation of the ensemble's component k, nothing held constant: "
        f"{short(float(width[0]))} DN at k = 0, {short(float(width[-1]))} DN at k = {width.size - 1}.",
        (table,),
        components_chart(table, [c for c in _HIGHLIGHTED if c in cases]),
        PAGE_MM,
    )


def case_name(constant: Sequence[str]) -> str:
    """Return the name of a case of Appendix B: the parameters held constant, or ``none``."""
    return ", ".join(_SYMBOLS.get(symbol, symbol) for symbol in constant) or "none"


def ensemble_tables(arrays: Arrays) -> tuple[DataTable, ...]:
    """Return data and predictions of the group ``ensemble``, raw and after correction; either may lack."""
    tables = []
    for part, axis, data, model, unit, *_ in HALVES:
        if axis not in arrays or f"{data}density" not in arrays or not np.sum(arrays[f"{data}counts"]):
            continue
        columns = {axis: arrays[axis], "counts": arrays[f"{data}counts"]}
        names = (f"{data}density", *(f"{model}{each}" for each in (*PREDICTIONS, "stderr")))
        columns |= {name: arrays[name] for name in names if name in arrays}
        tables.append(DataTable(columns, dict.fromkeys(names, f"1/{unit}") | {axis: unit}, part))
    return tuple(tables)


def component_table(
    variance: NDArray[Any], cases: Sequence[str], nuced_variance: NDArray[Any] | None = None
) -> DataTable:
    """Return the standard deviations of the components by electron number.

    They are the roots of Var(E | K_e = k), DN^2, (n_cases, n_k), and of Var(E' | K_e = k), e-^2, (n_k,).
    """
    width = np.sqrt(np.maximum(variance, 0.0))
    columns = {"k": np.arange(width.shape[1])} | dict(zip(map(_held, cases), width, strict=True))
    units = dict.fromkeys(columns, "DN") | {"k": "e-", "sd after correction": "e-"}
    if nuced_variance is not None:
        columns["sd after correction"] = np.sqrt(np.maximum(nuced_variance, 0.0))
    return DataTable(columns, units)


def _held(case: str) -> str:
    return f"sd, constant: {case}"


def ensemble_chart(
    tables: Sequence[DataTable], rmse: Mapping[str, float], n_frames: int | None = None
) -> Chart:
    """Return the chart of :func:`ensemble_tables`: data, the three EPCDs, differences (fig:ensemble_plot).

    The strip below each shows data minus prediction over two standard deviations of the sampling noise. On a
    page, a panel at the right shows all values on a logarithmic axis. The legend has the RMSE of each
    prediction, and ``noise_floor``, ``nuced_noise_floor``.
    """
    halves = [_Drawn(table, rmse, n_frames) for table in tables]
    stacks = tuple(stack for half in halves for stack in (_bulk_stack(half), _tail_stack(half)))
    return Chart(stacks, (2.4, 1.0))


class _Drawn:
    def __init__(self, table: DataTable, rmse: Mapping[str, float], n_frames: int | None) -> None:
        _, axis, data, model, unit, words, self.title = next(h for h in HALVES if h.part == table.part)
        self.unit = unit_text(unit)
        self.x = table[axis].astype(np.float64)
        self.step = float(np.median(np.diff(self.x))) if self.x.size > 1 else 1.0
        self.counts = table["counts"].astype(np.float64)
        self.density = table[f"{data}density"].astype(np.float64)
        self.models = {each: table[model + each] for each in PREDICTIONS if model + each in table}
        self.floor = rmse.get(f"{data}noise_floor")
        self.label = f"{words}, {n_frames:,} frames" if n_frames else words
        self.rmse = {each: rmse[model + each] for each in PREDICTIONS if model + each in rmse}

    def bars(self, where: slice, **style: Any) -> Steps:
        """Return the data as gray bars."""
        x = self.x[where]
        edges = np.append(x - self.step / 2, x[-1] + self.step / 2)
        return Steps(edges, self.density[where], filled=True, colour="bars", label=self.label, **style)

    def lines(self, where: slice, values: Mapping[str, FloatArray], **style: Any) -> list[Line]:
        """Return a line for each prediction."""
        found = []
        for suffix, each in values.items():
            words, hue, dash = PREDICTIONS[suffix]
            label = f"{words}, RMSE {scientific(self.rmse[suffix])}" if suffix in self.rmse else words
            found.append(Line(self.x[where], each, colour=hue, dash=dash, label=label, **style))
        return found


def _bulk_stack(half: _Drawn) -> Stack:
    # what can be seen on a linear axis: above 1/300 of the peak, the last 0.2 % left out
    rest = np.cumsum(half.counts) / half.counts.sum()
    seen = np.flatnonzero((half.density > half.density.max() / 300.0) & (rest > 5e-4) & (rest < 0.998))
    if seen.size == 0:
        seen = np.flatnonzero(half.density == half.density.max())
    margin = max(2, int(seen[-1] - seen[0]) // 14)
    where = slice(max(int(seen[0]) - margin, 0), int(seen[-1]) + margin + 1)
    bars = half.bars(where)
    lines = half.lines(where, {suffix: model[where] for suffix, model in half.models.items()})
    if half.floor is not None:
        words = f"sampling noise alone, RMSE {scientific(half.floor)}"
        lines.append(Line(np.empty(0), np.empty(0), colour="none", label=words))
    y = Axis(f"density (1/{half.unit})", low=0.0)
    top = Panel(y, (bars, *lines), 3.2, legend="upper right", room=(1.3, 1.75))
    ends = Axis(f"signal ({half.unit})", float(bars.edges[0]), float(bars.edges[-1]))
    return Stack((top, _strip(half, where)), ends, half.title, height_mm=78.0)


def _strip(half: _Drawn, where: slice) -> Panel:
    density = half.density[where]
    noise = np.sqrt(np.maximum(density, 0.0) / (max(float(half.counts.sum()), 1.0) * half.step))
    differences = {suffix: density - model[where] for suffix, model in half.models.items()}
    power = _power([2.0 * noise, *differences.values()])
    scale = 10.0**-power
    band = Band(half.x[where], -2.0 * scale * noise, 2.0 * scale * noise, colour="band", step=True)
    scaled = {suffix: scale * difference for suffix, difference in differences.items()}
    lines = half.lines(where, scaled, width=0.8, listed=False)
    zero = Level(0.0, colour="ink", width=0.5)
    return Panel(Axis(f"data − model\n({power_of_ten(power) or 1}/{half.unit})"), (band, *lines, zero), 1.0)


def _power(values: Sequence[FloatArray]) -> int:
    """Return the power of ten in which values are drawn, so that tick labels have few digits."""
    largest = float(np.max(np.abs(values), initial=0.0))
    return int(np.floor(np.log10(largest))) if largest > 0 else 0


def _tail_stack(half: _Drawn) -> Stack:
    """Return the whole range on a logarithmic axis, down to less than one count."""
    where = shown_bins(half.counts, tail=0.0)
    low, high = 0.3 / (float(half.counts.sum()) * half.step), 3.0 * float(half.density.max())
    models = {suffix: np.maximum(model[where], 1e-3 * low) for suffix, model in half.models.items()}
    lines = half.lines(where, models, width=0.9, listed=False)
    panel = Panel(Axis("", low, high, log=True), (half.bars(where, listed=False), *lines))
    x = Axis(f"signal ({half.unit})")
    return Stack((panel,), x, "all values, log scale", height_mm=78.0, wide=True)


def electrons_chart(table: DataTable) -> Chart:
    """Return the chart of estimated electron numbers against the predicted mass (eq. K_ensemble_pmf).

    The table has ``k``, ``electron_mass`` and ``electron_pmf``; where they are known ``electron_pmf_map``,
    which the estimator itself should show, and ``electron_counts``.
    """
    # the last number with a mass that can be seen, at least 1
    seen = np.flatnonzero(np.nan_to_num(np.maximum(table["electron_mass"], table["electron_pmf"])) > 1e-3)
    last = int(max(seen[-1] + 1 if seen.size else 1, 1)) if table["k"].size > 1 else 0
    k, mass, pmf = (table[name][: last + 1] for name in ("k", "electron_mass", "electron_pmf"))
    power = _power([mass - pmf])
    scale = 10.0**-power
    estimated = Bars(k, np.zeros(k.size), mass, colour="bars", label="estimated electron numbers")
    predicted = r"predicted mass $p_{K_e}$"
    above: list[Mark] = [estimated, Points(k, pmf, colour="ink", size=3.2, label=predicted)]
    below: list[Mark] = []
    if "electron_counts" in table and table["electron_counts"].sum() > 0:
        noise = 2.0 * scale * np.sqrt(mass / float(table["electron_counts"].sum()))
        below.append(Bars(k, -noise, noise, colour="band"))
    rest = scale * (mass - pmf)
    below.append(Points(k, rest, colour="ink", size=3.0, label=predicted, listed=False))
    if "electron_pmf_map" in table:
        expected, words = table["electron_pmf_map"][: last + 1], "expected share"
        cross: dict[str, Any] = {"colour": "vermilion", "mark": "x", "size": 4.0, "label": words}
        above.append(Points(k, expected, **cross))
        below.append(Points(k, scale * (mass - expected), listed=False, **cross))
    below.append(Level(0.0, colour="ink", width=0.5))
    y = Axis("probability", 0.0, 1.1 * max(float(np.nanmax(mass, initial=0.0)), 1e-12))
    panels = (
        Panel(y, tuple(above), 3.2, legend="upper right", room=(1.3, 1.3)),
        Panel(Axis(f"difference\n({power_of_ten(power) or 1})"), tuple(below), 1.0),
    )
    return Chart(
        (Stack(panels, Axis("electron number k (e⁻)", -0.6, last + 0.6, whole=True), height_mm=74.0),)
    )


#: Hue and line style of the cases drawn in colour.
_CASES: tuple[tuple[str, Dash], ...] = (
    ("blue", "-"),
    ("vermilion", "--"),
    ("green", "-."),
    ("orange", ":"),
    ("purple", "-..."),
    ("sky", ".."),
)


def components_chart(table: DataTable, highlight: Sequence[str] = ()) -> Chart:
    """Return the chart of :func:`component_table` (Appendix B): at most six cases in colour, others gray."""
    chosen = dict(zip(map(_held, highlight), _CASES, strict=False))
    k = table["k"]
    gray, lines = [], []
    for name in table.columns:
        if name in chosen:
            hue, dash = chosen[name]
            lines.append(Line(k, table[name], colour=hue, dash=dash, label=name.removeprefix("sd, ")))
        elif name.startswith("sd, "):
            gray.append(Line(k, table[name], colour="no_value", width=0.7))
    note = "" if chosen else "one line per set of constant parameters"
    stacks = [_component_stack("raw ensemble", "DN", (*gray, *lines), note)]
    if "sd after correction" in table:
        line = Line(k, table["sd after correction"], colour="ink", dots=2.5, label="sd", listed=False)
        stacks.append(_component_stack("NUCed ensemble", "e⁻", (line,)))
    return Chart(tuple(stacks), (1.0,) * len(stacks), (3, 2) if chosen else (0, 0))


def _component_stack(title: str, unit: str, lines: tuple[Line, ...], note: str = "") -> Stack:
    known = np.concatenate([line.y for line in lines])
    low, high = float(np.min(known)), float(np.max(known))
    bottom = 0.0 if low < 0.5 * high else low - 0.1 * abs(low)
    y = Axis(f"component width, sd ({unit})", bottom, 1.1 * max(high, 1e-12))
    return Stack(
        (Panel(y, lines, note=note),), Axis("electron number k (e⁻)", whole=True), title, height_mm=75.0
    )
