"""Disagreement of data and model along DN and time: residuals of the codes, and frame means."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Band,
    Chart,
    Line,
    Mark,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
    Sticks,
)
from pchem_pipeline.report.data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.stacks import pull_axis
from pchem_pipeline.report.style.wording import count, short

FloatArray = NDArray[np.float64]

#: Standard deviations to which the axis of residuals is linear.
_LINEAR = 4.0
#: Number of stretches of the run over which frames are averaged.
_STRETCHES = 24
#: Factor and unit in which frames are shown, by what is shown of them, and the label of the axis.
_SCALES = {"charge": (100.0, "%"), "readout": (1.0, "DN"), "noise": (1.0, "sigma")}
_LABELS = {
    "charge": "charge: exposure (%)",
    "readout": "readout: mean (DN)",
    "noise": "noise (sigma)",
}
_PANEL_MM, _AXIS_MM = 42.0, 12.0


def code_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the counts of each DN and their residuals."""
    if not _has(data, "code_dn", "code_observed", "code_expected"):
        return
    table = code_table(data.arrays)
    dn, residual = table["dn"], table["residual"]
    if dn.size == 0:
        return
    order = np.argsort(-np.abs(residual))[:3]
    largest = ", ".join(f"{residual[i]:+.1f} at {dn[i]:.0f} DN" for i in order).replace("-", "−")
    even = dn % 2 == 0
    comb = "not known"
    if even.any() and (~even).any():
        comb = f"{residual[even].mean():+.2f} on even and {residual[~even].mean():+.2f} on odd DN"
    alt = (
        f"Counts from {dn[0]:.0f} to {dn[-1]:.0f} DN and their residuals in standard deviations: root mean "
        f"square {np.sqrt(np.mean(residual**2)):.2f} (expected below 1); largest {largest}; mean "
        f"{comb.replace('-', '−')}."
    )
    yield Figure(
        "discrepancy_codes",
        "where",
        "Along the digital numbers",
        "All usable pixels together. Top: samples at each DN (gray) and expectation from the fitted PCDs "
        "(black; with added effects: purple). Bottom: difference from the plain model in sigma, even and "
        "odd DN in two colours; the gray band is 2 sigma. A single tall line is saturation or clipping, "
        "alternating colours are differential nonlinearity of the ADC, a slow wave is integral "
        "nonlinearity. Yellow: codes named in the verdict.",
        alt,
        (table,),
        _codes_chart(table, data.found.where),
        PAGE_MM,
    )


