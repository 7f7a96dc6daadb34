"""The numbers behind each figure as tables, for the CSV files beside figures for papers."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.checks.multiple_testing import misfit
from pchem_pipeline.model.electrons.electrons import thresholds
from pchem_pipeline.model.law.pcd import pcd
from pchem_pipeline.report.data import MAP_NAMES, PixelFit, ReportData
from pchem_pipeline.report.figures.exhibits import UNCERTAIN, Exhibit
from pchem_pipeline.report.figures.map_figures import is_strip, map_bins, status_counts
from pchem_pipeline.report.figures.method_exhibits import METHOD_FIGURE
from pchem_pipeline.report.figures.pixel_figures import PAPER_EXAMPLE, cell_range, has_fit
from pchem_pipeline.report.figures.plan_exhibits import PLAN_FIGURE
from pchem_pipeline.report.figures.rounding_figures import rounding_curves
from pchem_pipeline.report.figures.trust_figures import noise_shares
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.wording import stored_unit

__all__ = ["DataTable", "csv_text", "figure_tables"]


@dataclass(frozen=True)
class DataTable:
    """Columns of equal length under headings that bear the unit.

    Attributes:
        part: what of the figure it is, for the name of its file; empty for the main part.
        columns: heading to values.
    """

    part: str
    columns: Mapping[str, Sequence[Any] | NDArray[Any]]


def csv_text(table: DataTable) -> str:
    """Return a table as CSV: a line of headings, then rows; values that are not known are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    columns = [np.asarray(values).tolist() for values in table.columns.values()]
    writer.writerows(zip(*(_known(column) for column in columns), strict=True))
    return text.getvalue()


def _known(column: list[Any]) -> list[Any]:
    return ["" if isinstance(value, float) and value != value else value for value in column]


def figure_tables(exhibit: Exhibit, data: ReportData, settings: ReportSettings) -> list[DataTable] | None:
    """Return the numbers of a figure of the report, or None for one that is not known here.

    Args:
        exhibit: the figure.
        data: what it was made from.
        settings: bins of its histograms.
    """
    if exhibit.name.removeprefix("map_") in MAP_NAMES:
        return _map(exhibit.name.removeprefix("map_"), data, settings)
    make = _MAKERS.get(exhibit.name)
    return None if make is None else make(data, settings)


def _grid(shape: tuple[int, ...]) -> dict[str, NDArray[Any]]:
    y, x = np.indices(shape)
    return {"y (pixel)": y.ravel(), "x (pixel)": x.ravel()}


def _histogram(values: NDArray[Any], heading: str, bins: int, part: str) -> DataTable:
    counts, edges = map_bins(values, bins)
    return DataTable(part, {f"{heading} from": edges[:-1], f"{heading} to": edges[1:], "pixels": counts})


def _map(name: str, data: ReportData, settings: ReportSettings) -> list[DataTable]:
    values, heading = data.maps[name], f"{name} ({stored_unit(name)})"
    columns: dict[str, Any] = {**_grid(values.shape), heading: values.ravel()}
    if f"{name}_stderr" in data.maps:
        columns[f"standard error ({stored_unit(name)})"] = data.maps[f"{name}_stderr"].ravel()
    tables = [DataTable("", columns)]
    if not is_strip(values.shape):
        tables.append(_histogram(values, heading, settings.histogram_bins, "histogram"))
    return tables


def _read_noise(data: ReportData, settings: ReportSettings) -> list[DataTable]:
    values = data.maps["read_noise_e"]
    return [_histogram(values, "read_noise_e (e-)", settings.histogram_bins, "")]


def _status(data: ReportData, _: ReportSettings) -> list[DataTable]:
    status = data.fit["fit_status"]
    rows = status_counts(status, data.status_words)
    columns: dict[str, list[Any]] = {
        "bit": [bit for bit, _, _ in rows],
        "meaning": [text for _, text, _ in rows],
        "pixels": [n for _, _, n in rows],
    }
    return [
        DataTable("", _grid(status.shape) | {"fit_status": status.ravel()}),
        DataTable("reasons", columns),
    ]


