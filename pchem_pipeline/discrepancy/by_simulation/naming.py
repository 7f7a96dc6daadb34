"""Which effects explain the shift of the statistics: sets compared by what they predict on held-out frames.

Every set of up to three candidates is fitted on one split and scored on the other, both ways round. The
scores, less a price for every effect, give each set a probability; an effect is named where the sets that
hold it have nearly all of it, and what could as well stand in its place is listed with it where not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Hypothesis,
    Noise,
    SetFit,
    fit_set,
    log_density,
    tolerance,
)

__all__ = ["Choice", "Contender", "ScoredSet", "choose", "score_set", "seen_among"]

FloatArray = NDArray[np.float64]

_PRICE = 3.0  # nats for the first effect of a set: none is there unless something speaks for it
_PRICE_OF_MORE = 6.0  # nats for every further one
_LARGEST_SET = 3
_SHORTLIST = 9
_SMALLEST_FACTOR = 2.0  # standard errors: less of an effect is none
_SEEN = 3.5  # standard deviations by which some statistic must ask for an effect among others
_MOVED = 2.0  # standard deviations by which the effect itself must move it
_BLUR = 2.0  # model errors of the others that are added to chance there


@dataclass(frozen=True)
class ScoredSet:
    """A set of effects and how well it predicts.

    Attributes:
        fits: of the first and the second split.
        score: held-out log score of both directions, nats, relative to no effect.
    """

    fits: tuple[SetFit, SetFit]
    score: float

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The set."""
        return self.fits[0].hypotheses

    @property
    def tags(self) -> frozenset[str]:
        """Their tags."""
        return frozenset(h.tag for h in self.hypotheses)

    @property
    def worth(self) -> float:
        """Score less the price of its effects, nats."""
        return self.score - _PRICE - _PRICE_OF_MORE * (len(self.hypotheses) - 1)


@dataclass(frozen=True)
class Contender:
    """An effect that could stand in the place of a chosen one.

    Attributes:
        hypothesis: of the rival.
        score: log score of the best set with it in that place, relative to the chosen set, nats.
        stderr: of that score: how far the two predictions lie apart, nats.
        probability: of such sets among all.
    """

    hypothesis: Hypothesis
    score: float
    stderr: float
    probability: float


@dataclass(frozen=True)
class Choice:
    """What the comparison came to.

    Attributes:
        best: the likeliest set.
        rivals: for each of its effects, who could stand in its place, itself first.
        probability: of each of its effects.
        tried: all sets, the likeliest first.
        advantage: held-out log score of the best set over no effect at all, less its price, nats.
    """

    best: ScoredSet
    rivals: tuple[tuple[Contender, ...], ...]
    probability: tuple[float, ...]
    tried: tuple[ScoredSet, ...]
    advantage: float

    def present(self, certainty: float) -> tuple[Hypothesis, ...]:
        """Return the effects of the best set in whose place there is something, with that probability."""
        kept = tuple(
            hypothesis
            for hypothesis, rivals in zip(self.best.hypotheses, self.rivals, strict=True)
            if sum(rival.probability for rival in rivals) >= certainty
        )
        return kept or self.best.hypotheses[:1]

    def rivals_of(self, tag: str) -> tuple[Contender, ...]:
        """Return who could stand in the place of an effect of the best set."""
        tags = [h.tag for h in self.best.hypotheses]
        return self.rivals[tags.index(tag)]


def score_set(
    hypotheses: Sequence[Hypothesis], shifts: tuple[FloatArray, FloatArray], noise: Noise
) -> ScoredSet:
    """Fit a set on each split and score it on the other.

    Of effects that an exact count asks for, both splits have the strength of their mean: an event proves
    itself, and need not come again.
    """
    first, second = (fit_set(hypotheses, shift, noise) for shift in shifts)
    if (first.certain | second.certain).any():
        mean = fit_set(hypotheses, (shifts[0] + shifts[1]) / 2.0, noise)
        first, second = (
            replace(fit, factors=np.where(mean.certain, mean.factors, fit.factors)) for fit in (first, second)
        )
    return ScoredSet((first, second), first.log_score(shifts[1], noise) + second.log_score(shifts[0], noise))


