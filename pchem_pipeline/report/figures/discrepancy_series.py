"""Where along DN and time a model fails: residuals of the codes, and the means of the frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.report.data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, note, styled
from pchem_pipeline.report.style.wording import count, short

FloatArray = NDArray[np.float64]

#: Residuals beyond this many standard deviations make their axis logarithmic outside of it.
_LINEAR = 8.0
#: Number of stretches of the run over which frames are averaged.
_STRETCHES = 24
#: Factor and unit in which the means of the frames are shown, by channel.
_SCALES = {"charge": (100.0, "%"), "readout": (1.0, "DN")}

_CODES_CAPTION = (
    "All usable pixels together. Top: samples at each DN (gray) and those that the fitted PCDs lead to "
    "expect (black; with what was added: orange). Below: the difference from the plain model in "
    "standard deviations, even and odd DN in two colours; the gray band is two standard deviations. A "
    "single tall line is a pile-up, alternating colours are a comb of the ADC, a slow wave is its "
    "nonlinearity. Yellow: what the verdict points to."
)
_FRAMES_CAPTION = (
    "Dots: means of the frames over all usable pixels. Blue: means over stretches of the run; the gray "
    "band is two standard deviations of these by chance. Dashed: path of the named effects, if it does "
    "not depend on chance. Yellow: frames that the verdict points to."
)


def code_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the counts of each DN and their residuals."""
    if not _has(data, "code_dn", "code_observed", "code_expected"):
        return []
    table = code_table(data.arrays)
    dn, residual = table["dn"], table["residual"]
    if dn.size == 0:
        return []
    order = np.argsort(-np.abs(residual))[:3]
    largest = ", ".join(f"{residual[i]:+.1f} at {dn[i]:.0f} DN" for i in order).replace("-", "−")
    even = dn % 2 == 0
    comb = "not known"
    if even.any() and (~even).any():
        comb = f"{residual[even].mean():+.2f} on even and {residual[~even].mean():+.2f} on odd DN"
    alt = (
        f"Counts from {dn[0]:.0f} to {dn[-1]:.0f} DN and their residuals in standard deviations: root mean "
        f"square {np.sqrt(np.mean(residual**2)):.2f} (by chance below 1); largest {largest}; mean "
        f"{comb.replace('-', '−')}."
    )
    return [
        Figure(
            "discrepancy_codes",
            "where",
            "Along the digital numbers",
            _CODES_CAPTION,
            alt,
            (table,),
            partial(draw_codes, table=table, marked=data.found.where),
            PAGE_MM,
        )
    ]


