"""The search for the effects that explain frames: the most promising set is simulated one step further.

A set of effects is a trial. Its promise is the log score that it may come to: by its fingerprints before it
was simulated (:mod:`pchem_pipeline.discrepancy.by_simulation.candidates`), by its slopes afterwards. A trial
is open while its promise, and what that may be wrong by, reaches the best one. The most promising one goes
first; before a set, each of its effects alone, which tells where the set begins.

Forward selection: where the best set leaves something, sets with what stands out beside it are trials, and so
is what is measured without a name. Backward elimination: so is the best set without each of its effects.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pchem_pipeline.discrepancy.by_simulation.candidates.details import may_be_tuned, tuned
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    FAR,
    FAR_SHARE_OF_PART,
    PRICE_OF_MORE,
    Hypothesis,
    SetFit,
    firsts,
    fit_set,
    meets_itself,
    share_place,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    MOST_STARTS,
    HistogramLikelihood,
    note_defect,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import (
    ESTABLISHED,
    Refitted,
    Refitter,
    Steps,
    is_expensive,
    price,
    tags_of,
)
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN, DECISIVE

#: Relative error of a fingerprint before its refit.
LOOSE = 0.1
#: What sets are sorted by.
PENALISED = operator.attrgetter("penalised_log_likelihood")
_MOST_SINGLES, _MOST_SETS = 7, 3  # hypotheses that are tried alone, sets that fingerprints propose
_MISJUDGED = 5.0  # times the gain that the next step promises, that all further ones may bring
_FAR_SHARE = 0.25  # of what there is to explain, beside `FAR`, for a set that leaves nothing
_HARDLY = 0.1  # of a deviation, what effects may move the statistic by that cannot account for it
# sets beside which others are asked for, share of what the best one explains by which one may be behind it,
# and how many of these sets are tried, by how many effects they have besides
_MOST_SEEDS, _REACH_SHARE = 2, 0.05
_MOST_GROWN = {1: 2, 2: 1}


@dataclass(eq=False)
class Trial:
    """A set of effects as proposed, the log score that their fingerprints promise, and its simulations.

    ``way`` has the steps to its best strengths (None: not simulated); ``ended``: no further step pays.
    """

    members: tuple[Hypothesis, ...]
    foreseen: float
    way: Steps | None = None
    ended: bool = False

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects."""
        return tuple(h.effect for h in self.members)

    def begins_with(self, other: Trial) -> bool:
        """Test whether another trial, an effect of this one alone, was to be simulated before this one."""
        own = {_kind_and_place(h) for h in self.members}
        new = self.way is None and other.way is None
        return new and len(own) > 1 and len(other.members) == 1 and _kind_and_place(other.members[0]) in own

    @property
    def promise(self) -> float:
        """Log score that it may come to, less the price of its effects, nats."""
        if self.way is None:
            return self.foreseen - price(self.effects)
        best = self.way.best
        return (best.score if self.ended else max(best.promise, best.score)) - best.price


