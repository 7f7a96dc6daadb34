"""How much of the disagreement a named effect closes: the gap against its floor, and pulls before and after.

The gap is an estimate of the Kullback-Leibler divergence between the laws of the data's and of the model's
statistics, per sample; its floor is what chance alone makes of it.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pchem_pipeline.discrepancy.verdict import MOST_PULLS, Pull, Verdict, micronats
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.style.palette import Palette
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, plain, styled
from pchem_pipeline.report.style.wording import short

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

_GAP_CAPTION = (
    "Gap before and after on a logarithmic axis, with intervals where they are known, the floor (gray: "
    "chance alone), and what the second-best effect and a placebo (a wrong effect, fitted in the same "
    "way) leave. Open triangles at the edge are gaps below the axis. By family: before and after."
)
_PULLS_CAPTION = (
    "The statistics farthest from chance, before (circles) and after effects were added (diamonds). The gray "
    "band is two standard deviations; with some hundred statistics the largest lies near 3 by chance."
)


def gap_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the gap before and after, against its floor."""
    found = data.found
    tables = gap_tables(found)
    if not tables:
        return []
    return [
        Figure(
            "discrepancy_gap",
            "shown",
            "The gap against its floor",
            _GAP_CAPTION,
            f"Gap in micronats (10⁻⁶ nats) per sample: {_gap_alt(found)}.",
            tables,
            partial(draw_gap, bars=gap_bars(found), families=families(found), floor=MICRO * found.gap.floor),
            PAGE_MM,
        )
    ]


def pull_figures(data: DiscrepancyData) -> list[Figure]:
    """Return the statistics farthest from chance, before and after."""
    rows = largest_pulls(data)
    if not rows:
        return []
    columns: dict[str, Sequence[Any]] = {
        "statistic": [row.statistic for row in rows],
        "sentence": [row.sentence for row in rows],
        "before": [row.before for row in rows],
        "after": [row.after for row in rows],
    }
    return [
        Figure(
            "discrepancy_pulls",
            "shown",
            "The statistics farthest from chance, before and after",
            _PULLS_CAPTION,
            f"Standard deviations of chance. {_pull_text(rows)}.",
            (DataTable(columns, dict.fromkeys(("before", "after"), "standard deviations")),),
            partial(draw_pulls, rows=rows),
            PAGE_MM,
        )
    ]


def gap_tables(found: Verdict) -> tuple[DataTable, ...]:
    """Return the gap of each model, with its interval and the floor, and by family of statistics."""
    bars, parts, floor = gap_bars(found), families(found), MICRO * found.gap.floor
    if not bars:
        return ()
    columns: dict[str, Sequence[Any]] = {
        "model": [bar.label for bar in bars],
        "role": [bar.role for bar in bars],
        "gap": [bar.gap for bar in bars],
        "low": [bar.low for bar in bars],
        "high": [bar.high for bar in bars],
        "floor": [floor] * len(bars),
    }
    gaps = DataTable(columns, dict.fromkeys(("gap", "low", "high", "floor"), _GAP_UNIT))
    if not parts:
        return (gaps,)
    names, before, after = (list(column) for column in zip(*parts, strict=True))
    units = dict.fromkeys(("before", "after"), _GAP_UNIT)
    return gaps, DataTable({"family": names, "before": before, "after": after}, units, "families")


_GAP_UNIT = "1e-6 nats/sample"


