"""Sets of effects that are refitted, as far as each is worth it: eliminated backward, and tuned."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pchem_pipeline.discrepancy.by_simulation.candidates.details import has_numbers, may_be_tuned, tuned
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    FAR,
    FAR_SHARE_OF_PART,
    PRICE_OF_MORE,
    Hypothesis,
    fit_set,
    meets_itself,
    share_place,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    FEW_PIXELS,
    HistogramLikelihood,
    note_defect,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import ESTABLISHED, Refitted, Refitter, is_expensive
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, CERTAIN

_MOST_EXPENSIVE = 4  # sets whose refit takes long
#: Relative error of a fingerprint before its refit.
LOOSE = 0.1
_HARDLY = 0.1  # of a deviation, what effects may move the statistic by that cannot account for it
_FAR_SHARE = 0.25  # of what there is to explain, beside `FAR`, for a set that leaves nothing
#: What sets are sorted by.
PENALISED = operator.attrgetter("penalised_log_likelihood")


@dataclass
class Trials:
    """Sets that are refitted, as far as they are worth it.

    Attributes:
        refitter: fits sets.
        likelihood: of the pixels' histograms, which brings a set near its best.
        tried: sets at their best fit, in the order in which they were tried.
        settled: tags of the sets whose numbers were tuned.
        asked: sets as they were begun.
        limit: what was next when the budget was first used; None: it is not.
    """

    refitter: Refitter
    likelihood: HistogramLikelihood
    tried: list[Refitted] = field(default_factory=list)
    settled: set[frozenset[str]] = field(default_factory=set)
    asked: list[tuple[Hypothesis, ...]] = field(default_factory=list)
    limit: EffortSpentError | None = None

    @property
    def best(self) -> Refitted:
        """The best so far."""
        return self.refitter.ranked(self.tried)[0]

    @property
    def complete(self) -> bool:
        """Whether that leaves nothing."""
        return bool(self.tried) and self.refitter.passes_goodness_of_fit(self.best)

    def refit(self, members: Sequence[Hypothesis], *, proven: bool = False) -> bool:
        """Refit a set unless it is in vain, which one that is proven never is; return False at the limit."""
        if not (proven or self._worth_it(members)):
            return True
        self.asked.append(tuple(members))
        best = max((one.score for one in self.tried), default=-np.inf)
        try:
            begun = self.likelihood.begun(members)
            self.tried.append(self.refitter.refined(begun, best, whole=len(members) == 1))
        except EffortSpentError as spent:
            self.limit = spent
            return False
        except NotFittedError:
            pass
        # whatever a stranger's effect raises must not stop the others
        except Exception as error:
            note_defect(self.refitter.defects, " + ".join(h.tag for h in members), error)
        return True

    def measure(self, measured: Callable[[tuple[Hypothesis, ...]], Iterable[Refitted]]) -> None:
        """Measure what is left without effects, then beside the best set; at the limit some is left out.

        Unless that leaves nothing at no higher price than that of one measured part beside the same effects.
        """
        best = self.best.hypotheses if self.tried else ()
        for beside in ((), best) if best else ((),):
            if self.complete and self.best.price <= PRICE_OF_MORE * (len(beside) + 1):
                return
            try:
                for one in measured(beside):
                    self.tried += [] if one in self.tried else [one]
                    if one.score < self._far_below(0.0):
                        break  # those that promise less come next
            except EffortSpentError as spent:
                self.limit = self.limit or spent

    def tune(self) -> None:
        """Tune the numbers of the best set where it leaves something, then of those as good until then."""
        gained = 0.0
        while self.tried and not self.complete:
            near = self.best.penalised_log_likelihood - gained
            close = [one for one in self.tried if one.penalised_log_likelihood >= near]
            if not (tunable := [one for one in close if self._may_be_tuned(one)]):
                return
            one = max(tunable, key=PENALISED)
            gained = max(gained, self._tuned(one).score - one.score)

    def _may_be_tuned(self, one: Refitted) -> bool:
        return one.tags not in self.settled and may_be_tuned(self.refitter, one)

    def _tuned(self, one: Refitted) -> Refitted:
        """Tune the numbers of a set, once; at the limit of the work they stay as they are."""
        self.settled.add(one.tags)
        try:
            better = tuned(self.refitter, one)
        except (EffortSpentError, NotFittedError):
            return one
        except Exception as error:  # of a stranger's effect, as above
            note_defect(self.refitter.defects, one.words, error)
            return one
        if better is not one:
            self.tried.append(better)
        return better

    def begun(self, members: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
        """Return a set at the strengths of the best refitted one that is a part of it or differs in one.

        A strong effect alone is nearer to its strength in the set than its fingerprint can tell.
        """
        tags = {h.tag for h in members}
        common = max(2, len(members) - 1)
        near = [
            one for one in self.tried if one.tags < tags or sum(h.tag in one.tags for h in members) >= common
        ]
        if not near:
            return tuple(members)
        best = max(near, key=PENALISED)
        own = {h.tag: h for h in best.hypotheses}
        better = best.tuned and best.tags != tags
        return tuple(own[h.tag] if h.tag in own and (better or alike(h, own[h.tag])) else h for h in members)

    def refit_set(self, members: Sequence[Hypothesis]) -> bool:
        """Refit a set, then the best one without each of its effects; return False at the limit."""
        return self.refit(self.begun(members)) and self.backward_eliminate()

    def backward_eliminate(self) -> bool:
        """Refit the best set without each of its effects; return False at the limit.

        The weakest first. Where the set leaves nothing, fewer may leave nothing, too; and what they leave
        tells in the end whether each is seen. Where it leaves something, others at their own numbers may
        account for what an effect was brought in for; and one that its best fit lets vanish would stand in
        the way of the others, since each of a set must be seen.
        """
        best = self.best
        gone = vanished(best)
        new = best.hypotheses
        scale = self.refitter.null.std
        for weakest in sorted(new, key=lambda h: float(np.sum((h.fingerprint / scale) ** 2))):
            fewer = [h for h in new if h is not weakest]
            several = len(new) > 2
            if not fewer or not (
                has_numbers(self.refitter, fewer) or (several and (self.complete or weakest.tag in gone))
            ):
                continue
            if several and not self.refit(fewer):
                return False
            tags = best.tags - {weakest.tag}
            same = max((one for one in self.tried if one.tags == tags), key=PENALISED, default=None)
            if same is not None and not self.complete and self._may_be_tuned(same):
                self._tuned(same)
            if self.best is not best:
                return self.backward_eliminate()
        return True

    def _worth_it(self, members: Sequence[Hypothesis]) -> bool:
        """Tell whether a set may come near the best one, and was not refitted before."""
        if share_place(h.effect for h in members) or meets_itself(members):
            return False
        expensive = [one for one in self.tried if is_expensive(one.effects)]
        if is_expensive(h.effect for h in members) and len(expensive) >= _MOST_EXPENSIVE:
            return False
        if len(members) > 1 and any(same_kinds(members, others) for others in self.asked):
            return False
        settled = self._settled
        if settled and len({h.tag for h in members}) > len(self.best.tags):
            return False
        alone = len(members) == 1 and bool(self.tried)
        if not (alone or settled):
            return True
        return not (self._beaten(members) or (alone and self._less_likely(members)))

    @property
    def _settled(self) -> bool:
        """Whether the best set leaves nothing, and all of its effects have a name."""
        return self.complete and not any(type(effect).empirical for effect in self.best.effects)

    def _beaten(self, members: Sequence[Hypothesis]) -> bool:
        """Tell whether a refit of hypotheses is in vain: far behind the best set, or blind where that is not.

        By their fingerprints at the best strengths; how far these are trusted goes with what there is to
        explain, and is less where the best set leaves something, or has more effects. Where that leaves
        nothing, a statistic that stands out and that they hardly move says enough: a refit does not change
        them so much.
        """
        refitter, complete = self.refitter, self._settled
        shift = refitter.target - refitter.null.mean
        noise = refitter.noise(refitter.null.covariance, refitter.null.n_replicates)
        noise = replace(noise, model_error=LOOSE)
        fit = fit_set(members, shift, noise)
        parts = fit.parts
        left = np.abs(shift - parts.sum(axis=0)) / np.sqrt(noise.of(parts).variances)
        blind = (left > CERTAIN) & (np.abs(parts).max(axis=0) < _HARDLY * np.abs(shift))
        if complete and np.any(blind):
            return True
        trust = _FAR_SHARE if complete and len(members) >= len(self.best.hypotheses) else FAR_SHARE_OF_PART
        return fit.log_score(shift, noise) < self._far_below(trust)

    def _far_below(self, trust: float) -> float:
        """Return a score below which a set is far behind the best one, nats.

        Args:
            trust: share of what there is to explain by which a score may be misjudged.
        """
        return self.best.score - FAR - trust * (self.best.score - self.refitter.nothing)

    def _less_likely(self, members: Sequence[Hypothesis]) -> bool:
        """Tell whether the histograms of the pixels are clearly less likely with a set than with the best.

        Of what they do not tell, nothing is said.
        """
        effects = [h.effect for h in members]
        answer = self.likelihood.behind(effects, self.best.effects, FEW_PIXELS)
        return answer is not None and answer[0] < -FAR - BEYOND_DOUBT * answer[1]


def vanished(one: Refitted) -> set[str]:
    """Return the tags of the effects of a set of which its best fit leaves no more than their error."""
    gone = np.exp(one.change) < ESTABLISHED * one.stderr
    return {h.tag for h, is_gone in zip(one.hypotheses, gone, strict=True) if is_gone and h.effect.strength}


def alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Tell whether two hypotheses differ in nothing but the strength of their effect."""
    without = {one.effect.strength}
    return one.effect.model_dump(exclude=without) == other.effect.model_dump(exclude=without)


def same_kinds(one: Sequence[Hypothesis], other: Sequence[Hypothesis]) -> bool:
    """Tell whether two sets differ in the strengths of their effects only."""
    own = {h.tag: h for h in one}
    return own.keys() == {h.tag for h in other} and all(alike(own[h.tag], h) for h in other)
