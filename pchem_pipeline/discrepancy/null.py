"""The statistics where the model is right, from replicates of it, and whether the data deviate from them.

Replicates are simulated from the fitted model and refitted (parametric bootstrap), so whatever the fit
absorbs is absorbed in them too. Data disagree with the model where a statistic deviates beyond chance, among
all that were looked at, and alike in two parts of the samples.

Tails are not those of the normal law: sums of squares over the pixels are skewed by the few pixels whose law
has rare samples, and a number of pixels or samples is a count of hardly any. The skewness comes from the
replicates, statistics of a kind together; counts have the tail that they are made to have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.covariance import Covariance
from pchem_pipeline.discrepancy.observe.catalogue import EXACT, STATISTICS
from pchem_pipeline.discrepancy.observe.laws import without_skew
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.arithmetic.robust import look_elsewhere, robust_sd

FloatArray = NDArray[np.float64]

_OF_ORDER = ("time", "frame", "space")
# statistics of neighbouring codes, and the period that they look at, DN
_OF_CODES = {"code.alternating": 2, "code.period2": 2, "code.largest": 2, "code.rough": 3, "code.period4": 4}
_SHORTER = 1.5  # than the comb of the electrons such a period must be

# of the correlations between statistics; their estimates from few replicates are noise, so pull them to 0
_SHRINKAGE = 0.6
# standard deviations of statistics are 1 by construction up to a few tenths; the replicates count for that
# many fewer than this number of earlier ones
_PRIOR_WEIGHT = 10.0
_SMALLEST_STD = 0.6
# last words of the names of statistics that are normal quantiles of a count: of few events their scatter is
# far below 1, but their tail is that of the normal law all the same
_COUNTS = ("cnt", "count", "pixels", "clusters")
# errors of its mean by which a statistic must move to count as moved, and the chance of as much more scatter
_MOVED = 4.0
_WIDER = 0.01
_REPLICATION = 0.02  # in each split by itself, and in the same direction
#: Nats on held-out frames that an explanation must be worth where no statistic deviates by itself.
CONVINCING = 6.0
_SUSPICION = 0.1  # chance of a deviation for which it is worth to ask the candidates
# robust standard deviations beyond which a value of a replicate is a single pixel's: with effects, that may
# move a few replicates only, and without
_STRAY, _STRAY_ALONE = 30.0, 10.0
_SIGNATURE = 3.0  # standard deviations by which an effect moves the statistics of its signature


@dataclass(frozen=True)
class NullModel:
    """Mean and covariance of the statistics of one split under a model.

    Attributes:
        names: of the statistics, shape (m,).
        mean: shape (m,).
        std: standard deviations, shape (m,).
        covariance: shrunk towards its diagonal.
        replicates: the vectors, shape (b, m).
        skewness: of the statistics of one split, shape (m,).
        effective_tests: number of independent statistics that the largest of them is worth.
        strengths: by how much a standard error of the strength of each effect moves the statistics, (e, m).
    """

    names: tuple[str, ...]
    mean: FloatArray
    std: FloatArray
    covariance: Covariance
    replicates: FloatArray
    skewness: FloatArray
    effective_tests: float
    strengths: FloatArray | None = None

    @classmethod
    def from_replicates(
        cls,
        names: tuple[str, ...],
        vectors: FloatArray,
        before: NullModel | None = None,
        *,
        effects: bool = False,
    ) -> NullModel:
        """Estimate from replicates, shape (b, m).

        Args:
            names: of the statistics.
            vectors: the replicates.
            before: null of the model to which effects were added: statistics that they leave where they were,
                and do not widen, scatter as they did, which few new replicates need not show again.
            effects: whether the model has effects, as one with a model before it has.
        """
        vectors = without_strays(vectors, _STRAY if effects or before is not None else _STRAY_ALONE)
        mean, std, covariance = moments(vectors)
        skewness = _skewness(names, vectors)
        tests = _effective_tests(names, vectors, skewness)
        if before is not None:
            moved = before.moved_by(vectors)
            pooled = np.where(moved, std, _pooled(std, len(vectors), before.std, before.n_replicates))
            covariance = covariance.scaled(pooled / std)
            std, skewness, tests = pooled, before.skewness, before.effective_tests
        return cls(names, mean, std, covariance, vectors, skewness, tests)

    def moved_by(self, vectors: FloatArray) -> NDArray[np.bool_]:
        """Tell which statistics effects move or widen, shape (m,), from replicates with them, shape (b, m).

        A common mode scatters trends and correlations in time without moving them.
        """
        n = len(vectors)
        moved = np.abs(vectors.mean(axis=0) - self.mean) > _MOVED * self.std / np.sqrt(n)
        wider = special.fdtrc(n - 1, self.freedom, vectors.var(axis=0, ddof=1) / self.std**2)
        return np.asarray(moved | (wider < _WIDER))

    def shifted(self, shift: FloatArray) -> NullModel:
        """Return the null of a model that gives ``shift`` more, shape (m,)."""
        return replace(self, mean=self.mean + shift, replicates=self.replicates + shift)

    @property
    def n_replicates(self) -> int:
        """Number of replicates."""
        return int(self.replicates.shape[0])

    @property
    def events(self) -> FloatArray:
        """By how much an event raises each exact count; 0 for all other statistics, shape (m,)."""
        return np.array([EXACT.get(name.partition("@")[0], 0.0) for name in self.names])

    @property
    def counts(self) -> NDArray[np.bool_]:
        """Which statistics are normal quantiles of a count, shape (m,)."""
        return _are_counts(self.names)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the standard deviations."""
        return self.n_replicates - 1 + _PRIOR_WEIGHT

    def pulls(self, z: FloatArray, splits: int = 1) -> FloatArray:
        """Return (z - mean) / std for the mean of ``splits`` vectors, with the error of the mean."""
        scale = np.sqrt(1.0 / splits + 1.0 / self.n_replicates)
        return np.asarray((z - self.mean) / (self.std * scale))

    def p_values(self, z: FloatArray, splits: int = 1) -> FloatArray:
        """Return two-sided p-values of the mean of ``splits`` vectors."""
        return self.p_of(self.pulls(z, splits), splits)

    def p_of(self, pulls: FloatArray, splits: int = 1) -> FloatArray:
        """Return two-sided p-values of pulls of the mean of ``splits`` vectors.

        Student's t, since the standard deviation comes from few replicates, of the pulls without their skew
        (Wilson and Hilferty 1931).
        """
        straight = _straight(self.names, pulls, self.std, self.skewness / np.sqrt(splits))
        return two_sided(straight, self.freedom)

    def global_p(self, z: FloatArray, splits: int = 1) -> float:
        """Return the probability that any statistic deviates as much as the most deviating one."""
        return look_elsewhere(float(self.p_values(z, splits).min()), self.effective_tests)


