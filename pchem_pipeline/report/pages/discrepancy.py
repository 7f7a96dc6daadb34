"""The page of a verdict on what the model is missing: verdict first, then its evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pchem_pipeline.discrepancy.verdict import (
    CONVINCING_PLACEBO,
    RARE,
    Candidate,
    GapChange,
    Moved,
    Place,
    Step,
    Verdict,
)
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.report.figures.discrepancy_gap import gap_text
from pchem_pipeline.report.pages.pictures import Picture
from pchem_pipeline.report.pages.summary import Flag, Level
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.wording import count, measured, percent, short, signed, symbol, unit_text

#: File of the verdict's own page in the folder of a run.
DISCREPANCY_PAGE = "discrepancy.html"
#: Longer lists are in ``discrepancy.json`` only.
_MOST_PLACES, _MOST_CANDIDATES = 12, 8
#: Parameters that moved by less than this share of a pixel's standard error did not matter.
_IMMATERIAL = 0.2
#: And by less than this did not move.
_NOT_MOVED = 0.01

#: Verdict to its level and its name.
VERDICT_WORDS: dict[str, tuple[Level, str]] = {
    "named": ("note", "Named"),
    "named_in_part": ("caution", "Named in part"),
    "ambiguous": ("caution", "Ambiguous"),
    "described": ("caution", "Described"),
    "unexplained": ("serious", "Unexplained"),
    "consistent": ("good", "Consistent"),
    "cannot_tell": ("caution", "Cannot tell"),
}

#: (id, heading, introduction) of the parts of the page.
PARTS: tuple[tuple[str, str, str], ...] = (
    (
        "signature",
        "What shows most, before and after",
        "The statistic that the added effect moves most (where nothing was added, the largest disagreement), "
        "and each statistic before and after, in standard deviations of chance.",
    ),
    (
        "where",
        "Where data and model disagree",
        "Effects of light and charge show in the charge channel, those of the electronics in the readout "
        "residuals. Pictures are of the frames to find with, numbers of these and those to confirm with.",
    ),
    (
        "evidence",
        "Which effect it is",
        "Each candidate is fitted, and scored on frames that its strength was not fitted to: differences of "
        "log-probability, larger is better. A difference below three standard errors decides nothing.",
    ),
    (
        "shown",
        "How much of the gap is closed",
        "The gap on frames that no fit has seen, in micronats.",
    ),
    (
        "parameters",
        "The effect, and what it changes",
        "",
    ),
    (
        "limits",
        "What these data cannot tell",
        "Effects that frames of one constant exposure cannot show, whatever their number, and what was not "
        "examined.",
    ),
)

#: What the maps of the survey show.
_SURVEYED = {
    "next_x": "neighbours in a row alike",
    "next_y": "neighbours in a column alike",
    "lag": "successive frames alike",
    "spread": "levels change along the run",
}

_EMPTY = {
    "where": "Nothing was kept to draw.",
    "evidence": "No candidate was asked for: nothing disagrees beyond chance.",
    "shown": "No gap was measured.",
    "parameters": "Nothing was added to the model.",
    "limits": "Nothing was recorded.",
}


@dataclass(frozen=True)
class KeyFact:
    """One number of the first screen, with up to two lines below it."""

    label: str
    value: str
    more: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part:
    """A part of the page: figures and tables under a heading; ``empty`` says why there are none."""

    id: str
    title: str
    intro: str
    empty: str
    pictures: list[Picture]
    tables: list[Table]


@dataclass(frozen=True)
class DiscrepancyView:
    """All that the templates show.

    Attributes:
        level: how grave it is (a class of the style sheet).
        name: the verdict's name.
        sentence: the verdict in one sentence.
        frames: which samples it rests on.
        facts: the key numbers.
        remarks: what speaks for and against it.
        parts: figures and tables.
    """

    level: str
    name: str
    sentence: str
    frames: str
    facts: list[KeyFact]
    remarks: list[Flag]
    parts: list[Part]


def discrepancy_view(data: DiscrepancyData, pictures: Sequence[Picture]) -> DiscrepancyView:
    """Return the page's content.

    Args:
        data: verdict and arrays.
        pictures: the figures of the verdict.
    """
    level, name = verdict_level(data.found)
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
            continue  # nothing disagrees, or nothing was kept to draw
        if id_ == "where" and not data.found.where:
            title = "Data and model side by side"
        empty = "" if shown or rows else _EMPTY[id_]
        parts.append(Part(f"discrepancy-part-{id_}", title, intro, empty, shown, rows))
    sentence = data.found.sentence.replace(" -> ", " → ")
    return DiscrepancyView(
        level, name, sentence, frames_text(data.found), key_facts(data), remarks(data), parts
    )


#: Family of a statistic, or its beginning, to the figure that shows it.
_PICTURES = (
    ("code.", "discrepancy_codes"),
    ("frame.", "discrepancy_frames"),
    ("space.row.", "discrepancy_lines"),
    ("space.column.", "discrepancy_lines"),
    ("", "discrepancy_maps"),
)


def _signature(found: Verdict) -> tuple[str, ...]:
    """Return the figures that come first: of the statistic that matters most, and all before and after."""
    pulls = [pull for step in found.steps[:1] for pull in step.pulls]
    statistic = pulls[0].statistic if pulls else next((place.statistic for place in found.where), "")
    if not statistic:
        return ()
    return next(name for start, name in _PICTURES if statistic.startswith(start)), "discrepancy_pulls"


def frames_text(found: Verdict) -> str:
    """Return which samples the verdict rests on."""
    seen = found.examined
    dealt = f"{seen.train:,} to find with, {seen.test:,} to confirm with, {seen.final:,} only for the gap"
    if seen.histograms is not None:
        return f"{count(seen.histograms, 'histogram')}; their samples were dealt at random: {dealt}."
    share = f" ({percent(seen.share, 1.0)} of the run's samples)" if math.isfinite(seen.share) else ""
    place = f"rows {seen.rows[0]} to {seen.rows[1] - 1}, columns {seen.columns[0]} to {seen.columns[1] - 1}"
    return f"{count(seen.frames, 'frame')} of {place}{share}: {dealt} that is left."


def verdict_level(found: Verdict) -> tuple[Level, str]:
    """Return how grave a verdict is, and its name."""
    return VERDICT_WORDS.get(found.verdict, ("note", found.verdict.capitalize()))


def probability_text(p: float) -> str:
    """Return a probability as people write it."""
    if not math.isfinite(p):
        return ""
    return "< 0.001" if p < 0.001 else "> 0.999" if p > 0.999 else f"{p:.3f}"


def parameter_texts(candidate: Candidate) -> list[tuple[str, str]]:
    """Return the fields of a candidate as text, numbers to four digits."""
    return [
        (name, f"{value:.4g}" if isinstance(value, int | float) else str(value or ""))
        for name, value in candidate.parameters.items()
        if not isinstance(value, list | dict)
    ]


def parameter_name(name: str) -> str:
    """Return what a map is called, for people."""
    try:
        return symbol(name)[1]
    except KeyError:
        return name.replace("_", " ")


def key_facts(data: DiscrepancyData) -> list[KeyFact]:
    """Return the numbers of the first screen."""
    found = data.found
    return [*_effect_facts(data), *_moved_fact(found), *_chance_fact(found), *_gap_fact(found)]


def _gap_fact(found: Verdict) -> list[KeyFact]:
    """Return how much of the distance between data and model is closed; the distance itself stands below."""
    gap = found.gap
    if not math.isfinite(gap.before):
        return []
    extended = any(found.added(step) for step in found.steps) and math.isfinite(gap.after)
    nats = f"{gap_text(gap.before)} → {gap_text(gap.after)}" if extended else gap_text(gap.before)
    words, chance = f"{nats} micronats per sample", f"chance alone: up to {gap_text(gap.floor)}"
    if not extended:
        return [KeyFact("distance of data and model", words, (chance,))]
    more = (words, chance + _interval(gap))
    nearest = " by what is most like it, not named" if found.verdict == "unexplained" else ""
    return [KeyFact(f"of the gap closed{nearest}", percent(max(gap.closed_fraction, 0.0), 1.0), more)]


def _interval(gap: GapChange) -> str:
    low, high = gap.interval_after
    if not (math.isfinite(low) and math.isfinite(high)):
        return ""
    return (
        f"; left: {gap_text(low)} to {gap_text(high)}" if low > 0.0 else f"; left: at most {gap_text(high)}"
    )


def _effect_facts(data: DiscrepancyData) -> list[KeyFact]:
    facts = []
    for step in data.found.steps:
        if (step.effect or step.verdict == "described") and step.parameters:
            values = [
                f"{name} {measured(p.value, p.stderr, unit_text(p.unit))}"
                for name, p in step.parameters.items()
            ]
            facts.append(KeyFact(data.title(step.likeliest), *_size_texts(step, values)))
    return facts[:4]


def _size_texts(step: Step, values: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return the size of an effect, and the two lines below it; its parameters where no size is known."""
    size = step.size
    if size is None:
        return values[0], tuple(values[1:3])
    part = "" if size.samples >= RARE else f", in {percent(size.samples, 1.0)} of the samples"
    share = (
        f"{short(100.0 * size.of_read_noise, 2)} % of the read noise, {short(size.electrons, 2)} e⁻ rms{part}"
    )
    return f"{short(size.dn, 2)} DN", (share, values[0])


