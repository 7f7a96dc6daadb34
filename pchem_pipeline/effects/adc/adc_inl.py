"""Integral nonlinearity of the ADC: a bent transfer curve.

What the ADC converts is ``x + a sin(2 pi x / P + phi)`` instead of x (IEEE Std 1241: INL is the deviation of
the transfer curve from the best line). One bend over the codes in use is a half or a whole period; more bends
come from segmented references and ramps. It is fixed in DN, whatever the bias and the gain of a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.bends import best_bend
from pchem_pipeline.effects.estimators.codes import code_range
from pchem_pipeline.effects.framework.effect import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw


@register_effect
class AdcInl(Effect):
    """Smooth deviation of the transfer curve, the same for every pixel.

    Signature: counts per DN, summed over the pixels, deviate smoothly along DN, beyond what the pixels' own
    bias and gain take up; pixels of different bias show the same pattern at the same DN.
    """

    tag: Literal["adc_inl"] = Field(default="adc_inl", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ADC
    along: ClassVar[int] = 1
    title: ClassVar[str] = "integral nonlinearity of the ADC (INL)"
    source: ClassVar[str] = "IEEE Std 1241 (terminology and test methods for analog-to-digital converters)"
    signature: ClassVar[tuple[str, ...]] = (
        "code.smooth",
        "shape.goodness.mean",
        "shape.He1C2.mean",
        "shape.He1C2.chi",
        "shape.He3.mean",
    )
    strength: ClassVar[str] = "inl_lsb"
    separate: ClassVar[Mapping[str, str]] = {
        "gain_stitch": "a ramp of light over all codes: INL bends everywhere, a stitch is one kink",
        "nonlinearity": "a shifted bias (pedestal): INL stays at its DN, nonlinearity at its charge",
        "adc_dnl": "a ramp over many codes: INL is smooth along DN, DNL new from code to code",
        "signal_dependent_noise": "a shifted bias: INL moves peaks to and fro in DN, noise only widens them",
    }
    inl_lsb: float = Field(ge=0, le=1e4, description="amplitude of the deviation, LSB")
    period_dn: float = Field(
        default=100.0, ge=4, le=1e6, description="period of the deviation, DN; two bends per period"
    )
    phase: float = Field(default=0.0, ge=-100, le=100, description="phase at 0 DN, rad")

    @model_validator(mode="after")
    def _monotone(self) -> Self:
        if 2.0 * math.pi * self.inl_lsb >= self.period_dn:
            raise ValueError(
                f"adc_inl: inl_lsb {self.inl_lsb} at period_dn {self.period_dn} turns the curve back; "
                f"keep inl_lsb below period_dn / (2 pi)"
            )
        return self

    def scaled(self, factor: float) -> Self:
        """Return a copy of ``factor`` times the amplitude, as far as the curve stays monotone."""
        most = 0.99 * self.period_dn / (2.0 * math.pi)
        return super().scaled(min(factor, most / self.inl_lsb) if self.inl_lsb > 0 else factor)

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal at the ADC (frame, y, x), DN, bent; draws nothing."""
        result: NDArray[Any] = values + self._deviation(values)
        return result

    def _deviation(self, values: NDArray[Any]) -> NDArray[np.float64]:
        turned = values * (2.0 * math.pi / self.period_dn)
        turned += self.phase
        np.sin(turned, out=turned)
        turned *= self.inl_lsb
        return turned

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it at 0.065 LSB with periods of 60 and 150 DN, at two phases each."""
        return tuple(
            cls(inl_lsb=0.065, period_dn=period, phase=phase)
            for period in (60.0, 150.0)
            for phase in (0.0, 1.57)
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the sines (period, phase, amplitude) that explain the smooth residuals of the codes best."""
        return [
            cls(inl_lsb=bend.amplitude, period_dn=bend.period, phase=bend.phase)
            for bend in best_bend(evidence)
            if 2.0 * math.pi * bend.amplitude < bend.period
        ]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the code edges where the bent curve crosses them."""
        first, last = code_range(maps)
        ideal = np.arange(first, last + 1) - 0.5
        edges = ideal.copy()
        # the slope of the deviation is below 1, so this contracts
        for _ in range(50):
            edges = ideal - self._deviation(edges)
        return model.with_edges(first, edges - ideal)
