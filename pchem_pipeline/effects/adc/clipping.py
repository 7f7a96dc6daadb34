"""Clipping of the digital numbers inside the range of the ADC.

Black-level clamping, a limited ramp or a full column amplifier end the scale before the ADC does: every
value beyond the limit becomes the limit, ``x = min(max(x, low), high)``, so the likelihood of that code is
the whole tail beyond it (a censored observation). The cut at 0 and at ``2**bit_depth - 1`` is not this
effect: the ADC always makes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.base import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext

__all__ = ["Clipping"]


@register_effect
class Clipping(Effect):
    """Smallest and largest digital number that come out, the same for every pixel.

    Signature: counts pile up at one code, the extreme one, and none lie beyond it. A low limit near the
    bias pulls the bias up and the read noise down; a high one pulls the exposure down.
    """

    tag: Literal["clipping"] = Field(default="clipping", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ADC
    low: int | None = Field(
        default=None, ge=0, description="smallest DN that comes out; null: that of the ADC"
    )
    high: int | None = Field(
        default=None, ge=0, description="largest DN that comes out; null: that of the ADC"
    )

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        if self.low is None and self.high is None:
            raise ValueError("clipping without low and high does nothing; give one of them")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"clipping: low {self.low} is not below high {self.high}; swap them")
        return self

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal at the ADC (frame, y, x), DN, inside the limits; draws nothing."""
        # the limits are whole DN, so to limit before rounding is to limit after it
        result: NDArray[Any] = np.clip(values, self.low, self.high)
        return result
