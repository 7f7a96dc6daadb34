"""The gap between data and model, and the largest pulls, before and after effects were added.

The gap is an estimate of the Kullback-Leibler divergence per sample; its floor is the 95 % limit of sampling
noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pchem_pipeline.base.wording import short
from pchem_pipeline.discrepancy.verdict import MOST_PULLS, Pull, Verdict, micronats
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Level,
    Line,
    Mark,
    Points,
    Shape,
    Span,
    Stack,
    Words,
)
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure, pull_axis, row_stack

#: The gap is shown in millionths of a nat per sample.
MICRO = 1e6

_FAMILY_WORDS = {
    "shape": "shape of the pixels' histograms",
    "code": "single codes",
    "tail": "samples beyond the range of the PCD",
    "time": "pixels along time",
    "frame": "means of the frames",
    "space": "rows, columns, neighbours",
}


def gap_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the gap before and after, against its floor."""
    bars, parts, floor = gap_bars(data.found), families(data.found), data.found.gap.floor
    if not bars:
        return
    ends = _limits(bars, parts, MICRO * floor)
    rows = _gap_rows(bars, MICRO * floor, ends)
    words = [
        f"{bar.label} {short(bar.gap)}"
        + (f" ({short(bar.low)} to {short(bar.high)})" if math.isfinite(bar.low + bar.high) else "")
        for bar in bars
    ]
    names, unit = ("model", *GapBar._fields[1:]), "1e-6 nats/sample"
    columns = dict(zip(names, map(list, zip(*bars, strict=True)), strict=True))
    columns["floor"] = [MICRO * floor] * len(bars)
    tables = [DataTable(columns, dict.fromkeys(("gap", "low", "high", "floor"), unit))]
    if parts:
        shares = dict(zip(("family", "before", "after"), map(list, zip(*parts, strict=True)), strict=True))
        tables.append(DataTable(shares, dict.fromkeys(("before", "after"), unit), "families"))
    yield Figure(
        "discrepancy_gap",
        "shown",
        "The gap against its floor",
        "Gap before and after with 95 % intervals, the floor (gray: sampling noise), and the remaining gap "
        "with the next best effect instead, fitted in the same way. Open triangles at the edge are gaps "
        "below the axis. By family of statistics: before and after.",
        f"Gap in micronats (10⁻⁶ nats) per sample: {'; '.join(words)}; floor {micronats(floor)}.",
        tuple(tables),
        Chart((rows, _family_rows(parts, ends)), (1.0, 1.0), (2, 2)) if parts else Chart((rows,)),
        PAGE_MM,
    )


def pull_figures(data: DiscrepancyData) -> Iterator[Figure]:
    """Return the figure of the largest deviations before and after."""
    rows = largest_pulls(data)
    if not rows:
        return
    names = ("statistic", "sentence", "before", "after")
    columns = {name: [getattr(row, name) for row in rows] for name in names}
    words = [
        f"{pull.sentence or pull.statistic}: before "
        + (f"{pull.before:+.1f}" if math.isfinite(pull.before) else "not known")
        + (f", after {pull.after:+.1f}" if math.isfinite(pull.after) else "")
        for pull in rows[:6]
    ]
    marks: list[Mark] = [Span(-2.0, 2.0, "x", colour="band"), Level(0.0, "x", colour="ink", width=0.6)]
    places = np.arange(len(rows))
    values = {role: np.array(columns[role]) for role in ("before", "after")}
    for row, (before, after) in enumerate(zip(*values.values(), strict=True)):
        marks += _bar_line(row, before, after, "bars", 1.4)
    for role, label in (("before", "plain model"), ("after", "with effects")):
        known = np.isfinite(values[role])
        if known.any():
            colour, shape = _ROLES[role]
            marks.append(Points(values[role][known], places[known], shape, 4.5, colour=colour, label=label))
    reach = float(np.nanmax(np.abs([*values.values()]), initial=6.0))
    x = pull_axis("deviation (sigma)", 1.4 * reach)
    yield Figure(
        "discrepancy_pulls",
        "shown",
        "Largest deviations, before and after",
        "The largest deviations from the model, before (circles) and after effects were added (diamonds). "
        "Gray: 2 sigma. Sampling noise makes the largest of some hundred 3 sigma, counts of few pixels more.",
        f"In sigma. {'; '.join(words).replace('-', '−')}.",
        (DataTable(columns, dict.fromkeys(("before", "after"), "standard deviations")),),
        Chart((row_stack([row.sentence or row.statistic for row in rows], marks, x),), legend=(2, 2)),
        PAGE_MM,
    )


def largest_pulls(data: DiscrepancyData) -> list[Pull]:
    """Return the statistics that deviate most before or after, from the vectors ``z_before``, ``z_after``.

    Those of a part of the sensor or the run are only in the JSON; without vectors all are from the JSON.
    """
    rows: dict[str, Pull] = {}
    if "z_before" in data.arrays:
        before = data.arrays["z_before"]
        both = before.tolist(), data.arrays.get("z_after", np.full(before.size, np.nan)).tolist()
        for (name, (_, sentence)), z, after in zip(data.statistics.items(), *both, strict=False):
            if math.isfinite(z):
                rows[name] = Pull(statistic=name, sentence=sentence, before=z, after=after)
    whole = not rows
    for pull in [pull for step in data.found.steps for pull in step.pulls if whole or "@" in pull.statistic]:
        known = rows.get(pull.statistic, pull)
        after = pull.after if math.isfinite(pull.after) else known.after
        rows[pull.statistic] = known.model_copy(update={"after": after})

    def far(pull: Pull) -> float:
        return max((abs(v) for v in (pull.before, pull.after) if math.isfinite(v)), default=0.0)

    return sorted(rows.values(), key=far, reverse=True)[:MOST_PULLS]