def choose(
    hypotheses: Sequence[Hypothesis], shifts: tuple[FloatArray, FloatArray], noise: Noise
) -> Choice | None:
    """Compare all sets of up to three of the most promising hypotheses; None where none improves on nothing.

    Args:
        hypotheses: candidates; several may be of one effect.
        shifts: measured statistics minus null mean of the two splits, shape (m,) each.
        noise: covariance of a shift.
    """
    shortlist = _shortlist(hypotheses, shifts, noise)
    sets = []
    for size in range(1, _LARGEST_SET + 1):
        for members in itertools.combinations(shortlist, size):
            if len({h.tag for h in members}) == size:
                scored = score_set(members, shifts, noise)
                if _all_needed(scored, shifts, noise):
                    sets.append(scored)
    base = sum(log_density(shift, noise.covariance) for shift in shifts)
    sets = [s for s in sets if s.worth > base]
    if not sets:
        return None
    sets.sort(key=lambda s: s.worth, reverse=True)
    weights = np.exp([s.worth - sets[0].worth for s in sets])
    weights /= weights.sum() + np.exp(base - sets[0].worth)
    best = sets[0]
    rivals, probabilities = [], []
    for hypothesis in best.hypotheses:
        others = best.tags - {hypothesis.tag}
        probabilities.append(
            float(sum(w for s, w in zip(sets, weights, strict=True) if hypothesis.tag in s.tags))
        )
        rivals.append(_rivals(hypothesis, others, best, sets, weights, noise))
    return Choice(best, tuple(rivals), tuple(probabilities), tuple(sets), best.worth - base)


def _rivals(
    hypothesis: Hypothesis,
    others: frozenset[str],
    best: ScoredSet,
    sets: Sequence[ScoredSet],
    weights: FloatArray,
    noise: Noise,
) -> tuple[Contender, ...]:
    """Return what could stand in the place of a hypothesis of the best set, by probability."""
    found: dict[str, Contender] = {}
    for scored, weight in zip(sets, weights, strict=True):
        new = scored.tags - others
        if not new or (not others <= scored.tags and len(new) > len(best.tags)):
            continue
        for candidate in scored.hypotheses:
            if candidate.tag not in new:
                continue
            if hypothesis.tag in new and candidate.tag != hypothesis.tag:
                continue  # it joins the chosen one, it does not replace it
            if candidate.tag in found:
                old = found[candidate.tag]
                found[candidate.tag] = Contender(
                    old.hypothesis, old.score, old.stderr, old.probability + float(weight)
                )
            else:
                apart = math.hypot(
                    *(a.distance(b, noise) for a, b in zip(best.fits, scored.fits, strict=True))
                )
                found[candidate.tag] = Contender(candidate, scored.worth - best.worth, apart, float(weight))
    return tuple(sorted(found.values(), key=lambda r: (-r.probability, -r.score)))


def _shortlist(
    hypotheses: Sequence[Hypothesis], shifts: tuple[FloatArray, FloatArray], noise: Noise
) -> list[Hypothesis]:
    """Return the hypotheses that do best alone, and those that do best with the best ones."""
    chosen: list[Hypothesis] = []

    def take(count: int, others: Sequence[Hypothesis]) -> None:
        scored = []
        for hypothesis in hypotheses:
            if any(hypothesis is h for h in chosen) or hypothesis.tag in {h.tag for h in others}:
                continue
            scored.append((score_set([*others, hypothesis], shifts, noise).score, hypothesis))
        scored.sort(key=lambda pair: pair[0], reverse=True)
        chosen.extend(h for _, h in scored[:count])

    take(4, ())
    if chosen:
        best = chosen[0]
        take(3, (best,))
        second = max(
            (h for h in chosen if h.tag != best.tag),
            key=lambda h: score_set([best, h], shifts, noise).score,
            default=None,
        )
        if second is not None:
            take(_SHORTLIST - len(chosen), (best, second))
    return chosen


def _all_needed(scored: ScoredSet, shifts: tuple[FloatArray, FloatArray], noise: Noise) -> bool:
    """Tell whether every effect of the set is there by more than its error, and seen among the others.

    Seen means: some statistic deviates, in the direction of the effect, from what the others make of it.
    Where a strong effect moves a statistic, a weak one is not told from the details of the strong one; and
    one without a statistic of its own only helps out where others fit badly.
    """
    first, second = scored.fits
    factor = (first.factors + second.factors) / 2.0
    error = np.hypot(first.stderr, second.stderr) / 2.0
    there = factor > _SMALLEST_FACTOR * error
    if not np.all(there | first.certain | second.certain):
        return False
    parts = (first.parts + second.parts) / 2.0
    shift = (shifts[0] + shifts[1]) / 2.0
    both = replace(noise, covariance=noise.covariance / 2.0)
    return len(parts) == 1 or all(
        seen_among(part, np.delete(parts, member, axis=0), shift, both) for member, part in enumerate(parts)
    )


def seen_among(part: FloatArray, others: FloatArray, shift: FloatArray, noise: Noise) -> bool:
    """Tell whether a statistic deviates from what other effects make of it, in the direction of an effect.

    Args:
        part: what the effect does to the statistics, shape (m,).
        others: what the other effects do to them, shape (e, m).
        shift: what is seen of all, shape (m,).
        noise: of the shift.
    """
    blur = _BLUR * tolerance(others, noise.model_error)
    scale = np.sqrt(np.diag(noise.covariance) + blur**2)
    left, own = (shift - others.sum(axis=0)) / scale, part / scale
    return bool(np.any((np.abs(left) > _SEEN) & (np.abs(own) > _MOVED) & (left * own > 0.0)))
