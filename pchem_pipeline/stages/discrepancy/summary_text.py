"""The verdict of a search for missing effects as text for the terminal: about a dozen lines."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence

import numpy as np

from pchem_pipeline.base.wording import count, fitted_or_chosen, percent, typeset
from pchem_pipeline.discrepancy.verdict import Place, Step, Verdict, micronats, sigma_text
from pchem_pipeline.model.histogram.odd_frames import frame_words

_WIDTH = 100
#: Longer lists end with a count.
_MOST_PLACES, _MOST_CANDIDATES, _MOST_LEFT = 3, 5, 4
# no line break between a number and its unit
_HELD = "\u00a0"
_BEFORE_UNIT = re.compile(r"(?<=\d) (?=%|DN|e⁻|sigma\b|nats)")


def verdict_text(found: Verdict) -> str:
    """Format verdict, disagreements, candidates, gap and untestable effects in lines of 100 characters."""
    lines = _wrapped(f"{found.word.upper()}: {found.sentence}")
    agrees = found.verdict in ("consistent", "cannot_tell")
    lines += _places("largest deviation" if agrees else "disagreement", found.where, _MOST_PLACES)
    for number, step in enumerate(found.steps, 1):
        lines += _step(step, number if len(found.steps) > 1 else 0, found)
    lines += _gap(found)
    lines += _wrapped(found.examined.words())
    if found.examined.left_out:
        words = frame_words(np.array(found.examined.left_out))
        lines += _wrapped(f"left out (empty, repeated, outlying or moved): {words}")
    if found.proposed:
        tags = ", ".join(str(effect["tag"]) for effect in found.proposed)
        lines += _wrapped(f"proposed, not in the model: {tags} (see proposed in discrepancy.json)")
    if found.doubt and found.steps:
        lines += _wrapped(f"not tested, and no sizes in e-: {found.doubt}")
    lines += _places("unexplained", found.unexplained, _MOST_LEFT)
    for tag, why in found.defects.items():
        lines += _wrapped(f"DEFECT: candidate {tag} failed and was not compared: {why}")
    lines += _wrapped(found.limit) if found.limit else []
    if found.untestable:
        lines += _wrapped(f"not testable with such frames: {', '.join(found.untestable)}")
    return "\n".join(lines)


def _wrapped(text: str) -> list[str]:
    # line breaks in a plug-in's message would break the columns
    words = _BEFORE_UNIT.sub(_HELD, typeset(" ".join(text.split())))
    lines = textwrap.wrap(words, _WIDTH, subsequent_indent="  ") or [""]
    return [line.replace(_HELD, " ") for line in lines]


def _places(title: str, places: Sequence[Place], most: int) -> list[str]:
    lines = []
    for place in places[:most]:
        details = "; ".join(filter(None, (sigma_text(place.z), _spots(place))))
        lines += _wrapped(f"{title}: {place.sentence or place.statistic} ({details})")
    more = len(places) - most
    return [*lines, f"{title}: {more} more (see discrepancy.json)"] if more > 0 else lines


def _spots(place: Place) -> str:
    # the sentence of a statistic of a part ends with that part
    words = [place.spot()] if place.spot() and "@" not in place.statistic else []
    if place.pixels:
        words.append(f"{count(len(place.pixels), 'pixel')} listed, first (y, x) = {place.pixels[0]}")
    if place.dn is not None:
        words.append(f"{place.dn[0]:g} to {place.dn[1]:g} DN")
    if place.frames:
        words.append(f"{count(len(place.frames), 'frame')}, first {place.frames[0]}")
    return ", ".join(words)


def _step(step: Step, number: int, found: Verdict) -> list[str]:
    """Format the named effect of a step and its rejected rivals, or the table of an ambiguous step."""
    lines = []
    title = f"step {number}" if number else "candidate"
    if not step.effect and len(step.candidates) > 1 and found.verdict == "ambiguous":
        lines.append(f"{title:<28}{'score':>10}{'stderr':>9}{'probability':>13}")
        for each in step.candidates[:_MOST_CANDIDATES]:
            row = f"  {each.effect:<26}{_number(each.score):>10}{_number(each.stderr):>9}"
            lines.append(f"{row}{_number(each.probability, 3):>13}"[:_WIDTH])
        more = len(step.candidates) - _MOST_CANDIDATES
        lines += [f"  and {more} more"] if more > 0 else []
    # parameters are those of a single candidate
    if step.parameters and (step.effect or (len(step.candidates) == 1 and found.verdict == "ambiguous")):
        values = [
            f"{name} = {fitted_or_chosen(p.value, p.stderr, p.unit)}" for name, p in step.parameters.items()
        ]
        values += [f"{name} = {word}" for name, word in step.form.items()]
        place = f" in {step.place}" if step.place else ""
        known = all(math.isfinite(p.stderr) for p in step.parameters.values())
        errors = "" if known else " (those without ± have no computed error)"
        lines += _wrapped(f"{step.likeliest}{place}: {', '.join(values)}{errors}")
    if step.effect:
        for other in step.rivals:
            nats = -other.behind
            lower = f" (log-likelihood lower by {nats:{',.0f' if nats >= 100.0 else '.2g'}})"
            score, why = lower if math.isfinite(nats) else "", f"; {other.why}" if other.why else ""
            lines += _wrapped(f"{other.effect} is rejected{score}{why}")
    elif found.verdict == "ambiguous":
        for rival, text in step.separate.items():
            lines += _wrapped(f"to distinguish {rival}: {text}")
    return lines


def _number(value: float, digits: int = 1) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _gap(found: Verdict) -> list[str]:
    gap = found.gap
    if not math.isfinite(gap.before):
        return []
    words = f"gap between data and model: {micronats(gap.before, gap.interval_before)}"
    if found.steps and math.isfinite(gap.after):
        words += f" → {gap.after_text}"
    words += f" micronats per sample (sampling noise: up to {micronats(gap.floor)})"
    if found.steps and gap.after > gap.floor and math.isfinite(gap.closed_fraction):
        words += f", {percent(gap.closed_fraction)} closed{found.closed_by}"
    return _wrapped(words)
