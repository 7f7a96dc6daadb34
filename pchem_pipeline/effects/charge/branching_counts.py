"""Branching counts: an electron may release further ones in its own pixel, and these again.

Avalanches, hot carriers and luminescence that is absorbed in the pixel itself multiply electrons: every one,
the secondary ones too, makes Poisson many (mean l) more. A primary one then becomes a cluster of Borel size,
and Poisson many of them a generalised Poisson number (Consul and Jain 1973), in use for silicon
photomultipliers (Vinogradov 2012): ``P(k) = q (q + l k)^(k - 1) exp(-q - l k) / k!`` of mean ``q / (1 - l)``
and variance ``q / (1 - l)^3``.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import regrouped
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)


@register_effect
class BranchingCounts(Effect):
    """Mean number of further electrons that each electron makes: generalised Poisson electron numbers.

    H stays the mean number of electrons, ``q = H (1 - l)`` the primary ones: the two cannot be told apart at
    one exposure.

    Signature: the score of the second Charlier polynomial is positive in all pixels, and per sample the same
    at every H; then that of the third; nothing in time, nothing between neighbours.
    """

    tag: Literal["branching_counts"] = Field(default="branching_counts", description="name of the effect")
    plane = Plane.CHARGE
    title = "branching (generalised Poisson) counts"
    source = "Consul and Jain 1973, Technometrics 15, 791; Vinogradov 2012, Nucl. Instrum. Methods A 695, 247"
    signature = ("shape.C2.mean", "shape.C3.mean", "code.smooth")
    strength = "branching"
    separate: ClassVar[Mapping[str, str]] = {
        "overdispersed_counts": "several exposures: excess variance grows as H, by over-dispersion as H^2",
        "optical_crosstalk": "electron numbers of neighbours: correlated by crosstalk only",
        "exposure_flicker": "pixels of one frame: correlated by flicker only",
    }
    branching: Ratio = Field(
        ge=0, le=0.5, description="mean number of secondary electrons per electron (l), no unit"
    )

    #: at half a percent, and at the tenth of a silicon photomultiplier
    typical_values = ({"branching": 0.0052},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-; thinned by 1 - l first, so that the mean stays."""
        if self.branching == 0:
            return values.copy()
        u = context.random.uniform(("frame", "y", "x"))
        grow = -np.expm1(-self.branching)
        below = _borel_beyond_one(self.branching)

        def extra(v: FloatArray, index: IntArray) -> IntArray:
            return 1 + np.searchsorted(below, v)

        return regrouped(values, u, self.branching, lambda index: (self.branching, grow), extra)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with generalised Poisson electron numbers."""
        return model.with_counts("borel", self.branching)


@functools.lru_cache(maxsize=64)
def _borel_beyond_one(branching: float) -> FloatArray:
    """Return P(n <= 2 | n >= 2), P(n <= 3 | n >= 2), ... of a Borel number n, but for the last, 1."""
    mass, masses = branching * np.exp(-2.0 * branching), []
    n = 2
    while mass > 1e-17 * branching and n < 2000:
        masses.append(mass)
        # P(n) = exp(-l n) (l n)^(n - 1) / n!
        mass *= branching * np.exp(-branching + (n - 1) * np.log1p(1.0 / n))
        n += 1
    below: FloatArray = (np.cumsum(masses) / np.sum(masses))[:-1]
    return below