def moments(vectors: FloatArray) -> tuple[FloatArray, FloatArray, Covariance]:
    """Return mean, standard deviation and shrunk covariance of replicates, shape (b, m)."""
    mean = vectors.mean(axis=0)
    off = vectors - mean
    std, length = _std(off), np.linalg.norm(off, axis=0)
    # deviations of length 1, whose products are the correlations; one that is always the same has none
    common = np.sqrt(1.0 - _SHRINKAGE) * off / np.where(length > 0.0, length, 1.0)
    own = np.where(length > 0.0, _SHRINKAGE, 1.0)
    return mean, std, Covariance(own, common).scaled(std)


def two_sided(pulls: FloatArray, freedom: float) -> FloatArray:
    """Return two-sided p-values of Student's t, at least 1e-300."""
    return np.asarray(np.maximum(2.0 * special.stdtr(freedom, -np.abs(pulls)), 1e-300))


def without_strays(vectors: FloatArray, apart: float = _STRAY) -> FloatArray:
    """Return replicates, (b, m), in which no value is farther from the others than any scatter takes it.

    A single pixel that no fit holds makes a sum of squares of one replicate thousands of times as large as in
    all others; its mean and scatter would be those of that pixel. What is farther than ``apart`` robust
    standard deviations from the median is taken to be as far.
    """
    middle = np.median(vectors, axis=0)
    # statistics scatter by about 1 without effects
    reach = apart * np.maximum(robust_sd(vectors, middle, axis=0), 1.0)
    return np.asarray(np.clip(vectors, middle - reach, middle + reach))


