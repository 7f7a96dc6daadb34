"""Which set of effects is in the data, compared after the best fit of each.

The fingerprints (:mod:`pchem_pipeline.discrepancy.by_simulation.candidates`) say which sets are worth it.
One effect that leaves nothing beyond chance after its best fit is all there is; only where every single one
leaves something are sets of several compared, and each of their effects must have a signature of its own:
statistics that the others, at their best fit, do not account for and do not touch, or at least do not account
for where the set leaves nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.by_simulation.candidates.details import has_numbers
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    FAR,
    Choice,
    Hypothesis,
    ScoredSet,
    firsts,
    fit_set,
    meets_itself,
    seen_among,
    share_place,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    MOST_STARTS,
    HistogramLikelihood,
    note_defect,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Refitter, is_expensive
from pchem_pipeline.discrepancy.by_simulation.sets.trials import (
    LOOSE,
    PENALISED,
    Trials,
    alike,
    same_kinds,
)
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR

FloatArray = NDArray[np.float64]

_MOST_SINGLES = 7
_MOST_SETS = 5
# sets that others are grown from, and share of what the best one explains within which another one is as good
# a seed; how many of these sets are refitted, by how many effects they have besides
_MOST_SEEDS, _REACH_SHARE = 2, 0.05
_MOST_GROWN = {1: 2, 2: 1}
_UNTOUCHED = 0.5  # of that, the most by which the others may move it


@dataclass(frozen=True)
class Contender:
    """An effect that could stand in the place of a chosen one.

    Attributes:
        hypothesis: of the rival.
        score: log score of the best set with it in that place, relative to the chosen set, nats.
        stderr: of that score: how far the two predictions lie apart, nats.
        probability: among all that could stand there.
    """

    hypothesis: Hypothesis
    score: float
    stderr: float
    probability: float


@dataclass(frozen=True)
class Comparison:
    """Sets at their best fit.

    Attributes:
        chosen: the best.
        tried: all, the best first.
        by_histograms: by their tags, how far other sets are behind the chosen one by the likelihood of the
            pixels' histograms, nats, and the error of that.
    """

    chosen: Refitted
    tried: tuple[Refitted, ...]
    by_histograms: Mapping[frozenset[str], tuple[float, float]] = field(default_factory=dict)

    def rivals_of(self, tag: str) -> tuple[Contender, ...]:
        """Return what could stand in the place of an effect of the chosen set, itself first."""
        others = self.chosen.tags - {tag}
        found: dict[str, Contender] = {}
        for one in self.tried:
            new = one.tags - others
            if not others <= one.tags or len(new) != 1 or new & found.keys():
                continue
            [name] = new
            hypothesis = next(h for h in one.hypotheses if h.tag == name)
            if name != tag and hypothesis.effect.tag == tag.partition(" ")[0]:
                continue  # the same effect elsewhere
            if name != tag and type(hypothesis.effect).empirical:
                continue  # what has no name is no rival of a name
            if one.tags in self.by_histograms:
                behind, error = self.by_histograms[one.tags]
                # neither need be the very law of the samples
                probability = float(special.ndtr(behind / max(error, 1e-9)))
            else:
                behind = one.penalised_log_likelihood - self.chosen.penalised_log_likelihood
                error = _apart(one, self.chosen)
                probability = float(np.exp(min(behind, 0.0)))
            found[name] = Contender(hypothesis, behind, error, probability)
        total = sum(c.probability for c in found.values())
        shared = [replace(c, probability=c.probability / total) for c in found.values()]
        return tuple(sorted(shared, key=lambda c: (-c.probability, -c.score)))


def compare(
    trials: Trials,
    hypotheses: Sequence[Hypothesis],
    choice: Choice,
    beside: Callable[[Refitted], Choice] = lambda _: Choice(),
    measured: Callable[[tuple[Hypothesis, ...]], Iterable[Refitted]] = lambda _: (),
    steps: int = 3,
) -> None:
    """Refit single effects, then sets that grow and shrink, as long as the best one becomes better.

    Forward selection by the penalised log-likelihood, with backward elimination. What is measured without a
    name is a member as any other, at the price of its parts; it is asked for where the best set leaves
    something, or costs more than it would.

    Args:
        trials: refits sets; out: all that were tried.
        hypotheses: all, the likeliest first.
        choice: how their sets compare by fingerprints.
        beside: compares new hypotheses by what they do beside a refitted set.
        measured: measures what effects leave, and yields them with it at their best fit.
        steps: the most by which a set grows.
    """
    beside = functools.cache(beside)
    singles = trials.likelihood.ranked(_singles(hypotheses, choice)) if choice.tried else []
    first = len(choice.best)
    # what the likeliest set is made of, then that set: it may leave no others worth a refit
    for hypothesis in _expensive_last(singles[:first]):
        trials.refit((hypothesis,))
    if first > 1 and trials.tried and not trials.complete:
        trials.refit_set(_sets(choice, trials.tried)[0])
    trials.measure(measured)
    # the others, expensive ones last: they may be beaten by then
    for hypothesis in _expensive_last(singles[first:]):
        trials.refit((hypothesis,))
    trials.tune()
    for _ in range(steps):
        before = trials.best if trials.tried else None
        trials.measure(measured)
        if not trials.tried or trials.complete or trials.limit:
            return
        sets = [*_grown(trials, beside), *_sets(choice, trials.tried)]
        for members in _of_different_effects(sets)[:_MOST_SETS]:
            if not trials.refit_set(members):
                break
        trials.tune()
        if trials.best is before:
            return


def chosen(trials: Trials, hypotheses: Sequence[Hypothesis]) -> Comparison | None:
    """Choose among the sets that were tried, and fit placebos in the place of its effects; None: none holds.

    The best of which each effect is seen, or where the statistics tell two sets badly apart the one by which
    the histograms of the pixels are likelier.
    """
    tried, likelihood = trials.tried, trials.likelihood
    best = _best_seen(trials.refitter, tried)
    if best is None:
        return None
    by_histograms = _by_histograms(best, tried, likelihood)
    other = max(tried, key=lambda one: by_histograms.get(one.tags, (0.0, 0.0))[0])
    if by_histograms.get(other.tags, (0.0, 0.0))[0] > 0.0 and _all_seen(trials.refitter, other, tried):
        best, by_histograms = other, _by_histograms(other, tried, likelihood)
    for member in best.hypotheses:
        if not type(member.effect).empirical:
            tried += _placebo(trials, hypotheses, best, member)
    return Comparison(best, tuple(tried), by_histograms)


def _expensive_last(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses, those last whose refit takes long."""
    return sorted(hypotheses, key=lambda h: is_expensive([h.effect]))


