"""The gap between data and model in nats per sample, its floor, and its interval.

``gap = sum_f (D_f - E_f) / (2 N)``: D_f is the squared distance of the statistics of a family from what the
model gives, in its covariance, E_f the distance that replicates of the model itself have, N the number of
samples. It estimates the Kullback-Leibler divergence per sample between the laws of the statistics, so it
does not grow with the data; more data only lowers the floor, the 95 % quantile of what the model has against
itself. One covariance, that of the model before anything was added, measures all models of a comparison:
otherwise an effect that makes the statistics scatter would shrink the gap by widening the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pchem_pipeline.discrepancy.by_simulation.null import NullModel, moments
from pchem_pipeline.discrepancy.observe.catalogue import FAMILIES, STATISTICS

__all__ = ["Gap", "GapMetric"]

FloatArray = NDArray[np.float64]

_FLOOR_QUANTILE = 0.95
_INTERVAL = 1.96


@dataclass(frozen=True)
class Gap:
    """A gap, nats per sample.

    Attributes:
        value: the gap; negative values are chance.
        floor: what a right model stays below in 19 of 20 stacks.
        interval: 95 % interval.
        families: the contribution of each family of statistics.
    """

    value: float
    floor: float
    interval: tuple[float, float]
    families: dict[str, float]

    @property
    def at_floor(self) -> bool:
        """Whether nothing more can be seen in these frames."""
        return self.value <= self.floor


@dataclass(frozen=True)
class GapMetric:
    """Measures gaps in the covariance of one null model.

    Attributes:
        null: of the model before anything was added.
        n_samples: samples behind each statistic (frames x usable pixels).
    """

    null: NullModel
    n_samples: int
    _known: dict[int, dict[str, FloatArray]] = field(default_factory=dict, repr=False, compare=False)

    def gap(self, z: FloatArray, mean: FloatArray, replicates: FloatArray) -> Gap:
        """Return the gap of a model.

        Args:
            z: measured statistics, shape (m,).
            mean: what the model gives, shape (m,).
            replicates: vectors drawn from a model with that mean or another, for the floor, shape (b, m).
        """
        total, families = 0.0, {}
        own = self._own_distances(replicates)
        for family, index in self._members().items():
            distance = _distances((z - mean)[None, index], self.null.covariance[np.ix_(index, index)])[0]
            families[family] = (float(distance) - float(own[family].mean())) / (2.0 * self.n_samples)
            total += float(distance)
        chance = np.sum(list(own.values()), axis=0)
        scale = 2.0 * self.n_samples
        excess = total - float(chance.mean())
        spread = float(np.sqrt(chance.var(ddof=1) + 4.0 * max(excess, 0.0)))
        return Gap(
            value=excess / scale,
            floor=float(np.quantile(chance, _FLOOR_QUANTILE) - chance.mean()) / scale,
            interval=((excess - _INTERVAL * spread) / scale, (excess + _INTERVAL * spread) / scale),
            families=families,
        )

    def _members(self) -> dict[str, list[int]]:
        """Return the places of the statistics of each family that has any."""
        families = [STATISTICS[name].family for name in self.null.names]
        found = {family: [i for i, f in enumerate(families) if f == family] for family in FAMILIES}
        return {family: index for family, index in found.items() if index}

    def _own_distances(self, replicates: FloatArray) -> dict[str, FloatArray]:
        """Return for each family the distances that data of the model itself would have, shape (b,) each.

        Each replicate is measured against the others, as the data are against all: in the covariance too,
        where that was estimated from it.
        """
        if id(replicates) in self._known:
            return self._known[id(replicates)]
        b = replicates.shape[0]
        known = replicates is self.null.replicates
        own: dict[str, list[float]] = {family: [] for family in self._members()}
        for i in range(b):
            others = np.delete(replicates, i, axis=0)
            mean, _, covariance = (
                moments(others) if known else (others.mean(axis=0), None, self.null.covariance)
            )
            for family, index in self._members().items():
                apart = (replicates[i] - mean)[None, index]
                own[family].append(float(_distances(apart, covariance[np.ix_(index, index)])[0]))
        found = {family: np.array(values) for family, values in own.items()}
        self._known[id(replicates)] = found
        return found


def _distances(residuals: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances of residuals, shape (n, m)."""
    white = linalg.solve_triangular(linalg.cholesky(covariance, lower=True), residuals.T, lower=True)
    return np.asarray(np.sum(white**2, axis=0))
