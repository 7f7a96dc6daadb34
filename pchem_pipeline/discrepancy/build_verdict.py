"""From what a search measured to its verdict: the state, one sentence, and a step for each added effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS, VERSION
from pchem_pipeline.discrepancy.size import size_of
from pchem_pipeline.discrepancy.verdict import (
    CONVINCING_PLACEBO,
    MOST_PULLS,
    Candidate,
    Change,
    Discrepancy,
    Examined,
    Families,
    GapChange,
    Moved,
    Place,
    Pull,
    Rival,
    Size,
    State,
    Step,
    Verdict,
    closed_share,
    families_words,
    form_of,
    parameters_of,
)
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.compose import place_words, title_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.model.arithmetic.robust import look_elsewhere

FloatArray = NDArray[np.float64]

#: Share of the gap that effects may leave, where it is above its floor, and still explain it.
LARGEST_REST = 0.2
#: Rivals of an effect that are fitted in its place and told.
MOST_RIVALS = 3
_MOST_UNEXPLAINED = 8
_MOST_RESIDUALS = 3
_DECIDED = 3.0  # standard errors of a difference of scores that tells two effects apart
_MOST_LONGER = 30.0  # times the samples that anyone will take
# chance of any statistic as far from the model, below which nothing is called consistent, and one is told
# beside the farthest
_NO_CHANCE = 1e-6
_RARE = 0.02  # a chance that is worth telling though it is no disagreement
# nats per sample from which on a plain fit may be far off: six of seven hidden effects that left so much had
# moved the gain of 19 to 100 % of the pixels by a fifth or more
_BEYOND_A_FIT = 0.1


@dataclass(frozen=True)
class Addition:
    """An effect added to the model, or the likeliest of several.

    Attributes:
        effect: with its fitted parameters.
        alone: whether all others are excluded.
        against: why it is not what the data hold, and the candidates are only the nearest known; else empty.
        candidates: those compared, the likeliest first.
        strength_stderr: standard error of its strength.
        before, after: gap on the final samples without and with it.
        rivals: the next best candidates, fitted the same way, the best first.
        placebo: the best of those that have nothing to do with it, or None.
        pulls: the statistics that moved most.
        moved: change of each parameter map by its refit with the effect.
        described: whether it is measured where no known effect explains the data, and not understood.
        certain: whether its strength is beyond doubt.
    """

    effect: Effect
    alone: bool
    against: str
    candidates: tuple[Candidate, ...]
    strength_stderr: float
    before: Gap
    after: Gap
    rivals: tuple[Rival, ...]
    placebo: Rival | None
    pulls: tuple[Pull, ...]
    moved: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    described: bool = False
    certain: bool = True

    @property
    def fits(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.against

    @property
    def confirmed(self) -> bool:
        """Whether it is certain, and the final samples show what it is for or come nearer with it."""
        return self.certain and (not self.before.at_floor or self.after.value < self.before.value)

    @property
    def named(self) -> bool:
        """Whether the verdict names it."""
        return self.verdict == "named"

    @property
    def verdict(self) -> State:
        """The verdict of it alone."""
        if self.described:
            return "described"
        if not self.fits:
            return "unexplained"
        return "named" if self.alone and self.confirmed else "ambiguous"

    def step(self, size: Size | None) -> Step:
        """Return it as ``discrepancy.json`` holds it."""
        return Step(
            effect=self.effect.tag if self.named else None,
            verdict=self.verdict,
            # one that is not confirmed is not confused with those that it beats
            candidates=self.candidates[:1] if self.alone and not self.confirmed else self.candidates,
            parameters=parameters_of(self.effect, self.strength_stderr),
            form=form_of(self.effect),
            place=place_words(self.effect),
            gap_before=self.before.value,
            gap_after=self.after.value,
            gap_floor=self.after.floor,
            gap_interval_after=self.after.interval,
            families=Families(before=dict(self.before.families), after=dict(self.after.families)),
            size=size,
            rivals=self.rivals,
            placebo=self.placebo,
            moved={name: Moved(**change) for name, change in self.moved.items()},
            separate=self._separate(),
            pulls=self.pulls,
        )

    def _separate(self) -> dict[str, str]:
        """Return by effect what would tell it from this one: of those known, or of the candidates."""
        known = dict(type(self.effect).separate)
        if self.named:
            return known
        found = {}
        for each in self.candidates:
            other = effect_classes().get(each.effect)
            back = {} if other is None else other.separate
            if each.effect != self.effect.tag and not self.alone:
                text = known.get(each.effect) or back.get(self.effect.tag) or _more_samples(each)
                found[each.effect] = text
        return found


@dataclass(frozen=True)
class Added:
    """All that was added to the model, and what is left.

    Attributes:
        additions: the effects, the weightiest of a round first.
        after: gap on the final samples with all of them.
        unfinished: whether too much of the gap is left to call the model complete.
        nearest: tags of effects that come nearest where none explains the data.
        stand_ins: tags of effects that describe a part, but not on all codes alike.
        residuals: codes that the final model does not account for.
        set_aside: codes that its fit leaves out, by their place on a pixel's comb: intervals, e-.
    """

    additions: tuple[Addition, ...]
    after: Gap
    unfinished: bool = False
    nearest: tuple[str, ...] = ()
    stand_ins: tuple[str, ...] = ()
    residuals: tuple[Place, ...] = ()
    set_aside: tuple[tuple[float | None, float | None], ...] = ()


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
    """What a search measured.

    Attributes:
        samples: what the data are ("frames", "histograms").
        z: statistics of the data.
        first, last: replicates of the model before and after.
        before: gap on the final samples with no new effect.
        places: where the data disagree with the model as it was.
        still: whether they disagree with the final model.
        added: effects, and what is left.
        doubt: why the pixels are not identified, and what would help; empty where they are.
        limit: where the search ended at its limit, and what was not tried; empty where it did not.
    """

    samples: str
    z: Measured
    first: NullModel
    last: NullModel
    before: Gap
    places: Sequence[Place]
    still: bool
    added: Added
    doubt: str = ""
    limit: str = ""

    @property
    def state(self) -> State:
        """The verdict in a word."""
        additions = self.added.additions
        if not additions:
            # no families of statistics, and no gap, excuse a single one that chance does not make
            if self.still or self.first.global_p(self.z.both, 2) < _NO_CHANCE:
                return "unexplained"
            return "cannot_tell" if self.doubt else "consistent"
        if any(each.described for each in additions):
            return "described"
        if self.added.unfinished or any(not each.fits for each in additions):
            return "named_in_part" if self.named else "unexplained"
        if any(not each.named for each in additions):
            return "ambiguous"
        # what was not tried may be missing as well, and so is what shows in a single statistic
        whole = self.added.after.at_floor and not self.limit and not self.still
        return "named" if whole else "named_in_part"

    @property
    def named(self) -> tuple[Effect, ...]:
        """The named effects, the weightiest first."""
        return tuple(each.effect for each in self.added.additions if each.named)

    @property
    def described(self) -> tuple[Effect, ...]:
        """What was measured and is not understood."""
        return tuple(each.effect for each in self.added.additions if each.described)

    @property
    def proposed(self) -> tuple[Effect, ...]:
        """Descriptions that leave something: the pixels fitted with them may be farther off than without."""
        return () if self.added.after.at_floor else self.described

    def model(self, present: Sequence[Effect], extended: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return the model with those effects that were added and are named, or describe all that is left.

        Args:
            present: effects that it had before the search.
            extended: the same, and all that were added.
        """
        kept = self.named if self.proposed else (*self.named, *self.described)
        keys = {effect.key for effect in (*present, *kept)}
        return tuple(effect for effect in extended if effect.key in keys)