def _best_seen(refitter: Refitter, tried: list[Refitted]) -> Refitted | None:
    """Return the best set of which each effect is seen; sort all, and fit those that may be it to the end.

    Args:
        refitter: fits sets.
        tried: sets; out: the best first, at their best fit where that may be the best of all.
    """
    while True:
        tried[:] = refitter.ranked(tried)
        known = [*tried]
        found = next((one for one in tried if _all_seen(refitter, one, known)), None)
        if found is None:
            return None
        reach = found.promise - found.price
        short = [i for i, one in enumerate(tried) if one.short and one.promise - one.price >= reach]
        if not short:
            return found
        for i in short:
            tried[i] = refitter.refined(tried[i].hypotheses, found.score)


def _by_histograms(
    chosen: Refitted, tried: Sequence[Refitted], likelihood: HistogramLikelihood
) -> dict[frozenset[str], tuple[float, float]]:
    """Ask about the sets nearly as good as the chosen one that have another effect in the place of one."""
    found: dict[frozenset[str], tuple[float, float]] = {}
    for one in tried:
        swapped = len(one.tags - chosen.tags) == len(chosen.tags - one.tags) == 1
        near = abs(one.penalised_log_likelihood - chosen.penalised_log_likelihood) < FAR
        if swapped and near and one.tags not in found:
            answer = likelihood.behind(one.effects, chosen.effects)
            if answer is not None:
                found[one.tags] = answer
    return found


def unrelated(one: Effect, other: Effect) -> bool:
    """Tell whether neither of two effects is known to be confused with the other."""
    known = other.tag in type(one).separate or one.tag in type(other).separate
    return not known and one.tag != other.tag


def _placebo(
    trials: Trials, hypotheses: Sequence[Hypothesis], chosen: Refitted, member: Hypothesis
) -> list[Refitted]:
    """Return the refit of the best unrelated effect in the place of a member, unless there is one.

    Of all that have nothing to do with it, the one whose fingerprint would explain most: one that cannot
    close anything, whatever its strength, proves nothing about the name.
    """
    refitter, others = trials.refitter, [h for h in chosen.hypotheses if h.tag != member.tag]
    kept = {h.tag for h in others}
    pool = [
        h
        for h in hypotheses
        if h.tag not in chosen.tags
        and unrelated(h.effect, member.effect)
        and not is_expensive([h.effect])
        and not share_place(other.effect for other in (*others, h))
    ]
    if any(one.tags == kept | {h.tag} for one in trials.tried for h in pool):
        return []
    noise = refitter.noise(refitter.null.covariance, refitter.null.n_replicates)
    shift = refitter.target - refitter.null.mean
    fits = [fit_set([*others, h], shift, noise) for h in pool]
    closing = [(fit.log_score(shift, noise), i) for i, fit in enumerate(fits) if fit.factors[-1] > 0.0]
    if not closing:
        return []
    index = max(closing)[1]
    best = pool[index].times(float(fits[index].factors[-1]))
    try:
        # at the strength that its fingerprint asks for: it is not to win
        return [replace(refitter, steps=0).refined((*others, best))]
    # at the limit of the work its fingerprint must do
    except (NotFittedError, EffortSpentError):
        return []
    # whatever a stranger's effect raises must not stop the others
    except Exception as error:
        note_defect(refitter.defects, best.tag, error)
        return []