def _cells(parameters: Mapping[str, float], unit: str) -> list[DataTable]:
    exposure, gain, bias, sigma = (parameters[name] for name in PAPER_EXAMPLE)
    low, high, last = cell_range(exposure, gain, bias, sigma)
    x = np.linspace(low, high, 1200)
    edges = thresholds(exposure, gain, bias, sigma, last + 1)
    edges = edges[edges < high]
    return [
        DataTable("", {f"signal ({unit})": x, f"density (1/{unit})": pcd(x, exposure, gain, bias, sigma)}),
        DataTable("edges", {"below k": np.arange(1, edges.size + 1), f"edge ({unit})": edges}),
    ]


def _example(_: ReportData, __: ReportSettings) -> list[DataTable]:
    return _cells(PAPER_EXAMPLE, "e-")


def _first_fitted(data: ReportData, _: ReportSettings) -> list[DataTable]:
    pixel = next(pixel for pixel in data.pixels if has_fit(pixel.parameters))
    columns = {"dn (DN)": _codes(pixel), "frames": pixel.counts}
    return [*_cells(pixel.parameters, "DN"), DataTable("histogram", columns)]


def _codes(pixel: PixelFit) -> NDArray[np.int64]:
    return pixel.origin + np.arange(pixel.counts.size)


def _goodness(data: ReportData, _: ReportSettings) -> list[DataTable]:
    columns = {name: data.fit[f"goodness_{name}"].ravel() for name in ("p", "chi2", "dof", "q")}
    deviate = misfit(columns["chi2"], columns["dof"])
    return [DataTable("", _grid(data.shape) | columns | {"misfit (standard deviations)": deviate})]


def _left_out(data: ReportData, _: ReportSettings) -> list[DataTable]:
    share = data.fit["outlier_share"]
    return [DataTable("", _grid(share.shape) | {"share left out": share.ravel()})]


def _uncertainty(data: ReportData, _: ReportSettings) -> list[DataTable]:
    shares = noise_shares(data.maps, UNCERTAIN)
    columns: dict[str, Any] = {"map": list(shares), "share of the variance": list(shares.values())}
    names = ("epcd_exact", "epcd_stderr")
    curves = {f"{name} (1/DN)": data.ensemble[name] for name in names if name in data.ensemble}
    return [DataTable("maps", columns), DataTable("ensemble", {"dn (DN)": data.ensemble["dn"], **curves})]


def _rounding(data: ReportData, _: ReportSettings) -> list[DataTable]:
    curves = rounding_curves(data.maps, data.n_frames)
    headings = {name: f"{name} (standard errors)" for name in curves} | {"step": "1/g (DN/e-)"}
    return [DataTable("", {headings[name]: values for name, values in curves.items()})]


def _worst(data: ReportData, settings: ReportSettings) -> list[DataTable]:
    return _pixels(replace(data, pixels=data.worst), settings)


def _pixels(data: ReportData, _: ReportSettings) -> list[DataTable]:
    parts = [_pixel_columns(pixel) for pixel in data.pixels]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    facts: dict[str, list[Any]] = {
        "y (pixel)": [pixel.y for pixel in data.pixels],
        "x (pixel)": [pixel.x for pixel in data.pixels],
        "shown as": [pixel.label for pixel in data.pixels],
    }
    for name in (*PAPER_EXAMPLE, "read_noise_e"):
        unit, nan = stored_unit(name), float("nan")
        facts[f"{name} ({unit})"] = [pixel.parameters.get(name, nan) for pixel in data.pixels]
        facts[f"{name} standard error ({unit})"] = [pixel.stderr.get(name, nan) for pixel in data.pixels]
    facts["goodness_p"] = [pixel.goodness_p for pixel in data.pixels]
    facts["fit_status"] = [pixel.status for pixel in data.pixels]
    return [DataTable("", columns), DataTable("parameters", facts)]


def _pixel_columns(pixel: PixelFit) -> dict[str, NDArray[Any]]:
    dn, n = _codes(pixel), pixel.counts.size
    expected = np.full(n, np.nan)
    if has_fit(pixel.parameters):
        theta = (pixel.parameters[name] for name in PAPER_EXAMPLE)
        density = pcd(dn.astype(np.float64), *theta) if pixel.mass is None else pixel.mass
        expected = pixel.counts.sum() * density
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(expected >= 1.0, (pixel.counts - expected) / np.sqrt(expected), np.nan)
    return {
        "y (pixel)": np.full(n, pixel.y),
        "x (pixel)": np.full(n, pixel.x),
        "dn (DN)": dn,
        "frames": pixel.counts,
        "expected frames": expected,
        "residual (standard deviations)": residual,
    }


