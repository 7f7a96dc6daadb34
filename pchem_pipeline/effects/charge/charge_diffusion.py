"""Charge diffusion: an electron is collected by a neighbour of the pixel that it was made in.

Carriers released below the depleted region wander sideways before they are collected (Janesick 2001,
Scientific Charge-Coupled Devices, ch. 4). Each electron moves to one of the four neighbours with probability
f, independently of the others. Poisson electrons that are moved independently stay independent Poisson
(Kingman 1993, Poisson Processes, displacement theorem): in frames of one constant exposure this is invisible,
and part of H.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import sent_to_neighbours
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext


@register_effect
class ChargeDiffusion(Effect):
    """Probability that an electron is collected by one of the four neighbours (each a quarter of it).

    An electron that would leave the sensor at its edge stays.

    Signature: none: the map of H is blurred, and nothing tells a blurred map from a smooth one.
    """

    tag: Literal["charge_diffusion"] = Field(default="charge_diffusion", description="name of the effect")
    plane = Plane.CHARGE
    title = "charge diffusion"
    source = "Janesick 2001, Scientific Charge-Coupled Devices, ch. 4"
    strength = "fraction"
    reach_rows = 1
    untestable = (
        "randomly moved Poisson electrons remain independent and Poisson, only the map of H changes; an "
        "edge, a spot or single X-rays would show it"
    )
    fraction: Ratio = Field(ge=0, le=0.9, description="probability that an electron moves, no unit")

    #: at a fifth
    typical_values = ({"fraction": 0.2},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as collected."""
        result = values.copy()
        if self.fraction == 0:
            return result
        u = context.random.uniform(("frame", "y", "x"))
        (frame, y, x), (_, to_y, to_x) = sent_to_neighbours(values, u, self.fraction)
        row = context.rows[0] + to_y
        leaves = (row >= 0) & (row < context.shape[0]) & (to_x >= 0) & (to_x < context.shape[1])
        np.subtract.at(result, (frame[leaves], y[leaves], x[leaves]), 1)
        arrives = leaves & (to_y >= 0) & (to_y < values.shape[1])
        np.add.at(result, (frame[arrives], to_y[arrives], to_x[arrives]), 1)
        return result
