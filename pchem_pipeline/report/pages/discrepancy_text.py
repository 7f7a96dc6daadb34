"""Words of the discrepancy page: verdict, key numbers, remarks, headings and captions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pchem_pipeline.discrepancy.verdict import Candidate, GapChange, Moved, Rival, Step, Verdict
from pchem_pipeline.report.figures.discrepancy_gap import MICRO
from pchem_pipeline.report.pages.discrepancy_data import DiscrepancyData
from pchem_pipeline.report.pages.verdict import Flag, Level
from pchem_pipeline.report.style.wording import measured, percent, short, symbol, unit_text

__all__ = [
    "CAPTIONS",
    "PARTS",
    "VERDICT_WORDS",
    "KeyFact",
    "gap_words",
    "key_facts",
    "parameter_name",
    "parameter_texts",
    "parameter_words",
    "probability_words",
    "remarks",
    "verdict_level",
]

#: A placebo that closes more than this share of the gap weakens the verdict.
_PLACEBO_SHARE = 0.25
#: Parameters that moved by less than this share of a pixel's standard error did not matter.
_IMMATERIAL = 0.2

#: Verdict to its level and its name.
VERDICT_WORDS: dict[str, tuple[Level, str]] = {
    "named": ("note", "Named"),
    "ambiguous": ("caution", "Ambiguous"),
    "unexplained": ("serious", "Unexplained"),
    "consistent": ("good", "Consistent"),
}

#: (id, heading, introduction) of the parts of the page.
PARTS: tuple[tuple[str, str, str], ...] = (
    (
        "where",
        "Where data and model disagree",
        "Every sample is split into a charge channel (the expected electron number) and a readout channel "
        "(what is left). Effects of light and charge show in the first, effects of the electronics in the "
        "second. All is in standard deviations of what the plain model would show by chance. The pictures "
        "are of the frames in which effects were looked for; the table is of these and others to confirm it.",
    ),
    (
        "evidence",
        "Which effect it is",
        "Each candidate's fingerprint (how it would move all statistics together) was compared with the data "
        "on frames that its strength was not fitted to. Scores are differences of log-probability: larger is "
        "better, and a difference below about three standard errors decides nothing.",
    ),
    (
        "shown",
        "How much of the gap is closed",
        "The gap is the distance between data and model in nats per sample, on frames that no fit has seen. "
        "It does not grow with the amount of data; more data only lower its floor, which chance alone makes.",
    ),
    (
        "parameters",
        "The effect, and what it changes",
        "Parameters of the effects with their standard errors, and how far the delivered maps moved when the "
        "model grew.",
    ),
    (
        "limits",
        "What these data cannot tell",
        "Effects that frames of one constant exposure cannot show, whatever their number, and what was not "
        "examined.",
    ),
)

CAPTIONS: dict[str, str] = {
    "discrepancy_maps": (
        "Goodness of fit, and the quantities of the pixels that are farthest from chance. Below each map: "
        "its histogram (gray) and that of chance (line). A shift of the whole histogram is an effect of all "
        "pixels, long tails are one of few; these are ringed in the map where they are few."
    ),
    "discrepancy_codes": (
        "All usable pixels together. Top: samples at each DN (gray) and those that the fitted PCDs lead to "
        "expect (black; with the named effects: orange). Below: the difference from the plain model in "
        "standard deviations, even and odd DN in two colours; the "
        "gray band is two standard deviations. A single tall line is a pile-up, alternating colours are a "
        "comb of the ADC, a slow wave is its nonlinearity. Yellow: what the verdict points to."
    ),
    "discrepancy_frames": (
        "Dots: means of the frames over all usable pixels. Blue: means over stretches of the run; the gray "
        "band is two standard deviations of these by chance. Dashed: path of the named effects, if it does "
        "not depend on chance. Yellow: frames that the verdict points to."
    ),
    "discrepancy_lines": (
        "Left and middle: means of rows and of columns of the first frames. Right: scatter of each row or "
        "column over all frames; 1 is what independent pixels give. Stripes in the readout are noise common "
        "to a row or column, slanted lines are periodic pickup."
    ),
    "discrepancy_pulls": (
        "The statistics farthest from chance, before (circles) and after the model grew (diamonds). The gray "
        "band is two standard deviations; with some hundred statistics the largest lies near 3 by chance."
    ),
    "discrepancy_gap": (
        "Gap before and after on a logarithmic axis, with intervals where they are known, the floor (gray: "
        "chance alone), and what the second-best effect and a placebo (a wrong effect, fitted in the same "
        "way) leave. Open triangles at the edge are gaps below the axis. By family: before and after."
    ),
}


@dataclass(frozen=True)
class KeyFact:
    """One number of the first screen, with up to two lines below it."""

    words: str
    value: str
    more: tuple[str, ...] = ()


def verdict_level(found: Verdict) -> tuple[Level, str]:
    """Return how grave a verdict is, and its name."""
    return VERDICT_WORDS.get(found.verdict, ("note", found.verdict.capitalize()))


def gap_words(gap: float) -> str:
    """Return a gap in 10⁻⁶ nats, without the unit."""
    return short(MICRO * gap) if math.isfinite(gap) else "not known"


def probability_words(p: float) -> str:
    """Return a probability as people write it."""
    if not math.isfinite(p):
        return ""
    return "< 0.001" if p < 0.001 else "> 0.999" if p > 0.999 else f"{p:.3f}"


def parameter_words(step: Step) -> list[str]:
    """Return the parameters of a step's effect, each as ``name value ± error unit``."""
    return [
        f"{name} = {measured(p.value, p.stderr, unit_text(p.unit))}" for name, p in step.parameters.items()
    ]


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


