"""Where along DN and time a model fails: residuals of the codes, and the means of the frames."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    ORANGE,
    PAGE_MM,
    SKY,
    VERMILION,
    new_figure,
    note,
    styled,
)

__all__ = ["code_residuals", "codes", "frame_strip", "parity_difference", "trends"]

FloatArray = NDArray[np.float64]

#: Residuals beyond this many standard deviations make their axis logarithmic outside of it.
_LINEAR = 8.0
#: Number of stretches of the run over which frames are averaged.
_STRETCHES = 24
#: Colour of what the verdict points to.
_MARK = "#F0E442"


def code_residuals(arrays: Mapping[str, NDArray[Any]]) -> tuple[FloatArray, FloatArray]:
    """Return the codes with counts and their residuals, (observed - expected) / sqrt(expected).

    Args:
        arrays: ``code_dn``, ``code_observed``, ``code_expected``.

    Returns:
        DN and residuals of the codes where a count is seen or expected; both empty where there is none.
    """
    dn, observed, expected = (
        np.asarray(arrays[f"code_{name}"], dtype=np.float64) for name in ("dn", "observed", "expected")
    )
    residual = (observed - expected) / np.sqrt(np.maximum(expected, 1.0))
    seen = np.flatnonzero((observed > 0) | (expected >= 1.0))
    kept = slice(int(seen[0]), int(seen[-1]) + 1) if seen.size else slice(0, 0)
    return dn[kept], residual[kept]


@styled
def codes(
    arrays: Mapping[str, NDArray[Any]], *, marked: Sequence[Place] = (), width_mm: float = PAGE_MM
) -> Figure:
    """Draw counts per DN over the sensor and their residuals; even and odd codes differ in colour.

    Args:
        arrays: ``code_dn``, ``code_observed``, ``code_expected``; ``code_extended`` where
            effects were named.
        marked: places whose interval of DN is shaded.
        width_mm: width of the figure.
    """
    dn, residual = code_residuals(arrays)
    figure = new_figure(width_mm, 84.0 if width_mm > 1.5 * COLUMN_MM else 92.0)
    top, bottom = figure.subplots(2, 1, height_ratios=(1.0, 1.25), sharex=True)
    if dn.size == 0:
        note(top, "no counts")
        return figure
    first = int(dn[0] - float(arrays["code_dn"][0]))
    observed = np.asarray(arrays["code_observed"], dtype=np.float64)[first : first + dn.size]
    expected = np.asarray(arrays["code_expected"], dtype=np.float64)[first : first + dn.size]
    edges = np.append(dn - 0.5, dn[-1] + 0.5)
    top.stairs(observed, edges, fill=True, color=GRAY, label="observed")
    top.stairs(expected, edges, color=BLACK, linewidth=0.9, label="expected from the fitted PCDs")
    if "code_extended" in arrays:
        grown = np.asarray(arrays["code_extended"], dtype=np.float64)[first : first + dn.size]
        top.stairs(grown, edges, color=VERMILION, linewidth=0.9, label="with the named effects")
    top.set_yscale("log")
    top.set_ylim(0.5, (4.0 if width_mm > 1.5 * COLUMN_MM else 200.0) * max(observed.max(), 1.0))
    top.set_ylabel("samples per DN")
    top.legend(loc="upper right")
    even = dn % 2 == 0
    bottom.axhspan(-2, 2, color=GRAY, alpha=0.45, linewidth=0, zorder=0)
    for where, colour, label in ((even, BLUE, "even DN"), (~even, VERMILION, "odd DN")):
        bottom.vlines(
            dn[where], 0.0, residual[where], color=colour, linewidth=_bar(dn.size, width_mm), label=label
        )
    largest = int(np.argmax(np.abs(residual)))
    if abs(residual[largest]) > _LINEAR:
        bottom.set_yscale("symlog", linthresh=_LINEAR, linscale=1.5)
        ticks = [t for t in (4, 10, 100, 1000, 10_000, 100_000) if t <= 2.0 * abs(residual[largest])]
        bottom.set_yticks([*(-t for t in reversed(ticks)), 0, *ticks])
        bottom.set_yticklabels([f"{t:g}".replace("-", "−") for t in bottom.get_yticks()])
        bottom.minorticks_off()
    reach = 1.25 * max(float(np.abs(residual).max()), 4.0)
    bottom.set_ylim(-reach, reach * 1.6)
    bottom.set(xlabel="DN", ylabel="(obs. − exp.) / √exp.", xlim=(edges[0], edges[-1]))
    bottom.legend(loc="upper right", ncols=2)
    note(
        bottom,
        f"largest: {residual[largest]:+.1f} at {dn[largest]:.0f} DN".replace("-", "−"),
        where="lower left",
    )
    for place in marked:
        if place.dn is not None and place.dn[1] - place.dn[0] < 0.8 * dn.size:
            for axes in (top, bottom):
                axes.axvspan(
                    place.dn[0] - 0.5, place.dn[1] + 0.5, color=_MARK, alpha=0.5, linewidth=0, zorder=0
                )
    return figure


def _bar(n: int, width_mm: float) -> float:
    """Return the width of a bar in points, so that bars do not touch."""
    return float(np.clip(0.62 * (width_mm - 22.0) / 25.4 * 72.0 / max(n, 1), 0.35, 4.0))


def trends(number: NDArray[Any], values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the means of the frames over stretches of the run; none spans a gap between frames.

    Args:
        number: frame numbers, increasing, shape (n,).
        values: a value of each frame, shape (n,).

    Returns:
        Mean frame number, mean value, and number of frames of each stretch.
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(number) > 1) + 1, [number.size]])
    wanted = max(number.size // _STRETCHES, 4)
    pieces = [np.linspace(a, b, max((b - a) // wanted, 1) + 1)[:-1] for a, b in itertools.pairwise(starts)]
    edges = np.append(np.unique(np.concatenate(pieces).astype(np.int64)), number.size)
    if number.size == 0:
        return np.empty(0), np.empty(0), np.empty(0)
    n = np.diff(edges).astype(np.float64)
    centre, mean = (
        np.add.reduceat(np.asarray(v, dtype=np.float64), edges[:-1]) / n for v in (number, values)
    )
    return centre, mean, n


def parity_difference(number: NDArray[Any], values: FloatArray, sd: float) -> float:
    """Return the mean of the even frames minus that of the odd ones, in standard errors."""
    even = number % 2 == 0
    n_even, n_odd = int(even.sum()), int((~even).sum())
    if not n_even or not n_odd or not sd > 0:
        return 0.0
    error = sd * np.sqrt(1.0 / n_even + 1.0 / n_odd)
    return float((values[even].mean() - values[~even].mean()) / error)


@styled
def frame_strip(
    arrays: Mapping[str, NDArray[Any]], *, marked: Sequence[Place] = (), width_mm: float = PAGE_MM
) -> Figure:
    """Draw the means of the frames in both channels over the run, with the path of the named effects.

    Args:
        arrays: ``frame_number``, ``frame_charge``, ``frame_readout``, ``frame_sd`` and, where there is a
            path, ``frame_charge_model`` and ``frame_readout_model``.
        marked: places whose frames are shaded.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 96.0)
    both = figure.subplots(2, 1, sharex=True)
    number = np.asarray(arrays["frame_number"], dtype=np.float64)
    sds = np.asarray(arrays.get("frame_sd", np.full(2, np.nan)), dtype=np.float64)
    rows = (
        ("frame_charge", 100.0, "charge: exposure (%)"),
        ("frame_readout", 1.0, "readout: mean residual (DN)"),
    )
    for axes, sd, (name, scale, label) in zip(both, sds, rows, strict=True):
        values = scale * np.asarray(arrays[name], dtype=np.float64)
        path = arrays.get(f"{name}_model")
        _strip(axes, number, values, scale * float(sd), None if path is None else scale * np.asarray(path))
        axes.set_ylabel(label)
        channel = name.removeprefix("frame_")
        for place in marked:
            if place.channel in (channel, "cross", "") or not place.channel:
                _mark_frames(axes, place.frames, number)
    both[1].set_xlabel("frame")
    handles, labels = both[0].get_legend_handles_labels()
    columns = 5 if width_mm > 1.5 * COLUMN_MM else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, markerscale=2.0)
    return figure