def build_verdict(
    found: Findings,
    model: tuple[Effect, ...],
    fitted: Fitted,
    looked_at: tuple[Evidence, Examined],
    *,
    untestable: Mapping[str, str],
    defects: Mapping[str, str],
    n_replicates: int,
    work: float,
) -> Discrepancy:
    """Put the verdict together.

    Args:
        found: what was measured.
        model: effects that the model has now.
        fitted: the pixels under it.
        looked_at: evidence of the train samples, and what was examined.
        untestable: effects that such data cannot show, and why.
        defects: candidates that failed, and why.
        n_replicates: drawn in all.
        work: CPU seconds by count.
    """
    # e-, and the share of the read noise, of pixels whose gain and read noise are open would be made up
    sizes = {
        each.effect: None
        if found.doubt
        else size_of(fitted.seen(each.effect), fitted.maps, looked_at[1].frames)
        for each in found.added.additions
    }
    both = found.z.both
    pulls = found.first.pulls(both, splits=2), found.last.pulls(both, splits=2)
    return Discrepancy(
        verdict=Verdict(
            verdict=found.state,
            sentence=_sentence(found, sizes).removesuffix(".")
            + (f"; {found.limit}." if found.limit else "."),
            doubt=found.doubt,
            limit=found.limit,
            effects=tuple(dict.fromkeys(effect.tag for effect in found.named)),
            model_effects=tuple(effect.model_dump(mode="json") for effect in model),
            proposed=tuple(effect.model_dump(mode="json") for effect in found.proposed),
            steps=tuple(each.step(sizes[each.effect]) for each in found.added.additions),
            gap=_gap_change(found.before, found.added),
            where=tuple(found.places),
            unexplained=(*found.added.residuals, *_still(found, pulls[1])),
            set_aside=found.added.set_aside if found.named else (),
            untestable=dict(untestable),
            defects=dict(defects),
            examined=looked_at[1],
            p_global=Change(before=found.first.global_p(both, 2), after=found.last.global_p(both, 2)),
            replicates=n_replicates,
            work=round(work, 1),
            versions={"statistics": VERSION},
        ),
        model=model,
        maps=fitted.maps,
        evidence=looked_at[0],
        statistics=(found.first.names, pulls[0], pulls[1]),
        code_extended=fitted.code_extended,
        added=fitted.added,
    )


