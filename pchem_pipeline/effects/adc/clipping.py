"""Clipping of the digital numbers inside the range of the ADC.

Black-level clamping, a limited ramp or a full column amplifier end the scale before the ADC does: every
value beyond the limit becomes the limit, ``x = min(max(x, low), high)``, so the likelihood of that code is
the whole tail beyond it (a censored observation, Tobin 1958). The cut at 0 and at ``2**bit_depth - 1`` is not
this effect: the ADC always makes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.framework.effect import Code, Effect, Plane, register_effect
from pchem_pipeline.effects.framework.evidence import CodeResiduals
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, PixelMaps, SampleLaw

# counts expected beyond the limit, and standard errors of the pile-up at it
_EXPECTED_BEYOND = 8.0
_PILE_UP = 4.0


@register_effect
class Clipping(Effect):
    """Smallest and largest digital number that come out, the same for every pixel.

    Signature: counts pile up at one code, the extreme one, and none lie beyond it. A low limit near the
    bias pulls the bias up and the read noise down; a high one pulls the exposure down.
    """

    tag: Literal["clipping"] = Field(default="clipping", description="name of the effect")
    plane = Plane.ADC
    along = 3
    title = "clipping (black-level clamping, saturation)"
    source = "Tobin 1958, Econometrica 26, 24 (censored observations); EMVA 1288 (saturation)"
    signature = (
        "code.top",
        "code.bottom",
        "code.largest",
        "shape.goodness.cnt",
    )
    separate: ClassVar[Mapping[str, str]] = {
        "adc_dnl": "a shifted bias: a limit is fixed in DN, with no samples beyond",
        "adc_inl": "a shifted bias or more light: clipping affects one code, INL all",
    }
    low: Code | None = Field(default=None, ge=0, description="smallest DN; null: that of the ADC")
    high: Code | None = Field(default=None, ge=0, description="largest DN; null: that of the ADC")

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        if self.low is None and self.high is None:
            raise ValueError("clipping without low and high does nothing; give one of them")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"clipping: low {self.low} is not below high {self.high}; swap them")
        return self

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, inside the limits; draws nothing."""
        # the limits are whole DN, so to limit before rounding is to limit after it
        result: AnyArray = np.clip(values, self.low, self.high)
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the extreme codes at which counts pile up while those expected beyond are missing.

        Nothing is typical of a limit, which is a code of this very sensor: the default guesses are none.
        """
        code = evidence.code
        high = code.maximum if _piles_up(code, code.maximum, above=True) else None
        low = code.minimum if code.minimum > 0 and _piles_up(code, code.minimum, above=False) else None
        if high is None and low is None:
            return ()
        if high is None or low is None:
            return (cls(low=low, high=high),)
        return cls(low=low, high=high), cls(high=high), cls(low=low)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law that counts at the limits what lies beyond them."""
        return model.with_clip(self.low, self.high)


def _piles_up(code: CodeResiduals, limit: int, *, above: bool) -> bool:
    """Return whether a code holds what is missing beyond it."""
    at = limit - code.first
    if not 0 <= at < code.observed.size:
        return False
    beyond = slice(at + 1, None) if above else slice(0, at)
    missing = float(code.expected[beyond].sum() - code.observed[beyond].sum())
    excess = float(code.observed[at] - code.expected[at])
    return missing > _EXPECTED_BEYOND and excess > _PILE_UP * np.sqrt(float(code.expected[at]) + 1.0)