def _strip(axes: Axes, number: FloatArray, values: FloatArray, sd: float, path: NDArray[Any] | None) -> None:
    even = number % 2 == 0
    alternates = abs(parity_difference(number, values, sd)) > 4.0
    groups = ((even, SKY, "even frames"), (~even, ORANGE, "odd frames"))
    for where, colour, label in groups if alternates else ((np.ones(even.size, bool), GRAY, "frames"),):
        axes.plot(
            number[where], values[where], ".", markersize=1.6, color=colour, rasterized=True, label=label
        )
    centre, mean, n = trends(number, values)
    if np.isfinite(sd):
        half = 2.0 * sd / np.sqrt(n)
        axes.fill_between(
            centre, -half, half, color="#333333", alpha=0.18, linewidth=0, label="±2 sd of chance"
        )
    # no line across frames that are not there
    steps = np.diff(centre)
    apart = np.flatnonzero(steps > 2.0 * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    line = [np.insert(v, apart, np.nan) for v in (centre, mean)]
    axes.plot(*line, color=BLUE, linewidth=1.2, marker="o", markersize=1.8, label="mean of a stretch")
    if path is not None:
        axes.plot(number, path, color=VERMILION, linewidth=1.4, linestyle="--", label="named effects")
    low, high = np.quantile(values, [0.001, 0.999]) if values.size else (-1.0, 1.0)
    extremes = [
        low,
        high,
        *(mean if mean.size else []),
        *((path.min(), path.max()) if path is not None else ()),
    ]
    spread = max(float(max(extremes) - min(extremes)), 1e-12)
    axes.set_ylim(min(extremes) - 0.08 * spread, max(extremes) + 0.08 * spread)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    outside = int(((values < axes.get_ylim()[0]) | (values > axes.get_ylim()[1])).sum())
    if outside:
        note(axes, f"{outside} beyond the axis", where="lower right")


def _mark_frames(axes: Axes, frames: Sequence[int], number: FloatArray) -> None:
    """Shade the frames, successive ones together, unless they are most of the run."""
    if not frames or len(frames) > 0.8 * number.size:
        return
    ordered = np.unique(np.asarray(frames))
    width = max(float(number[-1] - number[0]) / 400.0, 1.0)
    for run in np.split(ordered, np.flatnonzero(np.diff(ordered) > width) + 1)[:50]:
        axes.axvspan(run[0] - width / 2, run[-1] + width / 2, color=_MARK, alpha=0.6, linewidth=0, zorder=0)
