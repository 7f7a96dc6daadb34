"""Figures of single pixels: the cells of the electron number, and histograms with their fits."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from pchem_pipeline.model.electrons.electrons import thresholds
from pchem_pipeline.model.law.pcd import pcd
from pchem_pipeline.report.data import PixelFit
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    PAGE_MM,
    VERMILION,
    new_figure,
    note,
    plain,
    styled,
)
from pchem_pipeline.report.style.wording import measured, symbol

__all__ = ["PAPER_EXAMPLE", "cell_range", "cluster_edges", "has_fit", "pixel_fits", "shown_bins"]

FloatArray = NDArray[np.float64]

#: The example of the paper, PCD(1.8, 1, 0, 0.33^2), in units of e- (fig:optimal_quantization).
PAPER_EXAMPLE: Mapping[str, float] = {
    "quanta_exposure": 1.8,
    "conversion_gain": 1.0,
    "bias": 0.0,
    "read_noise_dn": 0.33,
}

_LETTERS = "abcdefghijklmnop"
_TITLE_NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


def has_fit(parameters: Mapping[str, float]) -> bool:
    """Tell whether the four parameters of the PCD are all known and describe a density."""
    values = [parameters.get(name, float("nan")) for name in PAPER_EXAMPLE]
    return bool(np.all(np.isfinite(values))) and values[1] > 0 and values[3] > 0 and values[0] >= 0


def _theta(parameters: Mapping[str, float]) -> tuple[float, float, float, float]:
    return (
        parameters["quanta_exposure"],
        parameters["conversion_gain"],
        parameters["bias"],
        parameters["read_noise_dn"],
    )


@styled
def cluster_edges(
    parameters: Mapping[str, float],
    *,
    counts: NDArray[Any] | None = None,
    origin: int = 0,
    width_mm: float = COLUMN_MM,
) -> Figure:
    """Draw a PCD with the optimal edges between electron numbers (Hendrickson et al. 2023, eq. demarg_K_eqn).

    Args:
        parameters: the four parameters of the PCD, e.g. ``PAPER_EXAMPLE``.
        counts: histogram of the pixel drawn behind, shape (n_bins,); None for an example without data.
        origin: DN of ``counts[0]``.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 0.62 * min(width_mm, 1.3 * COLUMN_MM))
    axes = figure.add_subplot()
    if not has_fit(parameters):
        return _empty(figure, axes, "no fitted pixel to show")
    exposure, gain, bias, sigma = _theta(parameters)
    in_electrons = gain == 1.0 and bias == 0.0
    unit = "e⁻" if in_electrons else "DN"
    low, high, last = cell_range(exposure, gain, bias, sigma)
    if counts is not None and counts.sum() > 0:
        # bars beyond the axis would only make the files large
        first = int(np.clip(np.floor(low) - origin, 0, counts.size - 1))
        last_bar = int(np.clip(np.ceil(high) - origin, first, counts.size - 1))
        _bars(axes, counts, origin, slice(first, last_bar + 1))
    x = np.linspace(low, high, 1200)
    axes.plot(
        x,
        pcd(x, exposure, gain, bias, sigma),
        color=BLACK,
        label="fitted density" if counts is not None else "PCD",
    )
    top = 1.22 * axes.get_ylim()[1]
    edges = thresholds(exposure, gain, bias, sigma, last + 1)
    edges = edges[edges < high]
    axes.vlines(edges, 0.0, 0.86 * top, color=BLUE, linestyle="--", linewidth=0.9, label="edge of a cell")
    cells = np.concatenate([[low], edges, [high]])
    every = max(1, int(np.ceil(len(cells) / (18 if width_mm <= COLUMN_MM else 30))))
    for k in range(0, len(cells) - 1, every):
        axes.text(
            (cells[k] + cells[k + 1]) / 2,
            0.87 * top,
            f"k = {k}" if k == 0 else str(k),
            ha="center",
            va="bottom",
            color=BLUE,
            fontsize=7,
        )
    axes.set(xlim=(low, high), ylim=(0.0, top), xlabel=f"signal ({unit})", ylabel=f"density (1/{unit})")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def cell_range(exposure: float, gain: float, bias: float, sigma: float) -> tuple[float, float, int]:
    """Return the signals between which cells are drawn (DN), and the last electron number among them.

    Args:
        exposure: H, e-.
        gain: g, e-/DN.
        bias: mu, DN.
        sigma: read noise, DN.
    """
    last = int(np.ceil(exposure + 3.0 * np.sqrt(max(exposure, 0.3)))) + 1
    return bias - 4.0 * sigma, bias + last / gain + 4.0 * sigma, last


