"""Stitch point of two gains: above a level the samples come from another amplifier or slope.

Dual-gain sensors read every pixel by a high and a low gain and join the two into one scale at a fixed level
(sCMOS cameras: a kink, a change of width and codes that are missing or doubled there); so do ADCs with two
slopes. If the gains are not matched exactly, the scale has a kink at the level, and a step where they are
matched about another point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.bends import Stitch, best_stitch
from pchem_pipeline.effects.estimators.codes import code_range
from pchem_pipeline.effects.framework.effect import Dn, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, PixelMaps, SampleLaw

_FARTHEST = 1e6  # of the point at which both gains agree, DN
_FLATTEST = 1e-4  # gain changes below it are a step: with its point of agreement this many DN away


@register_effect
class GainStitch(Effect):
    """Above ``level_dn`` the scale deviates by ``gain_change (x - origin_dn)``, below it by nothing.

    Signature: counts per DN, summed over the pixels, deviate on both sides of one DN, beyond what the pixels'
    own bias and gain take up; pixels of different bias show it at the same DN. A step shows sharply, at one
    code; a kink without a step is hardly told from a bend of the whole curve (`adc_inl`).
    """

    tag: Literal["gain_stitch"] = Field(default="gain_stitch", description="name of the effect")
    plane = Plane.ADC
    along = 1
    title = "stitch point of two gains"
    source = "arXiv:2412.10109 (pCam6060); arXiv:2510.14484 (Marana 4.2)"
    signature = (
        "code.smooth",
        "shape.goodness.mean",
        "shape.He1C2.mean",
        "shape.C3.mean",
    )
    strength = "gain_change"
    separate: ClassVar[Mapping[str, str]] = {
        "adc_inl": "a ramp of light over all codes: a stitch is one kink, INL is curved everywhere",
        "nonlinearity": "a shifted bias (pedestal): a stitch is fixed in DN, nonlinearity in charge",
        "adc_dnl": "a ramp over many codes: a stitch shifts all codes above it, DNL single codes",
        "branching_counts": "a shifted bias: an excess of high electron numbers shifts with it",
        "signal_dependent_noise": "a shifted bias: a stitch is fixed in DN, noise in electrons",
    }
    gain_change: Ratio = Field(
        ge=-0.5, le=0.5, description="relative change of DN per electron above the level, no unit"
    )
    level_dn: Dn = Field(ge=0, le=1e6, description="level of the transition between the gains, DN")
    origin_dn: Dn | None = Field(
        default=None,
        ge=-_FARTHEST,
        le=_FARTHEST,
        description="DN at which both gains agree; null: the level (no step)",
    )

    #: gains that differ by 1 % above 130 DN, of either sign
    typical_values = ({"gain_change": 0.01, "level_dn": 130.0}, {"gain_change": -0.01, "level_dn": 130.0})

    @property
    def _origin(self) -> float:
        return self.level_dn if self.origin_dn is None else self.origin_dn

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, joined; draws nothing."""
        joined = values + self.gain_change * (values - self._origin)
        return np.asarray(np.where(values > self.level_dn, joined, values))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the break of the curve that explains the residuals of the codes best."""
        return [found for found in map(cls._of, best_stitch(evidence)) if found.gain_change]

    @classmethod
    def _of(cls, stitch: Stitch) -> Self:
        slope = float(np.clip(stitch.slope, -0.5, 0.5))
        if not stitch.step:
            return cls(gain_change=slope, level_dn=stitch.level)
        if abs(slope) < _FLATTEST:
            slope = _FLATTEST if stitch.step > 0 else -_FLATTEST
        origin = float(np.clip(stitch.level - stitch.step / slope, -_FARTHEST, _FARTHEST))
        return cls(gain_change=slope, level_dn=stitch.level, origin_dn=origin)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the code edges where the joined scale crosses them.

        A code that both gains reach is given the mass of both as one cell: right to first order of the step.
        """
        first, last = code_range(maps)
        ideal = np.arange(first, last + 1) - 0.5
        below = np.minimum(ideal, self.level_dn)
        crossing = (ideal + self.gain_change * self._origin) / (1.0 + self.gain_change)
        above = np.maximum(crossing, self.level_dn)
        return model.with_edges(first, below + above - self.level_dn - ideal)
