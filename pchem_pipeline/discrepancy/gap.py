"""The gap between data and model in nats per sample, its floor, and its interval.

``gap = sum_f (D_f - E_f) / (2 N)``: D_f is the squared distance of the statistics of a family from what the
model gives, in its covariance, E_f the distance that replicates of the model itself have, N the number of
samples. It estimates the Kullback-Leibler divergence per sample between the laws of the statistics, so it
does not grow with the data; more data only lowers the floor, the 95 % quantile of what the model has against
itself. One covariance, that of the model before anything was added, measures all models of a comparison:
otherwise an effect that makes the statistics scatter would shrink the gap by widening the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.catalogue import FAMILIES, STATISTICS
from pchem_pipeline.discrepancy.null import NullModel

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

    def gap(self, z: FloatArray, mean: FloatArray, replicates: FloatArray) -> Gap:
        """Return the gap of a model.

        Args:
            z: measured statistics, shape (m,).
            mean: what the model gives, shape (m,).
            replicates: vectors drawn from a model with that mean or another, for the floor, shape (b, m).
        """
        b = replicates.shape[0]
        # a replicate's distance from the mean of the others is that of new data from the mean of all
        apart = (replicates - replicates.mean(axis=0)) * b / (b - 1)
        apart *= np.sqrt((1.0 + 1.0 / b) / (1.0 + 1.0 / (b - 1)))
        total, own, families = 0.0, np.zeros(b), {}
        for family in FAMILIES:
            index = [i for i, name in enumerate(self.null.names) if STATISTICS[name].family == family]
            if not index:
                continue
            inverse = np.linalg.inv(self.null.covariance[np.ix_(index, index)])
            residual = (z - mean)[index]
            distance = float(residual @ inverse @ residual)
            chance = np.einsum("bi,ij,bj->b", apart[:, index], inverse, apart[:, index])
            families[family] = (distance - float(chance.mean())) / (2.0 * self.n_samples)
            total += distance
            own += chance
        scale = 2.0 * self.n_samples
        excess = total - float(own.mean())
        spread = float(np.sqrt(own.var(ddof=1) + 4.0 * max(excess, 0.0)))
        return Gap(
            value=excess / scale,
            floor=float(np.quantile(own, _FLOOR_QUANTILE) - own.mean()) / scale,
            interval=((excess - _INTERVAL * spread) / scale, (excess + _INTERVAL * spread) / scale),
            families=families,
        )
