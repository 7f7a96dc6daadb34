"""How many times an expected pattern is in what is seen: weighted least squares with one coefficient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.types import FloatArray

#: Standard errors from which on most effects are worth a hypothesis: by chance once in 160 times, of either
#: sign once in 80. A wrong hypothesis is thrown out by the comparison that follows, and costs time only.
SIGNIFICANT = 2.5
#: Standard deviations up to which a pixel's deviation counts: what is beyond is another effect's.
CUT = 4.0
#: Times that a mean is taken anew about which deviations are cut: by then it stays.
CUT_ROUNDS = 4
#: Share of the pixels beyond which what stands out is the rule, and not an effect of few pixels.
FEW_PIXELS = 0.3
#: Share of the pixels beyond which what some have is taken for all.
NEARLY_ALL = 0.8


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


def neighbour_mean(one: FloatArray, other: FloatArray, axis: str) -> float:
    """Return the mean of one map times the other at the neighbour, both ways; NaN without neighbours."""
    front, back = (slice(None), slice(None, -1)), (slice(None), slice(1, None))
    if axis == "y":
        front, back = front[::-1], back[::-1]
    products = np.concatenate([(one[a] * other[b]).ravel() for a, b in ((front, back), (back, front))])
    products = products[np.isfinite(products)]
    return float(products.mean()) if products.size else np.nan
