"""The gap between data and model in nats per sample, its floor, and its interval.

A gap is a distance of the final samples from the model, less what replicates of the model have of it by
chance, over the number of samples: an estimate of a Kullback-Leibler divergence per sample. It does not grow
with the data; more data only lowers the floor, the 95 % quantile of what the model has against itself.

Replicates are compared among themselves before they judge the data: one whose distance no other one has says
how a fit goes astray, not what chance makes. And what one family of statistics shows is not lost in the
chance of the others: a gap is at its floor where the sum and each family are within chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.covariance import Covariance
from pchem_pipeline.discrepancy.null import NullModel, moments
from pchem_pipeline.discrepancy.observe.catalogue import FAMILIES, STATISTICS
from pchem_pipeline.model.arithmetic.robust import chi_square, look_elsewhere, robust_sd

FloatArray = NDArray[np.float64]

_REST_OF_NAMED = 0.1  # of the gap that an effect closes, the most that may be left where it gets a name
_FLOOR_QUANTILE = 0.95
_INTERVAL = 1.96
# robust standard deviations from the middle beyond which the distance of a replicate is no chance: of data
# without effects, and with some, that may come in a few replicates only
_APART, _APART_WITH_EFFECTS = 8.0, 30.0
_BEYOND_CHANCE = 1e-3  # probability of any family, below which it stands out by itself


@dataclass(frozen=True)
class Gap:
    """A gap, nats per sample.

    Attributes:
        value: the gap; negative values are chance.
        floor: what a right model stays below in 19 of 20 data sets.
        interval: 95 % interval.
        families: the contribution of each family of statistics.
        standing_out: families that are farther from the model than chance takes them.
    """

    value: float
    floor: float
    interval: tuple[float, float]
    families: Mapping[str, float]
    standing_out: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        distance: float,
        chance: FloatArray,
        n_samples: float,
        *,
        variance: float,
        carried: float = 0.0,
        families: Mapping[str, float] | None = None,
        standing_out: tuple[str, ...] = (),
    ) -> Gap:
        """Return the gap of a distance.

        Args:
            distance: of the data from the model, nats.
            chance: distances that replicates of the model have, nats, shape (b,).
            n_samples: behind the distance.
            variance: of the distance beyond that by chance, nats^2.
            carried: part of the gap that the distance does not hold, nats.
            families: contributions, nats per sample; None: all is of the shape of the histograms.
            standing_out: families beyond chance.
        """
        expected = float(chance.mean())
        spread = float(np.sqrt(chance.var(ddof=1) + variance))
        total = distance - expected + carried
        value = total / n_samples
        ends = (total - _INTERVAL * spread) / n_samples, (total + _INTERVAL * spread) / n_samples
        # of few replicates the quantile that one more exceeds in as many cases as it says
        floor = float(np.quantile(chance, _FLOOR_QUANTILE, method="weibull") - expected) / n_samples
        return cls(value, floor, ends, {"shape": value} if families is None else families, standing_out)

    @property
    def at_floor(self) -> bool:
        """Whether nothing more can be seen in these samples, in all families together and in each."""
        return self.value <= self.floor and not self.standing_out

    def too_wide(self, closed: float) -> bool:
        """Tell whether so much is left that an effect which closed some gets no name.

        What counts is what the samples prove to be left: few of them tell the gap of a weak effect from none
        badly.
        """
        return max(self.interval[0], 0.0) >= _REST_OF_NAMED * closed


@dataclass(frozen=True)
class StatisticsGap:
    """Measures gaps by statistics: ``sum_f (D_f - E_f) / (2 N)`` over their families.

    D_f is the squared distance of the statistics of a family from what the model gives, in their covariance,
    E_f the distance that replicates of the model itself have. One covariance, that of the model before
    anything was added, measures all models of a comparison: otherwise an effect that makes the statistics
    scatter would shrink the gap by widening the noise. Only exact counts scatter as the Poisson counts that
    the model says they are: without an effect that predicts some there is none.

    Attributes:
        null: of the model before anything was added.
        n_samples: samples behind each statistic (frames x usable pixels).
    """

    null: NullModel
    n_samples: int
    _known: dict[tuple[int, int], tuple[FloatArray, FloatArray | None, dict[str, FloatArray]]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def gap(
        self,
        z: FloatArray,
        mean: FloatArray,
        replicates: FloatArray,
        strengths: FloatArray | None = None,
    ) -> Gap:
        """Return the gap of a model.

        Args:
            z: measured statistics, shape (m,).
            mean: what the model gives, shape (m,).
            replicates: vectors drawn from a model with that mean or another, for the floor, shape (b, m).
            strengths: by how much a standard error of the strength of each effect moves the statistics, shape
                (e, m); they were fitted to other samples, so that a right model, too, is off by that.
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
        """Return the covariance that measures a model that gives ``mean``."""
        counts = self.null.events * np.maximum(mean - self.null.mean, 0.0)
        return self.null.covariance.plus(counts)

    def _members(self) -> dict[str, list[int]]:
        """Return the places of the statistics of each family that has any."""
        families = [STATISTICS[name].family for name in self.null.names]
        found = {family: [i for i, f in enumerate(families) if f == family] for family in FAMILIES}
        return {family: index for family, index in found.items() if index}

    def _own_distances(self, replicates: FloatArray, strengths: FloatArray | None) -> dict[str, FloatArray]:
        """Return for each family half the squared distances of data of the model, (b,) or (2 b,) each.

        Each replicate is measured against the others, as the data are against all: in the covariance too,
        where that was estimated from it. Its strengths are off to one side and to the other. Those that are
        farther off than the others allow are left out.
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
        kept = among_themselves(
            np.sum(list(found.values()), axis=0), _APART if known else _APART_WITH_EFFECTS
        )
        found = {family: values[kept] for family, values in found.items()}
        # the vectors are kept with it: an id is given again to what comes after them
        self._known[key] = replicates, strengths, found
        return found


def among_themselves(distances: FloatArray, apart: float = _APART) -> NDArray[np.bool_]:
    """Tell which replicates are no farther from the model than the others allow, (b,).

    Args:
        distances: half a chi-square each, nats, shape (b,).
        apart: standard deviations, by the others or at least by the law of a chi-square.
    """
    middle = float(np.median(distances))
    return np.asarray(distances <= middle + apart * max(robust_sd(distances), np.sqrt(max(middle, 0.5))))


def _stands_out(distance: float, chance: FloatArray, families: int) -> bool:
    """Tell whether chance hardly takes any of so many families as far from the model as one is.

    Student's t, since replicates are few, of the cube root of what is nearly a chi-square.
    """
    mean, variance = float(chance.mean()), float(chance.var(ddof=1)) * (1.0 + 1.0 / chance.size)
    if not (mean > 0.0 and variance > 0.0):
        return False
    deviate = float(chi_square(distance, mean, variance))
    return look_elsewhere(float(special.stdtr(chance.size - 1, -deviate)), families) < _BEYOND_CHANCE
