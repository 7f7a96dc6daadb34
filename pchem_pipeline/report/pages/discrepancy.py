"""The page of a search for missing effects: verdict first, then its evidence, figures and tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from pchem_pipeline.base.wording import (
    MAPS,
    capitalised,
    count,
    fitted_or_chosen,
    measured,
    p_value_text,
    percent,
    probability_text,
    short,
    signed,
    symbol,
    typeset,
    unit_text,
)
from pchem_pipeline.discrepancy.verdict import FACTORS, Place, Step, Verdict, micronats, sigma_text
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.pages.page import Finding, KeyFact, Section
from pchem_pipeline.report.pages.summary import VERDICT_LEVELS, Flag, gravest_first
from pchem_pipeline.report.pages.tables import Table

#: Longer lists are in ``discrepancy.json`` only.
_MOST_PLACES = 12
#: Maps of the survey in words.
_SURVEYED = {
    "next_x": "neighbours in a row correlated",
    "next_y": "neighbours in a column correlated",
    "lag": "successive frames correlated",
    "spread": "levels change along the run",
    "unfitted": "clustered pixels without a reliable fit",
}


def _parameter_name(name: str) -> str:
    return symbol(name)[1] if name in MAPS else name.replace("_", " ")


def discrepancy_tables(data: DiscrepancyData) -> dict[str, list[Table]]:
    """Return the tables of each part of the page that have rows."""
    found = data.found
    parts = {
        "where": [_where(data, found.where)],
        "evidence": [
            *[_candidates(data, step, i) for i, step in enumerate(found.steps)],
            Table(
                "discrepancy-factors",
                "What is certain of an effect that has no name",
                "Certain is what all candidates that remain have in common.",
                [
                    {
                        "factor": FACTORS[name],
                        "value": " or ".join(values),
                        "": "certain" if len(values) == 1 else "open",
                    }
                    for step in found.steps
                    if any(len(values) > 1 for values in step.factors.values())
                    for name, values in step.factors.items()
                ],
            ),
            _rivals(data),
            Table(
                "discrepancy-separate",
                "Measurements that decide",
                "How to tell the effects of the verdict from similar ones.",
                [
                    {"similar effect": rival, "measurement: difference": text}
                    for rival, text in dict.fromkeys(
                        pair for step in found.steps for pair in step.separate.items()
                    )
                ],
            ),
        ],
        "parameters": [_parameters(data), _moved(found)],
        "limits": [
            Table(
                "discrepancy-untestable",
                "Effects that are not testable with these data",
                "",
                [
                    {"effect": tag, "name": data.title(tag), "reason, and data that would show it": why or ""}
                    for tag, why in found.untestable.items()
                ],
            ),
            Table(
                "discrepancy-unexplained",
                "Unexplained",
                "Remaining disagreements with the effects above in the model.",
                [
                    {
                        "disagreement": place.sentence or place.statistic,
                        "sigma": signed(place.z),
                        "where": place_text(place),
                    }
                    for place in found.unexplained[:_MOST_PLACES]
                ],
            ),
            Table(
                "discrepancy-defects",
                "Defects",
                "Candidates that failed and were not compared; the verdict does not cover them.",
                [{"effect": tag, "error": error} for tag, error in found.defects.items()],
            ),
            _examined(data),
        ],
    }
    return {part: [table for table in tables if table.rows] for part, tables in parts.items()}


def place_text(place: Place) -> str:
    """Describe the pixels, DN and frames of a disagreement; empty for the whole sensor and run."""
    words = [place.spot()] if place.spot() else []
    if place.pixels:
        shown = ", ".join(f"({y}, {x})" for y, x in place.pixels[:4])
        more = f" … {count(len(place.pixels), 'pixel')} listed" if len(place.pixels) > 4 else ""
        words.append(f"pixels (y, x) {shown}{more}")
    if place.dn is not None:
        low, high = place.dn
        words.append(f"{low:g} DN" if low == high else f"{low:g} to {high:g} DN")
    if len(place.frames) > 4:
        words.append(f"{count(len(place.frames), 'frame')} from {min(place.frames)} to {max(place.frames)}")
    elif place.frames:
        words.append(f"frames {', '.join(map(str, place.frames))}")
    return "; ".join(words)


def _where(data: DiscrepancyData, places: Sequence[Place]) -> Table:
    more = f" The first {_MOST_PLACES} of {len(places)}." if len(places) > _MOST_PLACES else ""
    return Table(
        "discrepancy-where",
        "Statistics that disagree",
        f"Deviation of each from the plain model in sigma, with its p-value; the largest first.{more}",
        [
            {
                "disagreement": place.sentence or sentence or place.statistic,
                "channel": place.channel or channel,
                "sigma": signed(place.z),
                "p": probability_text(place.p),
                "where": place_text(place) or "everywhere",
            }
            for place in places[:_MOST_PLACES]
            for channel, sentence in [data.statistics.get(place.statistic, ("", ""))]
        ],
    )


def _candidates(data: DiscrepancyData, step: Step, index: int) -> Table:
    rows = []
    best = max((c.score for c in step.candidates if math.isfinite(c.score)), default=math.nan)
    # an empirical description has no competitors
    several = len(step.candidates) > 1 and step.verdict != "described"
    for candidate in step.candidates[: 8 if several else 0]:
        behind = candidate.score - best
        given = [
            f"{name} {f'{value:.3g}' if isinstance(value, int | float) else value}"
            for name, value in candidate.parameters.items()
            if value is not None and not isinstance(value, list | dict)
        ]
        rows.append(
            {
                "effect": candidate.effect,
                "name": data.titles.get(candidate.effect, ""),
                "log-likelihood": measured(candidate.score, candidate.stderr),
                "difference": short(behind) if -math.inf < behind < 0 else "best" if behind == 0 else "",
                "probability": probability_text(candidate.probability),
                "parameters": ", ".join(given),
            }
        )
    if step.effect:
        outcome = f"{step.effect} was named"
    elif data.found.verdict == "ambiguous":
        outcome = "these data do not decide"
    else:
        outcome = f"none explains the data{f'; of the first: {step.why}' if step.why else ''}"
    title = f"Candidates, step {index + 1}" if len(data.found.steps) > 1 else "Candidates"
    return Table(f"discrepancy-candidates-{index + 1}", f"{title}: {outcome}", "", rows)


def _rivals(data: DiscrepancyData) -> Table:
    return Table(
        "discrepancy-rivals",
        "Rejected effects",
        "The next best effects, each fitted instead of the named one; log-likelihood of all statistics of "
        "training and test frames.",
        [
            {
                "effect": rival.effect,
                "name": data.titles.get(rival.effect, ""),
                "instead of": step.effect,
                "log-likelihood lower by": (
                    short(-rival.behind) if math.isfinite(rival.behind) else "not scored"
                ),
                "reason": rival.why or "it has a lower log-likelihood",
            }
            for step in data.found.steps
            if step.effect
            for rival in step.rivals
        ],
    )


def _how(step: Step, found: Verdict) -> str:
    """Return the status of an effect that was not named: empirical, or only the likeliest."""
    if step.effect:
        return ""
    if step.verdict != "described":
        return " (rejected)" if step.verdict == "unexplained" else " (the likeliest)"
    return " (empirical)" if found.part_of_model(step) else " (empirical, not in the model)"


def _parameters(data: DiscrepancyData) -> Table:
    effects = effect_classes()
    return Table(
        "discrepancy-parameters",
        "Parameters of the effects",
        "Each with its standard error, where one was computed; names are keys of model.effects in the run's "
        "YAML. Sizes are simulated with these values, and have their relative errors.",
        [
            {
                "parameter": f"{tag}: {name}",
                "value": value,
                "meaning": _meaning(tag, name),
                "effect": f"{data.title(tag)}{place}{_how(step, data.found)}" if i == 0 else "",
                "source": effects[tag].source if i == 0 and tag in effects else "",
            }
            for step in data.found.steps
            for tag, place in [(step.likeliest, f", in {step.place}" if step.place else "")]
            if tag and (step.effect or step.verdict == "described" or data.found.verdict == "ambiguous")
            for i, (name, value) in enumerate(_values(step).items())
        ],
    )


def _meaning(tag: str, name: str) -> str:
    if name == "frequency":
        return "frequency, or this plus or minus a multiple of the line rate"
    known = effect_classes().get(tag)
    return name if known is None or name not in known.model_fields else typeset(known.meaning(name))


def _values(step: Step) -> dict[str, str]:
    numbers = {n: fitted_or_chosen(p.value, p.stderr, unit_text(p.unit)) for n, p in step.parameters.items()}
    return numbers | step.form


def _moved(found: Verdict) -> Table:
    rows = []
    kept = [step for step in found.steps if found.part_of_model(step)]
    for step in kept:
        # effects that were fitted together have moved the maps together
        together = [other for other in kept if other.moved == step.moved]
        for name, each in step.moved.items() if together[0] is step else ():
            unit = unit_text(each.unit)
            rows.append(
                {
                    "parameter": f"{_parameter_name(name)}{f' ({unit})' if unit else ''}",
                    "effect added": " + ".join(f"{one.likeliest}{_how(one, found)}" for one in together),
                    "change": short(each.median, 2) if abs(each.in_stderr) >= _NOT_MOVED else "0",
                    "in standard errors": signed(each.in_stderr),
                }
            )
    return Table(
        "discrepancy-moved",
        "Changes of the parameter maps",
        "Median over the pixels concerned of (with the effect − without it), also in standard errors per "
        "pixel. An effect in few of them hardly moves a median.",
        rows,
    )


def _surveyed(name: str, data: DiscrepancyData) -> str:
    kind, _, rest = name.partition(".")
    if kind == "pairs":
        mode, _, channel = rest.partition(".")
        return f"pixels of a {mode} correlated ({'charge' if channel == 'charge' else 'readout'})"
    if kind in ("score", "goodness"):
        _, sentence = data.statistics.get(f"shape.{rest or kind}.mean", ("", name))
        return sentence.removesuffix(" (mean over pixels)")
    return _SURVEYED.get(name, name)


def _examined(data: DiscrepancyData) -> Table:
    examined, rows = data.found.examined, []
    if math.isfinite(examined.share):
        rows.append(("share of the samples", percent(examined.surveyed)))
        rows += [(f"share: {kind}", percent(share)) for kind, share in examined.surveyed_by.items()]
    for place in examined.places:
        words = Region.model_validate(place.region).describe()
        rows.append((_surveyed(place.map, data), f"{words} ({p_value_text(place.p)})"))
    cells = [{"item": item, "value": value} for item, value in rows]
    return Table("discrepancy-examined", "Survey of the whole sensor", "", cells)


#: File of the verdict's own page in the folder of a run.
DISCREPANCY_PAGE = "discrepancy.html"

#: Change of a parameter in standard errors of a pixel that is none.
_NOT_MOVED = 0.01
#: The parts of the page below the verdict.
PARTS = (
    Section(
        "signature",
        "Largest disagreement, before and after",
        "The statistic that the added effect changes most (or, if none, the largest disagreement), and all "
        "statistics before and after, in standard deviations of the statistic under the model (sigma).",
        "",
    ),
    Section(
        "where",
        "Where data and model disagree",
        "Light and charge show mainly in the charge channel, electronics mainly in the readout residuals. "
        "Figures show the training frames, numbers training and test frames.",
        "No data were kept for figures.",
    ),
    Section(
        "evidence",
        "Identification of the effect",
        "Log-likelihood of each fitted candidate, of all statistics of training and test frames, nats; larger"
        " is better. A difference below three standard errors, where given, is not decisive.",
        "There is nothing to identify: no statistic tested disagrees with the model.",
    ),
    Section(
        "shown",
        "Remaining gap between data and model",
        "Gap on held-out frames, micronats per sample.",
        "No gap was measured.",
    ),
    Section(
        "parameters",
        "Parameters of the effect, and changes of the maps",
        "",
        "Nothing was added to the model.",
    ),
    Section(
        "limits",
        "Limits of these data",
        "Effects that no number of frames of one constant exposure can show, and regions that deviate.",
        "Nothing was recorded.",
    ),
)


def finding(data: DiscrepancyData) -> Finding:
    """Return the verdict with its key numbers and remarks."""
    found = data.found
    level, sentence = VERDICT_LEVELS.get(found.verdict, "note"), typeset(found.sentence)
    facts = key_facts(data), remarks(data)
    return Finding(level, found.word.capitalize(), sentence, found.examined.words(), *facts)


def evidence(data: DiscrepancyData, figures: Sequence[Figure]) -> list[Section]:
    """Return the sections of the page below the verdict."""
    tables = discrepancy_tables(data)
    first = _signature(data.found)
    words = {"where": {} if data.found.where else {"title": "Data and model side by side"}}
    if any(step.verdict == "described" for step in data.found.steps):
        words["evidence"] = {"empty": "No effect in the library explains the disagreement."}
    elif data.found.steps:
        words["evidence"] = {"empty": "There is only one candidate."}
    parts = []
    for part in PARTS:
        shown = [each for each in figures if each.section == part.id and each.name not in first]
        if part.id == "signature":
            shown = [each for name in first for each in figures if each.name == name]
        section = part.filled(figures=shown, tables=tables.get(part.id, ()), **words.get(part.id, {}))
        if section is not None:
            parts.append(replace(section, id=f"discrepancy-part-{part.id}"))
    return parts


#: Family of a statistic, or its beginning, to the figure that shows it.
_PICTURES = (
    ("code.", "discrepancy_codes"),
    ("frame.", "discrepancy_frames"),
    ("space.row.", "discrepancy_lines"),
    ("space.column.", "discrepancy_lines"),
    ("", "discrepancy_maps"),
)


def _signature(found: Verdict) -> tuple[str, ...]:
    """Return the first figures: that of the most important statistic, and that of all statistics."""
    pulls = [pull for step in found.steps[:1] for pull in step.pulls]
    statistic = pulls[0].statistic if pulls else next((place.statistic for place in found.where), "")
    if not statistic:
        return ()
    return next(name for start, name in _PICTURES if statistic.startswith(start)), "discrepancy_pulls"


def key_facts(data: DiscrepancyData) -> list[KeyFact]:
    """Return the numbers of the first screen."""
    found, facts = data.found, _effect_facts(data)[:4]
    steps = filter(found.part_of_model, found.steps)
    moved = [(name, m) for step in steps for name, m in step.moved.items() if math.isfinite(m.in_stderr)]
    name, largest = max(moved, key=lambda pair: abs(pair[1].in_stderr), default=("", None))
    if largest is not None and abs(largest.in_stderr) >= _NOT_MOVED:
        small = ", negligible" if abs(largest.in_stderr) < 0.2 else ""
        value = f"{_signed(largest.median)} {unit_text(largest.unit)}".strip()
        text = f"median over pixels; {_signed(largest.in_stderr)} standard errors of one pixel{small}"
        facts.append(KeyFact(f"largest change: {_parameter_name(name)}", value, (text,)))
    if math.isfinite(found.p_global.before):
        more = ["of the largest deviation of all statistics, if the model holds"]
        more += [f"Student's t, scatter of {found.replicates} simulated stacks"] if found.replicates else []
        before, after = probability_text(found.p_global.before), probability_text(found.p_global.after)
        value = f"{before} → {after}" if after and found.steps else before
        facts.append(KeyFact("p-value", value, tuple(more)))
    return [*facts, _gap_fact(found)] if math.isfinite(found.gap.before) else facts


def _gap_fact(found: Verdict) -> KeyFact:
    gap = found.gap
    extended = any(found.added(step) for step in found.steps) and math.isfinite(gap.after)
    before = micronats(gap.before, gap.interval_before)
    nats = f"{before} → {gap.after_text}" if extended else before
    unit, chance = "micronats per sample", f"sampling noise up to {micronats(gap.floor)}"
    if not extended or gap.after <= gap.floor:
        return KeyFact("gap between data and model", nats, (unit, chance))
    more = (f"{nats} {unit}", chance)
    return KeyFact(f"of the gap closed{found.closed_by}", percent(gap.closed_fraction), more)


def _effect_facts(data: DiscrepancyData) -> list[KeyFact]:
    facts = []
    for step in data.found.steps:
        if (step.effect or step.verdict == "described") and step.parameters:
            (first, value), *others = _values(step).items()
            more = [_meaning(step.likeliest, first)]
            more += [f"{_meaning(step.likeliest, name)}: {text}" for name, text in others[:2]]
            more += [] if step.size is None else [step.size.words()]
            more += [f"in {step.place}"] if step.place else []
            more += [] if data.found.part_of_model(step) else ["proposed, not in the model"]
            facts.append(KeyFact(data.title(step.likeliest), value, tuple(more)))
    return facts


def _signed(value: float) -> str:
    return short(value, 2) if value < 0 or not math.isfinite(value) else f"+{short(value, 2)}"


def remarks(data: DiscrepancyData) -> list[Flag]:
    """Return evidence for and against the verdict, the most severe first."""
    return gravest_first(_remarks(data))


def _remarks(data: DiscrepancyData) -> Iterator[Flag]:
    found = data.found
    extended = [step for step in found.steps if step.effect]
    if found.doubt:
        words = "Statistics that depend on the pixels' parameters were not tested, and sizes have no e⁻"
        why = "" if found.doubt in found.sentence else f": {typeset(found.doubt)}"
        yield Flag("caution", f"{words}{why}.")
    if extended and found.gap.before <= found.gap.floor:
        yield Flag("note", "The gap is within sampling noise before, too: only single statistics show it.")
    for step in extended:
        second = step.runner_up
        if second is not None and second.why:
            titles = f"{data.title(step.likeliest)}, {data.title(second.effect)}"
            yield Flag("note", f"The next best effect instead of {titles}, is rejected, since {second.why}.")
    for step in found.steps:
        for rival, measurement in step.separate.items() if step.verdict == "ambiguous" else ():
            yield Flag("note", f"To distinguish {data.title(rival)}: {measurement}.")
    for most in found.unexplained[:1]:
        words = most.sentence or most.statistic
        yield Flag("caution", f"Largest remaining disagreement: {words} ({sigma_text(most.z)}).")
    for name, why in found.defects.items():
        yield Flag("serious", f"Defect: candidate {name} failed and was not compared: {why}.")
    if found.limit:
        yield Flag("note", f"{capitalised(found.limit)}.")
    if found.untestable:
        titles = ", ".join(map(data.title, found.untestable))
        yield Flag("note", f"Not testable with these data: {titles}.")
