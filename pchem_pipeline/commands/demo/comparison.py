"""What was hidden beside what was found: effect, parameters, and the bias of the maps before and after."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pchem_pipeline.base.variables import VARIABLES
from pchem_pipeline.effects.framework.compose import effect_words
from pchem_pipeline.report.pages.discrepancy_tables import parameter_texts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.discrepancy.verdict import Verdict
    from pchem_pipeline.effects.framework.effect import Effect

#: Maps whose bias is told, and of which the truth is kept.
COMPARED = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")

Maps = Mapping[str, "NDArray[Any]"]


def compare(found: Verdict, hidden: Effect, truth: Maps, before: Maps, after: Maps) -> str:
    """Return what was hidden, whether it was found, its parameters, and biases before and after.

    Args:
        found: the verdict.
        hidden: the effect in the frames.
        truth: true maps of :data:`COMPARED`.
        before: maps of the plain model, with ``<name>_stderr`` and ``quality``.
        after: the same of the extended model.
    """
    title = type(hidden).title
    words = f"{effect_words(hidden)}{f' ({title})' if title else ''}"
    lines = [f"hidden was: {words} - {judgement(found, hidden)}", *_place(found, hidden)]
    if type(hidden).untestable:
        lines += textwrap.wrap(f"such frames cannot show it: {type(hidden).untestable}", 100)
    lines += _parameters(found, hidden)
    return "\n".join([*lines, *_biases(truth, before, after)])


def _place(found: Verdict, hidden: Effect) -> list[str]:
    """Return where the effect was found, and how much of its place that is."""
    lines = [f"found in {step.place}" for step in found.steps if step.effect == hidden.tag and step.place]
    for step in found.steps:
        if step.effect == hidden.tag and not step.place and (hidden.region or hidden.when):
            lines.append("found without a place")
    return lines


def judgement(found: Verdict, hidden: Effect) -> str:
    """Return in words whether the verdict is right."""
    others = [tag for tag in found.effects if tag != hidden.tag]
    besides = f", and {', '.join(others)} besides, which is not there" if others else ""
    if type(hidden).untestable:
        return f"wrongly named: {', '.join(others)}" if others else "nothing was named, which is right"
    if hidden.tag in found.effects:
        return f"named{besides}" if others else "named, and nothing else"
    for step in found.steps:
        rivals = list(dict.fromkeys(candidate.effect for candidate in step.candidates))
        if not step.effect and found.verdict == "ambiguous" and hidden.tag in rivals:
            if len(rivals) == 1:
                return f"the only candidate, which these frames do not confirm{besides}"
            return f"among the {len(rivals)} that these frames leave open{besides}"
    return f"not named{besides}"


def _parameters(found: Verdict, hidden: Effect) -> list[str]:
    """Return the table of the hidden effect's parameters; of an ambiguous one those of the candidate."""
    true: dict[str, Any] = hidden.model_dump(exclude={"tag"})
    estimated: dict[str, tuple[str, str]] = {}
    for step in found.steps:
        if step.effect not in (None, hidden.tag):
            continue
        mine = [c for c in step.candidates if c.effect == hidden.tag]
        texts = {name: (text, "") for c in mine[:1] for name, text in parameter_texts(c)}
        estimated = texts | estimated
        if step.likeliest == hidden.tag and (step.effect or found.verdict == "ambiguous"):
            estimated |= {n: (_number(p.value), _number(p.stderr)) for n, p in step.parameters.items()}
    head = f"{'parameter':<26}{'true':>14}{'estimated':>14}{'stderr':>12}"
    lines = ["", head, "-" * len(head)]
    for name, value in true.items():
        if isinstance(value, list | tuple | dict) or value is None:
            continue
        words = _number(float(value)) if isinstance(value, int | float) else str(value)
        seen, error = estimated.get(name, ("-", ""))
        lines.append(f"{name:<26}{words:>14}{seen or '-':>14}{error:>12}")
    return lines if len(lines) > 3 else []


def _biases(truth: Maps, before: Maps, after: Maps) -> list[str]:
    good = (np.asarray(before["quality"]) == 0) & (np.asarray(after["quality"]) == 0)
    if not good.any():
        return ["", "no pixel is good in both models: no biases"]
    columns = ("true median", "bias before", "bias after", "known to", "pixel stderr")
    head = f"{'parameter':<24}" + "".join(f"{column:>14}" for column in columns)
    lines = ["", head, "-" * len(head)]
    for name in COMPARED:
        true = np.asarray(truth[name])[good]
        errors = [np.asarray(maps[name])[good] - true for maps in (before, after)]
        biases = [float(np.median(error)) for error in errors]
        # of a median: 1.2533 sd / sqrt(n), sd from the median absolute deviation
        spread = 1.4826 * float(np.median(np.abs(errors[1] - biases[1])))
        numbers = (
            float(np.median(true)),
            *biases,
            1.2533 * spread / math.sqrt(errors[1].size),
            float(np.median(np.asarray(after[f"{name}_stderr"])[good])),
        )
        label = f"{name}, {VARIABLES[f'maps/{name}'].unit}"
        lines.append(f"{label:<24}" + "".join(f"{number:>14.3g}" for number in numbers))
    lines.append(f"medians over the {int(good.sum())} of {good.size} pixels that are good in both models")
    return lines


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else ""