@dataclass
class Search:
    """Sets of effects that are tried."""

    refitter: Refitter
    likelihood: HistogramLikelihood  # of the pixels' histograms, which brings a set near its best
    trials: list[Trial] = field(default_factory=list)  # all sets
    limit: EffortSpentError | None = None  # what was next when the budget was used; None: it is not
    rejected: list[Refitted] = field(default_factory=list)  # sets that are not established
    report: Callable[[str], None] = lambda _: None  # is given the tags of the best set after each step
    _tuned: set[frozenset[str]] = field(default_factory=set, repr=False)

    @property
    def tried(self) -> list[Refitted]:
        """All sets that were simulated, each at the best strengths so far."""
        return [trial.way.best for trial in self.trials if trial.way is not None]

    @property
    def ranked(self) -> list[Refitted]:
        """Those that are not rejected, the best first."""
        return self.refitter.ranked(one for one in self.tried if one not in self.rejected)

    @property
    def best(self) -> Refitted | None:
        """The best so far."""
        return next(iter(self.ranked), None)

    @property
    def complete(self) -> bool:
        """Whether that leaves nothing."""
        best = self.best
        return best is not None and self.refitter.passes_goodness_of_fit(best)

    def add(self, members: Sequence[Hypothesis]) -> None:
        """Propose a set, unless it is one that was proposed before, or its effects exclude each other."""
        if share_place(h.effect for h in members) or meets_itself(members):
            return
        if self._trial_of(members) is None:
            self.trials.append(Trial(tuple(members), self._foreseen(members)))

    def _trial_of(self, members: Sequence[Hypothesis]) -> Trial | None:
        """Return the trial of the same effects at any strengths, if there is one."""
        kinds = {h.kind for h in members}
        return next((each for each in self.trials if {h.kind for h in each.members} == kinds), None)

    def compare(self, sets: Iterable[Sequence[Hypothesis]]) -> None:
        """Simulate sets, the most promising one a step further each time, then simplify and tune the best."""
        for members in sets:
            self.add(members)
        self._advance_most_promising(self.trials)
        self.eliminate()
        before = self.best
        self.tune()
        if self.best is not before:
            self.eliminate()

    def _advance_most_promising(self, trials: Sequence[Trial]) -> None:
        """Simulate the most promising of some trials a step further, as long as one may become the best."""
        while self.limit is None and (left := [trial for trial in trials if self._is_open(trial)]):
            # what is expensive comes last: it may be beaten by then
            next_one = max(left, key=lambda trial: (not is_expensive(trial.effects), trial.promise))
            self.advance(next((each for each in left if next_one.begins_with(each)), next_one))

    def advance(self, trial: Trial) -> None:
        """Simulate a trial a step further."""
        try:
            if trial.way is None:
                trial.way = self.refitter.begin(self.likelihood.begun(self._started(trial.members)))
            else:
                trial.ended = not self.refitter.step(trial.way)
        except EffortSpentError as spent:
            self.limit, trial.ended = spent, True
        except NotFittedError:
            trial.ended = True
        # an effect of a plug-in may raise anything: the others are compared all the same
        except Exception as error:
            note_defect(self.refitter.defects, tags_of(trial.members), error)
            trial.ended = True
        if self.best is not None:
            self.report(self.best.words)

    def settle(self, trial: Trial, least: float = -np.inf) -> Refitted | None:
        """Simulate a trial to its best strengths, or until it cannot reach ``least`` nats; None: no fit."""
        while not trial.ended and _may_reach(trial, least):
            self.advance(trial)
        return None if trial.way is None else trial.way.best

    def at_best_fit(self, members: Sequence[Hypothesis], least: float = -np.inf) -> Refitted | None:
        """Return some effects at their best fit, tuned if that was done; see `settle` for ``least``.

        A set whose steps were broken off goes on from the strengths of ``members`` if these explain more.
        """
        tags = {h.tag for h in members}
        known = [one for one in self.tried if one.tuned and one.tags == tags]
        if known:
            return max(known, key=PENALISED)
        self.add(members)
        trial = self._trial_of(members)
        if trial is None:
            return None
        if trial.way is not None and not trial.ended:
            # it was left far from its best, and would be compared as it was left
            again = Trial(tuple(members), trial.foreseen)
            self.advance(again)
            if again.way is not None and again.way.best.score > trial.way.best.score:
                trial.way = again.way
        return self.settle(trial, least)

    def measure(self, measured: Callable[[tuple[Hypothesis, ...]], Iterable[Steps]]) -> None:
        """Measure what is left without effects, then beside the best set, as far as the limit allows.

        Unless that leaves nothing at no higher price than one measured part beside the same effects.
        """
        kept = () if self.best is None else self.best.hypotheses
        before, self.limit = self.limit, None
        for beside in dict.fromkeys(((), kept)):
            best = self.best
            if best is not None and self.complete and best.price <= PRICE_OF_MORE * (len(beside) + 1):
                break
            new: list[Trial] = []
            try:
                for way in measured(beside):
                    new.append(Trial(way.best.hypotheses, way.best.score, way))
                    self.trials.append(new[-1])
                    if self.refitter.passes_goodness_of_fit(way.best):
                        break
            except EffortSpentError as spent:
                self.limit = spent
            self._advance_most_promising(new)
        self.limit = before or self.limit

    def tune(self) -> None:
        """Tune the parameters of the best set where it leaves something, then of those as good until then."""
        gained = 0.0
        while (best := self.best) is not None and not self.complete:
            near = best.penalised_log_likelihood - gained
            close = [one for one in self.tried if one.penalised_log_likelihood >= near and self._untuned(one)]
            if not close:
                return
            gained = max(gained, self._tune(max(close, key=PENALISED)))

    def _untuned(self, one: Refitted) -> bool:
        """Test whether what a set leaves asks for other parameters, and these were not tuned yet."""
        return one.tags not in self._tuned and may_be_tuned(self.refitter, one)

    def at_maximum(self, one: Refitted) -> Refitted:
        """Tune the parameters of a set, and of those that may be in its place as well; return it tuned."""
        for other in self.ranked:
            swapped = len(other.tags - one.tags) == len(one.tags - other.tags) == 1
            near = one.penalised_log_likelihood - other.penalised_log_likelihood <= DECISIVE
            if other.tags not in self._tuned and (other is one or (swapped and near)):
                self._tune(other)
        return max((each for each in self.ranked if each.tags == one.tags), key=PENALISED)

    def _tune(self, one: Refitted) -> float:
        """Tune the parameters of a set; return the nats that it gained."""
        self._tuned.add(one.tags)
        try:
            better = tuned(self.refitter, one)
        except (EffortSpentError, NotFittedError):
            return 0.0
        except Exception as error:  # of a plug-in, as above
            note_defect(self.refitter.defects, one.words, error)
            return 0.0
        for trial in self.trials:
            if trial.way is not None and trial.way.best is one and better is not one:
                trial.way, trial.ended = Steps.begin(better), True
        return better.score - one.score

    def eliminate(self) -> None:
        """Try the best set without each of its effects, the weakest first, as long as that is better.

        The parameters of those that stay are tuned. Where the set leaves something, only effects not beyond
        their error are left out.
        """
        best, scale = self.best, self.refitter.null.std
        if best is None or len(best.hypotheses) < 2 or self.limit is not None:
            return
        for weakest in sorted(best.hypotheses, key=lambda h: float(np.sum((h.fingerprint / scale) ** 2))):
            if self.complete or weakest.tag in vanished(best):
                rest = self.at_best_fit([h for h in best.hypotheses if h is not weakest])
                if rest is not None and self.complete and self._untuned(rest):
                    self._tune(rest)
                self.tune()
                if self.best is not best:
                    return self.eliminate()

    def _is_open(self, trial: Trial) -> bool:
        """Test whether a trial may come to more than the best one."""
        best = self.best
        if trial.ended or best is None:
            return not trial.ended
        explained = best.score - self.refitter.nothing
        named = self.complete and not any(type(effect).empirical for effect in best.effects)
        if named and price(trial.effects) > best.price:
            return False
        if trial.way is None:
            # a measured form fits what others make: it leaves no effect out for what a fingerprint misses
            measured = any(effect.measured_parts for effect in best.effects)
            if named and not measured and self._is_blind(trial.members, best):
                return False
            share = _FAR_SHARE if named and len(trial.members) >= len(best.hypotheses) else FAR_SHARE_OF_PART
            return trial.promise + FAR + share * explained >= best.penalised_log_likelihood
        return _may_reach(trial, best.penalised_log_likelihood)

    def _foreseen(self, members: Sequence[Hypothesis]) -> float:
        """Return the log score of fingerprints at their best strengths."""
        null, shift = self.refitter.null, self.refitter.target - self.refitter.null.mean
        noise = replace(self.refitter.noise(null.covariance, null.n_replicates), model_error=LOOSE)
        return fit_set(members, shift, noise).log_score(shift, noise)

    def _is_blind(self, members: Sequence[Hypothesis], best: Refitted) -> bool:
        """Test whether a statistic stands out, by its error under the best set, that a set hardly moves."""
        shift = self.refitter.target - self.refitter.null.mean
        noise = replace(self.refitter.noise(best.covariance, len(best.vectors)), model_error=LOOSE)
        parts = fit_set(members, shift, noise).parts
        left = shift - parts.sum(axis=0)
        left = np.abs(left) / np.sqrt(noise.of(parts, left).variances)
        return bool((left[np.abs(parts).max(axis=0) < _HARDLY * np.abs(shift)] > CERTAIN).any())

    def _started(self, members: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
        """Return effects at their strengths in the best trials of a part of the set, or with one other."""
        if len(members) == 1:
            return tuple(members)
        tags, common = {h.tag for h in members}, max(2, len(members) - 1)
        own: dict[tuple[str, str], Hypothesis] = {}
        for one in sorted(self.tried, key=PENALISED, reverse=True):
            if one.tags < tags or (one.tags != tags and len(one.tags & tags) >= common):
                own = {_kind_and_place(h): h for h in one.hypotheses} | own
        known = tuple(own.get(_kind_and_place(h), h) for h in members)
        return tuple(members) if meets_itself(known) else known


def _kind_and_place(one: Hypothesis) -> tuple[str, str]:
    """Return the tag of an effect and where it acts: in another place it is another hypothesis."""
    return one.tag, Part(one.effect.region, one.effect.when).text


def _may_reach(trial: Trial, least: float) -> bool:
    """Test whether further steps of a trial may bring it to a log score, less the price of its effects."""
    if trial.way is None:
        return True
    doubt = _MISJUDGED * (trial.promise - trial.way.best.penalised_log_likelihood)
    return trial.promise + doubt >= least


def compare(
    search: Search,
    hypotheses: Sequence[Hypothesis],
    sets: Sequence[SetFit],
    beside: Callable[[Refitted], Sequence[SetFit]] = lambda _: (),
    measured: Callable[[tuple[Hypothesis, ...]], Iterable[Steps]] = lambda _: (),
    rounds: int = 3,
) -> None:
    """Try effects and sets, then with one effect more or fewer, as long as the best one becomes better.

    Args:
        search: all that was tried; out.
        hypotheses: all, the likeliest first.
        sets: of them, the likeliest by their fingerprints first.
        beside: returns the likeliest sets of new hypotheses beside a refitted set.
        measured: measures what effects leave, and yields them with it, simulated at the measured size.
        rounds: of sets, at most.
    """
    beside = functools.cache(beside)
    singles = [(h,) for h in _singles(hypotheses, sets[0].hypotheses)] if sets else []
    together = (fit.at_best() for fit in sets if len(fit.hypotheses) > 1)
    search.compare([*singles, *_of_different_effects(together)[:_MOST_SETS]])
    for _ in range(rounds):
        before = search.best
        search.measure(measured)
        if search.best is None or search.complete or search.limit:
            return
        search.compare(_grown(search, beside))
        if search.best is before:
            return


def _singles(hypotheses: Sequence[Hypothesis], best: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses to be tried alone: those of the best set, and the likeliest of all."""
    chosen = firsts(best)
    for hypothesis in firsts(hypotheses):
        same = [h for h in chosen if h.tag == hypothesis.tag]
        most = 1 if type(hypothesis.effect).random_realisation else MOST_STARTS
        if len(same) < most and len(chosen) < _MOST_SINGLES and hypothesis.kind not in [h.kind for h in same]:
            chosen.append(hypothesis)
    return chosen


def _grown(search: Search, beside: Callable[[Refitted], Sequence[SetFit]]) -> list[tuple[Hypothesis, ...]]:
    """Return sets that hold one of the best so far and what stands out beside it."""
    seeds: list[Refitted] = []
    for one in sorted(search.tried, key=PENALISED, reverse=True):
        best = seeds[0] if seeds else one
        near = one.score >= best.score - _REACH_SHARE * (best.score - search.refitter.nothing)
        # what a set has besides is in vain where a part of it is better, and a part of a better set has grown
        if near and not any(one.tags <= other.tags or other.tags <= one.tags for other in seeds):
            seeds.append(one)
    grown: list[tuple[Hypothesis, ...]] = []
    for one in seeds[:_MOST_SEEDS]:
        others = _of_different_effects(fit.at_best() for fit in beside(one))
        for size, most in _MOST_GROWN.items():
            grown += [(*one.hypotheses, *each) for each in others if len(each) == size][:most]
    return grown


def _of_different_effects(sets: Iterable[tuple[Hypothesis, ...]]) -> list[tuple[Hypothesis, ...]]:
    """Return sets without those of the same effects as one before."""
    found: dict[frozenset[str], tuple[Hypothesis, ...]] = {}
    for members in sets:
        found.setdefault(frozenset(h.tag for h in members), members)
    return list(found.values())


def vanished(one: Refitted) -> set[str]:
    """Return the tags of the effects of a set that are not beyond their error at its best fit."""
    gone = np.exp(one.change) < ESTABLISHED * one.stderr
    return {h.tag for h, is_gone in zip(one.hypotheses, gone, strict=True) if is_gone and h.effect.strength}
