"""Figures of how far the numbers can be trusted: goodness of fit, samples left out, and uncertainties."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.model.checks.multiple_testing import misfit
from pchem_pipeline.report.figures.map_figures import is_strip, show_map
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    PAGE_MM,
    SKY,
    VERMILION,
    new_figure,
    note,
    styled,
)
from pchem_pipeline.report.style.wording import count, percent, symbol

__all__ = ["goodness", "left_out", "noise_shares", "uncertainty"]

FloatArray = NDArray[np.float64]

_P_BINS = 20
#: Deviates beyond these have the end colours.
_DEVIATES = (-4.0, 6.0)
_MOST_MARKS = 400


@styled
def goodness(
    fit: Mapping[str, NDArray[Any]], false_discovery_rate: float, *, width_mm: float = PAGE_MM
) -> Figure:
    """Draw the p-values of all pixels against what chance gives, and a map of the goodness of fit.

    Args:
        fit: ``goodness_p``, ``goodness_chi2``, ``goodness_dof`` and ``goodness_q``, each (y, x).
        false_discovery_rate: pixels with a q-value up to it are marked.
        width_mm: width of the figure.
    """
    left, right, figure = _two(width_mm, fit["goodness_p"].shape)
    known = finite(fit["goodness_p"])
    edges = np.linspace(0.0, 1.0, _P_BINS + 1)
    mean = known.size / _P_BINS
    spread = np.sqrt(mean * (1.0 - 1.0 / _P_BINS))
    left.axhspan(mean - 2 * spread, mean + 2 * spread, color="#EDEDED", linewidth=0)
    left.axhline(mean, color=BLACK, linewidth=0.6)
    left.stairs(np.histogram(known, edges)[0], edges, color=BLUE, linewidth=1.2)
    left.set(xlabel="p-value of the goodness of fit", ylabel="pixels", xlim=(0.0, 1.0), ylim=(0.0, None))
    deviate = misfit(fit["goodness_chi2"], fit["goodness_dof"])
    marked = np.argwhere(fit["goodness_q"] <= false_discovery_rate)
    if is_strip(deviate.shape):
        right.plot(deviate.ravel(), "o", markersize=2.5, color=BLUE)
        right.plot(marked.max(axis=1), deviate[tuple(marked.T)], "o", markersize=5, mec=VERMILION, mfc="none")
        right.set(xlabel="channel", ylabel="misfit (σ)")
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        return figure
    image = show_map(right, np.clip(deviate, *_DEVIATES), vmin=-4.0, vmax=6.0)
    if len(marked) <= _MOST_MARKS:
        right.plot(marked[:, 1], marked[:, 0], "o", markersize=5, mec=VERMILION, mfc="none", mew=0.8)
    bar = figure.colorbar(image, ax=right, fraction=0.06, pad=0.02, aspect=25)
    bar.set_label("misfit (σ)")
    return figure


def _two(width_mm: float, shape: tuple[int, ...]) -> tuple[Axes, Axes, Figure]:
    """Return two axes, side by side on a page, one above the other in a column."""
    if width_mm > 1.5 * COLUMN_MM:
        figure = new_figure(width_mm, 62.0)
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    else:
        figure = new_figure(width_mm, 52.0 + (40.0 if is_strip(shape) else 62.0))
        left, right = figure.subplots(2, 1, height_ratios=(1.0, 1.2))
    return left, right, figure


@styled
def left_out(share: NDArray[Any], n_frames: int | None, *, width_mm: float = PAGE_MM) -> Figure:
    """Draw how many samples of each pixel the tail guard left out, as a histogram and as a map.

    Args:
        share: of the frames of each pixel, (y, x).
        n_frames: frames of a pixel; None where pixels differ, and shares are drawn.
        width_mm: width of the figure.
    """
    left, right, figure = _two(width_mm, share.shape)
    samples = np.rint(share * n_frames) if n_frames else 100.0 * share
    label = "frames left out" if n_frames else "samples left out (%)"
    hit = samples[samples > 0]
    if hit.size:
        top = float(hit.max())
        edges = np.arange(0.5, min(top, 60.0) + 1.5) if n_frames else np.linspace(0.0, 1.05 * top, 21)
        left.stairs(np.histogram(np.minimum(hit, edges[-1] - 1e-9), edges)[0], edges, fill=True, color=GRAY)
        left.xaxis.set_major_locator(MaxNLocator(6, integer=bool(n_frames)))
        left.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        left.set_ylim(0.0, 1.18 * left.get_ylim()[1])  # room for the words above the bars
    else:
        left.set(xticks=[], yticks=[])
    left.set(xlabel=f"{label} of a pixel", ylabel="pixels")
    note(left, f"{count(int(hit.size), 'pixel')} of {samples.size:,} with any")
    if is_strip(samples.shape):
        right.plot(samples.ravel(), "o", markersize=2.5, color=BLUE)
        right.set(xlabel="channel", ylabel=label)
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        return figure
    # nothing is white, a single sample is seen
    shown = np.where(samples > 0, samples, np.nan)
    top = max(float(np.nanmax(shown, initial=1.0)), 1.0)
    image = show_map(right, shown, cmap="viridis_r", vmin=0.0, vmax=top)
    right.set_facecolor("white")
    bar = figure.colorbar(image, ax=right, fraction=0.06, pad=0.02, aspect=25)
    bar.set_label(label)
    if n_frames:
        bar.locator = MaxNLocator(6, integer=True)
        bar.update_ticks()
    return figure


def noise_shares(maps: Mapping[str, FloatArray], names: tuple[str, ...]) -> dict[str, float]:
    """Return, by map, the part of its variance over the pixels that the errors of the estimates make.

    Both are robust: the median squared standard error over ``(1.4826 MAD)^2``.

    Args:
        maps: ``name`` and ``name_stderr``, (y, x).
        names: maps to look at; those that do not exist or have fewer than 8 values are left out.
    """
    found = {}
    for name in names:
        if name not in maps or f"{name}_stderr" not in maps:
            continue
        values, errors = finite(maps[name]), finite(maps[f"{name}_stderr"])
        if values.size < 8 or not errors.size:
            continue
        spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
        if spread > 0:
            found[name] = float(np.median(errors) ** 2 / spread**2)
    return found


@styled
def uncertainty(
    shares: Mapping[str, float], ensemble: Mapping[str, NDArray[Any]], *, width_mm: float = PAGE_MM
) -> Figure:
    """Draw how much of each map is noise of the estimates, and how sure the predicted ensemble is.

    Args:
        shares: parts of the maps' variance that the errors of the estimates make, by map.
        ensemble: arrays of the group ``ensemble``; ``epcd_stderr`` where it is known.
        width_mm: width of the figure.
    """
    left, right, figure = _two(width_mm, (1, 1))
    places = np.arange(len(shares))[::-1]
    values = np.clip([100.0 * share for share in shares.values()], 0.0, 130.0)
    end = 1.3 * max(float(values.max()), 1.0)
    left.barh(places, values, color=GRAY, height=0.6)
    for place, value, share in zip(places, values, shares.values(), strict=True):
        left.text(value + 0.015 * end, place, percent(share, 1.0), va="center", fontsize=6.5)
    if end > 100.0:
        left.axvline(100.0, color=VERMILION, linewidth=0.9, linestyle=":")
    left.set_yticks(places, [symbol(name)[0] for name in shares])
    left.set(xlabel="noise in the variance of the map (%)", xlim=(0.0, end))
    if "epcd_stderr" not in ensemble:
        right.set(xticks=[], yticks=[])
        note(right, "no error of the prediction: the model holds effects")
        return figure
    dn, exact = ensemble["dn"], ensemble["epcd_exact"]
    total = max(float(ensemble["counts"].sum()), 1.0)
    seen = exact > 1e-6 * exact.max()
    sampling = np.sqrt(exact / total)
    right.plot(dn[seen], exact[seen], color=BLACK, label="EPCD")
    right.plot(dn[seen], sampling[seen], color=SKY, label="sampling noise of the data")
    right.plot(dn[seen], ensemble["epcd_stderr"][seen], color=BLUE, label="standard error of the EPCD")
    right.set_yscale("log")
    right.set(xlabel="signal (DN)", ylabel="density (1/DN)")
    floor = float(np.min(ensemble["epcd_stderr"][seen & (ensemble["epcd_stderr"] > 0)], initial=np.inf))
    right.set_ylim(max(0.5 * floor, 1e-5 * float(exact.max())) if np.isfinite(floor) else None, None)
    right.legend(loc="upper right")
    return figure