class GapBar(NamedTuple):
    """One line of the gap's figure: its label, its role, the gap and its interval in 1e-6 nats."""

    label: str
    role: str
    gap: float
    low: float
    high: float


#: Name of a family of statistics, its gap before and after, 1e-6 nats.
Family = tuple[str, float, float]


def gap_bars(found: Verdict) -> list[GapBar]:
    """Return the rows of the figure: the plain model, each with effects, the rivals of the last step."""
    bars = [_bar("plain model", found.gap.before, found.gap.interval_before, "before")]
    extended = [(step, words) for step in found.steps if (words := found.added(step))]
    for i, (step, words) in enumerate(extended):
        after, interval = step.gap_after, step.gap_interval_after
        if i == len(extended) - 1:
            after, interval = found.gap.after, found.gap.interval_after
        lead = "" if words.startswith("nearest") else "with " if i == 0 else "… and "
        bars.append(_bar(f"{lead}{words}", after, interval, "after"))
    for step, _ in extended[-1:]:
        if (other := step.runner_up) is not None:
            bars.append(_bar(f"next best: {other.effect}", other.gap_after, (math.nan,) * 2, "runner-up"))
    return [bar for bar in bars if math.isfinite(bar.gap)]


def _bar(words: str, value: float, interval: tuple[float, float], role: str) -> GapBar:
    return GapBar(words, role, MICRO * value, MICRO * interval[0], MICRO * interval[1])


def families(found: Verdict) -> list[Family]:
    """Return the gap of each family of statistics before and after, 1e-6 nats, largest first."""
    with_families = [step for step in found.steps if step.families.before]
    if not with_families:
        return []
    before = with_families[0].families.before
    after = next((step.families.after for step in reversed(with_families) if step.families.after), {})
    rows = [
        (_FAMILY_WORDS.get(name, name), MICRO * value, MICRO * after.get(name, math.nan))
        for name, value in before.items()
    ]
    return sorted(rows, key=lambda row: -row[1] if math.isfinite(row[1]) else 0.0)


_ROLES: dict[str, tuple[str, Shape]] = {
    "before": ("vermilion", "o"),
    "after": ("blue", "D"),
    "runner-up": ("orange", "s"),
}


def _limits(bars: Sequence[GapBar], parts: Sequence[Family], floor: float) -> tuple[float, float]:
    values = [v for bar in bars for v in (bar.gap, bar.low, bar.high)]
    values += [floor, *(v for _, before, after in parts for v in (before, after))]
    positive = [v for v in values if math.isfinite(v) and v > 0]
    if not positive:
        return 0.1, 10.0
    top = 10.0 ** math.ceil(math.log10(1.15 * max(positive)))
    # gaps far below the floor are equivalent to none
    least = floor / 10.0 if math.isfinite(floor) and floor > 0 else min(positive)
    return min(10.0 ** math.floor(math.log10(least)), top / 100.0), top


def _gap_axis(ends: tuple[float, float]) -> tuple[Axis, list[Mark]]:
    powers = range(math.ceil(math.log10(ends[0])) + 1, math.ceil(math.log10(ends[1])))
    grid: list[Mark] = [Level(10.0**power, "x", colour="grid", width=0.5) for power in powers]
    return Axis("gap (micronats per sample)", *ends, log=True), grid


def _gap_rows(bars: Sequence[GapBar], floor: float, ends: tuple[float, float]) -> Stack:
    x, marks = _gap_axis(ends)
    left = ends[0]
    if math.isfinite(floor) and floor > 0:
        marks += [
            Span(left, floor, "x", colour="bars", alpha=0.4),
            Level(floor, "x", colour="ink", width=0.9),
            Words(floor, 0.93, "\u00a0floor", "left", colour="ink"),
        ]
    for row, bar in enumerate(bars):
        marks += _bar_line(row, max(bar.low, left), max(bar.high, left), _ROLES[bar.role][0], 1.6)
        marks.append(_point(bar.gap, row, left, bar.role))
    return row_stack([bar.label for bar in bars], marks, x)


def _family_rows(parts: Sequence[Family], ends: tuple[float, float]) -> Stack:
    x, marks = _gap_axis(ends)
    labels = {"before": "before", "after": "after"}  # each stands once in the legend
    for row, (_, before, after) in enumerate(parts):
        marks += _bar_line(row, max(before, ends[0]), max(after, ends[0]), "bars", 1.2)
        for value, role in ((before, "before"), (after, "after")):
            if math.isfinite(value):
                label = labels.pop(role, "") if value > ends[0] else ""
                marks.append(_point(value, row, ends[0], role, label))
    return row_stack([words for words, _, _ in parts], marks, x)


def _bar_line(row: int, low: float, high: float, colour: str, width: float) -> list[Line]:
    """Return a line along a row; none where an end of it is not known."""
    ends = np.array([low, high])
    return [Line(ends, np.array([row, row]), colour=colour, width=width)] if np.isfinite(ends).all() else []


def _point(value: float, row: int, left: float, role: str, label: str = "") -> Points:
    """Return a gap; one below the axis (a gap can come out negative by chance) is an arrow at its edge."""
    colour, shape = _ROLES[role]
    y = np.array([row])
    if value > left:
        return Points(np.array([value]), y, shape, 5.0, colour=colour, label=label)
    return Points(np.array([left * 1.12]), y, "<", 5.0, face="paper", colour=colour)