def _moved_fact(found: Verdict) -> list[KeyFact]:
    moved = _largest_move(found.steps)
    if moved is None or abs(moved[1].in_stderr) < _NOT_MOVED:
        return []
    name, largest = moved
    unit = unit_text(largest.unit)
    small = ", immaterial" if abs(largest.in_stderr) < _IMMATERIAL else ""
    return [
        KeyFact(
            f"largest move: {parameter_name(name)}",
            f"{_signed(largest.median)} {unit}".strip(),
            (f"{_signed(largest.in_stderr, 2)} standard errors of a pixel{small}",),
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
    more = [f"of a disagreement this large, from {found.replicates} replicates"] if found.replicates else []
    before, after = probability_text(found.p_global.before), probability_text(found.p_global.after)
    value = f"{before} → {after}" if after and found.effects else before
    return [KeyFact("probability by chance", value, tuple(more))]


def remarks(data: DiscrepancyData) -> list[Flag]:
    """Return what speaks for and against the verdict, the gravest first."""
    found = data.found
    flags = [Flag("caution", f"{found.limit[0].upper()}{found.limit[1:]}.")] if found.limit else []
    extended = [step for step in found.steps if step.effect]
    if found.doubt:
        words = "What rests on the parameters of the pixels was not tested, and no size is given in e⁻"
        flags.append(Flag("caution", f"{words}: {found.doubt}."))
    if extended:
        flags += _closing(found)
        flags += [flag for step in extended for flag in _compared(step, data)]
    for step in found.steps:
        for rival, measurement in step.separate.items() if step.verdict == "ambiguous" else ():
            flags.append(Flag("note", f"To tell {data.title(rival)} apart: {measurement}."))
    if found.unexplained:
        most = found.unexplained[0]
        words = most.sentence or most.statistic
        flags.append(Flag("caution", f"What is left shows most in: {words} ({_signed(most.z)} sd)."))
    flags += [
        Flag("serious", f"A defect: the candidate {name} failed and was not compared: {why}.")
        for name, why in found.defects.items()
    ]
    if found.untestable:
        flags.append(
            Flag("note", f"Cannot be tested by these data: {', '.join(map(data.title, found.untestable))}.")
        )
    order = ("serious", "caution", "note", "good")
    return sorted(flags, key=lambda flag: order.index(flag.level))


def _closing(found: Verdict) -> list[Flag]:
    """Say whether the gap is at its floor."""
    gap, flags = found.gap, []
    level: Level
    if math.isfinite(gap.after) and math.isfinite(gap.floor):
        if gap.after <= gap.floor:
            flags.append(Flag("good", "The gap that is left is at its floor: chance alone makes as much."))
        else:
            left = percent(1.0 - max(gap.closed_fraction, 0.0), 1.0)
            words = f"{gap_text(gap.after)} against {gap_text(gap.floor)} micronats per sample"
            level = "caution" if found.verdict == "named_in_part" else "note"
            flags.append(Flag(level, f"{left} of the gap is left, more than chance alone makes: {words}."))
    return flags


def _short(data: DiscrepancyData, tag: str) -> str:
    """Return the name of an effect without its other names."""
    return data.title(tag).partition(" (")[0]


def _compared(step: Step, data: DiscrepancyData) -> list[Flag]:
    """Say what the runner-up and the placebo of a step close in the place of the named effect."""
    own, flags = 1.0 - max(step.gap_after, 0.0) / step.gap_before if step.gap_before > 0.0 else math.nan, []
    if not own > 0.0:
        return []
    name, runner_up, placebo = _short(data, step.effect or ""), step.runner_up, step.placebo
    if runner_up is not None:
        share = percent(max(step.closed_by(runner_up), 0.0), 1.0)
        why = f" and {runner_up.why}" if runner_up.why else ""
        rival = f"In the place of {name} the runner-up, {_short(data, runner_up.effect)}"
        flags.append(Flag("note", f"{rival}, would close {share} of the gap{why}."))
    if placebo is None:
        return [*flags, Flag("good", f"No effect unrelated to {name} closes any of the gap in its place.")]
    of_that = step.closed_by(placebo) / own
    doubtful = of_that > CONVINCING_PLACEBO
    end = ": take the name with caution" if doubtful else ""
    text = f"A placebo in the place of {name} ({_short(data, placebo.effect)}, unrelated to it) closes"
    words = f"{text} {percent(max(of_that, 0.0), 1.0)} of what it closes{end}."
    return [*flags, Flag("caution" if doubtful else "good", words)]


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
        "limits": [_untestable(data), _unexplained(found.unexplained), _defects(found), _examined(data)],
    }
    return {part: [table for table in tables if table.rows] for part, tables in parts.items()}


def place_text(place: Place) -> str:
    """Return where a statistic points to: pixels, DN, frames; empty for the whole sensor and run."""
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
                probability_text(candidate.probability),
                ", ".join(f"{name} {value}" for name, value in parameter_texts(candidate)),
            )
        )
    if step.effect:
        outcome = f"{step.effect} was named"
    elif data.found.verdict == "ambiguous":
        several = len(step.candidates) > 1
        outcome = "these data cannot tell them apart" if several else "the final samples do not confirm it"
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
        interval = f" ({gap_text(low)} to {gap_text(high)})" if math.isfinite(low) else ""
        rivals = [
            f"{gap_text(rival.gap_after)} ({rival.effect})" if rival is not None else ""
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
        "In micronats per sample on frames that no fit has seen, with its interval; runner-up and placebo "
        "were fitted in the place of the named effect.",
        ("step", "before", "after", "floor", "runner-up instead", "placebo instead"),
        tuple(rows),
    )