def _still(found: Findings, pulls: FloatArray) -> list[Place]:
    """Return what disagrees with the final model: the farthest statistic, and others beyond chance."""
    if not found.still:
        return []
    tests = found.last.effective_tests
    chance = [look_elsewhere(p, tests) for p in found.last.p_of(pulls, 2).tolist()]
    order = np.argsort(-np.abs(pulls))[:_MOST_UNEXPLAINED].tolist()
    kept = [i for n, i in enumerate(order) if n == 0 or chance[i] < _NO_CHANCE]
    return [Place.of(found.last.names[i], z=float(pulls[i])) for i in kept]


def largest_pulls(
    names: Sequence[str], weight: FloatArray, before: FloatArray, after: FloatArray
) -> tuple[Pull, ...]:
    """Return the statistics of largest weight with their pulls, shape (m,) each."""
    return tuple(
        Pull(
            statistic=names[i],
            sentence=STATISTICS[names[i]].says(float(before[i])),
            before=float(before[i]),
            after=float(after[i]),
        )
        for i in np.argsort(-np.abs(weight))[:MOST_PULLS]
    )


def _gap_change(before: Gap, added: Added) -> GapChange:
    after = added.after
    return GapChange(
        before=before.value,
        after=after.value,
        floor=after.floor,
        closed_fraction=closed_share(before.value, after.value) if added.additions else 0.0,
        interval_before=before.interval,
        interval_after=after.interval,
        standing_out=after.standing_out,
    )


def _more_samples(other: Candidate) -> str:
    """Return the run that tells a candidate from the best: scores grow with it, their errors as its root."""
    lead = abs(other.score)
    longer = (_DECIDED * other.stderr / lead) ** 2 if lead > 0.0 else math.inf
    if not longer <= _MOST_LONGER:
        return (
            "another exposure, or frames without any, as a second stack (pchem joint); hardly more of these"
        )
    return f"{max(longer, 1.5):.2g} times as many samples, if their scores go on to differ as they do"


def _nearly(found: Findings) -> str:
    """Return what comes near to a disagreement without being one; empty where nothing does."""
    words = []
    p = found.first.global_p(found.z.both, 2)
    if p < _RARE:
        least = int(np.argmin(found.first.p_values(found.z.both, 2)))
        says = STATISTICS[found.first.names[least]].says(float(found.first.pulls(found.z.both, 2)[least]))
        words.append(f"{says}, by chance in one of {1.0 / p:,.0f} such runs")
    if not found.before.at_floor:
        words.append(f"taken together the {found.samples} are farther from it than in 19 of 20 such runs")
    return f"; near the limit: {'; '.join(words)}; more frames would tell" if words else ""


