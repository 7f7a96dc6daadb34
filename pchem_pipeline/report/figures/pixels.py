"""Figures of single pixels: the cells of the electron number, and histograms with their fits."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.base.wording import cut, plain, short, stored_unit, symbol
from pchem_pipeline.model.law.pcd import pcd, thresholds
from pchem_pipeline.report.charts.chart import (
    COLUMN_MM,
    PAGE_MM,
    Axis,
    Chart,
    Level,
    Line,
    Mark,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
    Sticks,
    Words,
)
from pchem_pipeline.report.data import PixelFit, ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure

_TITLE_NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


def cell_figures(data: ReportData) -> Iterator[Figure]:
    """Return the cells of the electron number of a pixel of the run (fig:optimal_quantization)."""
    pixel = next((pixel for pixel in data.pixels if has_fit(pixel.parameters)), None)
    if pixel is None:
        return
    tables = cell_tables(pixel)
    edges = thresholds(*_theta(pixel.parameters), 4)
    first = ", ".join(short(float(edge), 4) for edge in edges if np.isfinite(edge))
    yield Figure(
        "electron_cells",
        "",
        f"Limits between electron numbers, {pixel.place}",
        "Histogram of the pixel (gray), its fitted density (line), and the limits between the most probable "
        "electron numbers (dashed). They are not half-way between the peaks, since small and large numbers "
        "are not equally likely.",
        f"Histogram and density of {pixel.place}; first limits at {first} DN.",
        tables,
        cells_chart(tables),
    )


def pixel_figures(data: ReportData) -> Iterator[Figure]:
    """Return the histograms of the shown pixels with their fits."""
    if not data.pixels:
        return
    units = {"y": "pixel", "x": "pixel", "dn": "DN", "residual": "standard deviations"}
    words, rows = [], []
    for pixel in data.pixels:
        numbers = ", ".join(f"{symbol(name)[1]} {pixel.text(name)}" for name in _TITLE_NAMES)
        state = f" ({pixel.status})" if pixel.status else ""
        words.append(f"{pixel.label} {pixel.place}: {numbers}{state}".strip())
        row: dict[str, Any] = {"y": pixel.y, "x": pixel.x, "shown as": pixel.label}
        for name in (*PARAMETERS, "read_noise_e"):
            units |= dict.fromkeys((name, f"{name} standard error"), stored_unit(name))
            row[name] = pixel.parameters.get(name, np.nan)
            row[f"{name} standard error"] = pixel.stderr.get(name, np.nan)
        rows.append(row | {"goodness_p": pixel.goodness_p, "fit_status": pixel.status})
    facts = {name: [row[name] for row in rows] for name in rows[0]}
    parts = [pixel_columns(pixel) for pixel in data.pixels]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    yield Figure(
        "pixel_fits",
        "pixels",
        "Histograms of single pixels with their fits",
        "Gray: share of the frames at each digital number. Black: fitted density. Below: (observed − "
        "expected) / √expected; gray band: 2 sigma. In a good fit about one line in twenty is outside the "
        "band, without a pattern. Uncertainties are standard errors of the fit.",
        "Histograms with fitted densities. " + "; ".join(words) + ".",
        (DataTable(columns, units), DataTable(facts, units, "parameters")),
        pixels_chart(data.pixels),
        PAGE_MM if len(data.pixels) > 1 else COLUMN_MM,
    )


def _codes(pixel: PixelFit) -> IntArray:
    return pixel.origin + np.arange(pixel.counts.size)


def pixel_columns(pixel: PixelFit) -> dict[str, NDArray[Any]]:
    """Return the histogram of a pixel, what its fit expects at each DN, and the residuals; NaN without."""
    dn, n = _codes(pixel), pixel.counts.size
    expected = np.full(n, np.nan)
    if has_fit(pixel.parameters):
        # under a model with effects the mass of each code, else the density there
        mass = pcd(dn.astype(np.float64), *_theta(pixel.parameters)) if pixel.mass is None else pixel.mass
        expected = pixel.counts.sum() * mass
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(expected >= 1.0, (pixel.counts - expected) / np.sqrt(expected), np.nan)
    return {
        "y": np.full(n, pixel.y),
        "x": np.full(n, pixel.x),
        "dn": dn,
        "frames": pixel.counts,
        "expected frames": expected,
        "residual": residual,
    }


def has_fit(parameters: Mapping[str, float]) -> bool:
    """Return whether the four parameters of the PCD are all known and describe a density."""
    values = _theta(parameters)
    return bool(np.all(np.isfinite(values))) and values[1] > 0 and values[3] > 0 and values[0] >= 0


def _theta(parameters: Mapping[str, float]) -> tuple[float, float, float, float]:
    """Return (H, g, mu, sigma); NaN where one is not known."""
    exposure, gain, bias, sigma = (parameters.get(name, float("nan")) for name in PARAMETERS)
    return exposure, gain, bias, sigma


def _bars(counts: NDArray[Any], origin: int, where: slice) -> Steps:
    """Return these bins of a histogram of DN, normalised with all of them, as gray bars of 1 DN."""
    edges = (origin + np.arange(counts.size + 1) - 0.5)[where.start : where.stop + 1]
    return Steps(edges, counts[where] / counts.sum(), filled=True, colour="bars", label="frames")


def shown_bins(counts: NDArray[Any], *, tail: float = 2e-4) -> slice:
    """Return the bins to draw: all between the quantiles ``tail`` and ``1 - tail``, and a margin of a tenth.

    Raises:
        ValueError: if there is no count at all.
    """
    total = int(counts.sum())
    if total == 0:
        raise ValueError("the histogram is empty")
    cumulative = np.cumsum(counts) / total
    first = int(np.searchsorted(cumulative, tail))
    last = int(np.searchsorted(cumulative, 1.0 - tail))
    margin = max(2, (last - first) // 10)
    occupied = np.flatnonzero(counts)
    return slice(
        max(first - margin, int(occupied[0]) - 2, 0),
        min(last + margin, int(occupied[-1]) + 2, counts.size) + 1,
    )


def pixels_chart(pixels: Sequence[PixelFit]) -> Chart:
    """Return the chart of histograms with the fitted density and the residuals (fig:plot_per_pixel_fits).

    Gray bars are the share of frames at each DN, the black line is the fitted density, or under a model with
    effects the mass of each DN. The strip below shows ``(count - expected) / sqrt(expected)`` where at least
    one frame is expected. Of several pixels two are in a row on a page.
    """
    if len(pixels) == 1:
        return Chart((_one_pixel(pixels[0], ""),))
    letters = itertools.cycle("abcdefghijklmnop")
    return Chart(tuple(map(_one_pixel, pixels, letters)), (1.0, 1.0))


def _one_pixel(pixel: PixelFit, letter: str) -> Stack:
    density, residual = "density (1/DN)", "residual\n(σ)"
    title, total = _title(pixel, letter), int(pixel.counts.sum())
    if total == 0:
        panels = (Panel(Axis(density), (), 3.4, note="no frames"), Panel(Axis(residual), (), 1.0))
        return Stack(panels, Axis("signal (DN)"), title, height_mm=62.0)
    where = shown_bins(pixel.counts)
    dn = _codes(pixel)
    low, high = dn[where][0] - 0.5, dn[where][-1] + 0.5
    bars = _bars(pixel.counts, pixel.origin, where)
    marks: list[Mark] = [bars]
    tallest = float(np.max(bars.values))
    remarks = [f"{total:,} {'samples' if pixel.channel else 'frames'}"]
    outside = total - int(pixel.counts[where].sum())
    if outside:
        remarks.append(f"{outside:,} outside the axis")
    strip = Panel(Axis(residual, -3.5, 3.5), (), 1.0)
    if has_fit(pixel.parameters):
        if pixel.mass is None:
            x = np.linspace(low, high, int(np.clip(8 * (high - low), 400, 3000)))
            y = pcd(x, *_theta(pixel.parameters))
        else:
            x, y = dn[where].astype(np.float64), pixel.mass[where]
        tallest = max(tallest, float(np.nanmax(y)))
        marks.append(Line(x, y, colour="ink", label="fit"))
        if np.isfinite(pixel.goodness_p):
            remarks.append(f"goodness of fit p = {pixel.goodness_p:.2g}")
        strip = _residual_strip(pixel, where, residual)
    else:
        remarks.append("no fit")
    top = Panel(Axis(density, 0.0, 1.3 * max(tallest, 1e-12)), tuple(marks), 3.4, note="\n".join(remarks))
    return Stack((top, strip), Axis("signal (DN)", float(low), float(high)), title, height_mm=62.0)


def _residual_strip(pixel: PixelFit, where: slice, label: str) -> Panel:
    columns = pixel_columns(pixel)
    enough = np.isfinite(columns["residual"][where])
    dn, residual = (columns[name][where][enough] for name in ("dn", "residual"))
    limit = float(np.clip(1.15 * np.max(np.abs(residual), initial=0.0), 3.5, 12.0))
    marks: list[Mark] = [
        Span(-2.0, 2.0, colour="band"),
        Level(0.0, colour="ink", width=0.6),
        Sticks(dn, np.clip(residual, -limit, limit), width=0.7, label="residual"),
    ]
    beyond = np.abs(residual) > limit
    note = ""
    if beyond.any():
        at = np.sign(residual[beyond]) * 0.93 * limit
        marks.append(Points(dn[beyond], at, mark="x", colour="vermilion", size=3.0))
        note = f"× {int(beyond.sum())} beyond {limit:.0f} σ"
    return Panel(Axis(label, -limit, limit), tuple(marks), 1.0, note=note)


def _title(pixel: PixelFit, letter: str) -> str:
    head = " ".join(part for part in (f"({letter})" if letter else "", plain(cut(pixel.label, 40))) if part)
    lines = [f"{head}: {pixel.place}" if head else pixel.place]
    if has_fit(pixel.parameters):
        known = (name for name in _TITLE_NAMES if name in pixel.parameters)
        words = [f"{symbol(name)[0]} = {pixel.text(name)}" for name in known]
        lines += ["   ".join(words[i : i + 2]) for i in range(0, len(words), 2)]
    if pixel.status:
        lines += textwrap.wrap(f"status: {plain(pixel.status)}", 52, max_lines=5, placeholder=" …")
    return "\n".join(lines)


def cell_tables(pixel: PixelFit) -> tuple[DataTable, ...]:
    """Return a pixel's density, the edges between the cells of its electron numbers, and its histogram."""
    theta = _theta(pixel.parameters)
    exposure, gain, bias, sigma = theta
    last = int(np.ceil(exposure + 3.0 * np.sqrt(max(exposure, 0.3)))) + 1
    low, high = bias - 4.0 * sigma, bias + last / gain + 4.0 * sigma
    x = np.linspace(low, high, 1200)
    edges = thresholds(*theta, last + 1)
    edges = edges[edges < high]
    density = DataTable({"signal": x, "density": pcd(x, *theta)}, {"signal": "DN", "density": "1/DN"})
    between = DataTable({"below k": np.arange(1, edges.size + 1), "edge": edges}, {"edge": "DN"}, "edges")
    histogram = DataTable({"dn": _codes(pixel), "frames": pixel.counts}, {"dn": "DN"}, "histogram")
    return density, between, histogram


