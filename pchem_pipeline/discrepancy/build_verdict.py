"""Build the verdict from the results of a search: its state, its sentence, and a step per added effect."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.wording import fitted_or_chosen, percent
from pchem_pipeline.discrepancy import verdict as schema
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS, VERSION
from pchem_pipeline.discrepancy.size import size_of
from pchem_pipeline.effects.framework.compose import AddedExposure, in_place, place_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.model.arithmetic.significance import CLEAR, FALSE_ALARM, NO_CHANCE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere

if TYPE_CHECKING:
    from pchem_pipeline.discrepancy.skeleton import Prepared

#: Largest share of a gap above its floor that may remain with effects that explain it.
LARGEST_REST = 0.2
#: Largest number of rivals that are fitted in place of an effect and listed.
MOST_RIVALS = 3
_MOST_UNEXPLAINED = 8
_MOST_RESIDUALS = 3
_MOST_LONGER = 30.0  # largest factor on the number of samples that is recommended
# nats per sample from which on a plain fit may be far off: six of seven hidden effects that left so much had
# moved the gain of 19 to 100 % of the pixels by a fifth or more
_BEYOND_A_FIT = 0.1
_UNFINISHED = "; the search used its budget before it finished: go on with a larger --effort."
#: Reason of a rejection.
LEAVES_TOO_MUCH = "it leaves too much of the discrepancy"


@dataclass(frozen=True)
class Addition:
    """An effect added to the model with its fitted parameters, or the likeliest of several."""

    effect: Effect
    alone: bool  # whether all others are excluded
    against: str  # reason of its rejection, starting with "it"; empty if it is accepted
    candidates: tuple[schema.Candidate, ...]
    stderr: Mapping[str, float]  # standard errors of its parameters, of those that have one
    before: Gap  # gap on the final samples without it
    after: Gap  # the same with it
    rivals: tuple[schema.Rival, ...]
    pulls: tuple[schema.Pull, ...]
    moved: Mapping[str, schema.Moved] = field(default_factory=dict)
    described: bool = False  # whether it is an empirical description without a cause
    certain: bool = True  # whether its strength is significant

    @property
    def fits(self) -> bool:
        """Whether it is not rejected."""
        return not self.against

    @property
    def confirmed(self) -> bool:
        """Whether it is significant, and the gap on the final samples shows or confirms it."""
        return self.certain and (not self.before.at_floor or self.after.value < self.before.value)

    @property
    def named(self) -> bool:
        """Whether the verdict names it."""
        return self.verdict == "named"

    @property
    def verdict(self) -> schema.State:
        """The verdict on this effect alone."""
        if self.described:
            return "described"
        if not self.fits:
            return "unexplained"
        return "named" if self.alone and self.confirmed else "ambiguous"

    def step(self, size: schema.Size | None) -> schema.Step:
        """Make its entry in ``discrepancy.json``."""
        return schema.Step(
            effect=self.effect.tag if self.named else None,
            verdict=self.verdict,
            why=self.against,
            # an unconfirmed effect without a competitor is listed alone
            candidates=self.candidates[:1] if self.alone and not self.confirmed else self.candidates,
            parameters=schema.parameters_of(self.effect, self.stderr),
            form=schema.form_of(self.effect),
            factors=self.factors,
            place=place_words(self.effect),
            gap_before=self.before.value,
            gap_after=self.after.value,
            gap_floor=self.after.floor,
            gap_interval_after=self.after.interval,
            families=schema.Families(before=dict(self.before.families), after=dict(self.after.families)),
            size=size,
            rivals=self.rivals,
            moved=dict(self.moved),
            separate=self._separate(),
            pulls=self.pulls,
        )

    @property
    def factors(self) -> dict[str, tuple[str, ...]]:
        """The values of each factor among the effects that the data leave; one value is certain."""
        if not self.fits:
            return {}
        left = [effect_classes()[c.effect].factors for c in self.candidates if c.effect in effect_classes()]
        if self.named:
            left = [type(self.effect).factors]
        values = zip(*(each for each in left if each is not None), strict=True)
        return dict(zip(schema.FACTORS, (tuple(dict.fromkeys(each)) for each in values), strict=False))

    def _separate(self) -> dict[str, str]:
        """Return, by effect, the measurement that would distinguish it from this one."""
        known, tag = dict(type(self.effect).separate), self.effect.tag
        if self.named or self.alone:
            return known if self.named else {}
        found = {}
        for each in self.candidates:
            if each.effect != tag:
                other = effect_classes().get(each.effect)
                back = None if other is None else other.separate.get(tag)
                found[each.effect] = known.get(each.effect) or back or _more_samples(each)
        return found


@dataclass(frozen=True)
class Added:
    """All effects added to the model, and the remaining discrepancy."""

    additions: tuple[Addition, ...]  # the effects, the largest first
    after: Gap  # gap on the final samples with all of them
    unfinished: bool = False  # whether the remaining gap is too large for a complete model
    stand_ins: tuple[str, ...] = ()  # tags of effects that explain some codes, but not all
    residuals: tuple[schema.Place, ...] = ()  # codes that the final model does not explain
    set_aside: tuple[tuple[float | None, float | None], ...] = ()  # intervals of (x - bias) * gain, e-


@dataclass(frozen=True)
class Fitted:
    """The pixels under the final model; see :class:`~pchem_pipeline.discrepancy.verdict.Discrepancy`.

    ``seen`` returns an effect as it acts on these pixels, for themselves a sensor.
    """

    maps: PixelMaps
    code_extended: FloatArray | None = None
    added: AddedExposure | None = None
    seen: Callable[[Effect], Effect] = lambda effect: effect


@dataclass(frozen=True)
class Findings:
    """The results of a search; see :class:`~pchem_pipeline.discrepancy.verdict.Verdict`."""

    samples: str  # kind of data ("frames", "histograms")
    z: Measured
    first: NullModel  # null distribution of the model before
    last: NullModel  # and after
    before: Gap  # gap on the final samples without new effects
    places: Sequence[schema.Place]  # disagreements of the data with the model before
    still: bool  # whether the data disagree with the final model
    added: Added
    doubt: str = ""
    limit: str = ""
    compared: int = 0  # number of effects

    @property
    def state(self) -> schema.State:
        """The kind of verdict."""
        additions = self.added.additions
        if not additions:
            # a single highly significant statistic counts even if gap and families are within sampling noise
            if self.still or self.first.global_p(self.z.both, 2) < NO_CHANCE:
                return "unexplained"
            return "cannot_tell" if self.doubt else "consistent"
        if any(each.described for each in additions):
            return "described"
        if self.added.unfinished or any(not each.fits for each in additions):
            return "named_in_part" if self.named else "unexplained"
        if any(not each.named for each in additions):
            return "ambiguous"
        # effects that were not tried may be missing too, and so may one that shows in a single statistic
        whole = self.added.after.at_floor and not self.limit and not self.still
        return "named" if whole else "named_in_part"

    @property
    def named(self) -> tuple[Effect, ...]:
        """The named effects, the largest first."""
        return tuple(each.effect for each in self.added.additions if each.named)

    @property
    def described(self) -> tuple[Effect, ...]:
        """The empirical descriptions without a cause."""
        return tuple(each.effect for each in self.added.additions if each.described)

    @property
    def proposed(self) -> tuple[Effect, ...]:
        """Incomplete descriptions: parameters fitted with them may be worse than without."""
        complete = self.added.after.at_floor and all(each.fits for each in self.added.additions)
        return () if complete else self.described

    @functools.cached_property
    def pulls(self) -> tuple[FloatArray, FloatArray]:
        """Pulls of the statistics under the model before and after, shape (m,) each."""
        return self.first.pulls(self.z.both, splits=2), self.last.pulls(self.z.both, splits=2)

    @property
    def closed(self) -> float:
        """The share of the gap that the added effects close."""
        return schema.closed_share(self.before.value, self.added.after.value)

    def model(self, present: Sequence[Effect], extended: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return the effects present before the search, the named ones and complete descriptions."""
        kept = self.named if self.proposed else (*self.named, *self.described)
        keys = {effect.key for effect in (*present, *kept)}
        return tuple(effect for effect in extended if effect.key in keys)