def as_matrix(
    names: Sequence[str], vectors: Sequence[Mapping[str, float]], usual: FloatArray | None = None
) -> FloatArray:
    """Return statistics as rows in the order of the names.

    One that a vector lacks, since too few of its pixels or pairs could be used, says nothing: it is the mean
    of the others, or the usual value where none has it.

    Args:
        names: of the statistics, shape (m,).
        vectors: by name.
        usual: value of each, shape (m,); None: at least one vector has it.

    Raises:
        KeyError: no vector has a statistic, and nothing is usual.
    """
    found = np.array([[vector.get(name, np.nan) for name in names] for vector in vectors], np.float64)
    lacking = np.array([[name not in vector for name in names] for vector in vectors], np.bool_)
    for j in np.flatnonzero(lacking.any(axis=0)):
        there = found[~lacking[:, j], j]
        if not there.size and usual is None:
            raise KeyError(names[int(j)])
        found[lacking[:, j], j] = there.mean() if there.size else np.asarray(usual)[j]
    return found


def _pooled(first: FloatArray, n_first: int, second: FloatArray, n_second: int) -> FloatArray:
    return np.asarray(np.sqrt((n_first * first**2 + n_second * second**2) / (n_first + n_second)))


def _std(deviations: FloatArray) -> FloatArray:
    return _std_of(np.sum(deviations**2, axis=0), deviations.shape[0] - 1)


def _std_of(squares: FloatArray, freedom: float) -> FloatArray:
    """Return standard deviations of sums of squares; 1 is what is known beforehand.

    That may not make a statistic that scatters more look quieter than it is.
    """
    own = np.maximum(squares, 0.0)
    variance = np.maximum((own + _PRIOR_WEIGHT) / (freedom + _PRIOR_WEIGHT), own / freedom)
    return np.asarray(np.maximum(np.sqrt(variance), _SMALLEST_STD))


def _kind(name: str) -> str:
    """Return the last word of the name of a statistic, without the part that it is of."""
    return name.partition("@")[0].rpartition(".")[2]


def _are_counts(names: Sequence[str]) -> NDArray[np.bool_]:
    return np.isin([_kind(name) for name in names], _COUNTS)


def _skewness(names: Sequence[str], vectors: FloatArray) -> FloatArray:
    """Return the skewness of statistics, shape (m,).

    From few replicates it is noise, or misses what is rare: each is drawn to the mean of its kind as far as
    those of a kind do not differ by more than chance (empirical Bayes).
    """
    n = vectors.shape[0]
    off = vectors - vectors.mean(axis=0)
    own = np.mean(off**3, axis=0) / _std(off) ** 3
    chance = 6.0 / n
    kinds, found = np.array([_kind(name) for name in names]), np.zeros(own.size)
    for kind in np.unique(kinds):
        some = kinds == kind
        # one more that has none, so that a kind of one is not believed
        usual = own[some].sum() / (some.sum() + 1.0)
        real = max(float(np.mean((own[some] - usual) ** 2)) - chance, 0.0)
        found[some] = usual + real / (real + chance) * (own[some] - usual)
    return np.where(np.isin(kinds, _COUNTS), 0.0, found)


def _straight(names: Sequence[str], pulls: FloatArray, std: FloatArray, skewness: FloatArray) -> FloatArray:
    """Return pulls as normal quantiles: counts at no less than their own scale, the others without skew.

    Not on their short side: a skewness by rare samples does not say that it ends.
    """
    scaled = pulls * np.where(_are_counts(names), np.minimum(std, 1.0), 1.0)
    straight = without_skew(scaled, skewness)
    return np.where(np.abs(straight) < np.abs(scaled), straight, scaled)


def _effective_tests(names: Sequence[str], vectors: FloatArray, skewness: FloatArray) -> float:
    """Return the m for which the smallest of m independent p-values is spread like that of the replicates.

    Each replicate is standardised by the others. The maximum-likelihood m of ``P(p_min < p) = 1 - (1 -
    p)^m`` is -1 / mean(log(1 - p_min)).
    """
    n, m = vectors.shape
    total, squares = vectors.sum(axis=0), (vectors**2).sum(axis=0)
    mean = (total - vectors) / (n - 1)
    std = _std_of((squares - vectors**2) - (n - 1) * mean**2, n - 2)
    pulls = (vectors - mean) / (std * np.sqrt(1.0 + 1.0 / (n - 1)))
    smallest = two_sided(_straight(names, pulls, std, skewness), n - 2 + _PRIOR_WEIGHT).min(axis=1)
    return float(np.clip(-1.0 / np.mean(np.log1p(-smallest)), 1.0, 4.0 * m))


