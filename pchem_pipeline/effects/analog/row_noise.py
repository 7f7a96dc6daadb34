"""Row noise: one random offset for each row of each frame, common to its pixels.

Noise of a ramp, reference or supply while a row is read shifts the whole row: ``x += n_row,t`` with
``n_row,t ~ N(0, s^2)``, new in every frame. A common design rule keeps it below a tenth of the read noise,
because the eye finds stripes long before the pixel statistics do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from pchem_pipeline.effects.base import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext

__all__ = ["RowNoise"]


@register_effect
class RowNoise(Effect):
    """Random offset per row and frame, in DN since the disturbance sits behind the pixels' gains.

    Signature: the variance of the row means of the readout residual exceeds that of ``n_x`` independent
    pixels by ``row_noise_dn^2``; neighbours along x are correlated. A pixel's own histogram only
    broadens: its read noise becomes ``(sigma^2 + row_noise_dn^2)^(1/2)`` DN.
    """

    tag: Literal["row_noise"] = Field(default="row_noise", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    row_noise_dn: float = Field(ge=0, description="standard deviation of the rows' offsets, DN")

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with the offsets referred to the input."""
        offset = self.row_noise_dn * context.random.normal(("frame", "y"))
        result: NDArray[Any] = values + offset * context.truth["conversion_gain"]
        return result
