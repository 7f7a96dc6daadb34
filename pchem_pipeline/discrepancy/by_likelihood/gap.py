"""The gap of a model on histograms: Kullback-Leibler, nats per sample, with its floor and its interval.

``2 G = 2 sum n log(n / (N p))`` against the saturated model is Wilks' statistic; what a right model has of it
by chance, the refit included, comes from replicates (parametric bootstrap; each is refitted by one scoring
step, which is all that a fit near the truth takes: Le Cam 1956). Codes that were set aside keep the
contribution that they had under the plain model: what is not understood does not count as closed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_likelihood.sets import chance_of_cells, saturated
from pchem_pipeline.discrepancy.gap import Gap, among_themselves
from pchem_pipeline.model.fit.shared import SharedFit, SharedProblem, Tangent

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def carried_over(log_masses: FloatArray, counts: IntArray, kept: NDArray[np.bool_]) -> float:
    """Return what codes that were set aside, and their share, contribute to the gap beyond chance, nats.

    With the gap among the kept codes it adds up to that of all codes (chain rule of the divergence).

    Args:
        log_masses: of all codes under the model, shape (n, B).
        counts: histograms, shape (n, B).
        kept: codes that were not set aside, shape (n, B).
    """
    seen = counts.astype(np.float64)
    total = seen.sum(axis=1)
    outside = np.where(kept, 0.0, seen)
    own = (outside * (np.log(np.maximum(outside, 1.0) / total[:, None]) - log_masses)).sum(axis=1)
    inside = np.where(kept, seen, 0.0).sum(axis=1)
    mass = np.where(kept, np.exp(log_masses), 0.0).sum(axis=1)
    share = inside * np.log(np.maximum(inside, 1.0) / total / np.maximum(mass, 1e-300))
    expected = np.where(kept, 0.0, np.exp(log_masses)) * total[:, None]
    chance = chance_of_cells(expected) + chance_of_cells(mass * total)
    return float((own + share).sum() - chance + 0.5 * total.size)


@dataclass(frozen=True)
class LikelihoodGap:
    """Measures gaps by likelihood on one part of the samples.

    Attributes:
        counts: that part, shape (n, B).
        kept: codes that are compared, shape (n, B).
        carried: nats that the other codes keep.
        replicates: behind expectation and floor.
        rng: their random numbers.
    """

    counts: IntArray
    kept: NDArray[np.bool_]
    carried: float
    replicates: int
    rng: np.random.Generator

    @property
    def n_samples(self) -> float:
        """Samples of the part, those in codes set aside included."""
        return float(self.counts.sum())

    def gap(self, problem: SharedProblem, fit: SharedFit) -> Gap:
        """Return the gap of a fit.

        Args:
            problem: what was fitted, on other samples and perhaps fewer codes.
            fit: the fit.
        """
        judged = self._judged(problem)
        log_masses = judged.log_masses(fit.theta, fit.shared)
        distance = self._distance(log_masses, self.counts)
        chance = self.by_chance(problem, fit)
        variance = self._variance(log_masses)
        return Gap.of(distance, chance, self.n_samples, variance=variance, carried=self.carried)

    def value(self, problem: SharedProblem, fit: SharedFit, chance: float) -> float:
        """Return a gap given what chance contributes to it, nats per sample."""
        log_masses = self._judged(problem).log_masses(fit.theta, fit.shared)
        return (self._distance(log_masses, self.counts) - chance + self.carried) / self.n_samples

    def _judged(self, problem: SharedProblem) -> SharedProblem:
        return replace(problem, counts=self.counts, kept=self.kept)

    def _distance(self, log_masses: FloatArray, counts: IntArray) -> float:
        return float((saturated(counts, self.kept) - (counts * log_masses).sum(axis=1)).sum())

    def _variance(self, log_masses: FloatArray) -> float:
        """Return the variance of the sum of the log-ratios of the samples, nats^2."""
        seen = np.where(self.kept, self.counts, 0).astype(np.float64)
        total = np.maximum(seen.sum(axis=1, keepdims=True), 1.0)
        ratio = np.where(seen > 0, np.log(np.maximum(seen, 1.0) / total) - log_masses, 0.0)
        sums = (seen * ratio).sum(axis=1)
        return float(max(((seen * ratio**2).sum(axis=1) - sums**2 / total[:, 0]).sum(), 0.0))

    def by_chance(self, problem: SharedProblem, fit: SharedFit) -> FloatArray:
        """Return distances that replicates of the fit have from their own refits, nats, (b,).

        Those whose one step went astray, as the others show, are left out.
        """
        judged = self._judged(problem)
        tangent = Tangent.at(problem, fit.theta, fit.shared)
        fitted, compared = (
            _frequencies(p.log_masses(fit.theta, fit.shared), p.kept) for p in (problem, judged)
        )
        n_fitted = np.where(problem.kept, problem.counts, 0).sum(axis=1)
        n_compared = np.where(self.kept, self.counts, 0).sum(axis=1)
        still, found = np.zeros(fit.theta.shape[0]), []
        for _ in range(self.replicates):
            drawn = self.rng.multinomial(n_fitted, fitted)
            own, shared, _ = tangent.slopes(drawn).step(still)
            moved = np.clip(fit.shared + shared, problem.bounds[:, 0], problem.bounds[:, 1])
            log_masses = judged.log_masses(fit.theta + own, moved)
            found.append(self._distance(log_masses, self.rng.multinomial(n_compared, compared)))
        distances = np.array(found)
        return distances[among_themselves(distances)]

    def chance(self, problem: SharedProblem, fit: SharedFit) -> float:
        """Return what chance contributes to the distance of a fit, nats."""
        return float(self.by_chance(problem, fit).mean())


def _frequencies(log_masses: FloatArray, kept: NDArray[np.bool_]) -> FloatArray:
    mass = np.where(kept, np.exp(log_masses), 0.0)
    return np.asarray(mass / mass.sum(axis=1, keepdims=True))
