"""The first screen: is the sensor within limits, are the results reliable, key numbers and remarks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pchem_pipeline.base.units import typeset
from pchem_pipeline.base.variables import CHARGE_RATES
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.checks.map_parts import Parts
from pchem_pipeline.model.fit.status import FLAGGED, FitStatus, flags_of
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.maps import status_counts
from pchem_pipeline.report.pages.criteria import Criterion, criteria
from pchem_pipeline.report.pages.quick_look import check_sentence, nothing_found
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import (
    count,
    measured,
    p_value_text,
    percent,
    scientific,
    short,
    symbol,
)

Level = Literal["good", "note", "caution", "serious"]

KEY_MAPS = ("read_noise_e", "conversion_gain", *CHARGE_RATES, "quanta_exposure", "bias")

#: Ratio of an RMSE to that of sampling noise alone up to which a significant difference is small, and from
#: which it is large.
_RMSE_GOOD, _RMSE_BAD = 1.3, 3.0
#: Share of pixels with one reason for caution from which the first screen says so.
_CAUTION_SHARE = 0.01
#: Read noise, e-, above which electrons cannot be told apart.
_TOO_NOISY = 0.5


@dataclass(frozen=True)
class KeyNumber:
    """A number of the first screen: median over the pixels, where 5 to 95 % lie, standard error of one."""

    name: str
    label: str
    value: str
    spread: str
    per_pixel: str


@dataclass(frozen=True)
class Flag:
    """One remark on how reliable the results are, or about the sensor itself."""

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
    wanted = (status & int(FitStatus.EXCLUDED)) == 0
    failed = (((status & data.failed_mask) != 0) | data.unfitted) & wanted
    return PixelCounts(int(wanted.sum()), int(failed.sum()), int(((status != 0) & ~failed & wanted).sum()))


def key_numbers(data: ReportData, *, with_flagged: bool = False) -> list[KeyNumber]:
    """Return the numbers of the first screen.

    Args:
        data: what the run found.
        with_flagged: of all pixels with a value; else flagged ones are left out, and of a sensor of which
            most are flagged nothing is said.
    """
    if data.mostly_flagged and not with_flagged:
        return []
    found = []
    which = f" of unflagged {data.noun}s" if data.often_flagged and not with_flagged else ""
    for name in KEY_MAPS:
        if not (data.has_values(name) if with_flagged else data.has_median(name)):
            continue
        _, words, unit = symbol(name)
        if name == "quanta_exposure" and data.samples is not None:
            words += f" in {data.samples.samples[data.samples.shown].name}"
        summary = data.summary(name, with_flagged=with_flagged)
        low, high = summary.percentiles[5.0], summary.percentiles[95.0]
        error = data.pixel_error(name, with_flagged=with_flagged)
        found.append(
            KeyNumber(
                name,
                f"{words}{which}",
                measured(summary.median, summary.median_stderr, unit),
                f"{short(low)} to {short(high)} {unit}",
                "" if error is None else f"± {short(error, 2)} {unit}",
            )
        )
    return found


def sentence(data: ReportData) -> str:
    """Return the report in one sentence or two."""
    pixels = pixel_counts(data)
    if pixels.fitted == 0:
        return f"None of the {count(pixels.total, data.noun)} could be fitted: see the table of fit status."
    frames = f" from {count(data.n_frames, 'frame')}" if data.n_frames else ""
    share = f"{percent(pixels.fitted, pixels.total)} of {count(pixels.total, data.noun)} were"
    if pixels.failed == 0 and pixels.total > 1:
        share = f"All {count(pixels.total, data.noun)} were"
    text = f"{share} fitted{frames}. "
    if "model" in data.run:
        text += f"The model is {data.run['model']}. "
    text += _medians(data)
    rmse: Mapping[str, float] = data.ensemble_facts.get("rmse", {})
    if "epcd_exact" in rmse and rmse.get("noise_floor"):
        text += (
            f" The fitted {data.noun}s predict the raw ensemble histogram with an RMSE of "
            f"{scientific(rmse['epcd_exact'])}; sampling noise alone gives {scientific(rmse['noise_floor'])}."
        )
    return text


def _medians(data: ReportData) -> str:
    """Return the medians in a sentence, or why there are none."""
    flagged = int(data.flagged.sum())
    if data.mostly_flagged:
        return (
            f"{percent(flagged, pixel_counts(data).fitted)} of them are flagged: no medians, since "
            "the other pixels are a biased selection."
        )
    parts = []
    for name in ("read_noise_e", "conversion_gain", *CHARGE_RATES):
        if data.has_median(name):
            summary = data.summary(name)
            unit = symbol(name)[2]
            parts.append(f"{symbol(name)[1]} {measured(summary.median, summary.median_stderr, unit)}")
    left_out = (
        f" ({count(flagged, 'flagged one')} excluded where a flag concerns the quantity)" if flagged else ""
    )
    return f"Medians over the {data.noun}s{left_out}: {', '.join(parts)}."


def flags(data: ReportData) -> list[Flag]:
    """Return what speaks for and against the results, the gravest first."""
    return gravest_first(dict.fromkeys(flag for check in CHECKS for flag in check(data)))


def gravest_first(found: Iterable[Flag]) -> list[Flag]:
    """Return remarks by their level, the gravest first."""
    order = ("serious", "caution", "note", "good")
    return sorted(found, key=lambda flag: order.index(flag.level))


def _levels(data: ReportData) -> Iterator[Flag]:
    """Say where the frames are of several exposures: what else is odd follows from that."""
    for check in () if data.quick_look is None else data.quick_look.found:
        if check.name == "levels":
            yield Flag(check.level, f"{check_sentence(check)}.")


def _failed_pixels(data: ReportData) -> Iterator[Flag]:
    pixels = pixel_counts(data)
    share = pixels.failed / max(pixels.total, 1)
    text = f"{count(pixels.failed, data.noun)} ({percent(pixels.failed, pixels.total)}) without a value"
    if share > data.allowed_failed:
        allowed = percent(data.allowed_failed, 1.0)
        yield Flag("serious", f"{text}; {allowed} allowed{_reasons(data)}.", "sensor")
    elif pixels.failed:
        yield Flag("caution" if share > _CAUTION_SHARE else "note", f"{text}{_reasons(data)}.", "sensor")
    else:
        yield Flag("good", f"Every {data.noun} has a value.", "sensor")


def _reasons(data: ReportData) -> str:
    """Return why pixels have no value, the commonest reason first, as the end of a sentence."""
    status = data.fit.get("fit_status")
    if status is None:
        return ""
    rows = [row for row in status_counts(status, data.status_words) if row[0] & data.failed_mask]
    rows.sort(key=lambda row: -row[2])
    return "".join(f"{'; ' if i else '. Reasons: '}{text} ({n:,})" for i, (_, text, n) in enumerate(rows))


def _spaced_codes(data: ReportData) -> Iterator[Flag]:
    """Report that only every n-th DN occurs: the samples are not the plain output of an ADC."""
    step = data.code_step
    if step < 2:
        return
    text = f"Only every {('second', 'third')[step - 2] if step < 4 else f'{step}th'} DN occurs"
    if step & (step - 1):
        yield Flag("serious", f"{text}: the samples were multiplied after the ADC. Take raw frames.")
    else:
        shift = step.bit_length() - 1
        yield Flag("serious", f"{text}: the samples look left-justified. Set input.bit_shift: {shift}.")


def _unfitted(data: ReportData) -> Iterator[Flag]:
    if missing := int(data.unfitted.sum()):
        few = missing <= data.allowed_failed * data.unfitted.size
        text = f"{count(missing, data.noun)} not fitted yet. Continue the run."
        yield Flag("caution" if few else "serious", text)


def _flagged(data: ReportData) -> Iterator[Flag]:
    """Report where many pixels can be off by whole electrons, and what to take."""
    if not data.often_flagged:
        return
    share = percent(int(data.flagged.sum()), pixel_counts(data).fitted)
    cure = "more frames or more exposures" if data.samples is not None else "several exposures (pchem joint)"
    level: Level = "caution"
    if data.flagged_share("conversion_gain") <= 0.5 * data.flagged_share():
        why = ": exposure and bias can be off by whole electrons; gain and read noise are known"
    elif not data.mostly_flagged:
        why = (
            " and excluded. The others are a biased selection: their median read noise is likely too low, by "
            "more than its quoted error"
        )
    else:
        level = "serious"
        why = (
            ": the data do not fix the electron number; gain, bias and read noise can be off by far more "
            "than quoted"
        )
    yield Flag(level, f"{share} of the {data.noun}s with a value are flagged{why}. Take {cure}.")


def _left_out_words(bit: int) -> str:
    if not bit & int(FLAGGED):
        return ""
    which = "" if bit & int(flags_of("conversion_gain")) else " of exposure and bias"
    return f" (excluded from medians and tables{which})"


def _cautions(data: ReportData) -> Iterator[Flag]:
    status = data.fit.get("fit_status")
    if status is None:
        return
    # what else is odd about a pixel without a value misleads nobody
    kept = status[(status & data.failed_mask) == 0]
    for bit, text, n in status_counts(kept, data.status_words):
        if n > _CAUTION_SHARE * kept.size:
            share = f"{percent(n, kept.size)} of the {data.noun}s with a value"
            yield Flag("caution", f"{share}: {text}{_left_out_words(bit)}.")


def _goodness(data: ReportData) -> Iterator[Flag]:
    p = finite(data.fit.get("goodness_p", np.empty(0)))
    if p.size == 0:
        return
    poor = int((p < SIGNIFICANCE).sum())
    expected = SIGNIFICANCE * p.size
    text = (
        f"{percent(poor, p.size)} of the {data.noun}s fail the goodness-of-fit test (p < {SIGNIFICANCE:g}); "
        f"{percent(expected, p.size)} expected"
    )
    model = f"The model {data.run['model']}" if "model" in data.run else "The PCD"
    if poor > 0.05 * p.size:
        why = "does not describe this sensor: see the residuals of single pixels"
        yield Flag("serious", f"{text}. {model} {why}.")
    elif poor > 2.0 * expected + 5.0 * np.sqrt(expected):
        yield Flag("caution", f"{text}. {model} does not describe some pixels.")
    else:
        yield Flag("good", f"{text}.")


def _parts(data: ReportData) -> Iterator[Flag]:
    """Report a step or two modes of a map, with the medians of the parts."""
    for name, found in data.parts.items():
        for parts in found:
            yield Flag("note" if name == "bias" else "caution", _parts_sentence(name, parts))


def _parts_sentence(name: str, parts: Parts) -> str:
    _, words, unit = symbol(name)
    medians = [f"{short(median, 4)} {unit}" for median in parts.medians]
    if not parts.boxes:
        return (
            f"{words.capitalize()} has two modes, {medians[0]} and {medians[1]}: "
            "the median over the sensor describes neither."
        )
    lines = [{box[at : at + 2] for box in parts.boxes} for at in (0, 2)]
    places = []
    for box, median in zip(parts.boxes, medians, strict=True):
        ends = zip(("rows", "columns"), (box[:2], box[2:]), lines, strict=True)
        place = " and ".join(f"{name} {a} to {b - 1}" for name, (a, b), all_of in ends if len(all_of) > 1)
        places.append(f"{place}: {median}")
    listed = ", ".join(places)
    return f"{words.capitalize()} has a step ({listed}): the median over the sensor describes no part."


def _agreement(data: ReportData) -> Iterator[Flag]:
    rmse: Mapping[str, float] = data.ensemble_facts.get("rmse", {})
    for name, prefix, words in (("epcd_exact", "", "raw"), ("nuced_exact", "nuced_", "NUCed")):
        floor = f"{prefix}noise_floor"
        if name not in rmse or not rmse.get(floor):
            continue
        ratio = rmse[name] / rmse[floor]
        p = (data.ensemble_facts.get(f"{prefix}chi_square") or {}).get("p")
        tested = "" if p is None else f" (chi-square: {p_value_text(p)})"
        text = f"The RMSE of the predicted {words} ensemble is {short(ratio, 2)} times the sampling noise"
        text += tested
        if ratio <= _RMSE_GOOD or (p is not None and p >= SIGNIFICANCE):
            yield Flag("good", f"{text}: the model describes the data.")
        elif ratio <= _RMSE_BAD:
            yield Flag("caution", f"{text}: small differences remain.")
        else:
            yield Flag("serious", f"{text}: the model does not describe the data.")


#: Verdict of a search to its severity.
VERDICT_LEVELS: dict[str, Level] = {
    "named": "note",
    "named_in_part": "caution",
    "ambiguous": "caution",
    "described": "caution",
    "unexplained": "serious",
    "consistent": "good",
    "cannot_tell": "caution",
}


def _discrepancy(data: ReportData) -> Iterator[Flag]:
    """Say what was found to be missing from the model."""
    if data.discrepancy is not None:
        found = data.discrepancy.found
        yield Flag(VERDICT_LEVELS.get(found.verdict, "note"), _as_sentence(typeset(found.sentence)))


def _quick_look(data: ReportData) -> Iterator[Flag]:
    """Say what the quick look found, or what it would have found."""
    look = data.quick_look
    if look is None or not look.checks:
        return
    if not look.found:
        yield Flag("good", nothing_found(look))
    known = not look.command or data.discrepancy is not None
    closer = "" if known else f"; to look closer: {look.command}"
    for number, check in enumerate(look.found):
        if check.name != "levels":
            # what the model has already speaks for it
            level = "good" if check.in_model else check.level
            yield Flag(level, f"{check_sentence(check)}{'' if number else closer}.")


def _conditions(data: ReportData) -> Iterator[Flag]:
    for part in ("charge_rate", "ensemble"):
        if part in data.missing:
            yield Flag("note", _as_sentence(data.missing[part]))
    noisy = data.has_values("read_noise_e") and data.summary("read_noise_e").median > _TOO_NOISY
    if data.samples is None and noisy:
        words = "Read noise above 0.5 e⁻: one exposure does not suffice. Combine several exposures."
        yield Flag("caution", words)
    if data.mostly_coarse:
        yield Flag("caution", "Rounding to whole DN biases the estimates: set fit.likelihood: auto.")
    for stage in data.stages:
        name = stage.get("stage")
        if stage.get("state") not in (None, "complete"):
            yield Flag("serious", f"Stage {name} is {stage['state']}: the report is incomplete.")
        # why there is no charge rate is said once, with what is missing
        for remark in stage.get("notes", ()):
            if not ("charge_rate" in data.missing and "no charge rate" in remark):
                yield Flag("note", _as_sentence(f"{name}: {remark}"))


#: What looks for remarks; a further check is a further row.
CHECKS: tuple[Callable[[ReportData], Iterator[Flag]], ...] = (
    _spaced_codes, _levels, _failed_pixels, _unfitted, _flagged, _cautions, _parts, _goodness, _agreement,
    _quick_look, _discrepancy, _conditions,
)  # fmt: skip


def _as_sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


@dataclass(frozen=True)
class Answer:
    """A question with its answer; ``level`` is the class of the style sheet.

    Attributes:
        question: what is asked.
        level: good, note, caution or serious.
        word: the answer.
        text: why, in a sentence.
        criteria: the limits that the answer rests on, where it rests on such.
    """

    question: str
    level: Level
    word: str
    text: str
    criteria: tuple[Criterion, ...] = ()


def answers(data: ReportData, remarks: list[Flag] | None = None) -> tuple[Answer, Answer]:
    """Answer 'is the sensor within limits' and 'are the results reliable' from the maps and the remarks.

    Args:
        data: what the run found.
        remarks: of :func:`flags`; None: they are made.
    """
    sensor, belief = _sensor(data), _belief(data, flags(data) if remarks is None else remarks)
    if belief.level == "serious" and sensor.level != "serious":
        text = f"{sensor.text.rstrip('.')}, but the results are not reliable."
        sensor = replace(sensor, level="caution", word="Unknown", text=text)
    return sensor, belief


def _sensor(data: ReportData) -> Answer:
    question = f"{'Are the channels' if data.shape[0] == 1 else 'Is the sensor'} within limits?"
    pixels = pixel_counts(data)
    if pixels.fitted == 0:
        return Answer(question, "serious", "Unknown", f"No {data.noun} could be fitted{_reasons(data)}.")
    judged = tuple(criteria(data))
    if data.mostly_flagged:
        kept = tuple(each for each in judged if each.setting in ("failed_pixels", "flagged_pixels"))
        text = f"Most {data.noun}s are flagged: the data do not fix their gain and read noise."
        return Answer(question, "serious", "Unknown", text, kept)
    missed = [each for each in judged if not each.met]
    limits = "; ".join(f"{each.words} {each.found} (limit {each.limit[2:]})" for each in missed)
    met = f"all {len(judged)} criteria pass" if judged else "no limits are set (report.criteria)"
    text = f"{_value_share(data)}; {limits or met}."
    if pixels.failed > data.allowed_failed * pixels.total:
        return Answer(question, "serious", "No", text, judged)
    if any(each.setting == "read_noise_e" for each in missed):
        noisy = data.summary("read_noise_e").median > _TOO_NOISY
        word = "Too noisy to count electrons" if noisy else "Too noisy"
        return Answer(question, "caution", word, text, judged)
    if data.often_flagged:
        return Answer(question, "caution", "Partly known", text, judged)
    if missed:
        return Answer(question, "caution", "Mostly", text, judged)
    return Answer(question, "good", "Yes", text, judged)


def _value_share(data: ReportData) -> str:
    pixels = pixel_counts(data)
    if pixels.failed == 0:
        return f"All {count(pixels.total, data.noun)} have a value"
    return f"{percent(pixels.fitted, pixels.total)} of {count(pixels.total, data.noun)} have a value"


def _belief(data: ReportData, remarks: list[Flag]) -> Answer:
    question = "Are these results reliable?"
    if pixel_counts(data).fitted == 0:
        return Answer(question, "serious", "No results", f"No {data.noun} has a value.")
    about = [flag for flag in remarks if flag.about == "results"]
    serious = [flag for flag in about if flag.level == "serious"]
    cautions = [flag for flag in about if flag.level == "caution"]
    if serious:
        more = f" ({len(serious) - 1} more below)" if len(serious) > 1 else ""
        return Answer(question, "serious", "No", f"{serious[0].text}{more}")
    if cautions:
        more = f" ({len(cautions) - 1} more below)" if len(cautions) > 1 else ""
        return Answer(question, "caution", "With caution", f"{cautions[0].text}{more}")
    passed = sum(flag.level == "good" for flag in about)
    checks = f"{count(passed, 'check')} of the model against the data passed" if passed else "No check fails"
    looked = "" if data.discrepancy is not None else _not_looked_for(data)
    pixels = pixel_counts(data)
    if pixels.failed > data.allowed_failed * pixels.total:
        word = f"For the {data.noun}s with a value"
        return Answer(
            question, "caution", word, f"{checks}; {count(pixels.failed, data.noun)} without a value.{looked}"
        )
    quick = data.discrepancy is None
    return Answer(question, "good", _QUICK_YES if quick else "Yes", f"{checks}.{looked}")


_QUICK_YES = "No problem found by the quick checks"


def _not_looked_for(data: ReportData) -> str:
    """Say what the quick checks cannot find."""
    if data.quick_look is None or not data.quick_look.checks:
        return " Missing effects were not searched for."
    missing = data.quick_look.missing
    parts = f" Not checked: {', '.join(missing)}." if missing else ""
    return (
        f"{parts} The quick checks do not detect what is the same in all frames and pixels (a nonlinearity, "
        f"charge that is not Poisson distributed): run {data.quick_look.command}."
    )