#: What histograms show, and what they do not.
_OF_PIXELS = ", of the histograms of single pixels; frames, rows, columns and neighbours were not looked at"


def _sentence(found: Findings, sizes: Mapping[Effect, Size | None]) -> str:
    """Return the verdict in one sentence: what, how large, and what it closes beside its rivals."""
    state, data, added = found.state, found.samples, found.added
    titles = [_sized(effect, sizes) for effect in found.named]
    if state == "consistent":
        seen = _OF_PIXELS if data == "histograms" else ""
        return f"The {data} agree with the model in every statistic tested{seen}{_nearly(found)}."
    if state == "cannot_tell":
        return (
            f"Nothing in the order of the {data}, between pixels or in the codes disagrees with the model; "
            f"of what shows only in the shape of the histograms nothing can be told: {found.doubt}."
        )
    if state == "unexplained":
        first = found.places[0] if found.places else None
        lead = f": {first.sentence or first.statistic}" if first is not None else ""
        none = "no known effect explains it" if not found.limit else "none that was tried explains it"
        words = f"{lead}; {none}{_nearest(found)}{_left(added)}{_broken(found)}"
        return f"The {data} disagree with the model{words}."
    if state == "described":
        return _described(found, titles, sizes)
    if state == "ambiguous":
        return _ambiguous(found, titles, sizes)
    if found.before.at_floor:
        return f"The model was missing {_and(titles)}, too little for the final {data} alone to show."
    if state == "named_in_part":
        words = f"{_rest(found)}{_shown(found)}{_nearest(found)}{_left(added)}{_doubts(added)}"
        words += _broken(found)
        return f"A part of what the model was missing is {_and(titles)}{words}."
    them = "them" if len(titles) > 1 else "it"
    words = f"with {them}, no more of the gap is left than chance makes{_left(added)}{_doubts(added)}"
    return f"The model was missing {_and(titles)}; {words}."


def _ambiguous(found: Findings, titles: Sequence[str], sizes: Mapping[Effect, Size | None]) -> str:
    """Return what the model may lack: effects not told apart, and what the final samples do not confirm."""
    data, additions = found.samples, found.added.additions
    unknown = [" or ".join(_title(c.effect) for c in each.candidates) for each in additions if not each.alone]
    doubtful = [each for each in additions if each.alone and each.fits and not each.confirmed]
    weak = _and([_sized(each.effect, sizes) for each in doubtful])
    why = f"which the final {data} do not confirm"
    if not all(each.certain for each in doubtful):
        why = f"too weak in these {data} to be certain"
    also = f"{_and(titles)} is missing, and " if titles else ""
    if not unknown:
        also = f"The model was missing {_and(titles)}, and it may" if titles else "The model may"
        left = f"{_rest(found)}{_left(found.added)}"
        return f"{also} lack {weak}, {why}: more samples would tell{left}."
    weak = f"; it may lack {weak}, {why}" if weak else ""
    lacks = f"{also}{_and(unknown)}{weak}{_rest(found)}{_left(found.added)}"
    return f"The model lacks something that these {data} cannot tell apart: {lacks}."


def _sized(effect: Effect, sizes: Mapping[Effect, Size | None]) -> str:
    """Return what an effect is called, with its size, and then its place."""
    size = sizes.get(effect)
    if size is None:
        return title_words(effect)
    place = "" if effect.everywhere else f", in {place_words(effect)}"
    return f"{_title(effect.tag)} of {size.words()}{place}"


def _described(found: Findings, titles: Sequence[str], sizes: Mapping[Effect, Size | None]) -> str:
    """Return what is known of a disagreement that was measured and is not understood."""
    known = [(effect.words(), sizes.get(effect)) for effect in found.described]
    told = [text if size is None else f"{text}, in all {size.words()}" for text, size in known]
    words, them = "; and ".join(told), "it" if len(told) == 1 else "them"
    besides = f" besides {_and(titles)}" if titles else ""
    none = "No known effect explains" if not found.limit else "No effect that was tried explains"
    return (
        f"{none} the {found.samples}{besides}; a description of them, which names no cause: {words}; "
        f"with {them} {_closed(found)}; {_alike(found)}{_broken(found)}."
    )


