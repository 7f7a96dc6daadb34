"""Sets of effects that are refitted, as far as each is worth it: in vain, thinned, and with numbers tuned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pchem_pipeline.discrepancy.by_simulation.candidates.details import has_numbers, may_be_tuned, tuned
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    PRICE_OF_MORE,
    Hypothesis,
    fit_set,
    meets_itself,
    share_place,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import FEW_PIXELS, Witness, note_defect
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Refitter, is_dear
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.discrepancy.null import CONVINCING
from pchem_pipeline.model.arithmetic.robust import look_elsewhere

_MOST_DEAR = 4  # sets whose refit takes long
#: Relative error of a fingerprint before its refit.
LOOSE = 0.1
_HARDLY = 0.1  # of a deviation, what effects may move the statistic by that cannot account for it
#: Nats behind from which on a fingerprint is no rival of a right set.
FAR = 40.0
_FAR_SHARE = 0.25  # of what there is to explain, the same in addition
_FAR_SHARE_OF_PART = 0.5  # the same of a set that leaves something
_LEFT = 0.02  # chance of what a complete set may leave, anywhere among the statistics
_SEEN = 4.0  # deviations that a set leaves of a statistic for it to stand out
_LITTLE = 0.03  # of what there is to explain, nats
_CLEARLY = 5.0  # standard errors of a difference of likelihoods
_VANISHED = 4.5  # standard errors of its strength below which an effect of a set is not established


@dataclass
class Trials:
    """Sets that are refitted, as far as they are worth it.

    Attributes:
        refitter: fits sets.
        held: effects that are fitted with each.
        witness: brings a set near its best.
        tried: sets at their best fit, in the order in which they were tried.
        settled: tags of the sets whose numbers were tuned.
        asked: sets as they were begun.
        measured: what was measured without any of these effects, and leaves little.
    """

    refitter: Refitter
    held: tuple[Hypothesis, ...]
    witness: Witness
    tried: list[Refitted] = field(default_factory=list)
    settled: set[frozenset[str]] = field(default_factory=set)
    asked: list[tuple[Hypothesis, ...]] = field(default_factory=list)
    measured: Refitted | None = None

    @property
    def best(self) -> Refitted:
        """The best so far."""
        return max(self.tried, key=worth)

    @property
    def beaten(self) -> bool:
        """Whether what was measured leaves less, and that leaves more than details."""
        return self.measured is not None and self._bar is self.measured and not self.nearly

    @property
    def _bar(self) -> Refitted:
        """What the next one must come near: the best, or what was measured where that is clearly better."""
        one = self.measured
        return self.best if one is None or one.score < self.best.score + CONVINCING else one

    @property
    def complete(self) -> bool:
        """Whether that leaves nothing."""
        return bool(self.tried) and leaves_nothing(self.refitter, self.best)

    @property
    def nearly(self) -> bool:
        """Whether that leaves little, but something."""
        return bool(self.tried) and not self.complete and leaves_little(self.refitter, self.best)

    def refit(self, members: Sequence[Hypothesis], *, whatever: bool = False) -> bool:
        """Refit a set unless it is in vain; return False at the limit of the work, where sets are known.

        Args:
            members: effects of the set.
            whatever: fit it where it stands whatever was spent, unless that takes long.

        Raises:
            EffortSpentError: at that limit, no set of several has been refitted.
        """
        if not self._worth_it(members):
            return True
        self.asked.append(tuple(members))
        best = max(max(one.score for one in self.tried), self._bar.score) if self.tried else -np.inf
        try:
            begun = self.witness.begun((*self.held, *members))
            refitter = self.refitter
            if whatever and not is_dear(h.effect for h in begun):
                refitter = replace(refitter, allow=_but_once(refitter.allow))
            self.tried.append(refitter.refined(begun, best, whole=len(members) == 1))
        except EffortSpentError:
            if all(len(one.hypotheses) <= len(self.held) + 1 for one in self.tried):
                raise
            return False
        except NotFittedError:
            pass
        # whatever a stranger's effect raises must not stop the others
        except Exception as error:
            note_defect(self.refitter.defects, _words(members), error)
        return True

    def tune(self) -> None:
        """Tune the numbers of the best set where it leaves something, then of those as good until then."""
        gained = 0.0
        while self.tried and not self.complete:
            near = worth(self.best) - gained
            open_ = [one for one in self.tried if worth(one) >= near and self._may_be_tuned(one)]
            if not open_:
                return
            one = max(open_, key=worth)
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
            note_defect(self.refitter.defects, _words(one.hypotheses), error)
            return one
        if better is not one:
            self.tried.append(better)
        return better

    def thin(self) -> bool:
        """Refit the best set without each of its effects; return False at the limit.

        The weakest first. Where the set leaves nothing, fewer may leave nothing, too; and what they leave
        tells in the end whether each is seen. Where it leaves something, others at their own numbers may
        account for what an effect was brought in for; and one that its best fit lets vanish would stand in
        the way of the others, since each of a set must be seen.
        """
        best = self.best
        gone = vanished(best)
        new = best.hypotheses[len(self.held) :]
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
            same = [one for one in self.tried if one.tags == tags]
            if same and not self.complete and self._may_be_tuned(max(same, key=worth)):
                self._tuned(max(same, key=worth))
            if self.best is not best:
                return self.thin()
        return True

    def _worth_it(self, members: Sequence[Hypothesis]) -> bool:
        """Tell whether a set may come near the best one, and was not refitted before."""
        tags = frozenset(h.tag for h in (*self.held, *members))
        every = (*self.held, *members)
        if share_place(h.effect for h in every) or meets_itself(every):
            return False
        dear = [one for one in self.tried if is_dear(one.effects)]
        if is_dear(h.effect for h in members) and len(dear) >= _MOST_DEAR:
            return False
        if len(members) > 1 and any(same_kinds(members, others) for others in self.asked):
            return False
        if self.complete and len(tags) > len(self.best.tags):
            return False
        alone = len(members) == 1 and bool(self.tried)
        if not (alone or self.complete):
            return True
        return not (
            _beaten(self.refitter, (*self.held, *members), self._bar)
            or (alone and self._less_likely(members))
        )

    def _less_likely(self, members: Sequence[Hypothesis]) -> bool:
        """Tell whether the histograms of the pixels are clearly less likely with a set than with the best.

        Of what they do not tell, nothing is said.
        """
        effects = [h.effect for h in (*self.held, *members)]
        answer = self.witness.behind(effects, self.best.effects, FEW_PIXELS)
        return answer is not None and answer[0] < -FAR - _CLEARLY * answer[1]


def _but_once(allow: Callable[[str], None]) -> Callable[[str], None]:
    """Return the same, to which what is asked first is no matter of the limit."""
    asked: list[str] = []

    def allowed(words: str) -> None:
        asked.append(words)
        try:
            allow(words)
        except EffortSpentError:
            if len(asked) > 1:
                raise

    return allowed


def leaves_nothing(refitter: Refitter, one: Refitted) -> bool:
    """Tell whether a set leaves no statistic beyond chance."""
    p = float(refitter.null.p_of(one.rest, 2).min())
    return look_elsewhere(p, refitter.null.effective_tests) > _LEFT


def leaves_little(refitter: Refitter, one: Refitted) -> bool:
    """Tell whether a set leaves nothing, or so little of what there was that it may be its details."""
    little = one.chance - one.score < _LITTLE * (one.chance - refitter.nothing)
    return little or leaves_nothing(refitter, one)


def vanished(one: Refitted) -> set[str]:
    """Return the tags of the effects of a set of which its best fit leaves no more than their error."""
    gone = np.exp(one.change) < _VANISHED * one.stderr
    return {h.tag for h, is_gone in zip(one.hypotheses, gone, strict=True) if is_gone and h.effect.strength}


def _beaten(refitter: Refitter, members: Sequence[Hypothesis], best: Refitted) -> bool:
    """Tell whether a refit of hypotheses is in vain: far behind the best set, or blind where that is not.

    By their fingerprints at the best strengths; how far these are trusted goes with what there is to explain,
    and is less where the best set leaves something, or has more effects. Where that leaves nothing, a
    statistic that stands out and that they hardly move says enough: a refit does not change them so much.
    """
    complete = leaves_nothing(refitter, best)
    trust = _FAR_SHARE if complete and len(members) >= len(best.hypotheses) else _FAR_SHARE_OF_PART
    shift = refitter.target - refitter.null.mean
    noise = replace(refitter.noise(refitter.null.covariance, refitter.null.n_replicates), model_error=LOOSE)
    fit = fit_set(members, shift, noise)
    parts = fit.parts
    left = np.abs(shift - parts.sum(axis=0)) / np.sqrt(noise.of(parts).variances)
    if complete and np.any((left > _SEEN) & (np.abs(parts).max(axis=0) < _HARDLY * np.abs(shift))):
        return True
    score = fit.log_score(shift, noise)
    return score < best.score - FAR - trust * (best.score - refitter.nothing)


def worth(one: Refitted) -> float:
    """Return the score of a set less the price of its effects, nats."""
    return one.score - PRICE_OF_MORE * (len(one.hypotheses) - 1)


def alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Tell whether two hypotheses differ in nothing but the strength of their effect."""
    without = {one.effect.strength}
    return one.effect.model_dump(exclude=without) == other.effect.model_dump(exclude=without)


def of_kinds(one: Refitted, members: Sequence[Hypothesis]) -> bool:
    """Tell whether a set is of these effects, differing in their strengths only."""
    return same_kinds(one.hypotheses, members)


def same_kinds(one: Sequence[Hypothesis], other: Sequence[Hypothesis]) -> bool:
    """Tell whether two sets differ in the strengths of their effects only."""
    own = {h.tag: h for h in one}
    return own.keys() == {h.tag for h in other} and all(alike(own[h.tag], h) for h in other)


def _words(members: Sequence[Hypothesis]) -> str:
    """Return the tags of a set: which of its effects failed is not known."""
    return " + ".join(h.tag for h in members)
