"""Covariance of many statistics from few replicates: a diagonal plus a matrix of low rank.

There are hundreds of statistics and some dozen replicates. The sample covariance shrunk towards its diagonal
has this form, and so have all sums with it; whitening is linear in the number of statistics, not cubic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Covariance:
    """A covariance ``diag(own) + common.T @ common``.

    Attributes:
        own: variance of each statistic by itself, above 0, shape (m,).
        common: modes that they share, shape (r, m).
    """

    own: FloatArray
    common: FloatArray

    @property
    def variances(self) -> FloatArray:
        """Variance of each statistic, shape (m,)."""
        return np.asarray(self.own + np.einsum("rm,rm->m", self.common, self.common))

    def dense(self) -> FloatArray:
        """Return the matrix, shape (m, m)."""
        return np.asarray(np.diag(self.own) + self.common.T @ self.common)

    def times(self, factor: float) -> Covariance:
        """Return so many times the covariance; the factor is not negative."""
        return Covariance(self.own * factor, self.common * np.sqrt(factor))

    def scaled(self, ratio: FloatArray) -> Covariance:
        """Return that of statistics so many times as large each, shape (m,)."""
        return Covariance(self.own * ratio**2, self.common * ratio)

    def plus(self, variances: FloatArray) -> Covariance:
        """Return it with independent scatter besides, shape (m,)."""
        return replace(self, own=self.own + variances)

    def with_modes(self, modes: FloatArray) -> Covariance:
        """Return it with further modes, each of which scatters with a deviation of 1, shape (k, m)."""
        return replace(self, common=np.concatenate([self.common, modes]))

    def among(self, kept: BoolArray | list[int]) -> Covariance:
        """Return that of some of the statistics."""
        return Covariance(self.own[kept], self.common[:, kept])

    def white(self, rows: FloatArray) -> FloatArray:
        """Return vectors, (..., m), in a basis in which they scatter independently with a deviation of 1."""
        scale, modes, change, _ = self._whitening
        scaled = rows / scale
        return np.asarray(scaled + ((scaled @ modes.T) * change) @ modes)

    @property
    def log_root_determinant(self) -> float:
        """Half the logarithm of the determinant."""
        return self._whitening[3]

    @cached_property
    def _whitening(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Own deviations, common modes as orthonormal rows, by how much each shrinks, the determinant.

        Of ``I + V.T V`` the symmetric root, from the eigenvectors of the smaller of ``V V.T`` and ``V.T V``.
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
