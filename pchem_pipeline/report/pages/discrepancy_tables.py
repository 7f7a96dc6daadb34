"""The tables of the discrepancy page, as plain rows of text."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pchem_pipeline.discrepancy.verdict import Place, Step, Verdict
from pchem_pipeline.report.pages.discrepancy_data import DiscrepancyData
from pchem_pipeline.report.pages.discrepancy_text import (
    gap_words,
    parameter_name,
    parameter_texts,
    probability_words,
)
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.wording import count, measured, short, signed, unit_text

__all__ = ["discrepancy_tables", "place_words"]

#: Longer lists are in ``discrepancy.json`` only.
_MOST_PLACES, _MOST_CANDIDATES = 12, 8


def discrepancy_tables(data: DiscrepancyData) -> dict[str, list[Table]]:
    """Return the tables of each part of the page that have rows."""
    found = data.found
    parts = {
        "where": [_where(data, found.where)],
        "evidence": [
            *[_candidates(data, step, i) for i, step in enumerate(found.steps)],
            _separate(found.steps),
        ],
        "shown": [_gaps(found)],
        "parameters": [_parameters(data), _moved(found.steps)],
        "limits": [_untestable(data), _unexplained(found.unexplained), _left_out(data), _examined(data)],
    }
    return {part: [table for table in tables if table.rows] for part, tables in parts.items()}


def place_words(place: Place) -> str:
    """Return where a statistic points to: pixels, DN, frames; empty for the whole sensor and run."""
    words = []
    if place.pixels:
        shown = ", ".join(f"({y}, {x})" for y, x in place.pixels[:4])
        more = f" … {count(len(place.pixels), 'pixel')}" if len(place.pixels) > 4 else ""
        words.append(f"pixels (y, x) {shown}{more}")
    if place.dn is not None:
        low, high = place.dn
        words.append(f"{low:g} DN" if low == high else f"{low:g} to {high:g} DN")
    if place.frames:
        words.append(_frame_words(place.frames))
    return "; ".join(words)


def _frame_words(frames: Sequence[int]) -> str:
    if len(frames) <= 4:
        return "frames " + ", ".join(str(frame) for frame in frames)
    return f"{count(len(frames), 'frame')} from {min(frames)} to {max(frames)}"


def _where(data: DiscrepancyData, places: Sequence[Place]) -> Table:
    rows = tuple(
        (
            place.sentence or _sentence(data, place.statistic),
            place.channel or data.statistics.get(place.statistic, ("", ""))[0],
            signed(place.z),
            probability_words(place.p),
            place_words(place) or "everywhere",
            place.statistic,
        )
        for place in places[:_MOST_PLACES]
    )
    more = f" The first {_MOST_PLACES} of {len(places)}." if len(places) > _MOST_PLACES else ""
    return Table(
        "discrepancy-where",
        "Statistics that disagree",
        "How far each lies from what the plain model gives, in standard deviations of chance, with its "
        f"probability, the farthest first.{more}",
        ("what it says", "channel", "standard deviations", "p", "where", "statistic"),
        rows,
    )


def _sentence(data: DiscrepancyData, statistic: str) -> str:
    return data.statistics.get(statistic, ("", ""))[1] or statistic


def _candidates(data: DiscrepancyData, step: Step, index: int) -> Table:
    rows = []
    best = max((c.score for c in step.candidates if math.isfinite(c.score)), default=math.nan)
    for candidate in step.candidates[:_MOST_CANDIDATES]:
        behind = candidate.score - best
        rows.append(
            (
                candidate.effect,
                data.titles.get(candidate.effect, ""),
                measured(candidate.score, candidate.stderr),
                short(behind) if math.isfinite(behind) and behind < 0 else "best" if behind == 0 else "",
                probability_words(candidate.probability),
                ", ".join(f"{name} {value}" for name, value in parameter_texts(candidate)),
            )
        )
    if step.effect:
        outcome = f"{step.effect} was named"
    elif data.found.verdict == "ambiguous":
        outcome = "these data cannot tell them apart"
    else:
        outcome = "none of them explains it"
    title = f"Candidates, step {index + 1}" if len(data.found.steps) > 1 else "Candidates"
    return Table(
        f"discrepancy-candidates-{index + 1}",
        f"{title}: {outcome}",
        "Held-out score with its standard error (nats, larger is better), how far behind the best one, and "
        "the share of the probability among the candidates.",
        ("effect", "in the literature", "score", "behind", "probability", "parameters"),
        tuple(rows),
    )


def _separate(steps: Sequence[Step]) -> Table:
    rows = tuple(dict.fromkeys((rival, text) for step in steps for rival, text in step.separate.items()))
    return Table(
        "discrepancy-separate",
        "What would tell them apart",
        "Measurements that separate the effects named here from those that they are confused with.",
        ("effect", "measurement"),
        rows,
    )


def _gaps(found: Verdict) -> Table:
    rows = []
    for i, step in enumerate(found.steps):
        low, high = step.gap_interval_after
        interval = f" ({gap_words(low)} to {gap_words(high)})" if math.isfinite(low) else ""
        rivals = [
            f"{gap_words(rival.gap_after)} ({rival.effect})" if rival is not None else ""
            for rival in (step.runner_up, step.placebo)
        ]
        rows.append(
            (
                f"{i + 1}: {found.added(step) or step.verdict}",
                gap_words(step.gap_before),
                f"{gap_words(step.gap_after)}{interval}",
                gap_words(step.gap_floor),
                *rivals,
            )
        )
    return Table(
        "discrepancy-gap",
        "Gap by step",
        "In 10⁻⁶ nats per sample on frames that no fit has seen, with its interval; runner-up and placebo "
        "were added in the place of the named effect.",
        ("step", "before", "after", "floor", "runner-up instead", "placebo instead"),
        tuple(rows),
    )


def _parameters(data: DiscrepancyData) -> Table:
    rows = tuple(
        (
            f"{tag}: {name}",
            measured(p.value, p.stderr, unit_text(p.unit)),
            data.title(tag) + ("" if step.effect else " (the likeliest)"),
            data.sources.get(tag, ""),
        )
        for step in data.found.steps
        for tag in [step.likeliest]
        for name, p in step.parameters.items()
        if tag and (step.effect or data.found.verdict == "ambiguous")
    )
    return Table(
        "discrepancy-parameters",
        "Parameters of the effects",
        "Estimates with their standard errors; these are the keys of model.effects in the run's YAML.",
        ("parameter", "value", "effect", "source"),
        rows,
    )


def _moved(steps: Sequence[Step]) -> Table:
    rows = []
    for step in steps:
        for name, each in step.moved.items():
            unit = unit_text(each.unit)
            rows.append(
                (
                    f"{parameter_name(name)}{f' ({unit})' if unit else ''}",
                    step.effect or "",
                    short(each.median) if math.isfinite(each.median) else "not known",
                    signed(each.in_stderr),
                )
            )
    return Table(
        "discrepancy-moved",
        "How the delivered parameters moved",
        "Median over the pixels of (with the effect − without it), also in standard errors of a pixel.",
        ("parameter", "effect added", "moved by", "in standard errors"),
        tuple(rows),
    )


def _untestable(data: DiscrepancyData) -> Table:
    rows = tuple((tag, data.title(tag), why or "") for tag, why in data.found.untestable.items())
    return Table(
        "discrepancy-untestable",
        "Not tested by these data",
        "They may be there or not: nothing in these frames depends on it.",
        ("effect", "in the literature", "why, and what would show it"),
        rows,
    )


def _unexplained(places: Sequence[Place]) -> Table:
    rows = tuple(
        (place.sentence or place.statistic, signed(place.z), place_words(place), place.statistic)
        for place in places[:_MOST_PLACES]
    )
    return Table(
        "discrepancy-unexplained",
        "Left unexplained",
        "What remains of the disagreement after all that was named.",
        ("what it says", "standard deviations", "where", "statistic"),
        rows,
    )


def _left_out(data: DiscrepancyData) -> Table:
    return Table(
        "discrepancy-left-out",
        "Left out",
        "Effects that could not be used as candidates.",
        ("effect", "why"),
        tuple(data.found.left_out.items()),
    )


def _examined(data: DiscrepancyData) -> Table:
    found, rows = data.found, []
    for key, words in (
        ("frames", "frames"),
        ("train", "frames to find and fit with"),
        ("test", "frames to confirm and score with"),
        ("final", "frames kept for the last gap"),
        ("rows", "rows, first and after the last"),
        ("columns", "columns, first and after the last"),
    ):
        value = getattr(found.examined, key)
        rows.append((words, " to ".join(map(str, value)) if isinstance(value, tuple) else f"{value:,}"))
    if found.replicates:
        rows.append(("simulated replicates", f"{found.replicates:,}"))
    rows += [(f"version: {name}", str(version)) for name, version in found.versions.items()]
    return Table("discrepancy-examined", "What was examined", "", ("item", "value"), tuple(rows))
