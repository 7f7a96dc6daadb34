"""Null distribution of the statistics from replicates of the model, and tests of the data against it.

Replicates are simulated from the fitted model and refitted (parametric bootstrap, Efron 1979), so that data
and replicates lose the same degrees of freedom to the fit. Data and model disagree if a statistic is
significant after correction for the number of statistics, with the same sign in two parts of the samples.

The distributions are not normal: sums of squares over pixels are skewed by rare samples of a few pixels, and
numbers of pixels or samples are small counts. The skewness is estimated from the replicates, pooled over
statistics of a kind; counts are normal quantiles by construction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.observe.catalogue import EXACT, STATISTICS
from pchem_pipeline.discrepancy.observe.laws import without_skew
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.arithmetic.significance import CERTAIN, PRICE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere, robust_sd

# statistics of neighbouring codes, and their period, DN
_OF_CODES = {"code.alternating": 2, "code.period2": 2, "code.largest": 2, "code.rough": 3, "code.period4": 4}
_SHORTER = 1.5  # smallest peak distance over such a period at which the fit cannot absorb it

# shrinkage of correlations between statistics towards 0, since few replicates estimate them poorly
_SHRINKAGE = 0.6
# weight of the prior that standard deviations are 1 (they are within a few tenths), in replicates
_PRIOR_WEIGHT = 10.0
_SMALLEST_STD = 0.6
# last words of the names of statistics that are normal quantiles of a count: of few events their scatter is
# far below 1, but their tail is normal all the same
_COUNTS = ("cnt", "count", "pixels", "clusters")
_WIDER = 0.01  # p-value below which a statistic has widened
_REPLICATION = 0.02  # p-value required in each split, with the same sign
#: Held-out log-likelihood ratio, nats, required where no statistic is significant by itself.
CONVINCING = 2.0 * PRICE
_SUSPICION = 0.1  # global p-value below which candidates are compared
#: Robust standard deviations beyond which a replicate is an outlier: with effects, which may change a few
#: replicates only; and at which a statistic is winsorised without any.
STRAY, _STRAY_ALONE = 30.0, 10.0


@dataclass(frozen=True)
class Covariance:
    """A covariance ``diag(own) + common.T @ common`` of many statistics from few replicates.

    The sample covariance shrunk towards its diagonal has this form, and so have all sums with it; whitening
    is linear in the number of statistics, not cubic.
    """

    own: FloatArray  # variance of each statistic by itself, above 0, shape (m,)
    common: FloatArray  # modes that they share, shape (r, m)

    @property
    def variances(self) -> FloatArray:
        """Variance of each statistic, shape (m,)."""
        return np.asarray(self.own + np.einsum("rm,rm->m", self.common, self.common))

    def times(self, factor: float) -> Covariance:
        """Return the covariance times a factor that is not negative."""
        return Covariance(self.own * factor, self.common * np.sqrt(factor))

    def scaled(self, ratio: FloatArray) -> Covariance:
        """Return the covariance of statistics that are each multiplied by a ratio, shape (m,)."""
        return Covariance(self.own * ratio**2, self.common * ratio)

    def plus(self, variances: FloatArray) -> Covariance:
        """Return the covariance with independent variances added, shape (m,)."""
        return replace(self, own=self.own + variances)

    def with_modes(self, modes: FloatArray) -> Covariance:
        """Return the covariance with further common modes, shape (k, m)."""
        return replace(self, common=np.concatenate([self.common, modes]))

    def among(self, kept: BoolArray | list[int]) -> Covariance:
        """Return the covariance of some of the statistics."""
        return Covariance(self.own[kept], self.common[:, kept])

    def white(self, rows: FloatArray) -> FloatArray:
        """Whiten vectors, (..., m): return them in a basis in which their covariance is the identity."""
        scale, modes, change, _ = self._whitening
        scaled = rows / scale
        return np.asarray(scaled + ((scaled @ modes.T) * change) @ modes)

    @property
    def log_root_determinant(self) -> float:
        """Half the logarithm of the determinant."""
        return self._whitening[3]

    @cached_property
    def _whitening(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Own deviations, orthonormal common modes, the shrinkage of each, half the log determinant.

        From the eigenvectors of the smaller of ``V V.T`` and ``V.T V`` with V the scaled common modes.
        """
        scale = np.sqrt(self.own)
        common = self.common / scale
        few = len(common) < scale.size
        sizes, axes = np.linalg.eigh(common @ common.T if few else common.T @ common)
        real = sizes > 1e-12 * max(float(sizes.max(initial=0.0)), 1.0)
        sizes = sizes[real]
        modes = axes[:, real].T
        if few:
            modes = modes @ common / np.sqrt(sizes)[:, None]
        half = float(np.sum(np.log(scale)) + 0.5 * np.sum(np.log1p(sizes)))
        return scale, modes, 1.0 / np.sqrt(1.0 + sizes) - 1.0, half


