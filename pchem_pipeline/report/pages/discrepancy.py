"""The page of a search for missing effects: verdict first, then its evidence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from pchem_pipeline.base.units import typeset
from pchem_pipeline.discrepancy.verdict import (
    CONVINCING_PLACEBO,
    RARE,
    GapChange,
    Moved,
    Step,
    Verdict,
    families_words,
    sigma_text,
)
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.discrepancy_gap import gap_text
from pchem_pipeline.report.pages.discrepancy_tables import (
    discrepancy_tables,
    parameter_name,
    probability_text,
)
from pchem_pipeline.report.pages.page import Finding, KeyFact, Section
from pchem_pipeline.report.pages.pictures import Picture
from pchem_pipeline.report.pages.summary import VERDICT_LEVELS, Flag, Level, gravest_first
from pchem_pipeline.report.style.wording import (
    count,
    fitted_or_chosen,
    percent,
    short,
    unit_text,
)

#: File of the verdict's own page in the folder of a run.
DISCREPANCY_PAGE = "discrepancy.html"
#: Changes below this share of the standard error per pixel are negligible.
_IMMATERIAL = 0.2
#: Changes below this are none.
_NOT_MOVED = 0.01

#: (id, heading, introduction) of the parts of the page.
PARTS: tuple[tuple[str, str, str], ...] = (
    (
        "signature",
        "Largest disagreement, before and after",
        "The statistic that the added effect changes most (else the largest disagreement), and all "
        "statistics before and after, in sigma.",
    ),
    (
        "where",
        "Where data and model disagree",
        "Effects of light and charge show in the charge channel, effects of the electronics in the readout "
        "residuals. Figures show the training frames, numbers training and test frames.",
    ),
    (
        "evidence",
        "Identification of the effect",
        "Log-likelihood of each fitted candidate on test frames, relative to the best; larger is better. A "
        "difference below three standard errors is not decisive.",
    ),
    (
        "shown",
        "Remaining gap between data and model",
        "Gap on held-out frames, micronats per sample.",
    ),
    (
        "parameters",
        "Parameters of the effect, and changes of the maps",
        "",
    ),
    (
        "limits",
        "Limits of these data",
        "Effects that no number of frames of one constant exposure can show, and the samples examined.",
    ),
)

_EMPTY = {
    "where": "No data were kept for figures.",
    "evidence": "No candidates were compared: data and model agree within sampling noise.",
    "shown": "No gap was measured.",
    "parameters": "Nothing was added to the model.",
    "limits": "Nothing was recorded.",
}


def finding(data: DiscrepancyData) -> Finding:
    """Return the verdict with its key numbers and remarks."""
    found = data.found
    return Finding(
        VERDICT_LEVELS.get(found.verdict, "note"),
        found.verdict.replace("_", " ").capitalize(),
        typeset(found.sentence),
        frames_text(found),
        key_facts(data),
        remarks(data),
    )


def evidence(data: DiscrepancyData, pictures: Sequence[Picture]) -> list[Section]:
    """Return the sections of the page below the verdict.

    Args:
        data: verdict and arrays.
        pictures: the figures of the verdict.
    """
    tables = discrepancy_tables(data)
    parts = []
    first = _signature(data.found)
    for id_, title, intro in PARTS:
        shown = [
            picture
            for picture in pictures
            if id_ == ("signature" if picture.figure.name in first else picture.figure.section)
        ]
        shown.sort(
            key=lambda picture: first.index(picture.figure.name) if picture.figure.name in first else 0
        )
        rows = tables.get(id_, [])
        if id_ == "signature" and not shown:
            continue  # no disagreement, or no data for figures
        if id_ == "where" and not data.found.where:
            title = "Data and model side by side"
        missing = () if shown or rows else (_empty(data.found, id_),)
        part = f"discrepancy-part-{id_}"
        parts.append(Section(id=part, title=title, intro=intro, missing=missing, pictures=shown, tables=rows))
    return parts


def _empty(found: Verdict, part: str) -> str:
    """Return why a part of the page is empty."""
    if part == "evidence" and any(step.verdict == "described" for step in found.steps):
        return "No known effect explains the disagreement; the empirical description has no rivals."
    return _EMPTY[part]


#: Family of a statistic, or its beginning, to the figure that shows it.
_PICTURES = (
    ("code.", "discrepancy_codes"),
    ("frame.", "discrepancy_frames"),
    ("space.row.", "discrepancy_lines"),
    ("space.column.", "discrepancy_lines"),
    ("", "discrepancy_maps"),
)


def _signature(found: Verdict) -> tuple[str, ...]:
    """Return the first figures: that of the most important statistic, and all before and after."""
    pulls = [pull for step in found.steps[:1] for pull in step.pulls]
    statistic = pulls[0].statistic if pulls else next((place.statistic for place in found.where), "")
    if not statistic:
        return ()
    return next(name for start, name in _PICTURES if statistic.startswith(start)), "discrepancy_pulls"


def frames_text(found: Verdict) -> str:
    """Describe the samples examined."""
    seen = found.examined
    dealt = f"{seen.train:,} for training, {seen.test:,} for testing, {seen.final:,} for the gap"
    if seen.histograms is not None:
        return f"{count(seen.histograms, 'histogram')}, samples split at random: {dealt}."
    share = f" ({percent(seen.share, 1.0)} of the run's samples)" if math.isfinite(seen.share) else ""
    place = f"rows {seen.rows[0]} to {seen.rows[1] - 1}, columns {seen.columns[0]} to {seen.columns[1] - 1}"
    rest = seen.frames - seen.train - seen.test - seen.final
    over = f"; {rest} left over" if rest > 0 else ""
    words = f"{count(seen.frames, 'frame')} of {place}{share}: {dealt}{over}."
    again = "" if seen.elsewhere is None else f" The final model was {seen.elsewhere.says()}."
    return words + again + _unfitted_text(found)


def _unfitted_text(found: Verdict) -> str:
    """State how many pixels are not compared, and where they cluster; empty if none."""
    seen = found.examined
    if not seen.unfitted:
        return ""
    spot = next((place for place in seen.places if place.map == "unfitted"), None)
    where = "" if spot is None else f", clustered in {Region.model_validate(spot.region).describe()}"
    return f" Not compared: {count(seen.unfitted, 'pixel')} without a reliable fit{where}."


def key_facts(data: DiscrepancyData) -> list[KeyFact]:
    """Return the numbers of the first screen."""
    found = data.found
    return [*_effect_facts(data), *_moved_fact(found), *_chance_fact(found), *_gap_fact(found)]


def _gap_fact(found: Verdict) -> list[KeyFact]:
    """Return the closed share of the gap, with the gap below it."""
    gap = found.gap
    if not math.isfinite(gap.before):
        return []
    extended = any(found.added(step) for step in found.steps) and math.isfinite(gap.after)
    nats = f"{gap_text(gap.before)} → {gap_text(gap.after)}" if extended else gap_text(gap.before)
    unit, chance = "micronats per sample", f"sampling noise: up to {gap_text(gap.floor)}"
    if not extended or gap.within_chance:
        return [KeyFact("gap between data and model", nats, (unit, chance))]
    more = (f"{nats} {unit}", chance + _interval(gap))
    nearest = " by the closest effect, not named" if found.verdict == "unexplained" else ""
    return [KeyFact(f"of the gap closed{nearest}", percent(gap.closed_fraction, 1.0), more)]


def _interval(gap: GapChange) -> str:
    low, high = gap.interval_after
    if not (math.isfinite(low) and math.isfinite(high)):
        return ""
    return f"; remaining: {f'{gap_text(low)} to ' if low > 0.0 else 'at most '}{gap_text(high)}"


def _effect_facts(data: DiscrepancyData) -> list[KeyFact]:
    facts = []
    for step in data.found.steps:
        if (step.effect or step.verdict == "described") and step.parameters:
            values = [
                f"{name} {fitted_or_chosen(p.value, p.stderr, unit_text(p.unit))}"
                for name, p in step.parameters.items()
            ]
            values += [f"{name} {word}" for name, word in step.form.items()]
            value, more = _size_texts(step, values)
            place = (f"in {step.place}",) if step.place else ()
            only = () if data.found.part_of_model(step) else ("proposed, not in the model",)
            facts.append(KeyFact(data.title(step.likeliest), value, (*more, *place, *only)))
    return facts[:4]


def _size_texts(step: Step, values: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Format the size of an effect, and the lines below it; its parameters if the size is unknown."""
    size = step.size
    if size is None:
        # name and value do not fit in one line
        name, _, value = values[0].partition(" ")
        return value, (name, *values[1:3])
    part = "" if size.samples >= RARE else f", in {percent(size.samples, 1.0)} of the samples"
    share = f"{size.beside_noise()}, {short(size.electrons, 2)} e⁻ rms{part}"
    return f"{short(size.dn, 2)} DN", (share, values[0])