def build_verdict(
    found: Findings, data: Prepared, model: tuple[Effect, ...], fitted: Fitted
) -> schema.Discrepancy:
    """Build the verdict on data from the results of a search, the final model, and the pixels under it."""
    additions, before, after = found.added.additions, found.before, found.added.after
    # unidentified gain and read noise give no size in e-
    sizes = {
        each.effect: None
        if found.doubt
        else size_of(fitted.seen(each.effect), fitted.maps, data.examined.frames)
        for each in additions
    }
    both = found.z.both
    return schema.Discrepancy(
        verdict=schema.Verdict(
            verdict=found.state,
            sentence=_sentence(found, sizes).removesuffix(".") + (_UNFINISHED if found.limit else "."),
            doubt=found.doubt,
            limit=found.limit,
            effects=tuple(dict.fromkeys(effect.tag for effect in found.named)),
            model_effects=tuple(effect.model_dump(mode="json") for effect in model),
            proposed=tuple(effect.model_dump(mode="json") for effect in found.proposed),
            steps=tuple(each.step(sizes[each.effect]) for each in additions),
            gap=schema.GapChange(
                before=before.value,
                after=after.value,
                floor=after.floor,
                closed_fraction=found.closed if additions else 0.0,
                interval_before=before.interval,
                interval_after=after.interval,
                standing_out=after.standing_out,
            ),
            where=tuple(found.places),
            unexplained=(*found.added.residuals, *_still(found, found.pulls[1])),
            set_aside=found.added.set_aside if found.named else (),
            untestable=dict(data.untestable),
            defects=dict(data.defects),
            examined=data.examined.model_copy(update={"compared": found.compared}),
            p_global=schema.Change(before=found.first.global_p(both, 2), after=found.last.global_p(both, 2)),
            replicates=data.effort.replicates,
            work=round(data.effort.spent, 1),
            versions={"statistics": VERSION},
        ),
        model=model,
        maps=fitted.maps,
        evidence=data.evidence,
        statistics=(found.first.names, *found.pulls),
        code_extended=fitted.code_extended,
        added=fitted.added,
    )


