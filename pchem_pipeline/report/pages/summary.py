"""The first screen: is the sensor all right, can one believe it, the key numbers, and the remarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pchem_pipeline.model.maps.maps import MapSummary, summarise
from pchem_pipeline.report.data import MAP_NAMES, ReportData
from pchem_pipeline.report.figures.maps import status_counts
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count, measured, percent, scientific, short, symbol

Level = Literal["good", "note", "caution", "serious"]

_KEY_MAPS = ("read_noise_e", "conversion_gain", "dark_current", "quanta_exposure", "bias")

#: Ratio of an RMSE to that of sampling noise alone up to which the model explains the data, and from which
#: it clearly does not.
_RMSE_GOOD, _RMSE_BAD = 1.3, 3.0
#: Share of pixels with one reason for caution from which the first screen says so.
_CAUTION_SHARE = 0.01
#: A pixel's fit is poor below this probability.
_POOR_P = 1e-3


@dataclass(frozen=True)
class KeyNumber:
    """A number of the first screen: the median over the pixels and the spread between them."""

    name: str
    label: str
    value: str
    spread: str
    per_pixel: str


@dataclass(frozen=True)
class Flag:
    """One remark on whether the results can be believed, or about the sensor itself."""

    level: Level
    text: str
    about: Literal["results", "sensor"] = "results"


@dataclass(frozen=True)
class PixelCounts:
    """How many pixels have a value, and how many of those deserve caution."""

    total: int
    failed: int
    caution: int

    @property
    def fitted(self) -> int:
        """Pixels with a value."""
        return self.total - self.failed


def pixel_counts(data: ReportData) -> PixelCounts:
    """Count the pixels by outcome of their fit."""
    status = data.fit.get("fit_status")
    if status is None:
        total = int(np.prod(data.shape))
        return PixelCounts(total, total, 0)
    failed = ((status & data.failed_mask) != 0) | data.unfitted
    return PixelCounts(int(status.size), int(failed.sum()), int(((status != 0) & ~failed).sum()))


def summaries(data: ReportData) -> dict[str, MapSummary]:
    """Describe every map by order statistics."""
    return {
        name: summarise(values, percentiles=data.percentiles, outlier_sigmas=data.outlier_sigmas)
        for name, values in data.maps.items()
        if not name.endswith("_stderr")
    }


def key_numbers(data: ReportData) -> list[KeyNumber]:
    """Return the numbers of the first screen."""
    found = []
    for name in _KEY_MAPS:
        if not data.has_values(name):
            continue
        _, words, unit = symbol(name)
        summary = summarise(data.maps[name], percentiles=(5.0, 95.0))
        low, high = summary.percentiles[5.0], summary.percentiles[95.0]
        errors = finite(data.maps.get(f"{name}_stderr", np.empty(0)))
        found.append(
            KeyNumber(
                name,
                words,
                measured(summary.median, summary.median_stderr, unit),
                f"5–95 % of the {data.noun}s: {short(low)} to {short(high)} {unit}",
                f"one {data.noun} is known to ± {short(float(np.median(errors)), 2)} {unit}"
                if errors.size
                else "",
            )
        )
    return found


def sentence(data: ReportData) -> str:
    """Return the report in one sentence or two."""
    pixels = pixel_counts(data)
    if pixels.fitted == 0:
        return (
            f"None of the {count(pixels.total, data.noun)} could be fitted; the table of fit status says why."
        )
    parts = []
    for name, lead in (
        ("read_noise_e", "read noise"),
        ("conversion_gain", "conversion gain"),
        ("dark_current", "dark current"),
    ):
        if data.has_values(name):
            summary = summarise(data.maps[name])
            parts.append(f"{lead} {measured(summary.median, summary.median_stderr, symbol(name)[2])}")
    frames = f" from {count(data.n_frames, 'frame')}" if data.n_frames else ""
    share = f"{percent(pixels.fitted, pixels.total)} of {count(pixels.total, data.noun)} were"
    if pixels.failed == 0 and pixels.total > 1:
        share = f"All {count(pixels.total, data.noun)} were"
    text = f"{share} fitted{frames}. "
    if "model" in data.run:
        text += f"The model is {data.run['model']}. "
    text += f"Medians over the {data.noun}s: " + ", ".join(parts) + "."
    rmse: Mapping[str, float] = data.ensemble_facts.get("rmse", {})
    if "epcd_exact" in rmse and rmse.get("noise_floor"):
        text += (
            f" The fitted {data.noun}s predict the raw ensemble histogram with an RMSE of "
            f"{scientific(rmse['epcd_exact'])}; sampling noise alone gives {scientific(rmse['noise_floor'])}."
        )
    return text


def flags(data: ReportData) -> list[Flag]:
    """Return what speaks for and against the results, the gravest first."""
    found = [
        *_failed_pixels(data),
        *_unfitted(data),
        *_cautions(data),
        *_goodness(data),
        *_agreement(data),
        *_discrepancy(data),
        *_conditions(data),
    ]
    order = ("serious", "caution", "note", "good")
    return sorted(found, key=lambda flag: order.index(flag.level))


def _failed_pixels(data: ReportData) -> list[Flag]:
    pixels = pixel_counts(data)
    share = pixels.failed / max(pixels.total, 1)
    text = f"{count(pixels.failed, data.noun)} ({percent(pixels.failed, pixels.total)}) without a value"
    if share > data.allowed_failed:
        allowed = percent(data.allowed_failed, 1.0)
        text = f"{text}, more than the {allowed} that is allowed{_reasons(data)}."
        return [Flag("serious", text, "sensor")]
    if pixels.failed:
        level: Level = "caution" if share > _CAUTION_SHARE else "note"
        return [Flag(level, f"{text}{_reasons(data)}.", "sensor")]
    return [Flag("good", f"Every {data.noun} has a value.", "sensor")]


def _reasons(data: ReportData) -> str:
    """Return why pixels have no value, the commonest reason first, as the end of a sentence."""
    status = data.fit.get("fit_status")
    if status is None:
        return ""
    rows = [row for row in status_counts(status, data.status_words) if row[0] & data.failed_mask]
    rows.sort(key=lambda row: -row[2])
    return "".join(f"{'; ' if i else '. Why: '}{text} ({n:,})" for i, (_, text, n) in enumerate(rows))


def _unfitted(data: ReportData) -> list[Flag]:
    missing = int(data.unfitted.sum())
    if not missing:
        return []
    return [Flag("serious", f"{count(missing, data.noun)} not fitted yet; continue the run.")]


def _cautions(data: ReportData) -> list[Flag]:
    status = data.fit.get("fit_status")
    if status is None:
        return []
    # what else is odd about a pixel without a value misleads nobody
    kept = status[(status & data.failed_mask) == 0]
    return [
        Flag("caution", f"{percent(n, kept.size)} of the {data.noun}s with a value: {text}.")
        for _, text, n in status_counts(kept, data.status_words)
        if n > _CAUTION_SHARE * kept.size
    ]


def _goodness(data: ReportData) -> list[Flag]:
    p = finite(data.fit.get("goodness_p", np.empty(0)))
    if p.size == 0:
        return []
    poor = int((p < _POOR_P).sum())
    expected = _POOR_P * p.size
    text = (
        f"Goodness of fit: {percent(poor, p.size)} of the fitted {data.noun}s have p < {_POOR_P:g}, "
        f"where the model alone leads to {percent(expected, p.size)}"
    )
    if poor > 0.05 * p.size:
        return [
            Flag(
                "serious",
                f"{text}. {_model(data)} does not describe this sensor; see the residuals of single pixels.",
            )
        ]
    if poor > 2.0 * expected + 5.0 * np.sqrt(expected):
        return [Flag("caution", f"{text}. Some pixels are not described by {_model(data, 'the')}.")]
    return [Flag("good", f"{text}.")]


def _agreement(data: ReportData) -> list[Flag]:
    rmse: Mapping[str, float] = data.ensemble_facts.get("rmse", {})
    found = []
    for name, floor, words in (
        ("epcd_exact", "noise_floor", "raw ensemble"),
        ("nuced_exact", "nuced_noise_floor", "NUCed ensemble"),
    ):
        if name not in rmse or not rmse.get(floor):
            continue
        ratio = rmse[name] / rmse[floor]
        text = f"The RMSE of the predicted {words} is {short(ratio, 2)} times that of sampling noise alone"
        if ratio <= _RMSE_GOOD:
            found.append(Flag("good", f"{text}: the model explains the data."))
        elif ratio <= _RMSE_BAD:
            found.append(Flag("caution", f"{text}: small differences are left."))
        else:
            found.append(Flag("serious", f"{text}: the model does not explain the data."))
    return found


def _discrepancy(data: ReportData) -> list[Flag]:
    """Say what was found to be missing from the model."""
    if data.discrepancy is None:
        return []
    found = data.discrepancy.found
    levels: dict[str, Level] = {"consistent": "good", "ambiguous": "caution", "unexplained": "serious"}
    return [Flag(levels.get(found.verdict, "note"), _as_sentence(found.sentence.replace(" -> ", " → ")))]


def _conditions(data: ReportData) -> list[Flag]:
    found = [
        Flag("note", _as_sentence(data.missing[part]))
        for part in ("dark_current", "ensemble")
        if part in data.missing
    ]
    read_noise = finite(data.maps.get("read_noise_e", np.empty(0)))
    if data.samples is None and read_noise.size and float(np.median(read_noise)) > 0.5:
        found.append(
            Flag("caution", "Read noise above 0.5 e⁻: one exposure tells little; take several exposures.")
        )
    gain = finite(data.maps.get("conversion_gain", np.empty(0)))
    if gain.size and float(np.median(gain)) > 0.4:
        found.append(
            Flag(
                "caution",
                "Conversion gain above 0.4 e⁻/DN: rounding to whole DN biases the read noise upwards.",
            )
        )
    for stage in data.stages:
        if stage.get("state") not in (None, "complete"):
            found.append(
                Flag(
                    "serious",
                    f"Stage {stage.get('stage')} is {stage['state']}: the report shows a part only.",
                )
            )
        # why there is no dark current is said once, with what is missing
        found += [
            Flag("note", _as_sentence(f"{stage.get('stage')}: {remark}"))
            for remark in stage.get("notes", ())
            if not ("dark_current" in data.missing and "no dark current" in remark)
        ]
    return list(dict.fromkeys(found))


def _model(data: ReportData, article: str = "The") -> str:
    """Return the name of the model that the pixels were fitted with."""
    return f"{article} model {data.run['model']}" if "model" in data.run else f"{article} PCD"


def _as_sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


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