def key_facts(found: Verdict) -> list[KeyFact]:
    """Return the numbers of the first screen."""
    return [*_gap_fact(found), *_effect_facts(found), *_moved_fact(found), *_chance_fact(found)]


def _gap_fact(found: Verdict) -> list[KeyFact]:
    gap = found.gap
    if not math.isfinite(gap.before):
        return []
    grown = any(found.added(step) for step in found.steps) and math.isfinite(gap.after)
    value = f"{gap_words(gap.before)} → {gap_words(gap.after)}" if grown else gap_words(gap.before)
    more = [f"10⁻⁶ nats per sample; floor {gap_words(gap.floor)}"]
    if grown and math.isfinite(gap.closed_fraction):
        more.append(f"{percent(max(gap.closed_fraction, 0.0), 1.0)} of the gap closed{_interval(gap)}")
    return [KeyFact("gap", value, tuple(more))]


def _interval(gap: GapChange) -> str:
    low, high = gap.interval_after
    if not (math.isfinite(low) and math.isfinite(high)):
        return ""
    return f"; after: {gap_words(low)} to {gap_words(high)}"


def _effect_facts(found: Verdict) -> list[KeyFact]:
    facts = []
    for step in found.steps:
        if step.effect and step.parameters:
            (name, first), *rest = step.parameters.items()
            facts.append(
                KeyFact(
                    f"{step.effect}: {name}",
                    measured(first.value, first.stderr, unit_text(first.unit)),
                    tuple(f"{name} {measured(p.value, p.stderr, unit_text(p.unit))}" for name, p in rest[:2]),
                )
            )
    return facts[:4]


def _moved_fact(found: Verdict) -> list[KeyFact]:
    moved = _largest_move(found.steps)
    if moved is None:
        return []
    name, largest = moved
    unit = unit_text(largest.unit)
    return [
        KeyFact(
            f"largest move: {parameter_name(name)}",
            f"{_signed(largest.median)} {unit}".strip(),
            (f"{_signed(largest.in_stderr, 2)} standard errors of a pixel",),
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
    before, after = probability_words(found.p_global.before), probability_words(found.p_global.after)
    value = f"{before} → {after}" if after and found.effects else before
    return [KeyFact("probability by chance", value, tuple(more))]


def remarks(data: DiscrepancyData) -> list[Flag]:
    """Return what speaks for and against the verdict, the gravest first."""
    found = data.found
    flags: list[Flag] = []
    grown = [step for step in found.steps if step.effect]
    if grown:
        flags += _closing(found, grown[-1])
        flags += _materiality(grown)
    for step in found.steps:
        for rival, measurement in step.separate.items() if step.verdict == "ambiguous" else ():
            flags.append(Flag("note", f"To tell {rival} apart: {measurement}."))
    if found.unexplained:
        most = found.unexplained[0]
        words = most.sentence or most.statistic
        flags.append(Flag("caution", f"What is left shows most in: {words} ({_signed(most.z)} sd)."))
    flags += [Flag("caution", f"{name} was left out: {why}.") for name, why in found.left_out.items()]
    if found.untestable:
        flags.append(Flag("note", f"Cannot be tested by these data: {', '.join(found.untestable)}."))
    order = ("serious", "caution", "note", "good")
    return sorted(flags, key=lambda flag: order.index(flag.level))


def _closing(found: Verdict, last: Step) -> list[Flag]:
    """Say whether the gap is at its floor, and whether a wrong effect closes it as well."""
    gap, flags = found.gap, []
    if math.isfinite(gap.after) and math.isfinite(gap.floor):
        if gap.after <= gap.floor:
            flags.append(Flag("good", "The gap that is left is at its floor: chance alone makes as much."))
        else:
            words = f"{gap_words(gap.after)} against {gap_words(gap.floor)} (10⁻⁶ nats per sample)"
            flags.append(Flag("note", f"The gap that is left lies above its floor: {words}."))
    share = _closed(last, last.placebo)
    if last.placebo is not None and math.isfinite(share):
        text = f"A placebo ({last.placebo.effect}), fitted in the same way, closes"
        level: Level = "caution" if share > _PLACEBO_SHARE else "good"
        flags.append(Flag(level, f"{text} {percent(max(share, 0.0), 1.0)} of the gap."))
    share = _closed(last, last.runner_up)
    if last.runner_up is not None and math.isfinite(share):
        closed = percent(max(share, 0.0), 1.0)
        text = f"The second-best effect ({last.runner_up.effect}) closes {closed} of the gap"
        flags.append(Flag("note", f"{text}; {last.effect} leaves {gap_words(last.gap_after)}, it leaves "
                                  f"{gap_words(last.runner_up.gap_after)}."))  # fmt: skip
    return flags


def _closed(step: Step, rival: Rival | None) -> float:
    """Return the share of a step's gap that another effect closes."""
    if rival is None or not step.gap_before > 0:
        return math.nan
    return 1.0 - max(rival.gap_after, 0.0) / step.gap_before


def _materiality(grown: list[Step]) -> list[Flag]:
    moved = _largest_move(grown)
    if moved is None:
        return []
    name, largest = parameter_name(moved[0]), moved[1]
    far = _signed(largest.in_stderr, 2)
    words = f"{name} moved by {far} standard errors of a pixel"
    if abs(largest.in_stderr) < _IMMATERIAL:
        return [Flag("note", f"Significant, but immaterial for the maps: at most, {words}.")]
    return [Flag("note", f"It matters for the maps: {words}.")]
