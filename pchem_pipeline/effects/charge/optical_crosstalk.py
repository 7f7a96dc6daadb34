"""Optical crosstalk: an electron's avalanche or hot carrier emits a photon that makes one more next door.

Every electron makes, with probability p, one further electron in one of the four neighbours. Electron
luminescence does so in image sensors, avalanches in single-photon diode arrays (Rech et al. 2008; Otte et al.
2009). Each pixel's count stays Poisson, of mean ``H + p`` times the mean of its neighbours' H, but neighbours
are correlated: ``cov(K_i, K_j) = (p / 4) (H_i + H_j)``. Only the electrons themselves show it, not the
readout.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import sent_to_neighbours
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw


@register_effect
class OpticalCrosstalk(Effect):
    """Probability that an electron makes one more in one of the four neighbours (each a quarter of it).

    Photons that leave the sensor at its edge are lost. H is the exposure from outside: the electrons that
    come from the neighbours are on top of it.

    Signature: electron numbers of neighbours along x and y are correlated by about p / 2; the readout
    residual follows neither the neighbour's residual nor its electrons.
    """

    tag: Literal["optical_crosstalk"] = Field(default="optical_crosstalk", description="name of the effect")
    plane: ClassVar[Plane] = Plane.CHARGE
    title: ClassVar[str] = "optical crosstalk (luminescence)"
    source: ClassVar[str] = (
        "Rech et al. 2008, Opt. Express 16, 8381; Otte et al. 2009, Nucl. Instrum. Methods A 610, 105"
    )
    signature: ClassVar[tuple[str, ...]] = ("space.x.kk", "space.y.kk")
    strength: ClassVar[str] = "probability"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "residuals and neighbour's electrons: correlated by capacitance only",
        "exposure_flicker": "distant pixels: correlated by flicker only",
        "cosmic_rays": "longer exposures: tracks are rare and bright, crosstalk is frequent and single",
    }
    probability: Ratio = Field(
        ge=0, le=0.5, description="probability that an electron creates one in a neighbour, no unit"
    )

    def halo(self) -> int:
        """Return 1 row: the neighbours above and below."""
        return 1

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return electron numbers (frame, y, x), e-, with those that came from the neighbours."""
        result = values.copy()
        if self.probability == 0:
            return result
        u = context.random.uniform(("frame", "y", "x"))
        _, (frame, y, x) = sent_to_neighbours(values, u, self.probability)
        inside = (y >= 0) & (y < values.shape[1]) & (x >= 0) & (x < values.shape[2])
        np.add.at(result, (frame[inside], y[inside], x[inside]), 1)
        return result

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it at one percent."""
        return (cls(probability=0.0112),)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return p from the correlations of neighbours' electron numbers, where these are above 2.5 sigma."""
        found, weight = 0.0, 0.0
        for axis, name in ((1, "x.kk"), (0, "y.kk")):
            response = _response(evidence, axis)
            pairs = evidence.time.neighbour_pairs.get(name, 0) if evidence.time else 0
            if evidence.time is None or not pairs or not np.isfinite(response):
                continue
            found += pairs * response * evidence.time.neighbours[name]
            weight += pairs * response**2
        if weight == 0 or found < 2.5 * np.sqrt(weight):
            return ()
        return (cls(probability=min(found / weight, 0.5)),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with a Poisson mean that holds what neighbours as bright as the pixel send."""
        return model.with_exposures([1.0], [1.0 + self.probability])


def _response(evidence: Evidence, axis: int) -> float:
    """Return the mean correlation of neighbours along an axis per unit of p, NaN without such pairs.

    The expected electron number answers to the true one with the slope Var(k) / H.
    """
    exposure, std = evidence.maps.quanta_exposure, evidence.charge_std
    first = tuple(slice(None, -1) if a == axis else slice(None) for a in range(2))
    second = tuple(slice(1, None) if a == axis else slice(None) for a in range(2))
    seen = evidence.maps.usable & (exposure > 0)
    good = seen[first] & seen[second]
    h, s = (exposure[first][good], exposure[second][good]), (std[first][good], std[second][good])
    return float(np.mean(0.25 * (h[0] + h[1]) * s[0] * s[1] / (h[0] * h[1]))) if good.any() else float("nan")
