"""How many times an expected pattern is in what is seen: weighted least squares with one coefficient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.types import FloatArray

#: Standard errors from which on most effects are worth a hypothesis: by chance once in 160 times, of either
#: sign once in 80. A wrong hypothesis is thrown out by the comparison that follows, and costs time only.
SIGNIFICANT = 2.5


class Multiple(NamedTuple):
    """A coefficient and its standard error, which is infinite where nothing shows it."""

    value: float
    error: float

    @property
    def sigmas(self) -> float:
        """Standard errors that it is away from zero, with its sign."""
        return self.value / self.error


def multiple_of(pattern: FloatArray, seen: FloatArray, weight: FloatArray | float = 1.0) -> Multiple:
    """Return how many times a pattern is in what is seen.

    Args:
        pattern: expected for a coefficient of 1, any shape.
        seen: of the same shape.
        weight: inverse variance of what is seen, of all or of each.
    """
    information = float((weight * pattern**2).sum())
    if not (np.isfinite(information) and information > 0):
        return Multiple(0.0, np.inf)
    return Multiple(float((weight * pattern * seen).sum()) / information, information**-0.5)
