"""Figures of a joint fit: the exposures with their line, and the photon-transfer curve."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pchem_pipeline.report.pages.joint_data import AXES, JointData, middle
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    SKY,
    VERMILION,
    new_figure,
    note,
    styled,
)
from pchem_pipeline.report.style.wording import short

__all__ = ["exposure_figure", "photon_transfer"]


@styled
def exposure_figure(data: JointData, *, width_mm: float = COLUMN_MM) -> Figure:
    """Draw the quanta exposures against time or light with their line, and the residuals below.

    Points are medians over the pixels, bars the 16 to 84 % range between pixels; the error bars of the
    residuals are standard errors of the median.

    Args:
        data: what was found; it has a line.
        width_mm: width of the figure.
    """
    words, unit, _ = AXES[data.against]
    label = f"{words} ({unit})" if unit else words
    figure = new_figure(width_mm, 92.0)
    top, bottom = figure.subplots(2, 1, height_ratios=(2.0, 1.0), sharex=True)
    places = np.array([data.samples[i].x for i in data.on_line], np.float64)
    exposures = np.array([middle(data.joint["quanta_exposure"][i]) for i in data.on_line])
    slope, offset = (float(np.median(finite(data.maps[name]))) for name in _line_names(data))
    grid = np.linspace(0.0, 1.05 * places.max(), 50)
    top.plot(grid, offset + slope * grid, color=VERMILION, label="median line of the pixels")
    spread = np.abs(exposures[:, 2:] - exposures[:, :1]).T
    label_points = "median pixel, 16–84 %"
    top.errorbar(
        places, exposures[:, 0], yerr=spread, fmt="o", color=BLUE, markersize=3.5, label=label_points
    )
    top.axhline(offset, color=GRAY, linewidth=0.8, linestyle=":")
    top.set(ylabel="quanta exposure $H$ (e⁻)")
    top.set_ylim(bottom=min(0.0, 1.1 * offset))
    top.legend(loc="upper left")
    note(top, f"offset {short(offset)} e⁻", where="lower right")
    _residuals(bottom, data, places)
    bottom.set(xlabel=label, ylabel="residual (e⁻)", xlim=(0.0, grid[-1]))
    return figure


def _line_names(data: JointData) -> tuple[str, str]:
    return ("dark_current" if data.against == "integration_time" else "charge_per_level"), "spurious_charge"


def _residuals(axes: Axes, data: JointData, places: np.ndarray[tuple[int], np.dtype[np.float64]]) -> None:
    """Draw median residuals with their errors; without freedom there are none to speak of."""
    axes.axhline(0.0, color=GRAY, linewidth=0.8)
    if places.size < 3:
        note(axes, "two exposures: the line goes through both")
        axes.set_ylim(-1.0, 1.0)
        return
    found = np.array([middle(data.joint["linearity_residual"][i]) for i in data.on_line])
    axes.errorbar(places, found[:, 0], yerr=found[:, 1], fmt="o", color=BLUE, markersize=3.5, capsize=2)
    most = 1.3 * np.nanmax(np.abs(found[:, 0]) + found[:, 1])
    axes.set_ylim(-most, most)


@styled
def photon_transfer(data: JointData, *, width_mm: float = COLUMN_MM) -> Figure:
    """Draw variance against mean above the bias with the curve of the joint fit.

    Photon transfer: ``variance = sigma^2 + (mean - mu) / g`` in DN. Points are medians over the pixels; the
    curve has the median parameters.

    Args:
        data: what was found.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 66.0)
    axes = figure.add_subplot()
    above = data.joint["mean"] - data.maps["bias"]
    x = np.array([middle(each) for each in above])
    y = np.array([middle(each) for each in data.joint["variance"]])
    gain, noise = (float(np.median(finite(data.maps[name]))) for name in ("conversion_gain", "read_noise_dn"))
    lit = [i for i, sample in enumerate(data.samples) if sample.kind == "exposed"]
    known = finite(x[lit, 0])
    most = 1.15 * float(np.max(known, initial=1e-3))
    least = float(np.min(known[known > 0], initial=most))
    logarithmic = most > 60.0 * least
    start = 0.3 * least if logarithmic else 0.0
    grid = np.geomspace(start, most, 200) if logarithmic else np.linspace(0.0, most, 200)
    axes.plot(grid, noise**2 + grid / gain, color=VERMILION, label="joint fit: $\\sigma^2 + (x - \\mu)/g$")
    axes.plot(grid, grid / gain, color=SKY, linewidth=0.9, linestyle="--", label="shot noise alone")
    axes.axhline(noise**2, color=GRAY, linewidth=0.8, linestyle=":", label="read noise $\\sigma^2$")
    for kind, mark, colour in (("exposed", "o", BLUE), ("bias", "s", BLACK)):
        chosen = [i for i, sample in enumerate(data.samples) if sample.kind == kind]
        if chosen:
            spread = np.abs(y[chosen, 2:] - y[chosen, :1]).T
            place = np.maximum(x[chosen, 0], grid[0])
            axes.errorbar(
                place, y[chosen, 0], yerr=spread, fmt=mark, color=colour, markersize=3.5, zorder=3,
                label={"exposed": "median pixel, 16–84 %", "bias": "bias"}[kind],
            )  # fmt: skip
    if logarithmic:
        axes.set(xscale="log", yscale="log", ylim=(0.4 * noise**2, 2.0 * (noise**2 + most / gain)))
    axes.set(xlabel="mean above the bias (DN)", ylabel="variance (DN²)")
    axes.legend(loc="upper left")
    return figure