def largest_pulls(data: DiscrepancyData) -> list[Pull]:
    """Return the statistics farthest from chance before and after: of the vectors ``z_before``, ``z_after``.

    Where those are not kept, those that the JSON tells.
    """
    rows: dict[str, Pull] = {}
    if "z_before" in data.arrays:
        before = np.asarray(data.arrays["z_before"], dtype=np.float64)
        after_all = np.asarray(data.arrays.get("z_after", np.full(before.size, np.nan)), dtype=np.float64)
        for i, (name, (_, sentence)) in enumerate(data.statistics.items()):
            if i < before.size and np.isfinite(before[i]):
                later = float(after_all[i]) if i < after_all.size else math.nan
                rows[name] = Pull(statistic=name, sentence=sentence, before=float(before[i]), after=later)
    for pull in () if rows else [pull for step in data.found.steps for pull in step.pulls]:
        known = rows.get(pull.statistic, pull)
        after = pull.after if math.isfinite(pull.after) else known.after
        rows[pull.statistic] = known.model_copy(update={"after": after})

    def far(pull: Pull) -> float:
        return max((abs(v) for v in (pull.before, pull.after) if math.isfinite(v)), default=0.0)

    return sorted(rows.values(), key=far, reverse=True)[:MOST_PULLS]


def _pull_text(rows: Sequence[Pull]) -> str:
    words = []
    for row in rows[:6]:
        after = f", after {row.after:+.1f}" if math.isfinite(row.after) else ""
        before = f"{row.before:+.1f}" if math.isfinite(row.before) else "not known"
        words.append(f"{row.sentence or row.statistic}: before {before}{after}")
    return "; ".join(words).replace("-", "−")


def _gap_alt(found: Verdict) -> str:
    words = [
        f"{bar.label} {short(bar.gap)}"
        + (f" ({short(bar.low)} to {short(bar.high)})" if math.isfinite(bar.low + bar.high) else "")
        for bar in gap_bars(found)
    ]
    return "; ".join([*words, f"floor {gap_text(found.gap.floor)}"])


def gap_text(gap: float) -> str:
    """Return a gap in micronats, without the unit."""
    return micronats(gap)


@dataclass(frozen=True)
class GapBar:
    """One line of the gap's figure: its label, the gap and interval in 1e-6 nats, and its role."""

    label: str
    gap: float
    low: float
    high: float
    role: str


def gap_bars(found: Verdict) -> list[GapBar]:
    """Return the lines of the figure: the plain model, each with effects, the rivals of the last step."""
    bars = [_bar("plain model", found.gap.before, found.gap.interval_before, "before")]
    extended = [(step, words) for step in found.steps if (words := found.added(step))]
    for i, (step, words) in enumerate(extended):
        after, interval = step.gap_after, step.gap_interval_after
        if i == len(extended) - 1:
            after, interval = found.gap.after, found.gap.interval_after
        lead = "" if words.startswith("nearest") else "with " if i == 0 else "… and "
        bars.append(_bar(f"{lead}{words}", after, interval, "after"))
    for step, _ in extended[-1:]:
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
    "before": ("vermilion", "o"),
    "after": ("blue", "D"),
    "runner-up": ("orange", "s"),
    "placebo": ("purple", "^"),
}


def _mark(colours: Palette, role: str) -> tuple[str, str]:
    """Return the colour and the marker of a role."""
    hue, marker = _ROLES[role]
    return getattr(colours, hue), marker


@styled
def draw_gap(
    look: Look, *, bars: Sequence[GapBar], families: Sequence[tuple[str, float, float]], floor: float
) -> Drawing:
    """Draw the gap before and after against its floor, with runner-up and placebo, and by family.

    Args:
        look: width and colours; a column stacks the panels.
        bars: of :func:`gap_bars`, at least one.
        families: of :func:`families`.
        floor: 1e-6 nats; NaN where it is not known.
    """
    wide, parts = look.wide, families
    heights = (14.0 + 8.0 * len(bars), 14.0 + 8.0 * len(parts))
    if not parts:
        figure = look.empty(12.0 + heights[0])
        both = [figure.add_subplot()]
    elif wide:
        figure = look.empty(12.0 + max(heights))
        both = list(figure.subplots(1, 2, width_ratios=(1.0, 1.0)))
    else:
        figure = look.empty(22.0 + sum(heights))
        both = list(figure.subplots(2, 1, height_ratios=heights))
    left, right = _limits(bars, parts, floor)
    _gap_lines(both[0], bars, floor, left)
    if parts:
        _family_lines(both[1], parts, left)
    for axes in both:
        axes.set_xscale("log")
        axes.set_xlim(left, right)
        axes.set_xlabel("gap (micronats per sample)")
        axes.grid(axis="x", color=look.palette.grid, linewidth=0.5)
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
    colours = colours_of(axes)
    if math.isfinite(floor) and floor > 0:
        axes.axvspan(left, floor, color=colours.bars, alpha=0.4, linewidth=0)
        axes.axvline(floor, color=colours.ink, linewidth=0.9)
        axes.text(
            floor, 1.01, "floor", transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=6.5
        )
    for y, bar in enumerate(bars):
        colour, marker = _mark(colours, bar.role)
        if math.isfinite(bar.low) and math.isfinite(bar.high):
            axes.plot([max(bar.low, left), max(bar.high, left)], [y, y], color=colour, linewidth=1.6)
        _point(axes, bar.gap, y, left, colour, marker)
    axes.set_yticks(range(len(bars)), [plain(textwrap.fill(bar.label, 24)) for bar in bars])
    axes.set_ylim(len(bars) - 0.5, -0.6)


