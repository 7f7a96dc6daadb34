"""Which set of effects is in the data, compared after the best fit of each.

The fingerprints (:mod:`pchem_pipeline.discrepancy.by_simulation.candidates`) say which sets are worth it.
One effect that leaves nothing beyond chance after its best fit is all there is; only where every single one
leaves something are sets of several compared, and each of their effects must have a signature of its own:
statistics that the others, at their best fit, do not account for and do not touch, or at least do not account
for where the set leaves nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.by_simulation.candidates.details import has_numbers
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    FAR,
    STANDS_OUT,
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
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import HistogramLikelihood, note_defect
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

FloatArray = NDArray[np.float64]
Answer = TypeVar("Answer")

_MOST_SINGLES, _FIRST_SINGLES = 7, 3
_MOST_OF_ONE = 3  # hypotheses of the same effect
_MOST_SETS = 5
# sets that others are grown from, and share of what the best one explains within which another one is as good
# a seed; how many of these sets are refitted, by how many effects they have besides
_MOST_SEEDS, _REACH_SHARE = 2, 0.05
_MOST_GROWN = {1: 2, 2: 1}
_MOVED = 3.0  # deviations by which an effect must move a statistic that stands out without it
_UNTOUCHED = 0.5  # of that, the most by which the others may move it
_NO_WORSE = 10.0  # nats by which fewer replicates may make a set look worse
_MOST_ALIKE = 3  # look-alikes of a single effect that are refitted before anything beside it
_NO_LIKELIHOOD = HistogramLikelihood()


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
    refitter: Refitter,
    held: Sequence[Hypothesis],
    hypotheses: Sequence[Hypothesis],
    choice: Choice,
    before: Refitted | None = None,
    beside: Callable[[Refitted], Choice | None] = lambda _: None,
    likelihood: HistogramLikelihood = _NO_LIKELIHOOD,
    unlisted: Callable[[], bool] = lambda: False,
    measured: Callable[[bool], Refitted | None] = lambda _: None,
) -> Comparison | None:
    """Refit the sets worth it, and choose the simplest that leaves nothing, else the best; None: none holds.

    Where what no known effect makes leaves nothing by itself, only single effects and the likeliest set come
    before it. What is measured, is one thing and leaves little stands before sets that do not explain more by
    more than their effects cost, and these do not grow further.

    Args:
        refitter: fits sets.
        held: effects that the model was given in earlier rounds; they are fitted anew with the others.
        hypotheses: all new ones, the likeliest first.
        choice: how their sets compare by fingerprints.
        before: the effects held, at their best fit; None: not known.
        beside: compares new hypotheses by what they do beside a refitted set.
        likelihood: of the pixels' histograms: brings a set near its best, and is asked about sets that the
            statistics tell badly apart.
        unlisted: tells whether what no known effect makes leaves nothing by itself.
        measured: returns what is clearest of all that is measured, or of what no known effect makes (True),
            where that leaves little by itself.

    Raises:
        EffortSpentError: the work is at its limit.
    """
    trials = Trials(refitter, tuple(held), likelihood)
    tried, beside = trials.tried, functools.cache(beside)
    singles = likelihood.ranked(_singles(hypotheses, choice))
    # what the likeliest set is made of, then that set: it may leave no others worth a refit
    first = len(choice.best.hypotheses)
    for hypothesis in _expensive_last(singles[:first]):
        trials.refit((hypothesis,))
    if trials.nearly:
        # a strong effect that is not quite this one leaves as little: what stands out beside it is in vain
        for hypothesis in _look_alikes(choice):
            trials.refit((hypothesis,), whatever=True)
        # fingerprints on top of pixels that were fitted without it show its details, not what is beside it
        trials.tune()
        if not held and not trials.complete and _within(unlisted):
            return None
        _forward_select(trials, beside)
    if first > 1 and tried and not trials.complete and all(len(one) == 1 for one in trials.asked):
        if not (held or trials.nearly):
            trials.measured = _within(lambda: measured(True))
        trials.refit_set(_sets(choice, tried)[0])
    # the likeliest in its place, whatever was spent until here: one of them may be all there is
    ahead = max(first, _FIRST_SINGLES)
    for hypothesis in _expensive_last(singles[first:ahead]):
        trials.refit((hypothesis,), whatever=True)
    if not held and tried and not (trials.complete or trials.nearly or trials.measured):
        trials.measured = _within(lambda: measured(False))
    # the others, expensive ones last: they may be beaten by then
    for hypothesis in _expensive_last(singles[ahead:]):
        if not trials.refit((hypothesis,)):
            break
    if not tried:
        return None
    if before is not None and max(one.score for one in tried) < before.score - _NO_WORSE:
        return None  # nothing beside the effects held explains more than they do by themselves
    if first > 1 and not trials.complete:
        # the same of the kinds that have done best
        trials.refit_set(_sets(choice, tried)[0])
    trials.tune()
    if not held and not trials.complete and (_within(unlisted) or trials.beaten):
        return None
    if len(trials.best.hypotheses) > len(held) + 1 or not trials.complete:
        grown = [] if trials.complete else _grown(trials, beside)
        for members in _of_different_effects([*grown, *_sets(choice, tried)])[:_MOST_SETS]:
            if not trials.refit_set(members):
                break
            trials.tune()
    return _concluded(trials, [] if before is None else [before], hypotheses, measured)


def _concluded(
    trials: Trials,
    before: Sequence[Refitted],
    hypotheses: Sequence[Hypothesis],
    measured: Callable[[bool], Refitted | None],
) -> Comparison | None:
    """Choose among the sets that were tried, and fit placebos in the place of its effects; see `compare`."""
    tried, likelihood = trials.tried, trials.likelihood
    # the work that led here must not be lost for the little that is left: no limit
    to_choose = replace(trials.refitter, allow=lambda _: None)
    chosen = _chosen(to_choose, tried, before)
    if chosen is None:
        return None
    if not trials.held and len(chosen.hypotheses) > 1:
        # one thing that explains as much as several is the simpler answer
        one = trials.measured or _within(lambda: measured(False))
        if one is not None and one.penalised_log_likelihood > chosen.penalised_log_likelihood:
            return None
    by_histograms = _by_histograms(chosen, tried, likelihood)
    best = max(tried, key=lambda one: by_histograms.get(one.tags, (0.0, 0.0))[0])
    if by_histograms.get(best.tags, (0.0, 0.0))[0] > 0.0 and _all_seen(to_choose, best, tried):
        chosen, by_histograms = best, _by_histograms(best, tried, likelihood)
    known = {h.tag for h in trials.held}
    for member in chosen.hypotheses:
        if member.tag not in known:
            tried += _placebo(trials, hypotheses, chosen, member)
    return Comparison(chosen, tuple(tried), by_histograms)


def _within(asked: Callable[[], Answer]) -> Answer | None:
    """Return an answer, None where the work is at its limit: sets that are known are not lost for it."""
    try:
        return asked()
    except EffortSpentError:
        return None


def _expensive_last(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses, those last whose refit takes long."""
    return sorted(hypotheses, key=lambda h: is_expensive([h.effect]))


