"""The gap between data and model in nats per sample, its floor, and its interval.

``gap = (D - E[D]) / N`` with the distance D of the final samples from the model, nats, its mean over
replicates of the model E[D], and the number of samples N: an estimate of the Kullback-Leibler divergence per
sample, independent of N. The floor is the 95 % quantile of the gap of replicates and falls with N.

Outlying replicates (failed fits) are left out. A gap is at its floor if the sum and each family of statistics
are within sampling noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.null import STRAY, Covariance, NullModel, moments
from pchem_pipeline.discrepancy.observe.catalogue import FAMILIES, STATISTICS
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import chi_square, look_elsewhere, robust_sd

_REST_OF_NAMED = 0.1  # largest remaining gap beside a named effect, over the gap that the effect closes
_FLOOR_QUANTILE = 0.95
_INTERVAL = 1.96
# robust standard deviations from the median beyond which a replicate without effects is an outlier
_APART = 8.0


@dataclass(frozen=True)
class Gap:
    """A gap, nats per sample."""

    value: float  # negative by sampling noise only
    floor: float  # 95 % quantile under the model
    interval: tuple[float, float]  # 95 % interval
    families: Mapping[str, float]  # contribution of each family of statistics
    standing_out: tuple[str, ...] = ()  # families that are significant by themselves

    @classmethod
    def of(
        cls,
        distance: float,
        chance: FloatArray,
        n_samples: float,
        *,
        variance: float,
        families: Mapping[str, float] | None = None,
        standing_out: tuple[str, ...] = (),
    ) -> Gap:
        """Compute gap, floor and interval from a distance, nats, and those of replicates (b,), by chance.

        The variance is what the distance has in addition, nats^2. The families are by default "shape" alone.
        """
        expected = float(chance.mean())
        reach = _INTERVAL * float(np.sqrt(chance.var(ddof=1) + variance))
        total = distance - expected
        value = total / n_samples
        ends = (total - reach) / n_samples, (total + reach) / n_samples
        # unbiased for few replicates: one more exceeds it with probability 0.05
        floor = float(np.quantile(chance, _FLOOR_QUANTILE, method="weibull") - expected) / n_samples
        return cls(value, floor, ends, {"shape": value} if families is None else families, standing_out)

    @property
    def at_floor(self) -> bool:
        """Whether all families together and each by itself are within sampling noise."""
        return self.value <= self.floor and not self.standing_out

    def too_wide(self, closed: float) -> bool:
        """Test whether the lower end of the rest is too large to name an effect that closed so much."""
        return max(self.interval[0], 0.0) >= _REST_OF_NAMED * closed


@dataclass(frozen=True)
class StatisticsGap:
    """Computes gaps from statistics: ``sum_f (D_f - E_f) / (2 N)`` over their families.

    D_f is the squared Mahalanobis distance of the statistics of a family from their expectation, E_f its mean
    over replicates of the model, N is ``n_samples`` (frames x usable pixels). All models are compared with
    one covariance, that of the model before anything was added: otherwise an effect could reduce the gap by
    widening the distribution. Exact counts have the Poisson variance of their expectation in addition.
    """

    null: NullModel
    n_samples: int
    _known: dict[tuple[int, int], tuple[FloatArray, FloatArray | None, dict[str, FloatArray]]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def gap(
        self, z: FloatArray, mean: FloatArray, replicates: FloatArray, strengths: FloatArray | None = None
    ) -> Gap:
        """Compute the gap of the data's statistics ``z`` from their expectation under a model, (m,).

        The floor is from replicates (b, m) of a model with that mean or another. Since strengths of effects
        were fitted to other samples, ``strengths`` are the shifts by one standard error of each, (e, m).
        """
        own, covariance = self._own_distances(replicates, strengths), self._covariance(mean)
        distances = {
            family: 0.5 * float(np.sum(covariance.among(index).white((z - mean)[index]) ** 2))
            for family, index in self._members().items()
        }
        expected = {family: float(values.mean()) for family, values in own.items()}
        chance, total = np.asarray(np.sum(list(own.values()), axis=0), np.float64), sum(distances.values())
        return Gap.of(
            total,
            chance,
            self.n_samples,
            # of a noncentral chi-square: Var(D / 2) beyond chance is the excess of D
            variance=2.0 * max(total - float(chance.mean()), 0.0),
            families={family: (distances[family] - expected[family]) / self.n_samples for family in own},
            standing_out=tuple(
                family for family in own if _stands_out(distances[family], own[family], len(own))
            ),
        )

    def _covariance(self, mean: FloatArray) -> Covariance:
        """Compute the covariance for a model of this expectation."""
        counts = self.null.events * np.maximum(mean - self.null.mean, 0.0)
        return self.null.covariance.plus(counts)

    def _members(self) -> dict[str, list[int]]:
        """Return the indices of the statistics of each family."""
        families = [STATISTICS[name].family for name in self.null.names]
        found = {family: [i for i, f in enumerate(families) if f == family] for family in FAMILIES}
        return {family: index for family, index in found.items() if index}

    def _own_distances(self, replicates: FloatArray, strengths: FloatArray | None) -> dict[str, FloatArray]:
        """Compute half the squared distances of the replicates, (b,) or (2 b,) for each family.

        Leave-one-out, with random errors of the strengths of either sign, without outliers.
        """
        key = id(replicates), id(strengths)
        if key in self._known:
            return self._known[key][2]
        known = replicates is self.null.replicates
        own: dict[str, list[FloatArray]] = {family: [] for family in self._members()}
        random, sides = np.random.default_rng(0), np.array([[1.0], [-1.0]])
        for i in range(replicates.shape[0]):
            others = np.delete(replicates, i, axis=0)
            mean = others.mean(axis=0)
            covariance = moments(others)[2] if known else self._covariance(mean)
            apart = (replicates[i] - mean)[None]
            if strengths is not None:
                apart = apart + sides * (random.standard_normal(len(strengths)) @ strengths)
            for family, index in self._members().items():
                white = covariance.among(index).white(apart[:, index])
                own[family].append(0.5 * np.sum(white**2, axis=1))
        found = {family: np.concatenate(values) for family, values in own.items()}
        total = np.sum(list(found.values()), axis=0)
        middle, apart = float(np.median(total)), _APART if known else STRAY
        # each is half a chi-square, of which this is the least scatter
        kept = total <= middle + apart * max(robust_sd(total), np.sqrt(max(middle, 0.5)))
        found = {family: values[kept] for family, values in found.items()}
        # the vectors are kept with it: an id is given again to what comes after them
        self._known[key] = replicates, strengths, found
        return found


def _stands_out(distance: float, chance: FloatArray, families: int) -> bool:
    """Test whether a family is significant, corrected for the number of families.

    Student's t-test of the cube root (Wilson and Hilferty 1931), since the distance is nearly chi-square.
    """
    mean, variance = float(chance.mean()), float(chance.var(ddof=1)) * (1.0 + 1.0 / chance.size)
    if not (mean > 0.0 and variance > 0.0):
        return False
    deviate = float(chi_square(distance, mean, variance))
    return look_elsewhere(float(special.stdtr(chance.size - 1, -deviate)), families) < SIGNIFICANCE
