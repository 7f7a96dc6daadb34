"""The model as rounds of a search add effects to it: each with its gap, its rivals, and whether it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import (
    LEAVES_TOO_MUCH,
    MOST_RIVALS,
    Added,
    Addition,
    largest_pulls,
)
from pchem_pipeline.discrepancy.by_simulation.acceptance import Acceptance
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    MOVED,
    STANDS_OUT,
    Hypothesis,
    Noise,
    fit_set,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.comparison import Comparison, Contender, unrelated
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, lesser
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import NullModel, misfits
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.verdict import Candidate, Rival, sigma_text
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect

FloatArray = NDArray[np.float64]

_CLEAR_MARGIN = 50.0  # nats
_OF_SIGNATURE = 0.1  # of what an effect does to all statistics, in a family where its signature stands
_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one
_AS_GOOD = 0.5  # of what an effect closes, from which on an unrelated one does about as well


@dataclass(frozen=True)
class Round:
    """One round of naming and adding.

    Attributes:
        compared: the sets at their best fit.
        added: the new effects of the chosen one, with what each has moved of the statistics.
        stderr: relative standard errors of their factors, shape (e,).
        hypotheses: all candidates of the round.
        null: of the model before it.
        extended: of the model after it.
        moved: change of the parameter maps by their refit with the effects.
        certain: whether the effects are beyond doubt; else they only leave nothing.
    """

    compared: Comparison
    added: tuple[Hypothesis, ...]
    stderr: FloatArray
    hypotheses: tuple[Hypothesis, ...]
    null: NullModel
    extended: NullModel
    moved: Mapping[str, Mapping[str, Any]]
    certain: bool = True

    @property
    def parts(self) -> FloatArray:
        """Shift of the statistics by each of them, shape (e, m)."""
        return np.array([h.fingerprint for h in self.added])

    def updated(self, now: Mapping[str, Hypothesis], errors: Mapping[str, float]) -> Round:
        """Return it with its effects as a later round has fitted them anew, and relative standard errors."""
        new = tuple(now.get(h.tag, h) for h in self.added)
        stderr = [errors.get(h.tag, error) for h, error in zip(self.added, self.stderr, strict=True)]
        return replace(self, added=new, stderr=np.array(stderr))


@dataclass
class ExtendedModel:
    """Effects, and how they came.

    Attributes:
        work: fits the pixels with them.
        first: null of the model before anything was added.
        given: effects that it had then.
        effects: those that it has now.
        rounds: in which the others were added.
        last: the set that was added last, at its best fit; None: nothing was.
    """

    work: Simulations
    first: NullModel
    given: tuple[Effect, ...]
    effects: tuple[Effect, ...]
    rounds: list[Round] = field(default_factory=list)
    last: Refitted | None = None

    @property
    def added(self) -> tuple[Hypothesis, ...]:
        """The effects of all rounds."""
        return tuple(h for this in self.rounds for h in this.added)

    @property
    def present(self) -> tuple[Effect, ...]:
        """The effects beside which those of the rounds are fitted."""
        return self._without(self.added)

    def _without(self, gone: tuple[Hypothesis, ...]) -> tuple[Effect, ...]:
        """Return its effects without some, whatever their strengths are now."""
        keys = {h.effect.key for h in gone}
        return tuple(e for e in self.effects if e.key not in keys)

    def put(
        self,
        found: Comparison,
        added: Refitted,
        hypotheses: tuple[Hypothesis, ...],
        null: NullModel,
        *,
        certain: bool = True,
    ) -> NullModel:
        """Put a set into the model, at the strengths to which its replicates correct it; return the null.

        Args:
            found: how it was chosen.
            added: the set with many replicates.
            hypotheses: all candidates of the round.
            null: of the model before it.
            certain: whether its effects are beyond doubt.
        """
        # within a standard error the steps end, too
        near = np.abs(added.change) < np.maximum(_NEAR, added.stderr)
        change = np.where(near, np.expm1(added.change), 0.0)
        try:
            corrected = self._take(added, change)
        except NotFittedError:  # a step too far
            change = np.zeros_like(change)
            corrected = self._take(added, change)
        self.last = added
        extended = NullModel.from_replicates(self.first.names, added.vectors, self.first)
        slopes = lesser(added.slopes, added.parts)
        extended = extended.shifted(np.sum(slopes * change[:, None], axis=0))
        fitted = np.array([bool(h.effect.strength) for h in added.hypotheses])
        extended = replace(extended, strengths=slopes * (added.stderr * fitted)[:, None])
        errors = dict(zip((h.tag for h in corrected), added.stderr, strict=True))
        now = {h.tag: h for h in corrected}
        self.rounds = [this.updated(now, errors) for this in self.rounds]
        before = {h.tag for h in self.added}
        new = tuple(h for h in corrected if h.tag not in before)
        stderr = np.array([errors[h.tag] for h in new])
        moved = self.work.mapped(self.effects).fit.moved
        self.rounds.append(Round(found, new, stderr, hypotheses, null, extended, moved, certain))
        return extended

    def put_measured(self, found: Refitted) -> NullModel:
        """Put what was measured into the model, without effects that are not beside it, and their rounds."""
        gone = {h.tag for h in self.added} - found.tags
        self.effects = self._without(tuple(h for h in self.added if h.tag in gone))
        changed = [i for i, this in enumerate(self.rounds) if gone & {h.tag for h in this.added}]
        self.rounds = self.rounds[: min(changed, default=len(self.rounds))]
        null = self.rounds[-1].extended if self.rounds else self.first
        return self.put(Comparison(found, (found,)), found, (), null)

    def _take(self, added: Refitted, change: FloatArray) -> tuple[Hypothesis, ...]:
        """Take a set into the model, its factors changed by shares, and return it.

        Raises:
            NotFittedError: no pixels can be fitted with that.
        """
        taken = tuple(h.times(1.0 + float(c)) for h, c in zip(added.hypotheses, change, strict=True))
        effects = along_chain(self._without(taken), [h.effect for h in taken])
        self.work.mapped(effects)
        self.effects = effects
        return taken


@dataclass(frozen=True)
class AddedRounds:
    """Measures what each effect of the rounds closed of the gap.

    Attributes:
        rounds: in their order.
        accept: measures gaps on the final frames, and says what is allowed to the details of effects.
    """

    rounds: Sequence[Round]
    accept: Acceptance

    @property
    def tolerance(self) -> FloatArray | float:
        """What is not held against their effects, (m,): a fraction of what they do."""
        if not self.rounds:
            return 0.0
        parts = np.concatenate([this.parts for this in self.rounds])
        return tolerance(parts, self.accept.allowed, self.accept.first.events)

    def left(self, last: NullModel) -> FloatArray:
        """Return what the model with them leaves of each statistic, in what it may leave, (m,)."""
        chance = last.std * np.sqrt(0.5 + 1.0 / last.n_replicates)
        return np.asarray((self.accept.z.both - last.mean) / np.hypot(chance, self.tolerance))

    def accounted(self, last: NullModel) -> tuple[Hypothesis, ...]:
        """Return the effects of which the model accounts for what they move."""
        rest = self.left(last)
        return tuple(
            h
            for this in self.rounds
            for h in this.added
            if not unexplained_of_its_own(h.fingerprint, rest, this.null)
        )

    def close(self, before: Gap, last: NullModel, still: bool) -> Added:
        """Return the added effects, the weightiest of a round first, and what is left.

        Args:
            before: gap of the model before the first round.
            last: null of the final model.
            still: whether the data disagree with that.
        """
        after = self.accept.gap(last)
        unfinished = not after.at_floor and (still or after.too_wide(before.value))
        rest = self.left(last) if unfinished and self.rounds else None
        additions: list[Addition] = []
        gap = before
        for index, this in enumerate(self.rounds):
            parts, mean = this.parts, this.null.mean
            of_round: list[Addition] = []
            order = np.argsort([-_weight(part, this.null) for part in parts])
            for place, member in enumerate(order):
                mean = mean + parts[member]
                if place < len(order) - 1:
                    now = self.accept.gap_at(mean, this.null.replicates)
                elif index < len(self.rounds) - 1:
                    now = self.accept.gap(this.extended)
                else:
                    now = after
                effect = this.added[member].effect
                against = (
                    "" if rest is None else unexplained_of_its_kind(effect, parts[member], rest, this.null)
                )
                if rest is not None and after.too_wide(gap.value - now.value):
                    against = LEAVES_TOO_MUCH
                against = against or self._against(this, int(member), still)
                later = parts[order[place + 1 :]].sum(axis=0)
                of_round.append(self._addition(this, int(member), (gap, now), against, later))
                gap = now
            additions += without_company(of_round)
        if still and len(additions) == 1:
            additions = [without_better_reason(additions[0])]
        return Added(tuple(additions), after, unfinished)

    def _against(self, this: Round, member: int, still: bool) -> str:
        """Return in words why an effect is not in the data, whatever is there besides; empty: nothing.

        A parameter that can go no further was driven there by another effect; and at its best fit an effect
        accounts for all that it moves. That is asked where the data disagree with the whole model: one that
        agrees, with every effect in it, is not judged a second time by fewer statistics.
        """
        added, parts = this.added[member], this.parts
        allowed = tolerance(parts, self.accept.allowed, this.null.events)
        significance = self.accept.settings.significance
        wrong = still and misfits(this.extended, self.accept.z, parts[member], significance, allowed)
        return added.effect.stuck_words() or (
            "it does not fit the statistics that it changes most" if wrong else ""
        )

    def _addition(
        self, this: Round, member: int, gaps: tuple[Gap, Gap], against: str, later: FloatArray
    ) -> Addition:
        """Return an effect of a round; ``later`` is what those of it do that come after, shape (m,)."""
        added = this.added[member]
        rivals = this.compared.rivals_of(added.tag)
        kept = _ambiguous_set(rivals, self.accept.settings.certainty)
        described = type(added.effect).empirical
        against = "" if described else against
        named = len(kept) == 1 and not against and not described
        compared = [
            (added.effect if r.hypothesis.tag == added.tag else r.hypothesis.effect, r)
            for r in (rivals if named else kept)
        ]
        others = self._others(this, member)
        ranked = others[:MOST_RIVALS]
        placebo = next((o for o in others[1:] if o.closes and unrelated(o.effect, added.effect)), None)
        return Addition(
            effect=added.effect if named else compared[0][0],
            alone=len(kept) == 1,
            against=against,
            described=described,
            candidates=tuple(Candidate.of(e, r.score, r.stderr, r.probability) for e, r in compared),
            strength_stderr=_stderr(added, float(this.stderr[member])),
            before=gaps[0],
            after=gaps[1],
            rivals=tuple(self._rival(this, one, later) for one in ranked),
            placebo=None if placebo is None else self._rival(this, placebo, later),
            pulls=largest_pulls(
                this.null.names,
                added.fingerprint / this.null.std,
                this.null.pulls(self.accept.z.both, 2),
                this.extended.pulls(self.accept.z.both, 2),
            ),
            moved=this.moved,
            certain=this.certain,
        )

    def _others(self, this: Round, member: int) -> list[_Other]:
        """Return all that could stand in the place of a member of the chosen set, the best first."""
        compared, added = this.compared, this.added[member]
        kept = [h for h in this.added if h is not added]
        found: dict[str, _Other] = {}
        for one in compared.tried:
            new = one.tags - compared.chosen.tags
            if len(new) == 1 and one.tags == (compared.chosen.tags - {added.tag}) | new:
                hypothesis = next(h for h in one.hypotheses if h.tag in new)
                behind, error = compared.by_histograms.get(
                    one.tags, (one.score - compared.chosen.score, None)
                )
                other = _Other(hypothesis.effect, behind, one.mean, one.rest, True, error)
                found.setdefault(hypothesis.tag, other)
        noise = Noise(this.null.covariance.times(0.5), self.accept.settings.model_error)
        shift = self.accept.z.both - this.null.mean
        best = fit_set(this.added, shift, noise).log_score(shift, noise)
        refitted = {*compared.chosen.tags, *found}
        for hypothesis in this.hypotheses:
            if hypothesis.tag in refitted or hypothesis.effect.tag == added.effect.tag:
                continue
            fit = fit_set([*kept, hypothesis], shift, noise)
            mean = this.null.mean + fit.parts.sum(axis=0)
            rest = (self.accept.z.both - mean) / np.sqrt(noise.of(fit.parts).variances)
            behind = fit.log_score(shift, noise) - best
            if hypothesis.tag not in found or behind > found[hypothesis.tag].behind:
                closes = bool(fit.factors[-1] > 0.0)
                found[hypothesis.tag] = _Other(hypothesis.effect, behind, mean, rest, closes)
        return sorted(found.values(), key=lambda other: -other.behind)

    def _rival(self, this: Round, other: _Other, later: FloatArray) -> Rival:
        """Return a rival with the gap that it leaves, and the statistic that speaks most against it.

        It was fitted beside all others of the round; its gap stands beside that of the effect in whose place
        it is, which is measured without those that come later.
        """
        gap = self.accept.gap_at(other.mean - later, this.null.replicates)
        worst = int(np.argmax(np.abs(other.rest)))
        if not other.closes:
            why = "it explains nothing at any strength"
        elif abs(other.rest[worst]) > STANDS_OUT:
            # in the unit of all other pulls
            left = this.null.shifted(other.mean - this.null.mean).pulls(self.accept.z.both, 2)[worst]
            says = STATISTICS[this.null.names[worst]].says(left)
            why = f"it leaves a misfit of {sigma_text(left)}: {says}"
        elif other.error is not None:
            why = f"it fits the pixel histograms worse, by {-other.behind:.1f} +- {other.error:.1f}"
        else:
            why = "it fits all statistics together worse"
        return Rival(effect=other.effect.tag, gap_after=gap.value, behind=other.behind, why=why)


@dataclass(frozen=True)
class _Other:
    """An effect fitted in the place of a chosen one.

    Attributes:
        effect: at its best strength.
        behind: its log score against the chosen set, nats.
        mean: statistics of the model with it, shape (m,).
        rest: what is left of the data, in its errors, shape (m,).
        closes: whether a strength above 0 explains anything.
        error: of ``behind`` where the histograms of the pixels say it, nats; None: all statistics do.
    """

    effect: Effect
    behind: float
    mean: FloatArray
    rest: FloatArray
    closes: bool
    error: float | None = None


def without_better_reason(addition: Addition) -> Addition:
    """Take the name from the only effect found if an unrelated one closes as much, or not much less.

    Asked where the data disagree with the model all the same: both merely mimic what it is.
    """
    closed, placebo = addition.before.value - addition.after.value, addition.placebo
    if addition.described or not addition.fits or placebo is None or closed <= 0.0:
        return addition
    share = (addition.before.value - max(placebo.gap_after, 0.0)) / closed
    if share <= _AS_GOOD:
        return addition
    return replace(addition, against="an unrelated control explains nearly as much")


def without_company(additions: Sequence[Addition]) -> list[Addition]:
    """Take the names from effects that were fitted beside one which moves more and does not fit.

    Args:
        additions: of a round, the weightiest first.
    """
    mimics = [i for i, each in enumerate(additions) if each.against]
    first = mimics[0] if mimics else len(additions)
    return [
        replace(each, against="it was fitted together with a larger effect that is rejected")
        if i > first and each.fits and not each.described
        else each
        for i, each in enumerate(additions)
    ]


def unexplained_of_its_own(part: FloatArray, rest: FloatArray, null: NullModel) -> str:
    """Return in words what the whole model does not account for of what an effect moves; empty: nothing.

    Args:
        part: by how much the effect moves the statistics, shape (m,).
        rest: what the model leaves of them, in what it may leave, shape (m,).
        null: of the model before it.
    """
    return _worst_words(np.abs(part) > MOVED * null.std, rest, null)


def unexplained_of_its_kind(effect: Effect, part: FloatArray, rest: FloatArray, null: NullModel) -> str:
    """Return the same of all in the families in which the signature of the effect stands and in its place.

    What is missing there may be what makes its signature as well, and then this is not its name.
    """
    place = "@" + Part(effect.region, effect.when).text
    beside = np.array([not effect.everywhere and name.endswith(place) for name in null.names])
    weight = (part / null.std) ** 2
    families = np.array([STATISTICS[name].family for name in null.names])
    own = [f for f in set(families) if weight[families == f].sum() > _OF_SIGNATURE * weight.sum()]
    return _worst_words(np.isin(families, own) | beside | (weight > MOVED**2), rest, null)


def _worst_words(looked_at: NDArray[np.bool_], rest: FloatArray, null: NullModel) -> str:
    left = np.where(looked_at, np.abs(rest), 0.0)
    worst = int(np.argmax(left))
    if left[worst] <= STANDS_OUT:
        return ""
    return f"it leaves a misfit: {STATISTICS[null.names[worst]].says(float(rest[worst]))}"


def _weight(part: FloatArray, null: NullModel) -> float:
    return float(np.sum((part / null.std) ** 2))


def _stderr(added: Hypothesis, factor_error: float) -> float:
    """Return the standard error of the strength, given that of the factor of the fingerprint."""
    strength = added.effect.strength
    value = float(getattr(added.effect, strength, float("nan"))) if strength else float("nan")
    return abs(value) * factor_error / added.effect.power


def _ambiguous_set(rivals: Sequence[Contender], certainty: float) -> list[Contender]:
    """Return the likeliest rivals that together have the wanted share of what all have."""
    total = sum(r.probability for r in rivals)
    kept: list[Contender] = []
    share = 0.0
    for rival in rivals:
        kept.append(rival)
        share += rival.probability / total
        if share >= certainty:
            break
    # what goes its own way in every simulation is not beaten by a few nats
    erratic = [r for r in rivals if type(r.hypothesis.effect).random_realisation and r.score > -_CLEAR_MARGIN]
    return kept + [r for r in erratic if r not in kept]
