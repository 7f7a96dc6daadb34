"""Which few values a quantity takes that is seen with noise of known variance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.types import FloatArray

_MOST_LEVELS = 6
_STEPS = 200  # of EM; levels that are as far apart as the noise is wide take some fifty


class Levels(NamedTuple):
    """Values and how often each is taken.

    Attributes:
        values: shape (k,), rising.
        shares: sum to 1, shape (k,).
    """

    values: FloatArray
    shares: FloatArray

    @property
    def rms(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.shares @ (self.values - self.shares @ self.values) ** 2))

    def loglik(self, seen: FloatArray, variance: float) -> float:
        """Return the log-likelihood of what is seen, shape (n,), with normal noise of this variance."""
        return float(_log_density(self, seen, variance)[0].sum())


def few_levels(seen: FloatArray, variance: float) -> Levels | None:
    """Return the fewest values that explain what is seen; None where a normal law does so as well.

    Mixtures of normal laws of known variance by EM, two values and more as long as Schwarz's criterion falls.

    Args:
        seen: relative deviations, each with noise, shape (n,).
        variance: of that noise.
    """
    price = math.log(seen.size)  # of a value and its share: twice half a logarithm
    whole = float(seen.var())
    total = max(whole, variance)
    best, criterion = None, -0.5 * seen.size * (math.log(2.0 * math.pi * total) + whole / total) - 0.5 * price
    for k in range(2, _MOST_LEVELS + 1):
        levels = _fitted(seen, variance, k)
        now = levels.loglik(seen, variance) - (k - 0.5) * price
        if now <= criterion and best is not None:
            break
        if now > criterion:
            best, criterion = levels, now
    return best


def _fitted(seen: FloatArray, variance: float, k: int) -> Levels:
    """Return k values and their shares by EM from equal shares."""
    start = np.quantile(seen, (np.arange(k) + 0.5) / k)
    levels = Levels(start, np.full(k, 1.0 / k))
    for _ in range(_STEPS):
        total, terms = _log_density(levels, seen, variance)
        belongs = np.exp(terms - total)
        number = np.maximum(belongs.sum(axis=1), 1e-9)
        levels = Levels(belongs @ seen / number, number / number.sum())
    order = np.argsort(levels.values)
    return Levels(levels.values[order], levels.shares[order])


def _log_density(levels: Levels, seen: FloatArray, variance: float) -> tuple[FloatArray, FloatArray]:
    """Return the log density of each of what is seen, (n,), and the logarithms of its terms, (k, n)."""
    terms = np.log(levels.shares)[:, None] - 0.5 * (
        (seen - levels.values[:, None]) ** 2 / variance + math.log(2.0 * math.pi * variance)
    )
    return np.logaddexp.reduce(terms, axis=0), terms