def _alike(found: Findings) -> str:
    """Return in words whether a measured component is alike in all that it is said of, and in the model."""
    if found.proposed:
        return "the rest is more than chance, so that the description is proposed and not in the model"
    if found.still:
        return "whether it is like that throughout is not known"
    return "as far as these statistics show, it is like that throughout"


def _nearest(found: Findings) -> str:
    """Return in words which known effects come nearest to what none explains."""
    named = {effect.tag for effect in found.named}
    doubtful = {e.candidates[0].effect: e.against for e in found.added.additions if not e.fits}
    doubtful = {tag: against for tag, against in doubtful.items() if tag not in named}
    nearest = [] if doubtful else [_title(tag) for tag in found.added.nearest if tag not in named]
    words = ""
    for why in dict.fromkeys(doubtful.values()):
        alike = [_title(tag) for tag, against in doubtful.items() if against == why]
        words += f"; most like {_and(alike)}, which {'does' if len(alike) == 1 else 'do'} not fit: {why}"
    return words + (f"; nearest known: {_and(nearest)}" if nearest else "")


def _title(tag: str) -> str:
    """Return what an effect is called."""
    effect = effect_classes().get(tag)
    return tag if effect is None else effect.title or tag


def _closed(found: Findings) -> str:
    """Return the share of the gap that is closed, in words."""
    before, after = found.before, found.added.after
    if before.at_floor or after.value >= before.value:
        return f"the gap on unseen {found.samples} is no smaller"
    return f"{_share(closed_share(before.value, after.value))} of the gap on unseen {found.samples} is closed"


def _share(share: float) -> str:
    """Return a share in words; what is not all is never said to be all."""
    percent = 100.0 * share
    return f"{percent:.0f} %" if percent < 99.0 or share >= 1.0 else f"{min(percent, 99.99):.4g} %"


def _rest(found: Findings) -> str:
    """Return how much of the gap is left above its floor, in words; nothing where it is at it."""
    after = found.added.after
    if after.at_floor or found.before.value <= 0.0:
        return ""
    if after.value <= after.floor:
        return f"; in {families_words(after.standing_out)} more is left than chance makes"
    left = 1.0 - closed_share(found.before.value, after.value)
    return f"; {_share(left)} of the gap is left unexplained"


def _broken(found: Findings) -> str:
    """Return a caution where what is left is so much that the pixels' own parameters are in doubt."""
    left = found.added.after.interval[0]
    if left < _BEYOND_A_FIT:
        return ""
    return (
        f"; what is left, {left:.2g} nats per sample at least, is so much that the fit itself breaks down: "
        "gain, bias, read noise and exposure of the pixels may be far off, and with them what is said of "
        "electrons"
    )


def _shown(found: Findings) -> str:
    """Return what one statistic shows still though the whole gap is at its floor, in words."""
    if not found.still or not found.added.after.at_floor:
        return ""
    pulls = found.last.pulls(found.z.both, splits=2)
    worst = int(np.argmax(np.abs(pulls)))
    name = found.last.names[worst]
    beside = "it" if len(found.named) == 1 else "them"
    return f"; beside {beside} {STATISTICS[name].says(float(pulls[worst]))} ({pulls[worst]:+.1f} sd)"


def _doubts(added: Added) -> str:
    """Return a caution where a placebo closes much of what a named effect does."""
    words = ""
    for each in added.additions:
        closed = each.before.value - each.after.value
        if each.named and each.placebo is not None and closed > 0.0:
            share = (each.before.value - max(each.placebo.gap_after, 0.0)) / closed
            if share > CONVINCING_PLACEBO:
                words += (
                    f"; {_title(each.placebo.effect)}, unrelated to {_title(each.effect.tag)}, would close "
                    f"{_share(min(share, 1.0))} of what that closes: take the name with caution"
                )
    return words


def _left(added: Added) -> str:
    """Return in words which codes are not accounted for, and what stands in for it."""
    first = "; ".join(place.sentence for place in added.residuals[:_MOST_RESIDUALS])
    words = f"; what is left: {first}" if first else ""
    if added.stand_ins:
        names = _and([_title(tag) for tag in added.stand_ins])
        words += f"; {names} would describe a part of it, but not on all codes alike, and is not named"
    return words


def _and(items: Sequence[str]) -> str:
    return ", ".join(items[:-1]) + (" and " if len(items) > 1 else "") + items[-1] if items else ""
