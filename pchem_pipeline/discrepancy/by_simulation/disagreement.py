"""Does the model disagree with the data: beyond chance, in both splits alike, and beyond tolerance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.null import NullModel, look_elsewhere, two_sided
from pchem_pipeline.discrepancy.observe.catalogue import EXACT, STATISTICS

__all__ = ["Measured", "contradicted", "disagrees", "misfits", "suspicious"]

FloatArray = NDArray[np.float64]

_REPLICATION = 0.02  # in each split by itself, and in the same direction
_SUSPICION = 0.1  # chance of a deviation for which it is worth to ask the candidates
# of what an effect does to its strongest statistic, the most that may remain in statistics of that kind
_LARGEST_CONTRADICTION = 0.3
_SIGNATURE = 3.0  # standard deviations by which an effect moves the statistics of its signature


@dataclass(frozen=True)
class Measured:
    """The statistics of the data, shape (m,) each.

    Attributes:
        train, test: of the splits that effects are found on.
        final: of the split that only the gap is measured on.
    """

    train: FloatArray
    test: FloatArray
    final: FloatArray

    @property
    def both(self) -> FloatArray:
        """Mean of the train and test splits."""
        return (self.train + self.test) / 2.0


def disagrees(null: NullModel, z: Measured, significance: float, tolerance: FloatArray | float = 0.0) -> bool:
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
    alone = [two_sided(pull, null.freedom) < _REPLICATION for pull in pulls]
    same = alone[0] & alone[1] & (pulls[0] * pulls[1] > 0)
    same |= np.isin(null.names, list(EXACT))  # no false positives: one split is enough
    return bool(np.any(same & (p < limit)))


def suspicious(null: NullModel, z: Measured) -> bool:
    """Tell whether some statistic deviates so far that a candidate may explain it together with others.

    An effect moves many statistics a little: where none is beyond chance by itself, all in the direction that
    the effect asks for may be.
    """
    p = two_sided(null.pulls(z.both, 2), null.freedom)
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


def contradicted(null: NullModel, shift: FloatArray, rest: FloatArray) -> bool:
    """Tell whether much of what an effect claims to explain is still there, in statistics of the same kind.

    The nearest relative of an effect that is no candidate moves the right statistics in wrong proportions.

    Args:
        null: of the model without the effect.
        shift: by how much the effect moves the statistics, shape (m,).
        rest: pulls of the mean of two splits that the whole model leaves, shape (m,).
    """
    own = np.abs(shift / null.std) * np.sqrt(2.0)
    kinds = [(STATISTICS[name].family, STATISTICS[name].channel) for name in null.names]
    strongest = int(own.argmax())
    same = [kind == kinds[strongest] for kind in kinds]
    return bool(np.abs(rest[same]).max() > _LARGEST_CONTRADICTION * own[strongest])


def _p_values(null: NullModel, z: Measured, tolerance: FloatArray | float) -> FloatArray:
    return two_sided(_pulls(null, z.both, tolerance, 2), null.freedom)


def _pulls(null: NullModel, z: FloatArray, tolerance: FloatArray | float, splits: int) -> FloatArray:
    chance = null.std**2 * (1.0 / splits + 1.0 / null.n_replicates)
    return np.asarray((z - null.mean) / np.sqrt(chance + np.square(tolerance)))
