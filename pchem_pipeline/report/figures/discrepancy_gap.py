"""How much of the disagreement a named effect closes: the gap against its floor, and pulls before and after.

The gap is an estimate of the Kullback-Leibler divergence between the laws of the data's and of the model's
statistics, per sample; its floor is what chance alone makes of it.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pchem_pipeline.discrepancy.verdict import Pull, Verdict
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    ORANGE,
    PAGE_MM,
    PURPLE,
    VERMILION,
    new_figure,
    plain,
    styled,
)

__all__ = ["MICRO", "GapBar", "families", "gap", "gap_bars", "pulls"]

#: The gap is shown in millionths of a nat per sample.
MICRO = 1e6

_FAMILY_WORDS = {
    "shape": "shape of the pixels' histograms",
    "code": "single codes",
    "tail": "samples beyond the PCD",
    "time": "pixels along time",
    "frame": "means of the frames",
    "space": "rows, columns, neighbours",
}


@dataclass(frozen=True)
class GapBar:
    """One line of the gap's figure: its words, the gap and interval in 1e-6 nats, and its role."""

    words: str
    gap: float
    low: float
    high: float
    role: str


def gap_bars(found: Verdict) -> list[GapBar]:
    """Return the lines of the figure: the plain model, each grown model, then the rivals of the last step."""
    bars = [_bar("plain model", found.gap.before, found.gap.interval_before, "before")]
    grown = [(step, words) for step in found.steps if (words := found.added(step))]
    for i, (step, words) in enumerate(grown):
        after, interval = step.gap_after, step.gap_interval_after
        if i == len(grown) - 1:
            after, interval = found.gap.after, found.gap.interval_after
        lead = "" if words.startswith("nearest") else "with " if i == 0 else "… and "
        bars.append(_bar(f"{lead}{words}", after, interval, "after"))
    for step, _ in grown[-1:]:
        for rival, role in ((step.runner_up, "runner-up"), (step.placebo, "placebo")):
            if rival is not None:
                bars.append(_bar(f"{role}: {rival.effect}", rival.gap_after, (math.nan, math.nan), role))
    return [bar for bar in bars if math.isfinite(bar.gap)]


def _bar(words: str, value: float, interval: tuple[float, float], role: str) -> GapBar:
    return GapBar(words, MICRO * value, MICRO * interval[0], MICRO * interval[1], role)


def families(found: Verdict) -> list[tuple[str, float, float]]:
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


_ROLES = {
    "before": (VERMILION, "o"),
    "after": (BLUE, "D"),
    "runner-up": (ORANGE, "s"),
    "placebo": (PURPLE, "^"),
}


@styled
def gap(found: Verdict, *, width_mm: float = PAGE_MM) -> Figure:
    """Draw the gap before and after against its floor, with runner-up and placebo, and by family.

    Args:
        found: the verdict; it must hold a gap (:func:`gap_bars` is not empty).
        width_mm: width; a column's width stacks the panels.
    """
    bars, parts = gap_bars(found), families(found)
    wide = width_mm > 1.5 * COLUMN_MM
    heights = (14.0 + 8.0 * len(bars), 14.0 + 8.0 * len(parts))
    if not parts:
        figure = new_figure(width_mm, 12.0 + heights[0])
        both = [figure.add_subplot()]
    elif wide:
        figure = new_figure(width_mm, 12.0 + max(heights))
        both = list(figure.subplots(1, 2, width_ratios=(1.0, 1.0)))
    else:
        figure = new_figure(width_mm, 22.0 + sum(heights))
        both = list(figure.subplots(2, 1, height_ratios=heights))
    floor = MICRO * found.gap.floor
    left, right = _limits(bars, parts, floor)
    _gap_lines(both[0], bars, floor, left)
    if parts:
        _family_lines(both[1], parts, left)
    for axes in both:
        axes.set_xscale("log")
        axes.set_xlim(left, right)
        axes.set_xlabel("gap (10⁻⁶ nats per sample)")
        axes.grid(axis="x", color="#DDDDDD", linewidth=0.5)
    return figure


def _limits(
    bars: Sequence[GapBar], parts: Sequence[tuple[str, float, float]], floor: float
) -> tuple[float, float]:
    values = [v for bar in bars for v in (bar.gap, bar.low, bar.high)]
    values += [floor, *(v for _, before, after in parts for v in (before, after))]
    positive = [v for v in values if math.isfinite(v) and v > 0]
    if not positive:
        return 0.1, 10.0
    top = 10.0 ** math.ceil(math.log10(1.15 * max(positive)))
    # what lies far below the floor is as good as nothing
    least = floor / 10.0 if math.isfinite(floor) and floor > 0 else min(positive)
    return min(10.0 ** math.floor(math.log10(least)), top / 100.0), top


