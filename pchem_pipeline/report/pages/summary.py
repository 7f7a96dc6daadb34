"""The first screen: is the sensor within limits, are the results reliable, remarks, next steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pchem_pipeline.base.variables import CHARGE_RATES
from pchem_pipeline.base.wording import (
    capitalised,
    count,
    measured,
    p_value_text,
    percent,
    scientific,
    short,
    symbol,
    typeset,
)
from pchem_pipeline.discrepancy.quick.checks import GRAVEST_FIRST, Check, Level, QuickLook
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.checks.map_parts import Parts
from pchem_pipeline.model.fit.status import FAILED, FLAGGED, FitStatus, flags_of, words_of
from pchem_pipeline.model.maps.defects import FAULTS, FEWEST, Defect
from pchem_pipeline.report.data import ReportData, reasons_in
from pchem_pipeline.report.style.ranges import finite


@dataclass(frozen=True)
class Criterion:
    """A criterion by its key in ``report.criteria``: what is judged, the value and the limit as text."""

    setting: str
    words: str
    found: str
    limit: str
    met: bool


#: A share of pixels or a ratio, and what it is of; None where this sensor cannot be judged by it.
_Found = tuple[float, str] | None


def criteria(data: ReportData) -> list[Criterion]:
    """Judge the sensor by each criterion that has a limit and can be judged."""
    found = []
    for setting, (measure, show) in _MEASURES.items():
        limit = getattr(data.criteria, setting)
        value = None if limit is None else measure(data)
        if value is not None:
            number, words = value
            met, shown = number <= limit, show(number)
            shown = shown if met or shown != show(limit) else f"> {shown}"  # rounded to the limit
            found.append(Criterion(setting, words, shown, f"≤ {show(limit)}", met))
    for name, (low, high) in data.criteria.medians.items():
        if data.has_values(name):
            median, (_, words, unit) = data.summary(name).median, symbol(name)
            shown, within = f"{short(median, 4)} {unit}", f"{low:g} to {high:g} {unit}"
            met, words = low <= median <= high, f"median {words}"
            found.append(Criterion(f"medians.{name}", words, shown, within, met))
    return found


def _read_noise(data: ReportData) -> _Found:
    median = data.summary("read_noise_e").median if data.has_values("read_noise_e") else np.nan
    return (median, "median read noise") if np.isfinite(median) else None


def _hot(data: ReportData) -> _Found:
    """Return the share of hot pixels; a flagged one is hot, too, whatever electrons it is open by."""
    if data.few_channels or data.defects is None or not data.has_values("quanta_exposure"):
        return None
    known = np.isfinite(data.maps["quanta_exposure"])
    if np.count_nonzero(known & ~data.flagged_in("quanta_exposure")) < FEWEST:
        return None
    return data.defects.counts().get("hot", 0) / int(known.sum()), f"hot {data.noun}s"


def _outlying(data: ReportData) -> _Found:
    if data.few_channels:
        return None
    shares = []
    for name in ("conversion_gain", "bias", "read_noise_e"):
        if data.has_values(name):
            summary = data.summary(name)
            share = (summary.n_low + summary.n_high) / max(summary.n_valid, 1)
            shares.append((share, f"outliers in {name.removesuffix('_e').replace('_', ' ')}"))
    return max(shares, default=None)


def _gain_spread(data: ReportData) -> _Found:
    """Return the spread of the gain between pixels over its median, corrected for their errors."""
    if data.few_channels or not data.has_values("conversion_gain"):
        return None
    summary = data.summary("conversion_gain")
    if summary.n_valid < 2:
        return None
    own = data.pixel_error("conversion_gain") or 0.0
    spread = np.sqrt(max(summary.robust_sd**2 - own**2, 0.0))
    return float(spread / summary.median), "non-uniformity of the gain"


_MEASURES: dict[str, tuple[Callable[[ReportData], _Found], Callable[[float], str]]] = {
    "read_noise_e": (_read_noise, lambda value: f"{short(value)} e⁻"),
    "failed_pixels": (
        lambda data: (pixel_counts(data).failed_share, f"{data.noun}s without a value"),
        percent,
    ),
    "flagged_pixels": (lambda data: (data.flagged_share(), f"flagged {data.noun}s"), percent),
    "hot_pixels": (_hot, percent),
    "outlying_pixels": (_outlying, percent),
    "gain_nonuniformity": (_gain_spread, percent),
}


def check_sentence(check: Check) -> str:
    """State title, size, place and consequence of a check, without a full stop."""
    title, size = capitalised(check.title), size_text(check)
    advice = "the model includes such an effect" if check.in_model else check.advice
    if check.unit in ("DN", "LSB") and check.name != "levels":
        place = f", {check.where}" if check.where else ""
        return f"{title} of {size}{place}{f': {advice}' if advice else ''}"
    place = f" ({check.where})" if check.where else ""
    place = f" at {check.where}" if check.name.endswith("_code") else place
    return f"{title}: {size}{place}{f'; {advice}' if advice else ''}"


def size_text(check: Check) -> str:
    """Format the size of a check, in DN, e- and as a share of the read noise."""
    if check.name == "levels":
        return f"{short(check.size, 2)} DN apart"
    if check.unit == "DN":
        electrons = f"{short(check.size_e, 2)} e⁻" if math.isfinite(check.size_e) else ""
        share = f"{percent(check.share)} of the read noise" if math.isfinite(check.share) else ""
        others = ", ".join(filter(None, (electrons, share)))
        return f"{short(check.size, 2)} DN{f' ({others})' if others else ''}"
    if check.unit == "LSB":
        return f"{short(check.size, 2)} LSB rms" if math.isfinite(check.size) else "unknown size"
    if check.name in ("lag", "frame_lag", "neighbours_x", "neighbours_y"):
        return short(check.size, 2)
    noun = next((noun for noun in ("frames", "pixels") if check.name.endswith(noun)), "samples")
    return f"{percent(check.size)} of the {noun}"


def nothing_found(look: QuickLook) -> str:
    """State that no check is significant, and the detection limit of row noise."""
    rows = next((check for check in look.checks if check.name == "row_noise"), None)
    if rows is None:
        return "Quick look: the codes agree with the model within sampling noise."
    codes = "" if "codes" in look.missing else ", codes"
    text = f"Quick look: frames, rows, columns, neighbours{codes} and pickup agree with the model"
    if math.isfinite(rows.limit):
        text += f"; row noise above {short(rows.limit, 2)} DN is excluded (95 %)"
    return f"{text}."


KEY_MAPS = ("read_noise_e", "conversion_gain", *CHARGE_RATES, "charge_per_level", "quanta_exposure", "bias")

#: Share of pixels with one reason for caution from which the first screen says so.
_CAUTION_SHARE = 0.01
#: Read noise, e-, above which electrons cannot be counted.
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

    @property
    def failed_share(self) -> float:
        """Share of pixels without a value."""
        return self.failed / max(self.total, 1)


def pixel_counts(data: ReportData) -> PixelCounts:
    """Count the pixels by outcome of their fit."""
    status = data.status
    wanted = (status & int(FitStatus.EXCLUDED)) == 0
    failed = (data.failed | data.unfitted) & wanted
    return PixelCounts(int(wanted.sum()), int(failed.sum()), int(((status != 0) & ~failed & wanted).sum()))


def key_numbers(data: ReportData, *, with_flagged: bool = False) -> list[KeyNumber]:
    """Return the numbers of the first screen, of all pixels or of unflagged ones, if these are not few."""
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
    flagged = int(data.flagged.sum())
    if data.mostly_flagged:
        return (
            f"{percent(flagged, pixel_counts(data).fitted)} of them are flagged: no medians, since "
            "the other pixels are a biased selection."
        )
    parts = []
    for name in ("read_noise_e", "conversion_gain", *CHARGE_RATES):
        if data.has_median(name):
            summary, (_, words, unit) = data.summary(name), symbol(name)
            parts.append(f"{words} {measured(summary.median, summary.median_stderr, unit)}")
    left_out = (
        f" ({count(flagged, 'flagged one')} excluded where a flag concerns the quantity)" if flagged else ""
    )
    return f"Medians over the {data.noun}s{left_out}: {', '.join(parts)}."


def flags(data: ReportData) -> list[Flag]:
    """Return what speaks for and against the results, the gravest first."""
    return gravest_first(dict.fromkeys(flag for check in CHECKS for flag in check(data)))


def gravest_first(found: Iterable[Flag]) -> list[Flag]:
    """Return remarks by their level, the gravest first."""
    return sorted(found, key=lambda flag: GRAVEST_FIRST.index(flag.level))


def _levels(data: ReportData) -> Iterator[Flag]:
    """Say where the frames are of several exposures: what else is odd follows from that."""
    for check in () if data.quick_look is None else data.quick_look.found:
        if check.name == "levels":
            yield Flag(check.level, f"{check_sentence(check)}.")


def _failed_pixels(data: ReportData) -> Iterator[Flag]:
    pixels = pixel_counts(data)
    share = pixels.failed_share
    text = f"{count(pixels.failed, data.noun)} ({percent(pixels.failed, pixels.total)}) without a value"
    if share > data.allowed_failed:
        allowed = percent(data.allowed_failed)
        yield Flag("serious", f"{text}; {allowed} allowed{_reasons(data)}.", "sensor")
    elif pixels.failed:
        yield Flag("caution" if share > _CAUTION_SHARE else "note", f"{text}{_reasons(data)}.", "sensor")
    else:
        yield Flag("good", f"Every {data.noun} has a value.", "sensor")


def _reasons(data: ReportData) -> str:
    """Return why pixels have no value, the commonest reason first, as the end of a sentence."""
    rows = sorted((row for row in reasons_in(data.status) if row[0] in FAILED), key=lambda row: -row[2])
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


def _defects(data: ReportData) -> Iterator[Flag]:
    counts = {} if data.defects is None else data.defects.counts()
    names = [words_of(kind) for kind in FAULTS | Defect.TELEGRAPH]
    if found := [f"{counts[name]:,} {name}" for name in names if name in counts]:
        listed = f"As a list: pchem export {data.typed_run} --format defects."
        yield Flag("note", f"Defects: {', '.join(found)}. {listed}", "sensor")


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


def _cautions(data: ReportData) -> Iterator[Flag]:
    # what else is odd about a pixel without a value misleads nobody
    kept = data.status[~data.failed]
    for bit, text, n in reasons_in(kept):
        if n > _CAUTION_SHARE * kept.size:
            share = f"{percent(n, kept.size)} of the {data.noun}s with a value"
            which = "" if bit in flags_of("conversion_gain") else " of exposure and bias"
            excluded = f" (excluded from medians and tables{which})" if bit in FLAGGED else ""
            yield Flag("caution", f"{share}: {text}{excluded}.")


def _goodness(data: ReportData) -> Iterator[Flag]:
    p = finite(data.fit.get("goodness_p", np.empty(0)))
    if p.size == 0:
        return
    poor, expected = int((p < SIGNIFICANCE).sum()), SIGNIFICANCE * p.size
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
        text = f"The RMSE of the predicted {words} ensemble is {short(ratio, 2)} times the sampling noise"
        text += "" if p is None else f" (chi-square: {p_value_text(p)})"
        if ratio <= 1.3 or (p is not None and p >= SIGNIFICANCE):
            yield Flag("good", f"{text}: the model describes the data.")
        elif ratio <= 3.0:
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
    if data.discrepancy is not None:
        found = data.discrepancy.found
        yield Flag(VERDICT_LEVELS.get(found.verdict, "note"), _as_sentence(typeset(found.sentence)))


def _quick_look(data: ReportData) -> Iterator[Flag]:
    look = data.quick_look
    if look is None or not look.checks:
        return
    if not look.found:
        yield Flag("good", nothing_found(look))
    known = not look.command or data.discrepancy is not None
    closer = "" if known else f"; to look closer: {look.command}"
    for number, check in enumerate(look.found):
        if check.name != "levels":
            # an effect that the model includes speaks for the model
            level = "good" if check.in_model else check.level
            yield Flag(level, f"{check_sentence(check)}{'' if number else closer}.")


def _conditions(data: ReportData) -> Iterator[Flag]:
    for part in ("charge_rate", "ensemble"):
        if part in data.missing:
            yield Flag("note", _as_sentence(data.missing[part]))
    noisy = data.has_values("read_noise_e") and data.summary("read_noise_e").median > _TOO_NOISY
    if data.samples is None and noisy:
        yield Flag(
            "caution", "Read noise above 0.5 e⁻: one exposure does not suffice. Combine several exposures."
        )
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
    _spaced_codes, _levels, _failed_pixels, _defects, _unfitted, _flagged, _cautions, _parts, _goodness,
    _agreement, _quick_look, _discrepancy, _conditions,
)  # fmt: skip


def _as_sentence(text: str) -> str:
    return f"{capitalised(text).rstrip('.')}."


@dataclass(frozen=True)
class Answer:
    """The answer to a question: a word, the reason in a sentence, and the criteria it rests on, if any."""

    question: str
    level: Level
    word: str
    text: str
    criteria: tuple[Criterion, ...] = ()


def answers(data: ReportData, remarks: list[Flag] | None = None) -> tuple[Answer, Answer]:
    """Answer 'is the sensor within limits' and 'are the results reliable' by the remarks of `flags`."""
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
    words = (f"{each.words} {each.found} (limit {each.limit.removeprefix('≤ ')})" for each in missed)
    limits = "; ".join(words)
    met = f"all {len(judged)} criteria pass" if judged else "no limits are set (report.criteria)"
    share = "All" if pixels.failed == 0 else f"{percent(pixels.fitted, pixels.total)} of"
    text = f"{share} {count(pixels.total, data.noun)} have a value; {limits or met}."
    if pixels.failed > data.allowed_failed * pixels.total:
        return Answer(question, "serious", "No", text, judged)
    if any(each.setting == "read_noise_e" for each in missed):
        noisy = data.summary("read_noise_e").median > _TOO_NOISY
        word = "Too noisy to count electrons" if noisy else "Too noisy"
        return Answer(question, "caution", word, text, judged)
    if data.often_flagged or missed:
        return Answer(question, "caution", "Partly known" if data.often_flagged else "Mostly", text, judged)
    return Answer(question, "good", "Yes", text, judged)


def _belief(data: ReportData, remarks: list[Flag]) -> Answer:
    question = "Are these results reliable?"
    if pixel_counts(data).fitted == 0:
        return Answer(question, "serious", "No results", f"No {data.noun} has a value.")
    about = [flag for flag in remarks if flag.about == "results"]
    doubts: tuple[tuple[Level, str], ...] = (("serious", "No"), ("caution", "With caution"))
    for level, word in doubts:
        if texts := [flag.text for flag in about if flag.level == level]:
            more = f" ({len(texts) - 1} more below)" if len(texts) > 1 else ""
            return Answer(question, level, word, f"{texts[0]}{more}")
    passed = sum(flag.level == "good" for flag in about)
    checks = f"{count(passed, 'check')} of the model against the data passed" if passed else "No check fails"
    looked, yes = "", "Yes"
    if data.discrepancy is None:
        looked, yes = _not_looked_for(data), "No problem found by the quick checks"
    pixels = pixel_counts(data)
    if pixels.failed > data.allowed_failed * pixels.total:
        text = f"{checks}; {count(pixels.failed, data.noun)} without a value.{looked}"
        return Answer(question, "caution", f"For the {data.noun}s with a value", text)
    return Answer(question, "good", yes, f"{checks}.{looked}")


def _not_looked_for(data: ReportData) -> str:
    if data.quick_look is None or not data.quick_look.checks:
        return " Missing effects were not searched for."
    missing = data.quick_look.missing
    parts = f" Not checked: {', '.join(missing)}." if missing else ""
    return (
        f"{parts} The quick checks do not detect what is the same in all frames and pixels (a nonlinearity, "
        f"charge that is not Poisson distributed): run {data.quick_look.command}."
    )


#: Stands for the run in a command.
RUN = "RUN"


@dataclass(frozen=True)
class Step:
    """A command, with :data:`RUN` in place of the run, and what it is for."""

    command: str
    why: str

    def of(self, run: str) -> str:
        """Return the command as it is typed for a run."""
        return " ".join(run if word == RUN else word for word in self.command.split(" "))


def next_steps(data: ReportData) -> list[Step]:
    """Return what to do next; the first is the one to begin with."""
    if any(stage.get("state") not in (None, "complete") for stage in data.stages) or data.unfitted.any():
        return [Step(f"pchem run {RUN}", "finish the run")]
    step = data.code_step
    if step > 1 and not step & (step - 1):
        shift = f"set input.bit_shift: {step.bit_length() - 1} in the YAML"
        return [Step(f"pchem run {RUN}", f"{shift} (left-justified samples) and run again")]
    if data.failed.all():
        return [
            Step(
                f"pchem joint EXPOSED.yaml --bias {RUN} --store joint.zarr",
                "if these are bias frames: fit them together with exposed frames",
            ),
            Step(f"pchem view {RUN}", "view the histograms"),
        ]
    if data.quick_look is not None and any(check.name == "levels" for check in data.quick_look.found):
        return [
            Step(
                "pchem run FILES_OF_ONE --store one.zarr",
                "the frames have several exposures: make one run per exposure, then fit them together "
                "(pchem joint)",
            )
        ]
    found = []
    if data.often_flagged and data.samples is None:
        noise = "0.6"  # a guess, where the median would be that of a biased selection
        if not data.mostly_flagged and data.has_values("read_noise_e"):
            noise = f"{data.summary('read_noise_e').median:.2g}"
        found += [
            Step(
                f"pchem joint {RUN} BRIGHTER.yaml --bias BIAS.yaml --store joint.zarr",
                "fit several exposures together: a second exposure, or bias frames, fix the electron number",
            ),
            Step(
                f"pchem plan --read-noise {noise} --samples 0,2,8 --target conversion_gain=1%",
                "compute how many frames at which exposures are needed, at the read noise that you expect",
            ),
        ]
    if data.mostly_coarse:
        found.append(Step(f"pchem run {RUN}", "set fit.likelihood: auto in the YAML and run again"))
    if data.discrepancy is None and not data.often_flagged and (data.n_frames or 0) >= 600:
        found.append(Step(f"pchem discrepancy {RUN}", "search for effects missing from the model"))
    if not found:
        found.append(Step(f"pchem view {RUN}", "view every pixel in the browser"))
    return found