@dataclass(frozen=True)
class NullModel:
    """Mean, covariance and skewness of the statistics of one split under a model."""

    names: tuple[str, ...]  # names of the statistics, (m,)
    mean: FloatArray  # of each, (m,)
    std: FloatArray  # standard deviation of each, (m,)
    covariance: Covariance  # shrunk towards its diagonal
    replicates: FloatArray  # the vectors, (b, m)
    skewness: FloatArray  # skewness of the statistics of one split, (m,)
    effective_tests: float  # equivalent number of independent statistics
    strengths: FloatArray | None = None  # shifts by one standard error of the strength of each effect, (e, m)

    @classmethod
    def from_replicates(
        cls,
        names: tuple[str, ...],
        vectors: FloatArray,
        before: NullModel | None = None,
        *,
        effects: bool = False,
    ) -> NullModel:
        """Estimate the null distribution from replicates, shape (b, m).

        Standard deviations of statistics that added effects neither shift nor widen are pooled with those of
        the model before. ``effects``: whether the model has any, as one with a model before it has.
        """
        vectors = without_strays(vectors, STRAY if effects or before is not None else _STRAY_ALONE)
        mean, std, covariance = moments(vectors)
        skewness = _skewness(names, vectors)
        tests = _effective_tests(names, vectors, skewness)
        if before is not None:
            moved = before.moved_by(vectors)
            n, m = len(vectors), before.n_replicates
            pooled = np.where(moved, std, np.sqrt((n * std**2 + m * before.std**2) / (n + m)))
            covariance = covariance.scaled(pooled / std)
            std, skewness, tests = pooled, before.skewness, before.effective_tests
        return cls(names, mean, std, covariance, vectors, skewness, tests)

    def moved_by(self, vectors: FloatArray) -> BoolArray:
        """Test which statistics effects, in replicates (b, m), shift (t-test) or widen (F-test), shape (m,).

        A common mode widens trends and correlations in time without shifting them.
        """
        n = len(vectors)
        moved = np.abs(vectors.mean(axis=0) - self.mean) > CERTAIN * self.std / np.sqrt(n)
        wider = special.fdtrc(n - 1, self.freedom, vectors.var(axis=0, ddof=1) / self.std**2)
        return np.asarray(moved | (wider < _WIDER))

    def shifted(self, shift: FloatArray) -> NullModel:
        """Return the null with shifted means, shape (m,)."""
        return replace(self, mean=self.mean + shift, replicates=self.replicates + shift)

    @property
    def n_replicates(self) -> int:
        """Number of replicates."""
        return int(self.replicates.shape[0])

    @property
    def events(self) -> FloatArray:
        """Increase of each exact count by one event, 0 for all other statistics, shape (m,)."""
        return np.array([EXACT.get(name.partition("@")[0], 0.0) for name in self.names])

    @property
    def counts(self) -> BoolArray:
        """Which statistics are normal quantiles of a count, shape (m,)."""
        return _are_counts(self.names)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the standard deviations."""
        return self.n_replicates - 1 + _PRIOR_WEIGHT

    def pulls(self, z: FloatArray, splits: int = 1, tolerance: FloatArray | float = 0.0) -> FloatArray:
        """Compute (z - mean) / sqrt(std^2 (1/splits + 1/b) + tolerance^2), z a mean of ``splits`` vectors."""
        chance = self.std**2 * (1.0 / splits + 1.0 / self.n_replicates)
        return np.asarray((z - self.mean) / np.sqrt(chance + np.square(tolerance)))

    def p_values(self, z: FloatArray, splits: int = 1, tolerance: FloatArray | float = 0.0) -> FloatArray:
        """Compute two-sided p-values of the mean of ``splits`` vectors."""
        return self.p_of(self.pulls(z, splits, tolerance), splits)

    def p_of(self, pulls: FloatArray, splits: int = 1) -> FloatArray:
        """Compute two-sided p-values of pulls of the mean of ``splits`` vectors.

        Student's t (few replicates) of pulls without their skewness (Wilson and Hilferty 1931).
        """
        straight = _straight(self.names, pulls, self.std, self.skewness / np.sqrt(splits))
        return two_sided(straight, self.freedom)

    def global_p(self, z: FloatArray, splits: int = 1) -> float:
        """Compute the smallest p-value, corrected for the effective number of statistics (Sidak)."""
        return look_elsewhere(float(self.p_values(z, splits).min()), self.effective_tests)


def moments(vectors: FloatArray) -> tuple[FloatArray, FloatArray, Covariance]:
    """Compute mean, standard deviation and shrunk covariance of replicates, shape (b, m)."""
    mean = vectors.mean(axis=0)
    off = vectors - mean
    std, length = _std(np.sum(off**2, axis=0), len(off) - 1), np.linalg.norm(off, axis=0)
    # deviations of length 1, whose products are the correlations; a constant has none
    common = np.sqrt(1.0 - _SHRINKAGE) * off / np.where(length > 0.0, length, 1.0)
    own = np.where(length > 0.0, _SHRINKAGE, 1.0)
    return mean, std, Covariance(own, common).scaled(std)


def two_sided(pulls: FloatArray, freedom: float) -> FloatArray:
    """Compute two-sided p-values of Student's t, at least 1e-300."""
    return np.asarray(np.maximum(2.0 * special.stdtr(freedom, -np.abs(pulls)), 1e-300))