def _still(found: Findings, pulls: FloatArray) -> list[schema.Place]:
    """Return the largest disagreement with the final model, and other significant ones."""
    if not found.still:
        return []
    tests = found.last.effective_tests
    chance = [look_elsewhere(p, tests) for p in found.last.p_of(pulls, 2).tolist()]
    order = np.argsort(-np.abs(pulls))[:_MOST_UNEXPLAINED].tolist()
    kept = [i for n, i in enumerate(order) if n == 0 or chance[i] < NO_CHANCE]
    return [schema.Place.of(found.last.names[i], z=float(pulls[i])) for i in kept]


def largest_pulls(
    names: Sequence[str], weight: FloatArray, before: FloatArray, after: FloatArray
) -> tuple[schema.Pull, ...]:
    """Return the statistics of largest weight with their pulls; all arguments have shape (m,)."""
    return tuple(
        schema.Pull(
            statistic=names[i],
            sentence=STATISTICS[names[i]].says(float(before[i])),
            before=float(before[i]),
            after=float(after[i]),
        )
        for i in np.argsort(-np.abs(weight))[: schema.MOST_PULLS]
    )


def _more_samples(other: schema.Candidate) -> str:
    """Return the data that decide between a candidate and the best.

    A difference of log-likelihoods grows with the number of samples, its standard error with the root.
    """
    lead = abs(other.score)
    longer = (CLEAR * other.stderr / lead) ** 2 if lead > 0.0 else math.inf
    if not longer <= _MOST_LONGER:
        return "fit a second exposure, or dark frames, jointly (pchem joint); more of the same will not do"
    return f"about {max(longer, 1.5):.2g} times as many samples"


