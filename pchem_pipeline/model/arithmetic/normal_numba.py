"""The normal law in cells of 1 DN: its mass between two values, and its mass added to codes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

FloatArray = NDArray[np.float64]

#: Standard deviations beyond which a tail is below all that double can hold.
FARTHEST = 38.0
#: Standard deviations within which a Gaussian is added; it is below 2e-16 of its peak outside.
REACH = 8.5
#: Below this read noise (DN) the density at the centre of a DN cell is no longer its mass.
NARROW = 1.0


@kernel
def normal_mass(low: float, high: float) -> float:
    """Return the standard normal mass of [low, high], exact in both tails."""
    root = math.sqrt(0.5)
    if low > 0.0:
        return 0.5 * (math.erfc(low * root) - math.erfc(high * root))
    if high < 0.0:
        return 0.5 * (math.erfc(-high * root) - math.erfc(-low * root))
    return 0.5 * (math.erf(high * root) - math.erf(low * root))


@kernel(borrows=True)
def reach_of(log_weight: float) -> float:
    """Return the standard deviations within which a component of a weight is seen."""
    return math.sqrt(max(REACH * REACH + 2.0 * log_weight, 0.0))


@kernel
def add_mass(out: FloatArray, base: float, weight: float, centre: float, sigma: float) -> None:
    """Add ``weight`` times the mass of N(centre, sigma^2) between ``base + i -+ 1/2`` to ``out[i]``."""
    first = max(0, math.floor(centre - REACH * sigma - base + 0.5))
    last = min(out.size - 1, math.floor(centre + REACH * sigma - base + 0.5))
    scale = 1.0 / (sigma * math.sqrt(2.0))
    below = math.erf((base + first - 0.5 - centre) * scale)
    for i in range(first, last + 1):
        above = math.erf((base + i + 0.5 - centre) * scale)
        out[i] += 0.5 * weight * (above - below)
        below = above
