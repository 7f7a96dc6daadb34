"""The two questions of the first screen, each with an answer: is the sensor all right, can I believe it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.report.data import MAP_NAMES, ReportData
from pchem_pipeline.report.pages.verdict import Flag, Level, flags, pixel_counts, summaries
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count, percent, short

__all__ = ["Answer", "answers"]

#: Share of outliers in a map above which the sensor is not called even.
_MANY_OUTLIERS = 0.01
#: Read noise, e-, above which electrons cannot be told apart.
_TOO_NOISY = 0.5


@dataclass(frozen=True)
class Answer:
    """A question with its answer; ``level`` is the class of the style sheet."""

    question: str
    level: Level
    word: str
    text: str


def answers(data: ReportData) -> tuple[Answer, Answer]:
    """Answer 'is this sensor all right' and 'can I believe it' from the maps and the remarks."""
    return _sensor(data), _belief(data, flags(data))


def _sensor(data: ReportData) -> Answer:
    question = f"Is this {'set of channels' if data.shape[0] == 1 else 'sensor'} all right?"
    pixels = pixel_counts(data)
    if pixels.fitted == 0:
        return Answer(question, "serious", "Not known", f"No {data.noun} could be fitted.")
    lost = pixels.failed / pixels.total
    noise = finite(data.maps.get("read_noise_e", np.empty(0)))
    median = float(np.median(noise)) if noise.size else float("nan")
    share = "all" if pixels.failed == 0 else f"{percent(pixels.fitted, pixels.total)} of"
    parts = [f"{share} {count(pixels.total, data.noun)} have a value"]
    if noise.size:
        below = percent(float((noise < _TOO_NOISY).sum()), noise.size)
        parts.append(f"median read noise {short(median, 3)} e⁻, {below} below {_TOO_NOISY:g} e⁻")
    odd, where = _outliers(data)
    if odd:
        parts.append(f"{percent(odd, 1.0)} are outliers in {where}")
    text = "; ".join(parts) + "."
    text = text[0].upper() + text[1:]
    if lost > data.allowed_failed:
        return Answer(question, "serious", "No", text)
    if median > _TOO_NOISY:
        return Answer(question, "caution", "Too noisy to count electrons", text)
    if odd > _MANY_OUTLIERS or lost > _MANY_OUTLIERS:
        return Answer(question, "caution", "Mostly", text)
    return Answer(question, "good", "Yes", text)


def _outliers(data: ReportData) -> tuple[float, str]:
    """Return the largest share of outliers in a map, and the name of the map."""
    worst, where = 0.0, ""
    if data.few_channels:
        return worst, where
    found = summaries(data)
    for name in MAP_NAMES:
        if name in found and found[name].n_valid:
            share = (found[name].n_low + found[name].n_high) / found[name].n_valid
            if share > worst:
                worst, where = share, name.removesuffix("_e").replace("_", " ")
    return worst, where


def _belief(data: ReportData, remarks: list[Flag]) -> Answer:
    question = "Can I believe these results?"
    if pixel_counts(data).fitted == 0:
        return Answer(question, "serious", "There are none", "The table of fit status says why.")
    about = [flag for flag in remarks if flag.about == "results"]
    serious = [flag for flag in about if flag.level == "serious"]
    cautions = [flag for flag in about if flag.level == "caution"]
    if serious:
        more = f" ({len(serious) - 1} more below)" if len(serious) > 1 else ""
        return Answer(question, "serious", "Not as they are", f"{serious[0].text}{more}")
    if cautions:
        more = f" ({len(cautions) - 1} more below)" if len(cautions) > 1 else ""
        return Answer(question, "caution", "With caution", f"{cautions[0].text}{more}")
    passed = sum(flag.level == "good" for flag in about)
    checks = f"{count(passed, 'check')} of the model against the data passed" if passed else "No check failed"
    looked = "" if data.discrepancy is not None else " What the model may be missing was not looked for."
    pixels = pixel_counts(data)
    if pixels.failed > data.allowed_failed * pixels.total:
        word = f"For the {data.noun}s with a value"
        return Answer(
            question, "caution", word, f"{checks}; {count(pixels.failed, data.noun)} have none.{looked}"
        )
    return Answer(question, "good", "Yes", f"{checks}.{looked}")