def without_strays(vectors: FloatArray, apart: float = STRAY) -> FloatArray:
    """Winsorise replicates, (b, m), at ``apart`` robust standard deviations from the median.

    A single badly fitted pixel would dominate mean and standard deviation of a sum of squares.
    """
    middle = np.median(vectors, axis=0)
    # statistics scatter by about 1 without effects
    reach = apart * np.maximum(robust_sd(vectors, middle, axis=0), 1.0)
    return np.asarray(np.clip(vectors, middle - reach, middle + reach))


def as_matrix(
    names: Sequence[str], vectors: Sequence[Mapping[str, float]], usual: FloatArray | None = None
) -> FloatArray:
    """Arrange statistics as a matrix (vector, m) in the order of the names.

    A missing value (too few usable pixels or pairs) is replaced by the mean of the other vectors, or by
    ``usual``, shape (m,), if all lack it.

    Raises:
        KeyError: no vector has a statistic, and there is no default.
    """
    found = np.array([[vector.get(name, np.nan) for name in names] for vector in vectors], np.float64)
    missing = np.array([[name not in vector for name in names] for vector in vectors], np.bool_)
    for j in np.flatnonzero(missing.any(axis=0)):
        known = found[~missing[:, j], j]
        if not known.size and usual is None:
            raise KeyError(names[int(j)])
        found[missing[:, j], j] = known.mean() if known.size else np.asarray(usual)[j]
    return found


def _std(squares: FloatArray, freedom: float) -> FloatArray:
    """Compute standard deviations from sums of squares with the prior 1, which only raises small ones."""
    own = np.maximum(squares, 0.0)
    variance = np.maximum((own + _PRIOR_WEIGHT) / (freedom + _PRIOR_WEIGHT), own / freedom)
    return np.asarray(np.maximum(np.sqrt(variance), _SMALLEST_STD))


def _kind(name: str) -> str:
    """Return the last word of the name of a statistic, without its part of the sensor."""
    return name.partition("@")[0].rpartition(".")[2]


def _are_counts(names: Sequence[str]) -> BoolArray:
    return np.isin([_kind(name) for name in names], _COUNTS)