def _moved_fact(found: Verdict) -> list[KeyFact]:
    moved = _largest_move([step for step in found.steps if not found.proposed or step.effect])
    if moved is None or abs(moved[1].in_stderr) < _NOT_MOVED:
        return []
    name, largest = moved
    unit = unit_text(largest.unit)
    small = ", negligible" if abs(largest.in_stderr) < _IMMATERIAL else ""
    return [
        KeyFact(
            f"largest change: {parameter_name(name)}",
            f"{_signed(largest.median, 2)} {unit}".strip(),
            (f"{_signed(largest.in_stderr, 2)} standard errors per pixel{small}",),
        )
    ]


def _largest_move(steps: Sequence[Step]) -> tuple[str, Moved] | None:
    moved = [(name, m) for step in steps for name, m in step.moved.items() if math.isfinite(m.in_stderr)]
    return max(moved, key=lambda pair: abs(pair[1].in_stderr), default=None)


def _signed(value: float, digits: int = 3) -> str:
    return short(value, digits) if value < 0 or not math.isfinite(value) else f"+{short(value, digits)}"


def _chance_fact(found: Verdict) -> list[KeyFact]:
    if not math.isfinite(found.p_global.before):
        return []
    more = [f"of the largest disagreement, {found.replicates} replicates"] if found.replicates else []
    before, after = probability_text(found.p_global.before), probability_text(found.p_global.after)
    value = f"{before} → {after}" if after and found.effects else before
    return [KeyFact("p-value", value, tuple(more))]


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
    if extended:
        yield from _closing(found)
    for step in extended:
        yield from _compared(step, data)
    for step in found.steps:
        for rival, measurement in step.separate.items() if step.verdict == "ambiguous" else ():
            yield Flag("note", f"To distinguish {data.title(rival)}: {measurement}.")
    for most in found.unexplained[:1]:
        words = most.sentence or most.statistic
        yield Flag("caution", f"Largest remaining disagreement: {words} ({sigma_text(most.z)}).")
    for name, why in found.defects.items():
        yield Flag("serious", f"Defect: candidate {name} failed and was not compared: {why}.")
    if found.untestable:
        titles = ", ".join(map(data.title, found.untestable))
        yield Flag("note", f"Not testable with these data: {titles}.")