def _family_lines(axes: Axes, parts: Sequence[tuple[str, float, float]], left: float) -> None:
    colours = colours_of(axes)
    for y, (_, before, after) in enumerate(parts):
        if math.isfinite(after) and math.isfinite(before):
            axes.plot(
                [max(before, left), max(after, left)], [y, y], color=colours.bars, linewidth=1.2, zorder=0
            )
        for value, role in ((before, "before"), (after, "after")):
            if math.isfinite(value):
                _point(axes, value, y, left, *_mark(colours, role))
    axes.set_yticks(range(len(parts)), [plain(textwrap.fill(words, 22)) for words, _, _ in parts])
    axes.set_ylim(len(parts) - 0.5, -0.6)
    colour, marker = _mark(colours, "before")
    axes.plot([], [], marker, color=colour, label="before")
    if any(math.isfinite(after) for _, _, after in parts):
        colour, marker = _mark(colours, "after")
        axes.plot([], [], marker, color=colour, label="after")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)


def _point(axes: Axes, value: float, y: float, left: float, colour: str, marker: str) -> None:
    """Draw a gap; one below the axis (a gap can come out negative by chance) is an arrow at its edge."""
    if value > left:
        axes.plot(value, y, marker, color=colour, markersize=5)
    else:
        axes.plot(
            left * 1.12,
            y,
            "<",
            color=colour,
            markersize=5,
            markerfacecolor=colours_of(axes).paper,
            clip_on=False,
        )


@styled
def draw_pulls(look: Look, *, rows: Sequence[Pull]) -> Drawing:
    """Draw the largest pulls before and after, in standard deviations of chance.

    Args:
        look: width and colours.
        rows: the statistics, the farthest first; ``after`` is NaN where nothing was added.
    """
    colours = look.palette
    wide = look.wide
    labels = [textwrap.fill(row.sentence or row.statistic, 62 if wide else 26) for row in rows]
    lines = sum(label.count("\n") + 1 for label in labels)
    figure = look.empty(20.0 + (6.6 * len(rows) if wide else 3.2 * lines + 3.0 * len(rows)))
    axes = figure.add_subplot()
    axes.axvspan(-2, 2, color=colours.band, linewidth=0)
    axes.axvline(0.0, color=colours.ink, linewidth=0.6)
    for y, row in enumerate(rows):
        if math.isfinite(row.after) and math.isfinite(row.before):
            axes.plot([row.before, row.after], [y, y], color=colours.bars, linewidth=1.4, zorder=1)
        for value, role in ((row.before, "before"), (row.after, "after")):
            if math.isfinite(value):
                colour, marker = _mark(colours, role)
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
    for role, words in (("before", "plain model"), ("after", "with effects")):
        if role == "before" or any(math.isfinite(row.after) for row in rows):
            colour, marker = _mark(colours, role)
            axes.plot([], [], marker, color=colour, label=words)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)
    return figure