def _beside(step: Step) -> str:
    """Return what stands beside the title of an effect: where it acts, whether it is but the likeliest."""
    place = f", in {step.place}" if step.place else ""
    return place if step.effect else f"{place} (the likeliest)"


def _parameters(data: DiscrepancyData) -> Table:
    rows = tuple(
        (
            f"{tag}: {name}",
            measured(p.value, p.stderr, unit_text(p.unit)),
            data.title(tag) + _beside(step),
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
                    step.effect or f"{step.likeliest} (the likeliest)",
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
        (place.sentence or place.statistic, signed(place.z), place_text(place), place.statistic)
        for place in places[:_MOST_PLACES]
    )
    return Table(
        "discrepancy-unexplained",
        "Left unexplained",
        "What remains of the disagreement after all that was named.",
        ("what it says", "standard deviations", "where", "statistic"),
        rows,
    )


def _defects(found: Verdict) -> Table:
    return Table(
        "discrepancy-defects",
        "Defects",
        "Candidates that failed and were not compared: the verdict says nothing of them.",
        ("effect", "error"),
        tuple(found.defects.items()),
    )


def _surveyed(name: str, data: DiscrepancyData) -> str:
    """Return in words what stands out of a map of the whole sensor."""
    kind, _, rest = name.partition(".")
    if kind == "pairs":
        mode, _, channel = rest.partition(".")
        return f"pixels of a {mode} move together ({'charge' if channel == 'charge' else 'readout'})"
    if kind in ("score", "goodness"):
        _, sentence = data.statistics.get(f"shape.{rest or kind}.mean", ("", name))
        return sentence.removesuffix(", in the mean of the pixels")
    return _SURVEYED.get(name, name)


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
    examined = found.examined
    if math.isfinite(examined.share):
        rows.append(("share of the run's samples", percent(examined.share, 1.0)))
        rows.append(("share that was looked at for places", percent(examined.surveyed, 1.0)))
        rows += [(f"share: {kind}", percent(share, 1.0)) for kind, share in examined.surveyed_by.items()]
    for place in examined.places:
        words = Region.model_validate(place.region).words()
        rows.append(
            (f"whole sensor: {_surveyed(place.map, data)}", f"{words} (p {probability_text(place.p)})")
        )
    if found.replicates:
        rows.append(("simulated replicates", f"{found.replicates:,}"))
    rows += [(f"version: {name}", str(version)) for name, version in found.versions.items()]
    return Table("discrepancy-examined", "What was examined", "", ("item", "value"), tuple(rows))