def frame_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the means of the frames along the run."""
    if not _has(data, "frame_number", "frame_charge", "frame_readout"):
        return
    frames, stretches = _frame_tables(data.arrays)
    by_channel = np.asarray(data.arrays.get("frame_sd", np.full(2, np.nan)), dtype=np.float64)
    sds = {**dict(zip(CHANNELS, by_channel.tolist(), strict=True)), "noise": 1.0}
    sds = {shown: sd for shown, sd in sds.items() if shown in frames}
    words = []
    for channel, sd in sds.items():
        (scale, unit), values = _SCALES[channel], frames[channel]
        centre, mean = stretches["frame"], stretches[channel]
        drift = float(np.polyfit(centre, mean, 1)[0] * np.ptp(centre)) if centre.size > 2 else math.nan
        chance = f" (expected {short(scale * sd)})" if np.isfinite(sd) else ""
        words.append(
            f"{channel}: standard deviation {short(float(values.std()))} {unit}{chance}, change "
            f"along the run {short(drift)} {unit}"
        )
    path = "; the time course of the named effects is drawn over them" if _model("readout") in frames else ""
    yield Figure(
        "discrepancy_frames",
        "where",
        "Along time",
        "Dots: frame means over all usable pixels, and the excess of squared residuals of each frame "
        "(noise). Blue: means over stretches of the run; the gray band is 2 sigma of their sampling noise. "
        "Dashed: time course of the named effects, if deterministic. Yellow: frames named in the verdict.",
        f"Means of {count(int(frames['frame'].size), 'frame')}. {'; '.join(words)}{path}.",
        (frames, stretches),
        _frames_chart(frames, stretches, sds, data.found.where),
        PAGE_MM,
    )


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


_NAMED = "expected with added effects"


def _frame_tables(arrays: Mapping[str, NDArray[Any]]) -> tuple[DataTable, DataTable]:
    """Return means of the frames in both channels and their noise, and means over stretches of the run."""
    number = np.asarray(arrays["frame_number"], dtype=np.float64)
    columns, means = {"frame": number}, dict[str, FloatArray]()
    units: dict[str, str] = {}
    for channel, (scale, unit) in _SCALES.items():
        if f"frame_{channel}" not in arrays:
            continue
        columns[channel] = scale * np.asarray(arrays[f"frame_{channel}"], dtype=np.float64)
        centre, means[channel], n = trends(number, columns[channel])
        path = arrays.get(f"frame_{channel}_model")
        if path is not None and path.size:
            columns[_model(channel)] = scale * np.asarray(path, dtype=np.float64)
        units |= dict.fromkeys((channel, _model(channel)), unit)
    return DataTable(columns, units), DataTable({"frame": centre, "frames": n, **means}, units, "stretches")


def _model(channel: str) -> str:
    return f"{channel}, named effects"


def _codes_chart(table: DataTable, marked: Sequence[Place] = ()) -> Chart:
    """Return the chart of counts per DN and their residuals; even and odd codes differ in colour."""
    dn, observed, expected, residual = (table[name] for name in ("dn", "observed", "expected", "residual"))
    edges = np.append(dn - 0.5, dn[-1] + 0.5)
    shaded = [
        Span(place.dn[0] - 0.5, place.dn[1] + 0.5, axis="x", colour="mark", alpha=0.5)
        for place in marked
        if place.dn is not None and place.dn[1] - place.dn[0] < 0.8 * dn.size
    ]
    above: list[Mark] = [
        *shaded,
        Steps(edges, observed, filled=True, colour="bars", label="observed"),
        Steps(edges, expected, colour="ink", width=0.9, label="expected from the fitted PCDs"),
    ]
    if _NAMED in table:
        above.append(Steps(edges, table[_NAMED], colour="purple", width=0.9, label="with added effects"))
    highest = max(float(observed.max()), 1.0)
    top = Panel(
        Axis("samples per DN", 0.5, 4.0 * highest, log=True), tuple(above), 1.0, legend="upper right",
        room=(1.0, 50.0),
    )  # fmt: skip
    even = dn % 2 == 0
    below: list[Mark] = [Span(-2.0, 2.0, colour="band"), *shaded]
    for where, colour, label in ((even, "blue", "even DN"), (~even, "vermilion", "odd DN")):
        below.append(Sticks(dn[where], residual[where], colour=colour, width=_bar(dn.size), label=label))
    largest = int(np.argmax(np.abs(residual)))
    reach = 1.25 * max(float(np.abs(residual).max()), 4.0)
    y = pull_axis("(obs. − exp.) / √exp.", reach, _LINEAR)
    note = f"largest: {residual[largest]:+.1f} at {dn[largest]:.0f} DN".replace("-", "−")
    bottom = Panel(
        y, tuple(below), 1.25, legend="upper right", columns=2, room=(1.6, 1.6), note=note,
        corner="lower left",
    )  # fmt: skip
    return Chart((Stack((top, bottom), Axis("DN", float(edges[0]), float(edges[-1])), height_mm=86.0),))


def _bar(n: int) -> float:
    """Return the width of a bar in points, so that bars do not touch on a page."""
    return float(np.clip(0.62 * (PAGE_MM - 22.0) / 25.4 * 72.0 / max(n, 1), 0.35, 4.0))


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


def _frames_chart(
    frames: DataTable, stretches: DataTable, sds: Mapping[str, float], marked: Sequence[Place] = ()
) -> Chart:
    """Return the chart of the frames in both channels and of their noise, with the path of named effects."""
    panels = []
    for channel, sd in sds.items():
        shaded = [
            span
            for place in marked
            if place.channel in ("readout" if channel == "noise" else channel, "cross", "")
            for span in _marked(place.frames, frames["frame"])
        ]
        marks, ends, note = _channel(frames, stretches, channel, _SCALES[channel][0] * sd)
        panel = Panel(Axis(_LABELS[channel], *ends), (*shaded, *marks), note=note, corner="lower right")
        panels.append(panel)
    return Chart(
        (Stack(tuple(panels), Axis("frame"), height_mm=len(panels) * _PANEL_MM + _AXIS_MM),), legend=(5, 2)
    )


def _channel(
    frames: DataTable, stretches: DataTable, channel: str, sd: float
) -> tuple[list[Mark], tuple[float, float], str]:
    """Return the marks of a channel, the ends of its axis, and how many frames lie beyond them."""
    number, values = frames["frame"], frames[channel]
    path = frames.get(_model(channel))
    even = number % 2 == 0
    alternates = abs(parity_difference(number, values, sd)) > 4.0
    groups = ((even, "sky", "even frames"), (~even, "orange", "odd frames"))
    all_frames = ((np.ones(even.size, bool), "bars", "frames"),)
    marks: list[Mark] = [
        Points(number[where], values[where], colour=colour, size=0.8, label=label)
        for where, colour, label in (groups if alternates else all_frames)
    ]
    centre, mean, n = (stretches[name] for name in ("frame", channel, "frames"))
    if np.isfinite(sd):
        half = 2.0 * sd / np.sqrt(n)
        marks.append(Band(centre, -half, half, colour="edge", alpha=0.18, label="±2 sigma"))
    # no line across frames that are not there
    steps = np.diff(centre)
    apart = np.flatnonzero(steps > 2.0 * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    x, y = np.insert(centre, apart, centre[apart]), np.insert(mean, apart, np.nan)
    marks.append(Line(x, y, width=1.2, dots=1.8, label="mean of a stretch"))
    if path is not None:
        marks.append(Line(number, path, colour="vermilion", width=1.4, dash="--", label="named effects"))
    low, high = np.quantile(values, [0.001, 0.999]) if values.size else (-1.0, 1.0)
    extremes = [low, high, *mean, *((path.min(), path.max()) if path is not None else ())]
    margin = 0.08 * max(float(max(extremes) - min(extremes)), 1e-12)
    ends = float(min(extremes)) - margin, float(max(extremes)) + margin
    outside = int(((values < ends[0]) | (values > ends[1])).sum())
    return marks, ends, f"{outside} beyond the axis" if outside else ""


def _marked(frames: Sequence[int], number: FloatArray) -> list[Span]:
    """Return what shades the frames, successive ones together, unless they are most of the run."""
    if not frames or len(frames) > 0.8 * number.size:
        return []
    ordered = np.unique(np.asarray(frames))
    width = max(float(number[-1] - number[0]) / 400.0, 1.0)
    return [
        Span(float(run[0]) - width / 2, float(run[-1]) + width / 2, axis="x", colour="mark", alpha=0.6)
        for run in np.split(ordered, np.flatnonzero(np.diff(ordered) > width) + 1)[:50]
    ]