def own_signature(own: FloatArray, others: FloatArray, left: FloatArray, noise: FloatArray) -> bool:
    """Tell whether an effect has statistics of its own: left by the others, untouched by them, and explained.

    Args:
        own: what the effect does, shape (m,).
        others: what the others do, shape (e, m).
        left: what their best fit leaves, in its errors, shape (m,).
        noise: standard deviations of the statistics with the others, shape (m,).
    """
    touched = np.abs(others).max(axis=0, initial=0.0)
    mine = (np.abs(own) > CLEAR * noise) & (touched < _UNTOUCHED * np.abs(own))
    return bool(np.any(mine & (np.abs(left) > CERTAIN) & (left * own > 0.0)))


def _singles(hypotheses: Sequence[Hypothesis], choice: Choice) -> list[Hypothesis]:
    """Return hypotheses to be refitted alone: those of the best set, and the likeliest of all."""
    chosen = firsts(choice.best)
    for hypothesis in firsts(hypotheses):
        same = sum(h.tag == hypothesis.tag for h in chosen)
        most = 1 if type(hypothesis.effect).random_realisation else MOST_STARTS
        if same < most and len(chosen) < _MOST_SINGLES and hypothesis not in chosen:
            chosen.append(hypothesis)
    return chosen


def _grown(trials: Trials, beside: Callable[[Refitted], Choice]) -> list[tuple[Hypothesis, ...]]:
    """Return sets that hold one of the best so far and what stands out beside it.

    One that is strong hides or distorts what the frames show of the others.

    Args:
        trials: sets that were refitted.
        beside: compares new hypotheses by what they do beside a refitted set.
    """
    kinds: dict[frozenset[str], Refitted] = {}
    for one in sorted(trials.tried, key=PENALISED, reverse=True):
        kinds.setdefault(one.tags, one)
    best = next(iter(kinds.values()))
    near = best.score - _REACH_SHARE * (best.score - trials.refitter.nothing)
    seeds: list[Refitted] = []
    for number, one in enumerate(kinds.values()):
        # what a set has besides is in vain where a part of it is better
        in_vain = any(better < one.tags for better in list(kinds)[:number])
        # a part of a better set has grown already
        if one.score >= near and not in_vain and not any(one.tags < better.tags for better in seeds):
            seeds.append(one)
    seeds = seeds[:_MOST_SEEDS]
    choices = [(one.hypotheses, beside(one)) for one in seeds]
    grown: list[tuple[Hypothesis, ...]] = []
    for size, most in _MOST_GROWN.items():
        found = [
            (each.penalised_log_likelihood, (*own, *each.at_fit()))
            for own, choice in choices
            for each in choice.tried
            if len(each.hypotheses) == size and not _far_behind(each, choice)
        ]
        found.sort(key=lambda item: item[0], reverse=True)
        grown += _of_different_effects([members for _, members in found])[:most]
    return grown


def _far_behind(one: ScoredSet, choice: Choice) -> bool:
    """Tell whether the fingerprints beside a refitted set say that another one explains far more."""
    best = choice.tried[0].penalised_log_likelihood
    return one.penalised_log_likelihood < best - FAR - _REACH_SHARE * choice.advantage


def _sets(choice: Choice, singles: Sequence[Refitted]) -> list[tuple[Hypothesis, ...]]:
    """Return sets of several, the likeliest first, with the better kind of what was refitted alone."""
    kinds: dict[str, Hypothesis] = {}
    least = min(len(one.hypotheses) for one in singles)
    alone = [one for one in singles if len(one.hypotheses) == least]
    for one in sorted(alone, key=lambda one: one.promise, reverse=True):
        kinds.setdefault(one.hypotheses[-1].tag, one.hypotheses[-1])
    # of an effect that was refitted alone, the kind that did best; its strength is that of the set
    sets = [scored.at_fit() for scored in choice.tried if len(scored.hypotheses) > 1]
    better = [
        tuple(h if alike(h, kinds.get(h.tag, h)) else kinds[h.tag] for h in members) for members in sets
    ]
    return [own if meets_itself(new) else new for own, new in zip(sets, better, strict=True)]


