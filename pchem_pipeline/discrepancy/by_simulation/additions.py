"""Effects that a search adds to the model: each with its gap, its rivals, and whether it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.build_verdict import (
    LEAVES_TOO_MUCH,
    MOST_RIVALS,
    Added,
    Addition,
    largest_pulls,
)
from pchem_pipeline.discrepancy.by_simulation.acceptance import Acceptance
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    Hypothesis,
    Noise,
    fit_set,
    lesser,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted
from pchem_pipeline.discrepancy.by_simulation.sets.rivals import Comparison, Contender
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.verdict import Candidate, Moved, Rival, sigma_text
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN, POSSIBLE

_CLEAR_MARGIN = 50.0  # nats
_OF_SIGNATURE = 0.1  # of what an effect does to all statistics, in a family where its signature stands
_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one


@dataclass(frozen=True)
class Extension:
    """Effects that a search adds to the model.

    Attributes:
        compared: the sets at their best fit.
        added: the effects of the chosen one, with what each has moved of the statistics.
        stderr: standard errors of their parameters, of those that have one.
        hypotheses: all candidates.
        last: null of the model with them.
        moved: change of the parameter maps by their refit with the effects.
        certain: whether the effects are beyond doubt; else they only leave nothing.
        accept: measures gaps on the final frames, and says what is allowed to the details of effects.
        model: with them.
    """

    compared: Comparison
    added: tuple[Hypothesis, ...]
    stderr: tuple[Mapping[str, float], ...]
    hypotheses: tuple[Hypothesis, ...]
    last: NullModel
    moved: Mapping[str, Moved]
    certain: bool
    accept: Acceptance
    model: tuple[Effect, ...]

    @classmethod
    def of(
        cls,
        work: Simulations,
        given: tuple[Effect, ...],
        accept: Acceptance,
        compared: Comparison,
        added: Refitted,
        stderr: Sequence[Mapping[str, float]],
        hypotheses: tuple[Hypothesis, ...],
        certain: bool,
    ) -> Extension:
        """Put a set with many replicates into a model, at the strengths to which these correct it."""
        # within a standard error the steps end, too
        near = np.abs(added.change) < np.maximum(_NEAR, added.stderr)
        change = np.where(near, np.expm1(added.change), 0.0)
        try:
            taken = tuple(h.times(1.0 + float(c)) for h, c in zip(added.hypotheses, change, strict=True))
            model = along_chain(given, [h.effect for h in taken])
            moved = work.mapped(model).fit.moved
        except NotFittedError:  # a step too far
            change, taken = np.zeros_like(change), added.hypotheses
            model = along_chain(given, added.effects)
            moved = work.mapped(model).fit.moved
        last = NullModel.from_replicates(accept.first.names, added.vectors, accept.first)
        slopes = lesser(added.slopes, added.parts)
        last = last.shifted(np.sum(slopes * change[:, None], axis=0))
        fitted = np.array([bool(h.effect.strength) for h in added.hypotheses])
        last = replace(last, strengths=slopes * (added.stderr * fitted)[:, None])
        return cls(compared, taken, tuple(stderr), hypotheses, last, moved, certain, accept, model)

    @property
    def parts(self) -> FloatArray:
        """Shift of the statistics by each of them, shape (e, m)."""
        return np.array([h.fingerprint for h in self.added])

    @property
    def tolerance(self) -> FloatArray:
        """What is not held against their effects, (m,): a fraction of what they do."""
        return tolerance(self.parts, self.accept.allowed, self.accept.first.events)

    def _left(self) -> FloatArray:
        """Return what the model with them leaves of each statistic, in what it may leave, (m,)."""
        chance = self.last.std * np.sqrt(0.5 + 1.0 / self.last.n_replicates)
        return np.asarray((self.accept.z.both - self.last.mean) / np.hypot(chance, self.tolerance))

    def close(self, before: Gap, still: bool) -> Added:
        """Return the added effects, the weightiest first; ``still``: data and final model disagree."""
        after = self.accept.gap(self.last)
        unfinished = not after.at_floor and (still or after.too_wide(before.value))
        rest = self._left() if unfinished else None
        additions: list[Addition] = []
        gap, parts, mean = before, self.parts, self.accept.first.mean
        order = np.argsort(-np.sum((parts / self.accept.first.std) ** 2, axis=1))
        for place, member in enumerate(order):
            mean = mean + parts[member]
            last = place == len(order) - 1
            now = after if last else self.accept.gap_at(mean, self.accept.first.replicates)
            against = ""
            if rest is not None and after.too_wide(gap.value - now.value):
                against = LEAVES_TOO_MUCH
            elif rest is not None:
                effect = self.added[member].effect
                against = unexplained_of_its_kind(effect, parts[member], rest, self.accept.first)
            against = against or self.added[member].effect.stuck_words()
            later = parts[order[place + 1 :]].sum(axis=0)
            additions.append(self._addition(int(member), (gap, now), against, later))
            gap = now
        return Added(tuple(without_company(additions)), after, unfinished)

    def _addition(self, member: int, gaps: tuple[Gap, Gap], against: str, later: FloatArray) -> Addition:
        """Return an added effect; ``later`` is what those do that come after, shape (m,)."""
        added = self.added[member]
        rivals = self.compared.rivals_of(added)
        kept = _ambiguous_set(rivals, self.accept.settings.certainty)
        described = type(added.effect).empirical
        against = "" if described else against
        named = len(kept) == 1 and not against and not described
        return Addition(
            effect=kept[0].effect,
            alone=len(kept) == 1,
            against=against,
            described=described,
            candidates=tuple(
                Candidate.of(r.effect, r.score, r.stderr, r.probability) for r in (rivals if named else kept)
            ),
            stderr=self.stderr[member],
            before=gaps[0],
            after=gaps[1],
            rivals=tuple(self._rival(one, later) for one in self._others(member)[:MOST_RIVALS]),
            pulls=largest_pulls(
                self.accept.first.names,
                added.fingerprint / self.accept.first.std,
                self.accept.first.pulls(self.accept.z.both, 2),
                self.last.pulls(self.accept.z.both, 2),
            ),
            moved=self.moved,
            certain=self.certain,
        )

    def _others(self, member: int) -> list[_Other]:
        """Return the other effects that could stand in the place of one of the set, the best first."""
        compared, added = self.compared, self.added[member]
        own = {h.effect.tag for h in self.added}
        kept = [h for h in self.added if h is not added]
        found: dict[str, _Other] = {}
        for name, (effect, one) in compared.exchanged(added).items():
            if name != added.tag:
                by_score = one.score - compared.chosen.score, None
                behind, error = compared.by_histograms.get(one.tags, by_score)
                found[name] = _Other(effect, behind, one.mean, one.rest, True, error)
        noise = Noise(self.accept.first.covariance.times(0.5), self.accept.settings.model_error)
        shift = self.accept.z.both - self.accept.first.mean
        best = fit_set(self.added, shift, noise).log_score(shift, noise)
        refitted = {*compared.chosen.tags, *found}
        for hypothesis in self.hypotheses:
            if hypothesis.tag in refitted or hypothesis.effect.tag in own:
                continue
            fit = fit_set([*kept, hypothesis], shift, noise)
            mean = self.accept.first.mean + fit.parts.sum(axis=0)
            left = self.accept.z.both - mean
            rest = left / np.sqrt(noise.of(fit.parts, left).variances)
            behind = fit.log_score(shift, noise) - best
            if hypothesis.tag not in found or behind > found[hypothesis.tag].behind:
                closes = bool(fit.factors[-1] > 0.0)
                found[hypothesis.tag] = _Other(hypothesis.effect, behind, mean, rest, closes)
        ranked = sorted(found.values(), key=lambda other: other.behind)
        likeliest = {other.effect.tag: other for other in ranked if other.effect.tag not in own}
        return sorted(likeliest.values(), key=lambda other: -other.behind)

    def _rival(self, other: _Other, later: FloatArray) -> Rival:
        """Return a rival with its gap without ``later`` effects, and what speaks against it."""
        gap = self.accept.gap_at(other.mean - later, self.accept.first.replicates)
        worst = int(np.argmax(np.abs(other.rest)))
        if not other.closes:
            why = "it explains nothing at any strength"
        elif abs(other.rest[worst]) > CERTAIN:
            left = float(other.rest[worst])
            says = STATISTICS[self.accept.first.names[worst]].says(left)
            why = f"it leaves a deviation of {sigma_text(left)}: {says}"
        elif other.error is not None:
            why = f"it fits the pixel histograms worse, by {-other.behind:.1f} ± {other.error:.1f} nats"
        else:
            why = "it fits all statistics together worse"
        return Rival(effect=other.effect.tag, gap_after=gap.value, behind=other.behind, why=why)


@dataclass(frozen=True)
class _Other:
    """An effect fitted in the place of a chosen one.

    Attributes:
        behind: its log score against the chosen set, nats.
        mean: statistics of the model with it, shape (m,).
        rest: what is left of the data, in its errors, shape (m,).
        closes: whether a strength above 0 explains anything.
        error: of ``behind`` if that is by the histograms of the pixels, nats; None: by all statistics.
    """

    effect: Effect
    behind: float
    mean: FloatArray
    rest: FloatArray
    closes: bool
    error: float | None = None


def without_company(additions: Sequence[Addition]) -> list[Addition]:
    """Take the names from effects, the weightiest first, after one which does not fit or has no name."""
    nameless = [i for i, each in enumerate(additions) if each.against or each.described]
    first = nameless[0] if nameless else len(additions)
    return [
        replace(each, against="it was fitted together with a larger effect that is rejected or has no name")
        if i > first and each.fits and not each.described
        else each
        for i, each in enumerate(additions)
    ]


def unexplained_of_its_kind(effect: Effect, part: FloatArray, rest: FloatArray, null: NullModel) -> str:
    """Say what a model leaves in the families of an effect's signature, in its place, or of what it moves.

    Empty if that is nothing.

    Args:
        effect: an effect.
        part: by how much it moves the statistics, shape (m,).
        rest: what the model leaves of them, in what it may leave, shape (m,).
        null: of the model before it.
    """
    place = "@" + Part(effect.region, effect.when).text
    beside = np.array([not effect.everywhere and name.endswith(place) for name in null.names])
    weight = (part / null.std) ** 2
    families = np.array([STATISTICS[name].family for name in null.names])
    own = [f for f in set(families) if weight[families == f].sum() > _OF_SIGNATURE * weight.sum()]
    left = np.where(np.isin(families, own) | beside | (weight > POSSIBLE**2), np.abs(rest), 0.0)
    worst = int(np.argmax(left))
    if left[worst] <= CERTAIN:
        return ""
    return f"it leaves a deviation: {STATISTICS[null.names[worst]].says(float(rest[worst]))}"


def _ambiguous_set(rivals: Sequence[Contender], certainty: float) -> list[Contender]:
    """Return the likeliest rivals that together have a share of the probability."""
    total = sum(r.probability for r in rivals)
    kept: list[Contender] = []
    share = 0.0
    for rival in rivals:
        kept.append(rival)
        share += rival.probability / total
        if share >= certainty:
            break
    # what differs from simulation to simulation is not beaten by a few nats
    erratic = [r for r in rivals if type(r.effect).random_realisation and r.score > -_CLEAR_MARGIN]
    return kept + [r for r in erratic if r not in kept]
