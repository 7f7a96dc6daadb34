"""Figures of several exposures fitted together: their line, its residuals, and photon transfer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.variables import CHARGE_RATES
from pchem_pipeline.base.wording import measured, short, symbol
from pchem_pipeline.model.maps.maps import summarise
from pchem_pipeline.report.charts.chart import Axis, Chart, Level, Line, Mark, Panel, Points, Stack
from pchem_pipeline.report.data import ReportData, Samples
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.style.ranges import finite

#: Label and unit of what the exposures are drawn against, the maps that their slope may be, and the offset.
AXES = {
    "integration_time": ("integration time", "s", CHARGE_RATES, "spurious_charge"),
    "light_level": ("light level", "", ("charge_per_level",), "dark_signal"),
}


def exposure_figures(data: ReportData) -> Iterator[Figure]:
    """Return the exposures on their line, where samples lie on one."""
    samples, slope = data.samples, slope_of(data)
    if samples is None or slope is None or not samples.on_line:
        return
    words, axis_unit, _, offset = AXES[samples.against]
    _, noun, unit = symbol(slope)
    chosen = samples.on_line
    exposures = np.array([middle(samples.arrays["quanta_exposure"][i]) for i in chosen])
    columns: dict[str, Any] = {
        "sample": [samples.samples[i].name for i in chosen],
        words: [samples.samples[i].x for i in chosen],
        "H": exposures[:, 0],
        "H at 16 %": exposures[:, 2],
        "H at 84 %": exposures[:, 3],
    }
    # two points leave no residual
    if len(chosen) > 2:
        rest = np.array([middle(samples.arrays["linearity_residual"][i]) for i in chosen])
        columns |= {"residual": rest[:, 0], "residual standard error": rest[:, 1]}
    table = DataTable(columns, dict.fromkeys(list(columns)[2:], "e-") | {words: axis_unit})
    centre, error = middle(data.maps[slope])[:2]
    yield Figure(
        "exposures",
        "exposures",
        f"{noun.capitalize()} as the slope of H",
        f"Quanta exposure against {words}, with the median line of the pixels. Below: median residual "
        "with its standard error.",
        f"Exposures on a line; median {noun} {measured(centre, error, unit)}.",
        (table,),
        _exposures_chart(table, centre, *middle(data.maps[offset])[:2]),
    )


def slope_of(data: ReportData) -> str | None:
    """Return the name of the map of the slope of the exposures; None where there is none."""
    if data.samples is None or data.samples.against not in AXES:
        return None
    return next((name for name in AXES[data.samples.against][2] if data.has_values(name)), None)


def transfer_figures(data: ReportData) -> Iterator[Figure]:
    """Return variance against mean of the samples, with the curve of the fit."""
    samples = data.samples
    if samples is None or not data.has_values("conversion_gain"):
        return
    table = _transfer_table(samples, data.maps["bias"])
    gain, noise = (middle(data.maps[name])[0] for name in ("conversion_gain", "read_noise_dn"))
    medians = zip(table["sample"], table["variance"], strict=True)
    yield Figure(
        "photon_transfer",
        "photon-transfer",
        "Variance against mean",
        "Medians over the pixels. Curve: prediction from the median parameters of the joint fit, not fitted "
        "to the points.",
        "Variance against mean above the bias: "
        + "; ".join(f"{name} {short(float(value))} DN²" for name, value in medians),
        (table,),
        _transfer_chart(table, gain, noise),
    )


def _transfer_table(samples: Samples, bias: NDArray[Any]) -> DataTable:
    """Return medians over the pixels of mean above the bias (DN) and variance (DN^2) of each sample."""
    mean = np.array([middle(each) for each in samples.arrays["mean"] - bias])
    variance = np.array([middle(each) for each in samples.arrays["variance"]])
    columns: dict[str, Any] = {
        "sample": [sample.name for sample in samples.samples],
        "kind": [sample.kind for sample in samples.samples],
        "mean above the bias": mean[:, 0],
        "variance": variance[:, 0],
        "variance at 16 %": variance[:, 2],
        "variance at 84 %": variance[:, 3],
    }
    units = dict.fromkeys(list(columns)[3:], "DN2") | {"mean above the bias": "DN"}
    return DataTable(columns, units)


def middle(values: NDArray[Any]) -> tuple[float, float, float, float]:
    """Return median, its standard error, and the 16 % and 84 % percentiles of the finite values."""
    found = summarise(np.asarray(values, np.float64), percentiles=(15.87, 84.13))
    low, high = found.percentiles.values()
    return found.median, found.median_stderr, low, high


def _exposures_chart(table: DataTable, slope: float, offset: float, error: float) -> Chart:
    """Return the chart of H against time or light with its line, and the residuals below.

    Points are medians over the pixels, bars the 16 to 84 % range between pixels; the error bars of the
    residuals are standard errors of the median.
    """
    against = list(table.columns)[1]
    places, exposures = table[against].astype(np.float64), table["H"]
    grid = np.linspace(0.0, 1.05 * places.max(), 50)
    marks = (
        Line(grid, offset + slope * grid, colour="vermilion", label="median line of the pixels"),
        Level(offset, colour="bars", width=0.8, dash=":"),
        Points(places, exposures, error=_spread(table, "H"), label="median pixel, 16–84 %"),
    )
    top = Panel(
        Axis("quanta exposure $H$ (e⁻)", low=min(0.0, 1.1 * offset)), marks, 2.0, legend="upper left",
        note=f"offset {measured(offset, error, 'e⁻')}", corner="lower right",
    )  # fmt: skip
    x = Axis(table.heading(against), 0.0, float(grid[-1]))
    return Chart((Stack((top, _residuals(places, table)), x, height_mm=92.0),))


def _spread(table: DataTable, name: str) -> FloatArray:
    """Return how far the 16 and 84 % percentiles lie from the median, as error bars."""
    ends = [table[f"{name} at {p} %"] - table[name] for p in (16, 84)]
    return np.abs(np.stack(ends, dtype=np.float64))


def _residuals(places: FloatArray, table: DataTable) -> Panel:
    """Return median residuals with their errors; without freedom there are none to speak of."""
    label, zero = "residual (e⁻)", Level(0.0, colour="bars", width=0.8)
    if "residual" not in table:
        return Panel(Axis(label, -1.0, 1.0), (zero,), note="two exposures: no residuals")
    found, error = table["residual"], table["residual standard error"]
    most = 1.3 * float(np.nanmax(np.abs(found) + error))
    points = Points(places, found, error=np.stack([error, error]), cap=2.0, label="median residual")
    return Panel(Axis(label, -most, most), (zero, points))


def _transfer_chart(table: DataTable, gain: float, noise: float) -> Chart:
    """Return the chart of variance against mean above the bias with the curve of the joint fit.

    Photon transfer: ``variance = sigma^2 + (mean - mu) / g`` in DN. Points are medians over the pixels; the
    curve has the median parameters.
    """
    x, y, kinds = (table[name] for name in ("mean above the bias", "variance", "kind"))
    known = finite(x[kinds == "exposed"])
    most = 1.15 * float(np.max(known, initial=1e-3))
    least = float(np.min(known[known > 0], initial=most))
    logarithmic = most > 60.0 * least
    start = 0.3 * least if logarithmic else 0.0
    grid = np.geomspace(start, most, 200) if logarithmic else np.linspace(0.0, most, 200)
    curve, shot = "joint fit: $\\sigma^2 + (x - \\mu)/g$", "shot noise alone"
    marks: list[Mark] = [
        Line(grid, noise**2 + grid / gain, colour="vermilion", label=curve),
        Line(grid, grid / gain, colour="sky", width=0.9, dash="--", label=shot),
        Level(noise**2, colour="bars", width=0.8, dash=":", label="read noise $\\sigma^2$"),
    ]
    spread = _spread(table, "variance")
    for kind, colour, label in (("exposed", "blue", "median pixel, 16–84 %"), ("bias", "ink", "bias")):
        chosen = kinds == kind
        if chosen.any():
            marks.append(
                Points(
                    np.maximum(x[chosen], grid[0]), y[chosen], mark="o" if kind == "exposed" else "s",
                    colour=colour, error=spread[:, chosen], label=label,
                )
            )  # fmt: skip
    up = Axis("variance (DN²)")
    if logarithmic:
        up = replace(up, low=0.4 * noise**2, high=2.0 * (noise**2 + most / gain), log=True)
    panel = Panel(up, tuple(marks), legend="upper left")
    return Chart((Stack((panel,), Axis("mean above the bias (DN)", log=logarithmic), height_mm=66.0),))