def _bars(axes: Axes, counts: NDArray[Any], origin: int, where: slice) -> None:
    """Draw these bins of a histogram of DN, normalised with all of them, as gray bars of 1 DN."""
    edges = (origin + np.arange(counts.size + 1) - 0.5)[where.start : where.stop + 1]
    axes.stairs(counts[where] / counts.sum(), edges, fill=True, color=GRAY, label="frames")


def _empty(figure: Figure, axes: Axes, text: str) -> Figure:
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, wrap=True)
    axes.set_axis_off()
    return figure


def shown_bins(counts: NDArray[Any], *, tail: float = 2e-4) -> slice:
    """Return the bins to draw: all between the quantiles ``tail`` and ``1 - tail``, and a margin of a tenth.

    Raises:
        ValueError: if there is no count at all.
    """
    total = int(counts.sum())
    if total == 0:
        raise ValueError("the histogram is empty; there is nothing to show")
    cumulative = np.cumsum(counts) / total
    first = int(np.searchsorted(cumulative, tail))
    last = int(np.searchsorted(cumulative, 1.0 - tail))
    margin = max(2, (last - first) // 10)
    occupied = np.flatnonzero(counts)
    return slice(
        max(first - margin, int(occupied[0]) - 2, 0),
        min(last + margin, int(occupied[-1]) + 2, counts.size) + 1,
    )


@styled
def pixel_fits(pixels: Sequence[PixelFit], *, width_mm: float = PAGE_MM) -> Figure:
    """Draw histograms of pixels with the fitted density and the residuals (fig:plot_per_pixel_fits).

    Gray bars are the share of frames at each DN, the black line is the fitted density, or under a model with
    effects the mass of each DN. The strip below
    shows ``(count - expected) / sqrt(expected)`` where at least one frame is expected.

    Args:
        pixels: any number; two in a row on a page, one in a row on a column.
        width_mm: width of the figure.
    """
    columns = 2 if width_mm > 1.5 * COLUMN_MM and len(pixels) > 1 else 1
    rows = max(1, -(-len(pixels) // columns))
    lines = max((_title(pixel, "a", width_mm / columns).count("\n") for pixel in pixels), default=0)
    figure = new_figure(width_mm, (62.0 + 3.5 * lines) * rows)
    if not pixels:
        return _empty(figure, figure.add_subplot(), "no pixel to show")
    parts = figure.subfigures(rows, columns, squeeze=False)
    for i, pixel in enumerate(pixels):
        letter = _LETTERS[i % len(_LETTERS)] if len(pixels) > 1 else ""
        _one_pixel(parts[i // columns, i % columns], pixel, letter, width_mm / columns)
    return figure


def _one_pixel(part: SubFigure, pixel: PixelFit, letter: str, width_mm: float) -> None:
    top, strip = part.subplots(2, 1, sharex=True, height_ratios=(3.4, 1.0))
    top.set_title(_title(pixel, letter, width_mm), fontsize=7.0, linespacing=1.35)
    strip.set(xlabel="signal (DN)", ylabel="residual\n(σ)")
    top.set_ylabel("density (1/DN)")
    total = int(pixel.counts.sum())
    if total == 0:
        note(top, "no frames")
        for axes in (top, strip):
            axes.set(xticks=[], yticks=[])
        return
    where = shown_bins(pixel.counts)
    dn = pixel.origin + np.arange(pixel.counts.size)
    low, high = dn[where][0] - 0.5, dn[where][-1] + 0.5
    _bars(top, pixel.counts, pixel.origin, where)
    top.set_xlim(low, high)
    remarks = [f"{total:,} {'samples' if pixel.channel else 'frames'}"]
    outside = total - int(pixel.counts[where].sum())
    if outside:
        remarks.append(f"{outside:,} outside the axis")
    if has_fit(pixel.parameters):
        x = np.linspace(low, high, int(np.clip(8 * (high - low), 400, 3000)))
        if pixel.mass is None:
            top.plot(x, pcd(x, *_theta(pixel.parameters)), color=BLACK)
        else:
            top.plot(dn[where], pixel.mass[where], color=BLACK)
        if np.isfinite(pixel.goodness_p):
            remarks.append(f"goodness of fit p = {pixel.goodness_p:.2g}")
        _residual_strip(strip, pixel, dn.astype(np.float64), where)
    else:
        remarks.append("no fit")
        strip.set_yticks([])
    top.set_ylim(0.0, 1.25 * max(top.get_ylim()[1], 1e-12))
    note(top, "\n".join(remarks))


def _residual_strip(strip: Axes, pixel: PixelFit, dn: FloatArray, where: slice) -> None:
    density = pcd(dn[where], *_theta(pixel.parameters)) if pixel.mass is None else pixel.mass[where]
    expected = pixel.counts.sum() * density
    enough = expected >= 1.0
    residual = (pixel.counts[where] - expected)[enough] / np.sqrt(expected[enough])
    limit = float(np.clip(1.15 * np.max(np.abs(residual), initial=0.0), 3.5, 12.0))
    strip.axhspan(-2.0, 2.0, color="#EDEDED", linewidth=0)
    strip.axhline(0.0, color=BLACK, linewidth=0.6)
    _sticks(strip, dn[where][enough], np.clip(residual, -limit, limit))
    beyond = np.abs(residual) > limit
    if beyond.any():
        strip.plot(
            dn[where][enough][beyond],
            np.sign(residual[beyond]) * 0.93 * limit,
            "x",
            color=VERMILION,
            markersize=3,
        )
        note(strip, f"× {int(beyond.sum())} beyond {limit:.0f} σ")
    strip.set_ylim(-limit, limit)


def _sticks(axes: Axes, x: FloatArray, y: FloatArray) -> None:
    """Draw lines from zero to each value, as one path: a fourth of the SVG that a path each takes."""
    ends = np.stack([np.repeat(x, 2), np.stack([np.zeros_like(y), y], axis=1).ravel()], axis=1)
    codes = np.tile([Path.MOVETO, Path.LINETO], x.size)
    axes.add_patch(PathPatch(Path(ends, codes), fill=False, edgecolor=BLUE, linewidth=0.7, zorder=2))


def _title(pixel: PixelFit, letter: str, width_mm: float) -> str:
    head = " ".join(part for part in (f"({letter})" if letter else "", plain(_cut(pixel.label))) if part)
    lines = [f"{head}: {pixel.place}" if head else pixel.place]
    if has_fit(pixel.parameters):
        words = []
        for name in _TITLE_NAMES:
            sign, _, unit = symbol(name)
            if name in pixel.parameters:
                words.append(
                    f"{sign} = {measured(pixel.parameters[name], pixel.stderr.get(name, float('nan')), unit)}"
                )
        pairs = ["   ".join(words[i : i + 2]) for i in range(0, len(words), 2)]
        # a symbol in mathtext is about two letters wide
        fits = all(len(re.sub(r"\$[^$]*\$", "MM", pair)) < 0.66 * width_mm for pair in pairs)
        lines += pairs if fits else words
    if pixel.status:
        letters = max(20, int(width_mm * 0.6))
        lines += textwrap.wrap(f"status: {plain(pixel.status)}", letters, max_lines=5, placeholder=" …")
    return "\n".join(lines)


def _cut(text: str, most: int = 40) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"
