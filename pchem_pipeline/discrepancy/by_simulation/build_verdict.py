"""From the rounds of the search to the verdict: what is named, what is ambiguous, what stays unexplained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import Addition, gap_change, step_of
from pchem_pipeline.discrepancy.by_simulation.disagreement import Measured, contradicted, misfits
from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Hypothesis,
    Noise,
    SetFit,
    fit_set,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.naming import Choice, Contender
from pchem_pipeline.discrepancy.by_simulation.null import NullModel
from pchem_pipeline.discrepancy.gap import Gap, GapMetric
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.catalogue import VERSION as STATISTICS_VERSION
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.verdict import (
    Candidate,
    Change,
    Discrepancy,
    Examined,
    Place,
    Pull,
    Rival,
    State,
    Verdict,
)
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes

__all__ = ["Round", "tell"]

FloatArray = NDArray[np.float64]

_MOST_PULLS = 12
_CLEAR_MARGIN = 50.0  # nats
_MOST_UNEXPLAINED = 8
#: a named effect must leave less of the gap than this, or the rest must lie below the floor
_LARGEST_REST = 0.2


@dataclass(frozen=True)
class Round:
    """One round of naming and adding.

    Attributes:
        choice: what the comparison of the sets came to.
        added: the chosen set at refined strengths.
        hypotheses: all candidates of the round.
        null: of the model before it.
        grown: of the model after it.
        moved: change of the parameter maps by their refit with the effects.
    """

    choice: Choice
    added: SetFit
    hypotheses: tuple[Hypothesis, ...]
    null: NullModel
    grown: NullModel
    moved: Mapping[str, Mapping[str, Any]]


def tell(
    rounds: Sequence[Round],
    *,
    first: NullModel,
    last: NullModel,
    z: Measured,
    places: Sequence[Place],
    train: Evidence,
    maps: PixelMaps,
    model: tuple[Effect, ...],
    settings: DiscrepancySettings,
    still: bool,
    left_out: Mapping[str, str],
    n_replicates: int,
    examined: Examined,
    code_grown: FloatArray | None = None,
) -> Discrepancy:
    """Put the verdict together; see :class:`~pchem_pipeline.discrepancy.verdict.Discrepancy`."""
    n_samples = examined.final * int(train.maps.usable.sum())
    metric = GapMetric(first, n_samples)
    before = metric.gap(z.final, first.mean, first.replicates)
    after = metric.gap(z.final, last.mean, last.replicates)
    both = z.both
    pulls = first.pulls(both, splits=2), last.pulls(both, splits=2)
    unfinished = still and after.value > max(after.floor, _LARGEST_REST * before.value)
    additions = _additions(rounds, metric, z, settings, before, after, pulls[1] if unfinished else None)
    rest = [(name, float(pull)) for name, pull in zip(first.names, pulls[1], strict=True)]
    rest.sort(key=lambda item: -abs(item[1]))
    verdict = _verdict(additions, still, unfinished)
    named = {added.effect.tag for added in additions if added.named}
    tentative = {h.tag for r in rounds for h in r.added.hypotheses} - named
    kept = tuple(e for e in model if e.tag not in tentative)
    return Discrepancy(
        verdict=Verdict(
            verdict=verdict,
            sentence=_sentence(verdict, additions, before, after, places),
            effects=tuple(added.effect.tag for added in additions if added.named),
            model_effects=tuple(e.model_dump(mode="json") for e in kept),
            steps=tuple(step_of(added) for added in additions),
            gap=gap_change(before, after, grown=bool(additions)),
            where=tuple(places),
            unexplained=tuple(Place.of(name, z=z) for name, z in rest[:_MOST_UNEXPLAINED]) if still else (),
            untestable={tag: c.untestable for tag, c in effect_classes().items() if c.untestable},
            left_out=dict(left_out),
            examined=examined,
            p_global=Change(before=first.global_p(both, 2), after=last.global_p(both, 2)),
            replicates=n_replicates,
            versions={"statistics": STATISTICS_VERSION},
        ),
        model=kept,
        maps=maps,
        evidence=train,
        statistics=(first.names, pulls[0], pulls[1]),
        code_grown=code_grown,
    )


def _additions(
    rounds: Sequence[Round],
    metric: GapMetric,
    z: Measured,
    settings: DiscrepancySettings,
    before: Gap,
    after: Gap,
    rest: FloatArray | None,
) -> tuple[Addition, ...]:
    """Return the added effects, the weightiest of a round first.

    ``rest``: the pulls that remain at the end, where they are too many to call the model complete.
    """
    additions: list[Addition] = []
    mean = metric.null.mean
    gap = before
    for index, this in enumerate(rounds):
        shift = z.both - this.null.mean
        parts = this.added.parts
        order = np.argsort([-_weight(part, this.null) for part in parts])
        mean = this.null.mean
        for place, member in enumerate(order):
            mean = mean + parts[member]
            last_of_all = index == len(rounds) - 1 and place == len(order) - 1
            last_of_round = place == len(order) - 1
            if last_of_all:
                now = after
            elif last_of_round:
                now = metric.gap(z.final, this.grown.mean, this.grown.replicates)
            else:
                now = metric.gap(z.final, mean, this.null.replicates)
            closed = gap.value - now.value
            stands = rest is None or (
                closed > after.value and not contradicted(this.null, parts[member], rest)
            )
            additions.append(_addition(this, int(member), metric, z, shift, gap, now, settings, stands))
            gap = now
    return tuple(additions)


def _weight(part: FloatArray, null: NullModel) -> float:
    return float(np.sum((part / null.std) ** 2))


def _addition(
    this: Round,
    member: int,
    metric: GapMetric,
    z: Measured,
    shift: FloatArray,
    before: Gap,
    after: Gap,
    settings: DiscrepancySettings,
    stands: bool,
) -> Addition:
    added = this.added.hypotheses[member]
    rivals = this.choice.rivals_of(added.tag)
    others = [h for i, h in enumerate(this.added.hypotheses) if i != member]
    kept = _ambiguous_set(rivals, settings.certainty)
    parts = this.added.parts
    allowed = tolerance(parts, settings.model_error)
    fits = stands and not misfits(this.grown, z, parts[member], settings.significance, allowed)
    named = len(kept) == 1 and fits
    compared = [
        (added.effect if r.hypothesis.tag == added.tag else r.hypothesis.effect, r)
        for r in (rivals if named else kept)
    ]

    def gap_with(hypothesis: Hypothesis) -> Rival:
        noise = Noise(this.null.covariance / 2.0, settings.model_error)
        fit = fit_set([*others, hypothesis], shift, noise)
        mean = this.null.mean + fit.parts.sum(axis=0)
        gap = metric.gap(z.final, mean, this.null.replicates)
        return Rival(effect=hypothesis.tag, gap_after=gap.value)

    runner_up, placebo = _comparisons(this, added, rivals)
    pull_before = (z.final - this.null.mean) / this.null.std
    pull_after = (z.final - this.null.mean - this.added.parts.sum(axis=0)) / this.null.std
    telling = np.argsort(-np.abs(added.fingerprint / this.null.std))[:_MOST_PULLS]
    factor_error = float(this.added.stderr[member])
    value = (
        getattr(added.effect, added.effect.strength, float("nan")) if added.effect.strength else float("nan")
    )
    return Addition(
        effect=added.effect if named else compared[0][0],
        alone=len(kept) == 1,
        fits=fits,
        candidates=tuple(Candidate.of(e, r.score, r.stderr, r.probability) for e, r in compared),
        strength_stderr=abs(float(value)) * factor_error / added.effect.power,
        before=before,
        after=after,
        runner_up=None if runner_up is None else gap_with(runner_up),
        placebo=None if placebo is None else gap_with(placebo),
        pulls=tuple(
            Pull(
                statistic=this.null.names[i],
                sentence=STATISTICS[this.null.names[i]].sentence,
                before=float(pull_before[i]),
                after=float(pull_after[i]),
            )
            for i in telling
        ),
        moved=this.moved,
    )


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
        runner_up = next((h for s in this.choice.tried for h in s.hypotheses if h.tag not in in_set), None)
    placebo = next(
        (h for h in pool if h.tag not in relatives and added.tag not in type(h.effect).separate), None
    )
    return runner_up, placebo


def _verdict(additions: Sequence[Addition], still: bool, unfinished: bool) -> State:
    if not additions:
        return "unexplained" if still else "consistent"
    if unfinished or any(not added.fits for added in additions):
        return "unexplained"
    return "ambiguous" if any(not added.named for added in additions) else "named"


def _sentence(
    verdict: State, additions: Sequence[Addition], before: Gap, after: Gap, places: Sequence[Place]
) -> str:
    gaps = [1e6 * value for value in (before.value, max(after.value, 0.0), after.floor)]
    closed = "{:.3g} -> {:.3g} micronats per sample (floor {:.2g})".format(*gaps)
    titles = [type(a.effect).title or a.effect.tag for a in additions if a.named]
    if verdict == "consistent":
        return "The frames agree with the model in every statistic tested."
    if verdict == "named" and before.at_floor:
        limit = f"{1e6 * before.floor:.2g} micronats per sample"
        return f"The model was missing {_and(titles)}; on the final frames alone its gap is below {limit}."
    if verdict == "named":
        return f"The model was missing {_and(titles)}; with it the gap on unseen frames went {closed}."
    if verdict == "ambiguous":
        sets = [" or ".join(c.effect for c in a.candidates) for a in additions if not a.named]
        also = f"{_and(titles)} is missing, and " if titles else ""
        return f"The model lacks something that these frames cannot tell apart: {also}{_and(sets)}."
    lead = f" (largest in {places[0].statistic})" if places else ""
    doubtful = [a.candidates[0].effect for a in additions if not a.fits]
    nearest = f"; nearest known: {_and(doubtful)}" if doubtful else ""
    besides = f" besides {_and(titles)}" if titles else ""
    return f"The frames disagree with the model{lead}, and no known effect explains it{besides}{nearest}."


def _and(items: Sequence[str]) -> str:
    return ", ".join(items[:-1]) + (" and " if len(items) > 1 else "") + items[-1] if items else ""