def _closing(found: Verdict) -> Iterator[Flag]:
    """State the remaining gap."""
    gap = found.gap
    if not (math.isfinite(gap.after) and math.isfinite(gap.floor)):
        return
    if gap.within_chance:
        yield Flag("note", "The gap is within sampling noise before, too: only single statistics show it.")
    elif gap.after <= gap.floor and gap.standing_out:
        families = families_words(gap.standing_out)
        yield Flag("caution", f"A significant discrepancy remains in {families}.")
    elif gap.after <= gap.floor:
        yield Flag("good", "The remaining gap is within sampling noise.")
    else:
        left = percent(1.0 - gap.closed_fraction, 1.0)
        words = f"{gap_text(gap.after)} micronats per sample, sampling noise up to {gap_text(gap.floor)}"
        level: Level = "caution" if found.verdict == "named_in_part" else "note"
        yield Flag(level, f"{left} of the gap remains: {words}.")


def _compared(step: Step, data: DiscrepancyData) -> Iterator[Flag]:
    """State the share of the gap that the next best effect and an unrelated control close instead."""

    def short_title(tag: str) -> str:
        return data.title(tag).partition(" (")[0]  # without synonyms

    own, name = step.closed, short_title(step.effect or "")
    runner_up, placebo = step.runner_up, step.placebo
    if runner_up is not None and (step.within_chance or own > 0.0):
        rival, why = short_title(runner_up.effect), f"is rejected, since {runner_up.why}"
        # reductions of sampling noise mean nothing
        if not step.within_chance:
            share = percent(step.closed_by(runner_up), 1.0)
            words = f"Instead of {name}, {rival} (next best effect) closes {share} of the gap"
            yield Flag("note", f"{words}{f' and {why}' if runner_up.why else ''}.")
        elif runner_up.why:
            yield Flag("note", f"The next best effect, {rival}, {why}.")
    if step.within_chance or not own > 0.0:
        return
    if placebo is None:
        yield Flag("good", f"No unrelated control instead of {name} closes any of the gap.")
        return
    of_that = min(step.closed_by(placebo) / own, 1.0)
    doubtful = of_that > CONVINCING_PLACEBO
    text = f"An unrelated control ({short_title(placebo.effect)}) reduces the gap"
    words = f"{text} {percent(of_that, 1.0)} as much as {name}{f': {name} is doubtful' if doubtful else ''}."
    yield Flag("caution" if doubtful else "good", words)
