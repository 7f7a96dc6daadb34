"""The effects that rounds of simulation added: each with its gap, its rivals, and whether it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import Added, Addition, largest_pulls
from pchem_pipeline.discrepancy.by_simulation.comparison import Comparison
from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Contender,
    Hypothesis,
    Noise,
    SetFit,
    fit_set,
    tolerance,
)
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import Measured, NullModel, misfits
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.verdict import Candidate, Rival

__all__ = ["AddedRounds", "Round"]

FloatArray = NDArray[np.float64]

_CLEAR_MARGIN = 50.0  # nats
_REST_OF_NAMED = 0.1  # of the gap that an effect closes, the most that may be left where it gets a name
_LEFT = 4.0  # deviations that are left of a statistic
_MOVED = 2.0  # standard deviations by which an effect moves it


@dataclass(frozen=True)
class Round:
    """One round of naming and adding.

    Attributes:
        compared: the sets at their best fit.
        added: the new effects of the chosen one.
        hypotheses: all candidates of the round.
        null: of the model before it.
        extended: of the model after it.
        moved: change of the parameter maps by their refit with the effects.
    """

    compared: Comparison
    added: SetFit
    hypotheses: tuple[Hypothesis, ...]
    null: NullModel
    extended: NullModel
    moved: Mapping[str, Mapping[str, Any]]

    def updated(self, now: Mapping[str, Hypothesis], errors: Mapping[str, float]) -> Round:
        """Return it with its effects as a later round has fitted them anew, and relative standard errors."""
        new = tuple(now.get(h.tag, h) for h in self.added.hypotheses)
        old = zip(self.added.hypotheses, self.added.stderr, strict=True)
        stderr = np.array([errors.get(h.tag, error) for h, error in old])
        return replace(self, added=replace(self.added, hypotheses=new, stderr=stderr))


@dataclass(frozen=True)
class AddedRounds:
    """Measures what each effect of the rounds closed of the gap.

    Attributes:
        rounds: in their order.
        gaps: in the statistics of the model before the first.
        z: statistics of the data.
        settings: the section ``discrepancy``.
        allowed: relative error of what the effects do that is not held against them.
    """

    rounds: Sequence[Round]
    gaps: StatisticsGap
    z: Measured
    settings: DiscrepancySettings
    allowed: float

    def close(self, before: Gap, last: NullModel, still: bool) -> Added:
        """Return the added effects, the weightiest of a round first, and what is left.

        Args:
            before: gap of the model before the first round.
            last: null of the final model.
            still: whether the data disagree with that.
        """
        after = self.gaps.gap(self.z.final, last.mean, last.replicates)
        unfinished = not after.at_floor and (still or after.value > _REST_OF_NAMED * before.value)
        rest = self._rest(last) if unfinished and self.rounds else None
        additions: list[Addition] = []
        gap = before
        for index, this in enumerate(self.rounds):
            parts, mean = this.added.parts, this.null.mean
            order = np.argsort([-_weight(part, this.null) for part in parts])
            for place, member in enumerate(order):
                mean = mean + parts[member]
                if place < len(order) - 1:
                    now = self.gaps.gap(self.z.final, mean, this.null.replicates)
                elif index < len(self.rounds) - 1:
                    now = self.gaps.gap(self.z.final, this.extended.mean, this.extended.replicates)
                else:
                    now = after
                stands = rest is None or (
                    after.value < _REST_OF_NAMED * (gap.value - now.value)
                    and not _implicated(parts[member], rest, this.null)
                )
                additions.append(self._addition(this, int(member), (gap, now), stands))
                gap = now
        return Added(tuple(additions), after, unfinished)

    def _rest(self, last: NullModel) -> FloatArray:
        """Return what the final model leaves of each statistic, in what it may leave, shape (m,)."""
        allowed = tolerance(np.concatenate([this.added.parts for this in self.rounds]), self.allowed)
        chance = last.std * np.sqrt(0.5 + 1.0 / last.n_replicates)
        return np.asarray((self.z.both - last.mean) / np.hypot(chance, allowed))

    def _addition(self, this: Round, member: int, gaps: tuple[Gap, Gap], stands: bool) -> Addition:
        added, parts = this.added.hypotheses[member], this.added.parts
        rivals = this.compared.rivals_of(added.tag)
        kept = _ambiguous_set(rivals, self.settings.certainty)
        allowed = tolerance(parts, self.allowed)
        fits = stands and not misfits(
            this.extended, self.z, parts[member], self.settings.significance, allowed
        )
        named = len(kept) == 1 and fits
        described = type(added.effect).measured_only
        compared = [
            (added.effect if r.hypothesis.tag == added.tag else r.hypothesis.effect, r)
            for r in (rivals if named else kept)
        ]
        runner_up, placebo = _comparisons(this, added, rivals)
        off = self.z.final - this.null.mean
        return Addition(
            effect=added.effect if named else compared[0][0],
            alone=len(kept) == 1,
            fits=fits or described,
            described=described,
            candidates=tuple(Candidate.of(e, r.score, r.stderr, r.probability) for e, r in compared),
            strength_stderr=_stderr(added, float(this.added.stderr[member])),
            before=gaps[0],
            after=gaps[1],
            runner_up=self._in_place(this, member, runner_up),
            placebo=self._in_place(this, member, placebo),
            pulls=largest_pulls(
                this.null.names,
                added.fingerprint / this.null.std,
                off / this.null.std,
                (off - parts.sum(axis=0)) / this.null.std,
            ),
            moved=this.moved,
        )

    def _in_place(self, this: Round, member: int, rival: Hypothesis | None) -> Rival | None:
        """Return a rival fitted in the place of a member of the chosen set, with the gap that it leaves."""
        if rival is None:
            return None
        refitted = this.compared.with_rival(this.added.hypotheses[member].tag, rival.tag)
        if refitted is not None:
            gap = self.gaps.gap(self.z.final, refitted.mean, this.null.replicates)
            return Rival(effect=rival.tag, gap_after=gap.value)
        others = [h for i, h in enumerate(this.added.hypotheses) if i != member]
        noise = Noise(this.null.covariance / 2.0, self.settings.model_error)
        fit = fit_set([*others, rival], self.z.both - this.null.mean, noise)
        mean = this.null.mean + fit.parts.sum(axis=0)
        gap = self.gaps.gap(self.z.final, mean, this.null.replicates)
        return Rival(effect=rival.tag, gap_after=gap.value)


def _implicated(part: FloatArray, rest: FloatArray, null: NullModel) -> bool:
    """Tell whether an effect moves statistics that the whole model does not account for.

    Whatever is missing besides, it is then not known that this effect has the right name.
    """
    return bool(np.any((np.abs(rest) > _LEFT) & (np.abs(part) > _MOVED * null.std)))


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
    erratic = [r for r in rivals if type(r.hypothesis.effect).erratic and r.score > -_CLEAR_MARGIN]
    return kept + [r for r in erratic if r not in kept]


def _comparisons(
    this: Round, added: Hypothesis, rivals: Sequence[Contender]
) -> tuple[Hypothesis | None, Hypothesis | None]:
    """Return the runner-up, and a candidate that is no relative of the named effect, for a placebo."""
    runner_up = next((r.hypothesis for r in rivals if r.hypothesis.tag != added.tag), None)
    in_set = {h.tag for h in this.added.hypotheses}
    relatives = set(type(added.effect).separate)
    pool = [h for h in this.hypotheses if h.tag not in in_set]
    if runner_up is None:
        runner_up = next((h for s in this.compared.tried for h in s.hypotheses if h.tag not in in_set), None)
    placebo = next(
        (h for h in pool if h.tag not in relatives and added.tag not in type(h.effect).separate), None
    )
    return runner_up, placebo