def _nearly(found: Findings) -> str:
    """Describe borderline deviations; empty if there are none."""
    words = []
    p = found.first.global_p(found.z.both, 2)
    if p < FALSE_ALARM:
        least = int(np.argmin(found.first.p_values(found.z.both, 2)))
        says = STATISTICS[found.first.names[least]].says(float(found.pulls[0][least]))
        words.append(f"{says} (p = {p:.1g}, corrected for the number of statistics)")
    if not found.before.at_floor:
        words.append("all statistics together exceed the 95 % limit of sampling noise")
    return f"; borderline: {'; '.join(words)}; take more frames to decide" if words else ""


def _sentence(found: Findings, sizes: Mapping[Effect, schema.Size | None]) -> str:
    """Return the verdict in one sentence: the effect, its size, and the remaining discrepancy."""
    state, data, added = found.state, found.samples, found.added
    titles = [_summary(each, sizes) for each in added.additions if each.named]
    if state == "consistent":
        seen = " (histograms of single pixels only; frames, rows, columns and neighbours were not tested)"
        seen = seen if data == "histograms" else ""
        return f"No statistic tested disagrees with the model{seen}{_nearly(found)}."
    if state == "cannot_tell":
        return (
            "Frame order, neighbours and codes agree with the model; the shape of the histograms cannot be "
            f"tested: {found.doubt}."
        )
    if state == "unexplained":
        lead = "".join(f": {place.sentence or place.statistic}" for place in found.places[:1])
        return f"Data and model disagree{lead}; {_none(found)} explains it{_left(added)}{_broken(found)}."
    if state == "described":
        return _described(found, titles, sizes)
    if state == "ambiguous":
        return _ambiguous(found, titles, sizes)
    if found.before.at_floor:
        return f"The data show {_and(titles)}; the final {data} alone are too few to show it."
    if state == "named_in_part":
        words = f"{_rest(found)}{_shown(found)}{_left(added)}"
        return f"The data show {_and(titles)}{words}{_broken(found)}."
    them = "them" if len(titles) > 1 else "it"
    lead = f"The data show {_and(titles)}; with {them} in the model"
    return f"{lead}, no statistic tested disagrees{_left(added)}."


def _none(found: Findings) -> str:
    """Return the subject of "explains it" where nothing does."""
    return "no effect tried" if found.limit else "no effect in the library"


def _ambiguous(found: Findings, titles: Sequence[str], sizes: Mapping[Effect, schema.Size | None]) -> str:
    """Describe effects between which the data do not decide, and unconfirmed ones."""
    data, additions = found.samples, found.added.additions
    open_ones = [each for each in additions if not each.alone]
    unknown = [" or ".join(_title(c.effect) for c in each.candidates) for each in open_ones]
    factors = "".join(_factor_words(each.factors) for each in open_ones)
    doubtful = [each for each in additions if each.alone and each.fits and not each.confirmed]
    weak = _and([_summary(each, sizes) for each in doubtful])
    certain = all(each.certain for each in doubtful)
    why = f"not confirmed by the final {data}" if certain else f"too weak in these {data} to be certain"
    also = f"The data show {_and(titles)}; the model also" if titles else "The model"
    rest = f"{_rest(found)}{_left(found.added)}"
    if not unknown:
        return f"{also} may lack {weak}: {why}; take more samples{rest}."
    weak = f"; it may lack {weak}: {why}" if weak else ""
    return f"{also} lacks {_and(unknown)}: these {data} do not decide which{factors}{weak}{rest}."


def _factor_words(factors: Mapping[str, tuple[str, ...]]) -> str:
    """State which factors of an effect are certain, and what the others may be."""
    words = ""
    for state, many in (("certain", False), ("open", True)):
        some = [f"{schema.FACTORS[k]} ({' or '.join(v)})" for k, v in factors.items() if (len(v) > 1) is many]
        words += f"; {state}: {_and(some)}" if some else ""
    return words


