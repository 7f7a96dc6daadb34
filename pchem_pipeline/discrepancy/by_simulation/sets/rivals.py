"""Which of the sets that were tried is in the data, and what could stand in the place of each effect.

One effect that leaves nothing beyond chance after its best fit is all there is; of a set of several, each
must be needed: without it the others at their best fit leave a statistic that it explains, or are far behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import FAR, Hypothesis
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import HistogramLikelihood
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted
from pchem_pipeline.discrepancy.by_simulation.sets.search import Search
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR, DECISIVE

_UNTOUCHED = 0.5  # of what an effect does to a statistic, the most by which others may move one of its own


@dataclass(frozen=True)
class Contender:
    """An effect that could stand in the place of a chosen one."""

    effect: Effect
    score: float  # log score of the best set with it in that place, relative to the chosen set, nats
    stderr: float  # of that score, nats
    probability: float  # among all that could stand there


@dataclass(frozen=True)
class Comparison:
    """The chosen set and all that were tried, the best first, at their best fit.

    ``by_histograms`` says how far others (by tags) are behind the chosen one in the likelihood of the
    histograms, nats, with the error.
    """

    chosen: Refitted
    tried: tuple[Refitted, ...]
    by_histograms: Mapping[frozenset[str], tuple[float, float]] = field(default_factory=dict)

    def exchanged(self, added: Hypothesis) -> dict[str, tuple[Effect, Refitted]]:
        """Return the effects, by tag, in the place of one of the chosen set, each with its best set."""
        others = self.chosen.tags - {added.tag}
        found: dict[str, tuple[Effect, Refitted]] = {}
        for one in self.tried:
            if others < one.tags and len(one.tags) == len(others) + 1:
                new = next(h for h in one.hypotheses if h.tag not in others)
                found.setdefault(new.tag, (new.effect, one))
        return found

    def rivals_of(self, added: Hypothesis) -> tuple[Contender, ...]:
        """Return what could stand in the place of an effect of the chosen set, that one first."""
        found: dict[str, Contender] = {}
        for name, (new, one) in self.exchanged(added).items():
            effect = added.effect if name == added.tag else new
            # neither the same effect elsewhere nor what has no name is a rival
            if name != added.tag and (effect.tag == added.effect.tag or type(effect).empirical):
                continue
            if one.tags in self.by_histograms:
                behind, error = self.by_histograms[one.tags]
                # neither need be the very law of the samples
                probability = float(special.ndtr(behind / max(error, 1e-9)))
            else:
                error, told = _apart(one, self.chosen)
                # a score that says more than the predictions tell is chance
                behind = max(one.penalised_log_likelihood - self.chosen.penalised_log_likelihood, -told)
                probability = float(np.exp(min(behind, 0.0)))
            found[name] = Contender(effect, behind, error, probability)
        total = sum(c.probability for c in found.values())
        shared = [replace(c, probability=c.probability / total) for c in found.values()]
        return tuple(sorted(shared, key=lambda c: (-c.probability, -c.score)))


def chosen(search: Search) -> Comparison | None:
    """Return the best set with all effects seen, or one as good with likelier histograms; None: none."""
    best = _best_seen(search)
    if best is None:
        return None
    by_histograms = _by_histograms(best, search.ranked, search.likelihood)
    other = max(search.ranked, key=lambda one: by_histograms.get(one.tags, (0.0, 0.0))[0])
    if by_histograms.get(other.tags, (0.0, 0.0))[0] > 0.0 and _all_seen(search, other):
        best, by_histograms = other, _by_histograms(other, search.ranked, search.likelihood)
    best = search.at_maximum(best)
    return Comparison(best, tuple(search.ranked), by_histograms)


def _best_seen(search: Search) -> Refitted | None:
    """Return the best set of which each effect is seen; those that may yet be it are fitted to the end."""
    while True:
        found = next((one for one in search.ranked if _all_seen(search, one)), None)
        if found is None:
            return None
        reach = found.penalised_log_likelihood
        short = [trial for trial in search.trials if trial.way and not trial.ended and trial.promise >= reach]
        if not short:
            return found
        for trial in short:
            search.settle(trial)


def _by_histograms(
    chosen: Refitted, tried: Sequence[Refitted], likelihood: HistogramLikelihood
) -> dict[frozenset[str], tuple[float, float]]:
    """Compare sets nearly as good as the chosen one that have another effect in the place of one."""
    found: dict[frozenset[str], tuple[float, float]] = {}
    for one in tried:
        swapped = len(one.tags - chosen.tags) == len(chosen.tags - one.tags) == 1
        near = abs(one.penalised_log_likelihood - chosen.penalised_log_likelihood) < FAR
        if swapped and near and one.tags not in found:
            answer = likelihood.behind(one.effects, chosen.effects)
            if answer is not None:
                found[one.tags] = answer
    return found


def own_statistics(own: FloatArray, others: FloatArray, noise: FloatArray) -> BoolArray:
    """Return which statistics an effect moves, (m,), and others, (e, m), leave alone, beyond noise (m,)."""
    touched = np.abs(others).max(axis=0, initial=0.0)
    return np.asarray((np.abs(own) > CLEAR * noise) & (touched < _UNTOUCHED * np.abs(own)))


def _all_seen(search: Search, one: Refitted) -> bool:
    """Test whether each effect of a set is needed beside the best fit of the others.

    Each must have a statistic of its own, which stands out without it. Of a set that leaves nothing it
    suffices that without it the set is far behind.
    """
    if len(one.tags) == 1:
        # the same effect in two places: without it nothing is left to compare with
        return len(one.hypotheses) == 1
    refitter, complete = search.refitter, search.refitter.passes_goodness_of_fit(one)
    # without it the others would be fitted stronger, not weaker: what they touch now is none of its own
    noise = refitter.scatter(refitter.null.covariance, len(one.vectors))
    apart = (own_statistics(part, np.delete(one.parts, i, axis=0), noise) for i, part in enumerate(one.parts))
    if not complete and not all(own.any() for own in apart):
        return False
    least = one.penalised_log_likelihood - DECISIVE
    for hypothesis in one.hypotheses:
        rest = [h for h in one.hypotheses if h is not hypothesis]
        others = search.at_best_fit(rest, least)
        if others is None:
            return False
        if complete and others.penalised_log_likelihood < least:
            continue
        part = hypothesis.fingerprint
        noise = refitter.scatter(others.covariance, len(others.vectors))
        left = (np.abs(others.rest) > CERTAIN) & (others.rest * part > 0.0)
        if not (own_statistics(part, others.parts, noise) & left).any():
            return False
    return True


def _apart(first: Refitted, second: Refitted) -> tuple[float, float]:
    """Return how far two predictions lie apart, d standard deviations of the statistics, and what this tells.

    That is d^2 / 2 nats (Kullback and Leibler 1951) less what the chance of the simulations adds to d^2:
    products of different replicates have none of it.
    """
    covariance = first.covariance.plus(second.covariance.own).with_modes(second.covariance.common)
    n = min(len(first.vectors), len(second.vectors))
    rows = covariance.times(0.5).white(first.vectors[:n] - second.vectors[:n])
    apart = float(np.linalg.norm(rows.mean(axis=0)))
    chance = float(rows.var(axis=0, ddof=1).sum()) / n
    return apart, max(apart**2 - chance, 0.0) / 2.0
