"""The tables of a verdict's page: disagreements, candidates, gaps, parameters, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pchem_pipeline.discrepancy.verdict import (
    Candidate,
    Place,
    Step,
    Verdict,
)
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.discrepancy_gap import gap_text
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.wording import (
    count,
    fitted_or_chosen,
    measured,
    percent,
    short,
    signed,
    symbol,
    unit_text,
)

#: Longer lists are in ``discrepancy.json`` only.
_MOST_PLACES, _MOST_CANDIDATES = 12, 8
#: Maps of the survey in words.
_SURVEYED = {
    "next_x": "neighbours in a row correlated",
    "next_y": "neighbours in a column correlated",
    "lag": "successive frames correlated",
    "spread": "levels change along the run",
    "unfitted": "clustered pixels without a reliable fit",
}


def probability_text(p: float) -> str:
    """Format a p-value."""
    if not math.isfinite(p):
        return ""
    return "< 0.001" if p < 0.001 else "> 0.999" if p > 0.999 else f"{p:.3f}"


def parameter_texts(candidate: Candidate) -> list[tuple[str, str]]:
    """Format the given fields of a candidate, numbers to three digits."""
    return [
        (name, f"{value:.3g}" if isinstance(value, int | float) else str(value))
        for name, value in candidate.parameters.items()
        if value is not None and not isinstance(value, list | dict)
    ]


def parameter_name(name: str) -> str:
    """Return the name of a map in words."""
    try:
        return symbol(name)[1]
    except KeyError:
        return name.replace("_", " ")


def discrepancy_tables(data: DiscrepancyData) -> dict[str, list[Table]]:
    """Return the tables of each part of the page that have rows."""
    found = data.found
    parts = {
        "where": [_where(data, found.where)],
        "evidence": [
            *[_candidates(data, step, i) for i, step in enumerate(found.steps)],
            _rivals(data),
            _separate(found.steps),
        ],
        "shown": [_gaps(found)],
        "parameters": [_parameters(data), _moved(found)],
        "limits": [_untestable(data), _unexplained(found.unexplained), _defects(found), _examined(data)],
    }
    return {part: [table for table in tables if table.rows] for part, tables in parts.items()}


def place_text(place: Place) -> str:
    """Describe the pixels, DN and frames of a disagreement; empty for the whole sensor and run."""
    words = [place.spot()] if place.spot() else []
    if place.pixels:
        shown = ", ".join(f"({y}, {x})" for y, x in place.pixels[:4])
        more = f" … {count(len(place.pixels), 'pixel')}" if len(place.pixels) > 4 else ""
        words.append(f"pixels (y, x) {shown}{more}")
    if place.dn is not None:
        low, high = place.dn
        words.append(f"{low:g} DN" if low == high else f"{low:g} to {high:g} DN")
    if place.frames:
        words.append(_frame_text(place.frames))
    return "; ".join(words)


def _frame_text(frames: Sequence[int]) -> str:
    if len(frames) <= 4:
        return "frames " + ", ".join(str(frame) for frame in frames)
    return f"{count(len(frames), 'frame')} from {min(frames)} to {max(frames)}"


def _where(data: DiscrepancyData, places: Sequence[Place]) -> Table:
    rows = tuple(
        (
            place.sentence or _sentence(data, place.statistic),
            place.channel or data.statistics.get(place.statistic, ("", ""))[0],
            signed(place.z),
            probability_text(place.p),
            place_text(place) or "everywhere",
            place.statistic,
        )
        for place in places[:_MOST_PLACES]
    )
    more = f" The first {_MOST_PLACES} of {len(places)}." if len(places) > _MOST_PLACES else ""
    return Table(
        "discrepancy-where",
        "Statistics that disagree",
        f"Deviation of each from the plain model in sigma, with its p-value; the largest first.{more}",
        ("disagreement", "channel", "sigma", "p", "where", "statistic"),
        rows,
    )


def _sentence(data: DiscrepancyData, statistic: str) -> str:
    return data.statistics.get(statistic, ("", ""))[1] or statistic


def _candidates(data: DiscrepancyData, step: Step, index: int) -> Table:
    rows = []
    best = max((c.score for c in step.candidates if math.isfinite(c.score)), default=math.nan)
    # an empirical description has no competitors
    for candidate in step.candidates[: 0 if step.verdict == "described" else _MOST_CANDIDATES]:
        behind = candidate.score - best
        rows.append(
            (
                candidate.effect,
                data.titles.get(candidate.effect, ""),
                measured(candidate.score, candidate.stderr),
                short(behind) if math.isfinite(behind) and behind < 0 else "best" if behind == 0 else "",
                probability_text(candidate.probability) if len(step.candidates) > 1 else "only candidate",
                ", ".join(f"{name} {value}" for name, value in parameter_texts(candidate)),
            )
        )
    if step.effect:
        outcome = f"{step.effect} was named"
    elif data.found.verdict == "ambiguous":
        several = len(step.candidates) > 1
        outcome = "these data do not decide" if several else "not confirmed by the final samples"
    else:
        outcome = "none explains the data"
    title = f"Candidates, step {index + 1}" if len(data.found.steps) > 1 else "Candidates"
    return Table(
        f"discrepancy-candidates-{index + 1}",
        f"{title}: {outcome}",
        "Held-out log-likelihood and its standard error, difference to the best (nats, larger is better) and "
        "posterior probability.",
        ("effect", "name", "log-likelihood", "difference", "probability", "parameters"),
        tuple(rows),
    )


def _rivals(data: DiscrepancyData) -> Table:
    rows = tuple(
        (
            rival.effect,
            data.titles.get(rival.effect, ""),
            step.effect,
            short(-rival.behind) if math.isfinite(rival.behind) else "not scored",
            rival.why or "it has a lower log-likelihood",
        )
        for step in data.found.steps
        if step.effect
        for rival in step.rivals
    )
    return Table(
        "discrepancy-rivals",
        "Rejected effects",
        "The next best effects, each fitted instead of the named one: difference of the held-out "
        "log-likelihood, nats, and reason of the rejection.",
        ("effect", "name", "instead of", "log-likelihood lower by", "reason"),
        rows,
    )


def _separate(steps: Sequence[Step]) -> Table:
    rows = tuple(dict.fromkeys((rival, text) for step in steps for rival, text in step.separate.items()))
    return Table(
        "discrepancy-separate",
        "Measurements that decide",
        "What distinguishes the effects above from similar ones.",
        ("similar effect", "measurement: difference"),
        rows,
    )


def _gaps(found: Verdict) -> Table:
    rows = []
    for i, step in enumerate(found.steps):
        low, high = step.gap_interval_after
        interval = f" ({gap_text(low)} to {gap_text(high)})" if math.isfinite(low) else ""
        none = "none reduces it" if step.effect else "not fitted"
        rivals = [
            f"{gap_text(rival.gap_after)} ({rival.effect})" if rival is not None else none
            for rival in (step.runner_up, step.placebo)
        ]
        rows.append(
            (
                f"{i + 1}: {found.added(step) or step.verdict}",
                gap_text(step.gap_before),
                f"{gap_text(step.gap_after)}{interval}",
                gap_text(step.gap_floor),
                *rivals,
            )
        )
    return Table(
        "discrepancy-gap",
        "Gap by step",
        "Gap on held-out frames, micronats per sample, with 95 % interval. The next best effect and the "
        "unrelated control were fitted instead of the named effect.",
        ("step", "before", "after", "floor", "next best effect instead", "unrelated control instead"),
        tuple(rows),
    )


def _how(step: Step, found: Verdict) -> str:
    """Return the status of an effect that was not named: empirical, or only the likeliest."""
    if step.effect:
        return ""
    if step.verdict != "described":
        return " (the likeliest)"
    return " (empirical)" if found.part_of_model(step) else " (empirical, not in the model)"


def _beside(step: Step, found: Verdict) -> str:
    """Return region and status of an effect, for its title."""
    return f"{f', in {step.place}' if step.place else ''}{_how(step, found)}"


def _parameters(data: DiscrepancyData) -> Table:
    rows = tuple(
        (f"{tag}: {name}", value, data.title(tag) + _beside(step, data.found), data.sources.get(tag, ""))
        for step in data.found.steps
        for tag in [step.likeliest]
        if tag and (step.effect or step.verdict == "described" or data.found.verdict == "ambiguous")
        for name, value in _values(step).items()
    )
    return Table(
        "discrepancy-parameters",
        "Parameters of the effects",
        "The strength with its standard error, and fixed parameters without one; names are keys of "
        "model.effects in the run's YAML.",
        ("parameter", "value", "effect", "source"),
        rows,
    )


def _values(step: Step) -> dict[str, str]:
    """Format the parameters and text fields of an effect."""
    numbers = {n: fitted_or_chosen(p.value, p.stderr, unit_text(p.unit)) for n, p in step.parameters.items()}
    return numbers | step.form


def _moved(found: Verdict) -> Table:
    rows = []
    for step in found.steps:
        for name, each in step.moved.items():
            unit = unit_text(each.unit)
            rows.append(
                (
                    f"{parameter_name(name)}{f' ({unit})' if unit else ''}",
                    f"{step.likeliest}{_how(step, found)}",
                    short(each.median, 2) if math.isfinite(each.median) else "not known",
                    signed(each.in_stderr),
                )
            )
    return Table(
        "discrepancy-moved",
        "Changes of the parameter maps",
        "Median over the pixels concerned of (with the effect − without it), also in standard errors per "
        "pixel. An effect in fewer than half of them does not change a median.",
        ("parameter", "effect added", "change", "in standard errors"),
        tuple(rows),
    )


def _untestable(data: DiscrepancyData) -> Table:
    rows = tuple((tag, data.title(tag), why or "") for tag, why in data.found.untestable.items())
    return Table(
        "discrepancy-untestable",
        "Effects that are not testable with these data",
        "",
        ("effect", "name", "reason, and data that would show it"),
        rows,
    )


def _unexplained(places: Sequence[Place]) -> Table:
    rows = tuple(
        (place.sentence or place.statistic, signed(place.z), place_text(place), place.statistic)
        for place in places[:_MOST_PLACES]
    )
    return Table(
        "discrepancy-unexplained",
        "Unexplained",
        "Remaining disagreements with all named effects in the model.",
        ("disagreement", "sigma", "where", "statistic"),
        rows,
    )


def _defects(found: Verdict) -> Table:
    return Table(
        "discrepancy-defects",
        "Defects",
        "Candidates that failed and were not compared; the verdict does not cover them.",
        ("effect", "error"),
        tuple(found.defects.items()),
    )


def _surveyed(name: str, data: DiscrepancyData) -> str:
    """Describe a deviating map of the whole sensor."""
    kind, _, rest = name.partition(".")
    if kind == "pairs":
        mode, _, channel = rest.partition(".")
        return f"pixels of a {mode} correlated ({'charge' if channel == 'charge' else 'readout'})"
    if kind in ("score", "goodness"):
        _, sentence = data.statistics.get(f"shape.{rest or kind}.mean", ("", name))
        return sentence.removesuffix(" (mean over pixels)")
    return _SURVEYED.get(name, name)


def _examined(data: DiscrepancyData) -> Table:
    found, rows = data.found, []
    for key, words in (
        ("frames", "frames"),
        ("train", "training frames"),
        ("test", "test frames"),
        ("final", "frames for the final gap"),
        ("rows", "rows"),
        ("columns", "columns"),
    ):
        value = getattr(found.examined, key)
        rows.append((words, f"{value[0]} to {value[1] - 1}" if isinstance(value, tuple) else f"{value:,}"))
    examined = found.examined
    if math.isfinite(examined.share):
        rows.append(("share of the run's samples", percent(examined.share, 1.0)))
        rows.append(("share surveyed for deviating regions", percent(examined.surveyed, 1.0)))
        rows += [(f"share: {kind}", percent(share, 1.0)) for kind, share in examined.surveyed_by.items()]
    for place in examined.places:
        words = Region.model_validate(place.region).describe()
        rows.append(
            (f"whole sensor: {_surveyed(place.map, data)}", f"{words} (p {probability_text(place.p)})")
        )
    if examined.elsewhere is not None:
        there = examined.elsewhere
        rows.append(("tested again", f"{there.words()}: {there.deviates or 'the model holds'}"))
    if found.replicates:
        rows.append(("simulated replicates", f"{found.replicates:,}"))
    if math.isfinite(found.work):
        rows.append(("counted work of the search, CPU s of a core of about 2020", f"{found.work:,.0f}"))
    rows += [(f"version: {name}", str(version)) for name, version in found.versions.items()]
    return Table("discrepancy-examined", "Samples examined", "", ("item", "value"), tuple(rows))