def _skewness(names: Sequence[str], vectors: FloatArray) -> FloatArray:
    """Compute the skewness of statistics, shape (m,), shrunk to the mean of their kind (empirical Bayes).

    The sampling variance of a skewness from n replicates is 6/n.
    """
    n = vectors.shape[0]
    off = vectors - vectors.mean(axis=0)
    own = np.mean(off**3, axis=0) / _std(np.sum(off**2, axis=0), n - 1) ** 3
    chance = 6.0 / n
    kinds, found = np.array([_kind(name) for name in names]), np.zeros(own.size)
    for kind in np.unique(kinds):
        some = kinds == kind
        # one more without skewness, so that a kind of one is shrunk to 0
        usual = own[some].sum() / (some.sum() + 1.0)
        real = max(float(np.mean((own[some] - usual) ** 2)) - chance, 0.0)
        found[some] = usual + real / (real + chance) * (own[some] - usual)
    return np.where(np.isin(kinds, _COUNTS), 0.0, found)


def _straight(names: Sequence[str], pulls: FloatArray, std: FloatArray, skewness: FloatArray) -> FloatArray:
    """Transform pulls to normal quantiles: counts with a standard deviation >= 1, others without skew.

    Only the long tail is transformed: skewness by rare samples does not shorten the other tail.
    """
    scaled = pulls * np.where(_are_counts(names), np.minimum(std, 1.0), 1.0)
    straight = without_skew(scaled, skewness)
    return np.where(np.abs(straight) < np.abs(scaled), straight, scaled)


def _effective_tests(names: Sequence[str], vectors: FloatArray, skewness: FloatArray) -> float:
    """Compute the effective number of independent tests from the smallest p-value of each replicate.

    The maximum-likelihood m of ``P(p_min < p) = 1 - (1 - p)^m`` is ``-1 / mean(log(1 - p_min))``.
    """
    n, m = vectors.shape
    total, squares = vectors.sum(axis=0), (vectors**2).sum(axis=0)
    mean = (total - vectors) / (n - 1)
    std = _std((squares - vectors**2) - (n - 1) * mean**2, n - 2)
    pulls = (vectors - mean) / (std * np.sqrt(1.0 + 1.0 / (n - 1)))
    smallest = two_sided(_straight(names, pulls, std, skewness), n - 2 + _PRIOR_WEIGHT).min(axis=1)
    return float(np.clip(-1.0 / np.mean(np.log1p(-smallest)), 1.0, 4.0 * m))


@dataclass(frozen=True)
class Measured:
    """The statistics of the data, shape (m,) each; the final part is used only to measure the gap."""

    train: FloatArray
    test: FloatArray
    final: FloatArray

    @property
    def both(self) -> FloatArray:
        """Mean of train and test."""
        return (self.train + self.test) / 2.0


def free_of_parameters(names: Sequence[str], maps: PixelMaps) -> BoolArray:
    """Return which statistics do not depend on the pixels' fitted parameters (are ancillary), shape (m,).

    Given the histograms, frames without an effect are in random order, which fixes all statistics of time,
    frame and space. Differences of adjacent codes are ancillary if electron peaks are farther apart.
    """
    step = float(np.nanmedian(1.0 / maps.conversion_gain[maps.usable])) if maps.usable.any() else 0.0
    free = {name for name, period in _OF_CODES.items() if _SHORTER * period <= step}
    kinds = ((STATISTICS[name].family, name) for name in names)
    return np.array([f in ("time", "frame", "space") or name in free for f, name in kinds], np.bool_)


def disagrees(null: NullModel, z: Measured, significance: float, tolerance: FloatArray | float = 0.0) -> bool:
    """Test whether any statistic deviates significantly, with the same sign in both splits.

    ``significance`` is the probability of a false alarm by any statistic. The model error (``tolerance``) of
    each, shape (m,), is added in quadrature: effects in the model are never known exactly.
    """
    p = null.p_values(z.both, 2, tolerance)
    limit = 1.0 - (1.0 - significance) ** (1.0 / null.effective_tests)
    train, test = (null.pulls(part, 1, tolerance) for part in (z.train, z.test))
    same = (null.p_of(train) < _REPLICATION) & (null.p_of(test) < _REPLICATION) & (train * test > 0)
    same |= np.isin(null.names, list(EXACT))  # no false positives: one split is enough
    return bool(np.any(same & (p < limit)))


def suspicious(null: NullModel, z: Measured) -> bool:
    """Test at a low significance whether candidates should be compared.

    An effect shifts many statistics a little: together they can be significant though none is by itself.
    """
    p = null.p_values(z.both, 2)
    same = (z.train - null.mean) * (z.test - null.mean) > 0
    return bool(same.any()) and look_elsewhere(float(p[same].min()), null.effective_tests) < _SUSPICION