def frame_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the means of the frames along the run."""
    if not _has(data, "frame_number", "frame_charge", "frame_readout"):
        return []
    frames, stretches = frame_tables(data.arrays)
    sds = np.asarray(data.arrays.get("frame_sd", np.full(2, np.nan)), dtype=np.float64)
    words = []
    for channel, sd in zip(CHANNELS, sds, strict=True):
        (scale, unit), values = _SCALES[channel], frames[channel]
        centre, mean = stretches["frame"], stretches[channel]
        drift = float(np.polyfit(centre, mean, 1)[0] * np.ptp(centre)) if centre.size > 2 else math.nan
        chance = f" (by chance {short(scale * float(sd))})" if np.isfinite(sd) else ""
        words.append(
            f"{channel}: standard deviation {short(float(values.std()))} {unit}{chance}, change "
            f"along the run {short(drift)} {unit}"
        )
    path = "; the path of the named effects is drawn over them" if _model("readout") in frames else ""
    return [
        Figure(
            "discrepancy_frames",
            "where",
            "Along time",
            _FRAMES_CAPTION,
            f"Means of {count(int(frames['frame'].size), 'frame')}. {'; '.join(words)}{path}.",
            (frames, stretches),
            partial(
                draw_frames, frames=frames, stretches=stretches, sds=sds.tolist(), marked=data.found.where
            ),
            PAGE_MM,
        )
    ]


def _has(data: DiscrepancyData, *names: str) -> bool:
    return all(name in data.arrays and data.arrays[name].size for name in names)


def code_table(arrays: Mapping[str, NDArray[Any]]) -> DataTable:
    """Return the counts of the codes and their residuals, (observed - expected) / sqrt(expected).

    Args:
        arrays: ``code_dn``, ``code_observed``, ``code_expected``; ``code_extended`` where effects were named.

    Returns:
        The codes where a count is seen or expected; none where there is no such code.
    """
    dn, observed, expected = (
        np.asarray(arrays[f"code_{name}"], dtype=np.float64) for name in ("dn", "observed", "expected")
    )
    residual = (observed - expected) / np.sqrt(np.maximum(expected, 1.0))
    seen = np.flatnonzero((observed > 0) | (expected >= 1.0))
    kept = slice(int(seen[0]), int(seen[-1]) + 1) if seen.size else slice(0, 0)
    columns = {"dn": dn, "observed": observed, "expected": expected, "residual": residual}
    if "code_extended" in arrays:
        columns[_NAMED] = np.asarray(arrays["code_extended"], dtype=np.float64)
    units = {"dn": "DN", "residual": "standard deviations"}
    return DataTable({name: values[kept] for name, values in columns.items()}, units)


_NAMED = "expected with what was added"


def frame_tables(arrays: Mapping[str, NDArray[Any]]) -> tuple[DataTable, DataTable]:
    """Return the means of the frames in both channels, and their means over stretches of the run.

    Args:
        arrays: ``frame_number``, ``frame_charge``, ``frame_readout`` and, where there is a path of the named
            effects, ``frame_charge_model`` and ``frame_readout_model``.
    """
    number = np.asarray(arrays["frame_number"], dtype=np.float64)
    columns, means = {"frame": number}, dict[str, FloatArray]()
    units: dict[str, str] = {}
    for channel, (scale, unit) in _SCALES.items():
        columns[channel] = scale * np.asarray(arrays[f"frame_{channel}"], dtype=np.float64)
        centre, means[channel], n = trends(number, columns[channel])
        path = arrays.get(f"frame_{channel}_model")
        if path is not None and path.size:
            columns[_model(channel)] = scale * np.asarray(path, dtype=np.float64)
        units |= dict.fromkeys((channel, _model(channel)), unit)
    return DataTable(columns, units), DataTable({"frame": centre, "frames": n, **means}, units, "stretches")


def _model(channel: str) -> str:
    return f"{channel}, named effects"


@styled
def draw_codes(look: Look, *, table: DataTable, marked: Sequence[Place] = ()) -> Drawing:
    """Draw counts per DN over the sensor and their residuals; even and odd codes differ in colour.

    Args:
        look: width and colours.
        table: of :func:`code_table`.
        marked: places whose interval of DN is shaded.
    """
    figure, colours = look.empty(84.0 if look.wide else 92.0), look.palette
    top, bottom = figure.subplots(2, 1, height_ratios=(1.0, 1.25), sharex=True)
    dn, observed, expected, residual = (table[name] for name in ("dn", "observed", "expected", "residual"))
    edges = np.append(dn - 0.5, dn[-1] + 0.5)
    top.stairs(observed, edges, fill=True, color=colours.bars, label="observed")
    top.stairs(expected, edges, color=colours.ink, linewidth=0.9, label="expected from the fitted PCDs")
    if _NAMED in table:
        label = "with what was added"
        top.stairs(table[_NAMED], edges, color=colours.vermilion, linewidth=0.9, label=label)
    top.set_yscale("log")
    top.set_ylim(0.5, (4.0 if look.wide else 200.0) * max(observed.max(), 1.0))
    top.set_ylabel("samples per DN")
    top.legend(loc="upper right")
    even = dn % 2 == 0
    bottom.axhspan(-2, 2, color=colours.band, linewidth=0, zorder=0)
    for where, colour, label in ((even, colours.blue, "even DN"), (~even, colours.vermilion, "odd DN")):
        bottom.vlines(
            dn[where], 0.0, residual[where], color=colour, linewidth=_bar(dn.size, look.width_mm), label=label
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
                    place.dn[0] - 0.5, place.dn[1] + 0.5, color=colours.mark, alpha=0.5, linewidth=0, zorder=0
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
def draw_frames(
    look: Look,
    *,
    frames: DataTable,
    stretches: DataTable,
    sds: Sequence[float],
    marked: Sequence[Place] = (),
) -> Drawing:
    """Draw the means of the frames in both channels over the run, with the path of the named effects.

    Args:
        look: width and colours.
        frames: of :func:`frame_tables`.
        stretches: likewise.
        sds: standard deviation of a frame's mean by chance, in the stored unit, by channel.
        marked: places whose frames are shaded.
    """
    figure = look.empty(96.0)
    both = figure.subplots(2, 1, sharex=True)
    labels = {"charge": "charge: exposure (%)", "readout": "readout: mean residual (DN)"}
    for axes, sd, (channel, label) in zip(both, sds, labels.items(), strict=True):
        _strip(axes, frames, stretches, channel, _SCALES[channel][0] * sd)
        axes.set_ylabel(label)
        for place in marked:
            if place.channel in (channel, "cross", ""):
                _mark_frames(axes, place.frames, frames["frame"])
    both[1].set_xlabel("frame")
    handles, labels = both[0].get_legend_handles_labels()
    columns = 5 if look.wide else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, markerscale=2.0)
    return figure


def _strip(axes: Axes, frames: DataTable, stretches: DataTable, channel: str, sd: float) -> None:
    colours = colours_of(axes)
    number, values = frames["frame"], frames[channel]
    path = frames.get(_model(channel))
    even = number % 2 == 0
    alternates = abs(parity_difference(number, values, sd)) > 4.0
    groups = ((even, colours.sky, "even frames"), (~even, colours.orange, "odd frames"))
    for where, colour, label in (
        groups if alternates else ((np.ones(even.size, bool), colours.bars, "frames"),)
    ):
        axes.plot(
            number[where], values[where], ".", markersize=1.6, color=colour, rasterized=True, label=label
        )
    centre, mean, n = (stretches[name] for name in ("frame", channel, "frames"))
    if np.isfinite(sd):
        half = 2.0 * sd / np.sqrt(n)
        axes.fill_between(
            centre, -half, half, color=colours.edge, alpha=0.18, linewidth=0, label="±2 sd of chance"
        )
    # no line across frames that are not there
    steps = np.diff(centre)
    apart = np.flatnonzero(steps > 2.0 * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    line = [np.insert(v, apart, np.nan) for v in (centre, mean)]
    axes.plot(*line, color=colours.blue, linewidth=1.2, marker="o", markersize=1.8, label="mean of a stretch")
    if path is not None:
        axes.plot(number, path, color=colours.vermilion, linewidth=1.4, linestyle="--", label="named effects")
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
    colours = colours_of(axes)
    if not frames or len(frames) > 0.8 * number.size:
        return
    ordered = np.unique(np.asarray(frames))
    width = max(float(number[-1] - number[0]) / 400.0, 1.0)
    for run in np.split(ordered, np.flatnonzero(np.diff(ordered) > width) + 1)[:50]:
        axes.axvspan(
            run[0] - width / 2, run[-1] + width / 2, color=colours.mark, alpha=0.6, linewidth=0, zorder=0
        )