@dataclass(frozen=True)
class Measured:
    """The statistics of the data, shape (m,) each.

    Attributes:
        train, test: of the parts that effects are found on.
        final: of the part that only the gap is measured on.
    """

    train: FloatArray
    test: FloatArray
    final: FloatArray

    @property
    def both(self) -> FloatArray:
        """Mean of the train and test splits."""
        return (self.train + self.test) / 2.0


def free_of_parameters(names: Sequence[str], maps: PixelMaps) -> NDArray[np.bool_]:
    """Tell of statistics whether they are what they are whatever the pixels' fitted parameters, shape (m,).

    Given the histograms, frames without an effect are in random order: all along time, between pixels and
    frames follows from that alone. So do codes that differ from their neighbours, if electrons are farther
    apart than that; the smooth rest of the histograms' shape is what the parameters bend.

    Args:
        names: of the statistics.
        maps: fitted parameters, of which the gain tells how far apart electrons are.
    """
    step = float(np.nanmedian(1.0 / maps.conversion_gain[maps.usable])) if maps.usable.any() else 0.0
    free = {name for name, period in _OF_CODES.items() if _SHORTER * period <= step}
    kinds = ((STATISTICS[name].family, name) for name in names)
    return np.array([f in _OF_ORDER or name in free for f, name in kinds], np.bool_)


def disagrees(
    null: NullModel,
    z: Measured,
    significance: float,
    tolerance: FloatArray | float = 0.0,
) -> bool:
    """Tell whether some statistic deviates more than chance allows, and does so in both splits.

    Args:
        null: of the model.
        z: the data.
        significance: allowed probability of a chance, anywhere among the statistics.
        tolerance: deviation that is not held against the model, shape (m,): effects that it has are never
            known in every detail.
    """
    p = _p_values(null, z, tolerance)
    limit = 1.0 - (1.0 - significance) ** (1.0 / null.effective_tests)
    pulls = [_pulls(null, part, tolerance, 1) for part in (z.train, z.test)]
    alone = [null.p_of(pull) < _REPLICATION for pull in pulls]
    same = alone[0] & alone[1] & (pulls[0] * pulls[1] > 0)
    same |= np.isin(null.names, list(EXACT))  # no false positives: one split is enough
    return bool(np.any(same & (p < limit)))


def suspicious(null: NullModel, z: Measured) -> bool:
    """Tell whether some statistic deviates so far that a candidate may explain it together with others.

    An effect moves many statistics a little: where none is beyond chance by itself, all in the direction that
    the effect asks for may be.
    """
    p = null.p_values(z.both, 2)
    same = (z.train - null.mean) * (z.test - null.mean) > 0
    return bool(same.any()) and look_elsewhere(float(p[same].min()), null.effective_tests) < _SUSPICION


def misfits(
    null: NullModel, z: Measured, shift: FloatArray, significance: float, tolerance: FloatArray
) -> bool:
    """Tell whether an effect of the model fails in what it moves itself: then it is not the right one.

    Args:
        null: of the model with the effect.
        z: the data.
        shift: by how much the effect moves the statistics, shape (m,).
        significance: allowed probability of a chance.
        tolerance: see :func:`disagrees`.
    """
    signature = np.abs(shift) > _SIGNATURE * null.std
    if not signature.any():
        return False
    smallest = float(_p_values(null, z, tolerance)[signature].min())
    tests = min(null.effective_tests, float(signature.sum()))
    return look_elsewhere(smallest, tests) < significance


def _p_values(null: NullModel, z: Measured, tolerance: FloatArray | float) -> FloatArray:
    return null.p_of(_pulls(null, z.both, tolerance, 2), 2)


def _pulls(null: NullModel, z: FloatArray, tolerance: FloatArray | float, splits: int) -> FloatArray:
    chance = null.std**2 * (1.0 / splits + 1.0 / null.n_replicates)
    return np.asarray((z - null.mean) / np.sqrt(chance + np.square(tolerance)))