def cells_chart(tables: Sequence[DataTable]) -> Chart:
    """Return the chart of :func:`cell_tables`: a PCD with the edges between numbers (eq. demarg_K_eqn)."""
    density, between, histogram = tables
    x, edges, dn = density["signal"], between["edge"], histogram["dn"]
    low, high = float(x[0]), float(x[-1])
    curve = Line(x, density["density"], colour="ink", label="fitted density")
    first = int(np.clip(np.floor(low) - dn[0], 0, dn.size - 1))
    last = int(np.clip(np.ceil(high) - dn[0], first, dn.size - 1))
    bars = _bars(histogram["frames"], int(dn[0]), slice(first, last + 1))
    top = 1.28 * max(float(np.max(curve.y)), float(np.max(bars.values)))
    ends = np.full(edges.size, 0.86 * top)
    dashed = Sticks(edges, ends, colour="blue", dash="--", width=0.9, label="limit between numbers k")
    cells = np.concatenate([[low], edges, [high]])
    every = -(-len(cells) // 18)  # of more cells not each has its number
    words = [Words((cells[k] + cells[k + 1]) / 2, 0.87, str(k)) for k in range(0, len(cells) - 1, every)]
    panel = Panel(Axis("density (1/DN)", 0.0, top), (bars, curve, dashed, *words))
    return Chart((Stack((panel,), Axis("signal (DN)", low, high), height_mm=55.0),), legend=(3, 3))