def _ensemble(data: ReportData, _: ReportSettings) -> list[DataTable]:
    tables = []
    for part, axis, data_name, model, unit in (
        ("raw", "dn", "", "epcd_", "DN"),
        ("nuced", "electrons", "nuced_", "nuced_", "e-"),
    ):
        if axis in data.ensemble and f"{data_name}density" in data.ensemble:
            columns = {f"{axis} ({unit})": data.ensemble[axis]}
            columns["counts"] = data.ensemble[f"{data_name}counts"]
            names = [
                "density",
                *(f"{model}{suffix}" for suffix in ("exact", "stderr", "dependent", "independent")),
            ]
            names[0] = f"{data_name}density"
            columns |= {f"{n} (1/{unit})": data.ensemble[n] for n in names if n in data.ensemble}
            tables.append(DataTable(part, columns))
    return tables


def _electrons(data: ReportData, _: ReportSettings) -> list[DataTable]:
    names = ("electron_counts", "electron_mass", "electron_pmf", "electron_pmf_map")
    found = {name: data.ensemble[name] for name in names if name in data.ensemble}
    return [DataTable("", {"k (e-)": data.ensemble["k"], **found})]


def _components(data: ReportData, _: ReportSettings) -> list[DataTable]:
    variance = data.ensemble["component_variance"]
    cases = data.component_cases or [f"case {i}" for i in range(variance.shape[0])]
    columns: dict[str, Any] = {"k (e-)": np.arange(variance.shape[1])}
    for case, row in zip(cases, variance, strict=True):
        columns[f"sd, constant: {case} (DN)"] = np.sqrt(np.maximum(row, 0.0))
    if "nuced_component_variance" in data.ensemble:
        columns["sd after correction (e-)"] = np.sqrt(
            np.maximum(data.ensemble["nuced_component_variance"], 0.0)
        )
    return [DataTable("", columns)]


def _methods(data: ReportData, _: ReportSettings) -> list[DataTable]:
    result = data.methods or {"study": [], "methods": []}
    tables = []
    if result["study"]:
        study = result["study"]
        columns: dict[str, Any] = {"read_noise_e (e-)": [point["read_noise_e"] for point in study]}
        for name in study[0]["methods"]:
            gain = [point["methods"][name]["errors"]["conversion_gain"] for point in study]
            columns[f"{name}: rms error of g"] = [_number(each["rmse"]) for each in gain]
        for name in study[0]["bounds"]:
            columns[f"limit, {name}"] = [_number(point["bounds"][name]) for point in study]
        tables.append(DataTable("simulated", columns))
    known = [method for method in result["methods"] if method["errors"]]
    gain = [method["errors"]["conversion_gain"] for method in known]
    rows = {"method": [method["name"] for method in known]}
    numbers = {key: [_number(each[key]) for each in gain] for key in ("bias", "rmse", "robust_sd", "bound")}
    return [*tables, DataTable("run", rows | numbers)]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _frames_needed(data: ReportData, _: ReportSettings) -> list[DataTable]:
    contours = (data.plan or {})["contours"]
    noise, exposure = np.meshgrid(contours["read_noises"], contours["exposures"], indexing="ij")
    columns = {"read_noise_e (e-)": noise.ravel(), "quanta_exposure (e-)": exposure.ravel()}
    frames = {f"frames for {words}": np.ravel(values) for words, values in contours["frames"].items()}
    return [DataTable("", columns | frames)]


_MAKERS: dict[str, Callable[[ReportData, ReportSettings], list[DataTable]]] = {
    "cluster_edges_example": _example,
    "cluster_edges_pixel": _first_fitted,
    "pixel_fits": _pixels,
    "goodness": _goodness,
    "worst_pixels": _worst,
    "left_out": _left_out,
    "uncertainty": _uncertainty,
    "rounding": _rounding,
    "read_noise_histogram": _read_noise,
    "ensemble": _ensemble,
    "electron_numbers": _electrons,
    "component_widths": _components,
    "fit_status": _status,
    METHOD_FIGURE: _methods,
    PLAN_FIGURE: _frames_needed,
}
