"""The normal law in cells of 1 DN: its mass between two values, and Gaussians added to codes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE

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


@kernel
def add_density(out: FloatArray, base: float, weight: float, centre: float, sigma: float) -> None:
    """Add ``weight * phi(base + i; centre, sigma^2)`` to ``out[i]``, by two multiplications a point."""
    first = max(0, math.ceil(centre - REACH * sigma - base))
    last = min(out.size - 1, math.floor(centre + REACH * sigma - base))
    if first > last:
        return
    nearest = min(max(math.floor(centre - base + 0.5), first), last)
    precision = 1.0 / (sigma * sigma)
    distance = base + nearest - centre
    peak = weight * 0.3989422804014327 / sigma * math.exp(-0.5 * distance * distance * precision)
    out[nearest] += peak
    shrink = math.exp(-precision)
    value, ratio = peak, math.exp(-(distance + 0.5) * precision)
    for i in range(nearest + 1, last + 1):
        value *= ratio
        ratio *= shrink
        out[i] += value
    value, ratio = peak, math.exp((distance - 0.5) * precision)
    for i in range(nearest - 1, first - 1, -1):
        value *= ratio
        ratio *= shrink
        out[i] += value


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


@kernel
def add_component(out: FloatArray, base: float, weight: float, centre: float, sigma: float) -> None:
    """Add a component of the PCD at the integers ``base + i``: its density, or its mass if narrow."""
    if sigma >= NARROW:
        add_density(out, base, weight, centre, sigma)
    else:  # sigma holds the 1/12 DN^2 of rounding, which the integration over the cell puts back
        add_mass(out, base, weight, centre, math.sqrt(max(sigma * sigma - QUANTISATION_VARIANCE, 1e-12)))
