"""The normal law: its mass between two values, and how far it reaches."""

from __future__ import annotations

import math

from pchem_pipeline.base.kernel import kernel

#: Standard deviations beyond which a tail is below all that double can hold.
FARTHEST = 38.0
#: Standard deviations within which a Gaussian is added; it is below 2e-16 of its peak outside.
REACH = 8.5


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