def _summary(each: Addition, sizes: Mapping[Effect, schema.Size | None]) -> str:
    """Describe an effect by its name, its place, its leading parameter and its size."""
    effect, size = each.effect, sizes.get(each.effect)
    numbers = list(schema.parameters_of(effect, each.stderr).items())[:1]
    words = [f"{effect.meaning(name)} {fitted_or_chosen(n.value, n.stderr, n.unit)}" for name, n in numbers]
    words += [] if size is None else [size.words()]
    return f"{effect.short_title()}{in_place(effect)}" + (f" ({'; '.join(words)})" if words else "")


def _described(found: Findings, titles: Sequence[str], sizes: Mapping[Effect, schema.Size | None]) -> str:
    """Describe the data empirically where no known effect explains them."""
    known = [(effect.describe(), sizes.get(effect)) for effect in found.described]
    words = "; and ".join(text if size is None else f"{text}; {size.words()}" for text, size in known)
    lead = f"The data show {_and(titles)}; {_none(found)} explains the rest"
    if not titles:
        lead = f"{_none(found).capitalize()} explains the discrepancy"
    before, after = found.before, found.added.after
    closed = f"does not reduce the discrepancy in unseen {found.samples}"
    if not before.at_floor and after.value < before.value:
        closed = f"explains {percent(found.closed)} of the discrepancy in unseen {found.samples}"
    rest = "; single statistics still disagree" if found.still else ""
    if found.proposed:
        rest = "; more than sampling noise remains, so it is proposed, not added to the model"
    lead = f"{lead}; empirically, {words}; this {closed}, and is a description, not a cause"
    return f"{lead}{rest}{_broken(found)}."


def _title(tag: str) -> str:
    """Return the name of an effect."""
    effect = effect_classes().get(tag)
    return tag if effect is None else effect.short_title()


def _rest(found: Findings) -> str:
    """State the remaining gap; empty if it is within sampling noise."""
    after = found.added.after
    if after.at_floor or found.before.value <= 0.0:
        return ""
    if after.value <= after.floor:
        return f"; a significant discrepancy remains in {schema.families_words(after.standing_out)}"
    single = "" if found.still else ", in no single statistic"
    limit = f"sampling noise up to {schema.micronats(after.floor)}"
    rest = f"{schema.micronats(after.value, after.interval)} micronats per sample"
    return f"; {percent(1.0 - found.closed)} of the discrepancy remains{single} ({rest}, {limit})"


def _broken(found: Findings) -> str:
    """Warn if the remaining gap is so large that the pixels' parameters are unreliable."""
    left = found.added.after.interval[0]
    if left < _BEYOND_A_FIT:
        return ""
    return (
        f"; the rest, at least {left:.2g} nats per sample, is too large for the fit: gain, bias, read noise, "
        "exposure and all numbers in electrons can be far off"
    )


def _shown(found: Findings) -> str:
    """Name the statistic that still deviates though the gap is at its floor."""
    if not found.still or not found.added.after.at_floor:
        return ""
    pulls = found.pulls[1]
    worst = int(np.argmax(np.abs(pulls)))
    says = STATISTICS[found.last.names[worst]].says(float(pulls[worst]))
    return f"; one statistic still disagrees: {says} ({schema.sigma_text(pulls[worst])})"


def _left(added: Added) -> str:
    """Name the codes that are not explained, and the effects that explain some codes only."""
    first = "; ".join(place.sentence for place in added.residuals[:_MOST_RESIDUALS])
    words = f"; not explained: {first}" if first else ""
    if added.stand_ins:
        names = _and([_title(tag) for tag in added.stand_ins])
        words += f"; {names} explains some codes, but not all, and is not named"
    return words


def _and(items: Sequence[str]) -> str:
    return ", ".join(items[:-1]) + (" and " if len(items) > 1 else "") + items[-1] if items else ""
