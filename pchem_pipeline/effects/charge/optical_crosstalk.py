"""Optical crosstalk: an electron's avalanche or hot carrier emits a photon that makes one more next door.

Every electron makes, with probability p, one further electron in one of the four neighbours. Electron
luminescence does so in image sensors, avalanches in single-photon diode arrays (Rech et al. 2008; Otte et al.
2009). Each pixel's count stays Poisson, of mean ``H + p`` times the mean of its neighbours' H, but neighbours
are correlated: ``cov(K_i, K_j) = (p / 4) (H_i + H_j)``. Only the electrons themselves show it, not the
readout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import sent_to_neighbours
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, PixelMaps, SampleLaw


@register_effect
class OpticalCrosstalk(Effect):
    """Probability that an electron makes one more in one of the four neighbours (each a quarter of it).

    Photons that leave the sensor at its edge are lost. H is the exposure from outside: the electrons that
    come from the neighbours are on top of it.

    Signature: electron numbers of neighbours along x and y are correlated by about p / 2; the readout
    residual follows neither the neighbour's residual nor its electrons.
    """

    tag: Literal["optical_crosstalk"] = Field(default="optical_crosstalk", description="name of the effect")
    plane = Plane.CHARGE
    title = "optical crosstalk (luminescence)"
    source = "Rech et al. 2008, Opt. Express 16, 8381; Otte et al. 2009, Nucl. Instrum. Methods A 610, 105"
    signature = ("space.x.kk", "space.y.kk")
    strength = "probability"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "residuals and neighbour's electrons: correlated by capacitance only",
        "exposure_flicker": "distant pixels: correlated by flicker only",
        "cosmic_rays": "longer exposures: tracks are rare and bright, crosstalk is frequent and single",
    }
    probability: Ratio = Field(
        ge=0, le=0.5, description="probability that an electron creates one in a neighbour, no unit"
    )

    #: at one percent
    typical_values = ({"probability": 0.0112},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, with those that came from the neighbours."""
        result = values.copy()
        if self.probability == 0:
            return result
        u = context.random.uniform(("frame", "y", "x"))
        _, (frame, y, x) = sent_to_neighbours(values, u, self.probability)
        inside = (y >= 0) & (y < values.shape[1]) & (x >= 0) & (x < values.shape[2])
        np.add.at(result, (frame[inside], y[inside], x[inside]), 1)
        return result

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with a Poisson mean that holds what neighbours as bright as the pixel send."""
        return model.with_exposures([1.0], [1.0 + self.probability])
