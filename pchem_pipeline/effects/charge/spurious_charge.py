"""Spurious charge: electrons that no light and no dark current made.

Clock-induced charge, glow of the amplifiers and leaking light add Poisson electrons to every frame (Janesick
2001, Scientific Charge-Coupled Devices, ch. 7; 1.5e-4 e-/px in Barak et al. 2022, SENSEI). The sum of
Poisson electrons is Poisson: at one exposure time they are part of H.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Electrons, Plane, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, PixelMaps, SampleLaw


@register_effect
class SpuriousCharge(Effect):
    """Mean number of electrons added to every pixel of every frame.

    Signature: none: H is larger by as much.
    """

    tag: Literal["spurious_charge"] = Field(default="spurious_charge", description="name of the effect")
    plane = Plane.CHARGE
    title = "spurious (clock-induced) charge"
    source = (
        "Janesick 2001, Scientific Charge-Coupled Devices, ch. 7; "
        "Barak et al. 2022, Phys. Rev. Applied 17, 014022"
    )
    strength = "mean_e"
    untestable = (
        "sums of Poisson electrons are Poisson, so that it is part of H; a series of integration times would "
        "show it (the part of H independent of time)"
    )
    mean_e: Electrons = Field(
        ge=0, le=1e6, description="mean number of spurious electrons per pixel and frame, e-"
    )

    #: at 0.3 e-
    typical_values = ({"mean_e": 0.3},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, spurious ones included."""
        if self.mean_e == 0:
            return values.copy()
        result: AnyArray = values + context.random.poisson(np.full(values.shape, self.mean_e))
        return result

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with this charge on top of H, which is then the exposure without it."""
        return model.with_added_exposure([[self.mean_e]], [[1.0]])