def _gap_lines(axes: Axes, bars: Sequence[GapBar], floor: float, left: float) -> None:
    if math.isfinite(floor) and floor > 0:
        axes.axvspan(left, floor, color=GRAY, alpha=0.4, linewidth=0)
        axes.axvline(floor, color=BLACK, linewidth=0.9)
        axes.text(
            floor, 1.01, "floor", transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=6.5
        )
    for y, bar in enumerate(bars):
        colour, marker = _ROLES[bar.role]
        if math.isfinite(bar.low) and math.isfinite(bar.high):
            axes.plot([max(bar.low, left), max(bar.high, left)], [y, y], color=colour, linewidth=1.6)
        _point(axes, bar.gap, y, left, colour, marker)
    axes.set_yticks(range(len(bars)), [plain(textwrap.fill(bar.words, 24)) for bar in bars])
    axes.set_ylim(len(bars) - 0.5, -0.6)


def _family_lines(axes: Axes, parts: Sequence[tuple[str, float, float]], left: float) -> None:
    for y, (_, before, after) in enumerate(parts):
        if math.isfinite(after) and math.isfinite(before):
            axes.plot([max(before, left), max(after, left)], [y, y], color=GRAY, linewidth=1.2, zorder=0)
        for value, role in ((before, "before"), (after, "after")):
            if math.isfinite(value):
                _point(axes, value, y, left, *_ROLES[role])
    axes.set_yticks(range(len(parts)), [plain(textwrap.fill(words, 22)) for words, _, _ in parts])
    axes.set_ylim(len(parts) - 0.5, -0.6)
    colour, marker = _ROLES["before"]
    axes.plot([], [], marker, color=colour, label="before")
    if any(math.isfinite(after) for _, _, after in parts):
        colour, marker = _ROLES["after"]
        axes.plot([], [], marker, color=colour, label="after")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)


def _point(axes: Axes, value: float, y: float, left: float, colour: str, marker: str) -> None:
    """Draw a gap; one below the axis (a gap can come out negative by chance) is an arrow at its edge."""
    if value > left:
        axes.plot(value, y, marker, color=colour, markersize=5)
    else:
        axes.plot(left * 1.12, y, "<", color=colour, markersize=5, markerfacecolor="white", clip_on=False)


@styled
def pulls(rows: Sequence[Pull], *, width_mm: float = PAGE_MM) -> Figure:
    """Draw the most telling statistics before and after, in standard deviations of chance.

    Args:
        rows: the statistics, the farthest first; ``after`` is NaN where nothing was added.
        width_mm: width of the figure.
    """
    wide = width_mm > 1.5 * COLUMN_MM
    labels = [textwrap.fill(row.sentence or row.statistic, 62 if wide else 26) for row in rows]
    lines = sum(label.count("\n") + 1 for label in labels)
    figure = new_figure(width_mm, 20.0 + (6.6 * len(rows) if wide else 3.2 * lines + 3.0 * len(rows)))
    axes = figure.add_subplot()
    axes.axvspan(-2, 2, color=GRAY, alpha=0.45, linewidth=0)
    axes.axvline(0.0, color=BLACK, linewidth=0.6)
    for y, row in enumerate(rows):
        if math.isfinite(row.after) and math.isfinite(row.before):
            axes.plot([row.before, row.after], [y, y], color=GRAY, linewidth=1.4, zorder=1)
        for value, role in ((row.before, "before"), (row.after, "after")):
            if math.isfinite(value):
                colour, marker = _ROLES[role]
                axes.plot(value, y, marker, color=colour, markersize=4.5, zorder=2)
    known = [v for row in rows for v in (row.before, row.after) if math.isfinite(v)]
    reach = max(float(np.abs(known).max()) if known else 0.0, 6.0)
    if reach > 12.0:
        axes.set_xscale("symlog", linthresh=4.0)
        ticks = [t for t in (2, 4, 10, 100, 1000, 10_000, 100_000) if t <= 1.3 * reach]
        axes.set_xticks([*(-t for t in reversed(ticks)), 0, *ticks])
        axes.set_xticklabels([f"{t:g}".replace("-", "−") for t in axes.get_xticks()])
        axes.minorticks_off()
    axes.set_xlim(-1.4 * reach, 1.4 * reach)
    axes.set_yticks(range(len(rows)), [plain(label) for label in labels])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel("standard deviations of chance")
    for role, words in (("before", "plain model"), ("after", "grown model")):
        if role == "before" or any(math.isfinite(row.after) for row in rows):
            axes.plot([], [], _ROLES[role][1], color=_ROLES[role][0], label=words)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)
    return figure