def _of_different_effects(sets: Sequence[tuple[Hypothesis, ...]]) -> list[tuple[Hypothesis, ...]]:
    """Return sets without those of the same effects as one before."""
    found: dict[frozenset[str], tuple[Hypothesis, ...]] = {}
    for members in sets:
        found.setdefault(frozenset(h.tag for h in members), members)
    return list(found.values())


def _all_seen(refitter: Refitter, one: Refitted, known: list[Refitted]) -> bool:
    """Tell whether each effect of a set has a signature of its own beside the best fit of the others.

    Or, of a set that leaves nothing, whether it is seen beside them.

    Args:
        refitter: fits sets.
        one: the set.
        known: sets at their best fit, the best first; those that are fitted here come to them.
    """
    if len(one.tags) == 1:
        # the same effect in two places: without it nothing is left to compare with
        return len(one.hypotheses) == 1
    # without an effect its own scatter is not there: events of which three are seen scatter by half of that
    noise = refitter.scatter(refitter.null.covariance, len(one.vectors))
    complete = refitter.passes_goodness_of_fit(one)
    if not complete and not all(_untouched(one, place, noise) for place in range(len(one.hypotheses))):
        return False
    for place, hypothesis in enumerate(one.hypotheses):
        members = [h for h in one.hypotheses if h.tag != hypothesis.tag]
        # at numbers of their own the others may move other statistics
        fixed = not has_numbers(refitter, members) or is_expensive(h.effect for h in members)
        if fixed and _beyond_others(refitter, one, place):
            continue
        # the same kinds: another kind of one that mimics both is another set
        others = next((other for other in known if same_kinds(other.hypotheses, members)), None)
        tags = {h.tag for h in members}
        # but for what these make of it at numbers of their own
        others = next((other for other in known if other.tuned and other.tags == tags), others)
        if others is None and is_expensive(h.effect for h in members):
            return False
        if others is None:
            try:
                others = refitter.refined(members, one.score)
            except NotFittedError:
                return False
            known.append(others)
        part = one.hypotheses[place].fingerprint
        noise = refitter.scatter(others.covariance, len(others.vectors))
        seen = own_signature(part, others.parts, others.rest, noise)
        if not seen and not (complete and _seen_beside(refitter, part, others)):
            return False
    return True


def _beyond_others(refitter: Refitter, one: Refitted, place: int) -> bool:
    """Tell whether an effect of a set has a signature that the others leave at any strength.

    Fitted without it they may be stronger, but at most until one alone makes all of what it moves most. What
    stands out beyond that needs no refit of the others.
    """
    own, others = one.parts[place], np.delete(one.parts, place, axis=0)
    seen = refitter.target - refitter.null.mean
    most = np.argmax(np.abs(others) / refitter.null.std, axis=1)
    largest = np.abs(others[np.arange(len(others)), most])
    others = np.abs(others) * np.maximum(np.abs(seen[most]) / np.maximum(largest, 1e-12), 1.0)[:, None]
    noise = refitter.noise(one.covariance, len(one.vectors))
    left = np.maximum(np.abs(seen) - others.sum(axis=0), 0.0) / np.sqrt(noise.of(others).variances)
    left *= np.sign(seen)
    return own_signature(own, others, left, np.sqrt(noise.covariance.variances))


def _seen_beside(refitter: Refitter, part: FloatArray, others: Refitted) -> bool:
    """Tell whether others leave a statistic that an effect moves, by more than their details may be wrong.

    Where a set leaves nothing at all, its effects may move the same statistics: those that merely mimic
    something else mend each other, and do not do so everywhere.
    """
    noise = replace(refitter.noise(others.covariance, len(others.vectors)), model_error=LOOSE)
    shift = refitter.target - others.mean + others.parts.sum(axis=0)
    return seen_among(part, others.parts, shift, noise)


def _untouched(one: Refitted, place: int, noise: FloatArray) -> bool:
    """Tell whether an effect of a set moves any statistic that the others leave alone where they stand.

    Without it they would be fitted stronger, not weaker: where there is none, a refit need not be tried.
    """
    own = np.abs(one.parts[place])
    touched = np.abs(np.delete(one.parts, place, axis=0)).max(axis=0, initial=0.0)
    return bool(np.any((own > CLEAR * noise) & (touched < _UNTOUCHED * own)))


def _apart(first: Refitted, second: Refitted) -> float:
    """Return how far two predictions lie apart, in standard deviations of the statistics."""
    covariance = first.covariance.plus(second.covariance.own).with_modes(second.covariance.common)
    return float(np.linalg.norm(covariance.times(0.5).white(first.mean - second.mean)))