def _chosen(refitter: Refitter, tried: list[Refitted], before: Sequence[Refitted]) -> Refitted | None:
    """Return the best set of which each effect is seen; sort all, and fit those that may be it to the end.

    Args:
        refitter: fits sets.
        tried: sets; out: the best first, at their best fit where that may be the best of all.
        before: sets that are known besides.
    """
    while True:
        tried.sort(key=PENALISED, reverse=True)
        known = [*tried, *before]
        chosen = next((one for one in tried if _all_seen(refitter, one, known)), None)
        if chosen is None:
            return None
        reach = chosen.promise - chosen.price
        short = [i for i, one in enumerate(tried) if one.short and one.promise - one.price >= reach]
        if not short:
            return chosen
        for i in short:
            tried[i] = refitter.refined(tried[i].hypotheses, chosen.score)


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
    mine = (np.abs(own) > _MOVED * noise) & (touched < _UNTOUCHED * np.abs(own))
    return bool(np.any(mine & (np.abs(left) > STANDS_OUT) & (left * own > 0.0)))


def _singles(hypotheses: Sequence[Hypothesis], choice: Choice) -> list[Hypothesis]:
    """Return hypotheses to be refitted alone: those of the best set, and the likeliest of all."""
    chosen = firsts(choice.best.hypotheses)
    for hypothesis in firsts(hypotheses):
        same = sum(h.tag == hypothesis.tag for h in chosen)
        most = 1 if type(hypothesis.effect).random_realisation else _MOST_OF_ONE
        if same < most and len(chosen) < _MOST_SINGLES and hypothesis not in chosen:
            chosen.append(hypothesis)
    return chosen


def _look_alikes(choice: Choice) -> list[Hypothesis]:
    """Return the likeliest effects that are known to be confused with the best set, if that is one effect."""
    best = choice.best.hypotheses
    if len(best) > 1:
        return []
    singles = [one.hypotheses[0] for one in choice.tried if len(one.hypotheses) == 1]
    others = (h for h in singles if h.tag != best[0].tag and not unrelated(h.effect, best[0].effect))
    return [h for h in others if not is_expensive([h.effect])][:_MOST_ALIKE]


def _forward_select(trials: Trials, beside: Callable[[Refitted], Choice | None]) -> None:
    """Refit the best set with what stands out beside it, and so on, as long as that is better.

    With the fewest effects that are not far behind: a refit shows what their fingerprints cannot tell.
    """
    best: Refitted | None = None
    while not (trials.best is best or trials.complete):
        best = trials.best
        choice = beside(best)
        if choice is None:
            return
        fewest = min(
            (one for one in choice.tried if not _far_behind(one, choice)),
            key=lambda one: (len(one.hypotheses), -one.penalised_log_likelihood),
        )
        members = (*best.hypotheses[len(trials.held) :], *fewest.at_fit())
        if not trials.refit_set(members):
            return
        trials.tune()


def _grown(trials: Trials, beside: Callable[[Refitted], Choice | None]) -> list[tuple[Hypothesis, ...]]:
    """Return sets that hold one of the best so far and what stands out beside it.

    One that is strong hides or distorts what the frames show of the others.

    Args:
        trials: sets that were refitted.
        beside: compares new hypotheses by what they do beside a refitted set.
    """
    held = len(trials.held)
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
    choices = [(one.hypotheses[held:], choice) for one in seeds if (choice := beside(one)) is not None]
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
    best = choice.best.penalised_log_likelihood
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
    return bool(np.any((own > _MOVED * noise) & (touched < _UNTOUCHED * own)))


def _apart(first: Refitted, second: Refitted) -> float:
    """Return how far two predictions lie apart, in standard deviations of the statistics."""
    covariance = first.covariance.plus(second.covariance.own).with_modes(second.covariance.common)
    return float(np.linalg.norm(covariance.times(0.5).white(first.mean - second.mean)))
