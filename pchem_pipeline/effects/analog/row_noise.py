"""Row noise: one random offset for each row of each frame, common to its pixels.

Noise of a ramp, reference or supply while a row is read shifts the whole row: ``x += n_row,t`` with
``n_row,t ~ N(0, s^2)``, new in every frame. A common design rule keeps it below a tenth of the read noise,
because the eye finds stripes long before the pixel statistics do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from pydantic import Field

from pchem_pipeline.effects.estimators.common_modes import (
    WORTH_A_GUESS,
    add_offset,
    line_excess,
    mean_variance,
    responsivity,
)
from pchem_pipeline.effects.framework.effect import Effect, Plane, register_effect
from pchem_pipeline.effects.framework.shared_offset import SharedOffset

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw


@register_effect
class RowNoise(Effect):
    """Random offset per row and frame, in DN since the disturbance sits behind the pixels' gains.

    Signature: the variance of the row means of the readout residual exceeds that of ``n_x`` independent
    pixels by ``row_noise_dn^2``; neighbours along x are correlated. A pixel's own histogram only
    broadens: its read noise becomes ``(sigma^2 + row_noise_dn^2)^(1/2)`` DN.
    """

    tag: Literal["row_noise"] = Field(default="row_noise", description="name of the effect")
    plane: ClassVar[Plane] = Plane.ANALOG
    title: ClassVar[str] = "row noise (row temporal noise)"
    source: ClassVar[str] = "Gow et al. 2007, IEEE Trans. Electron Devices 54, 1321"
    signature: ClassVar[tuple[str, ...]] = ("space.row.readout.variance", "space.x.rr")
    strength: ClassVar[str] = "row_noise_dn"
    power: ClassVar[float] = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "read_order_noise": "pixels far apart in a row: as alike as neighbours here, less alike there",
        "periodic_pickup": "a spectrum of the row means within a frame: pickup is a line, row noise is flat",
        "interpixel_capacitance": "pixels far apart in a row: they are as correlated as neighbours",
        "frame_noise": "means of rows within a frame: frame noise shifts them all alike",
    }
    row_noise_dn: float = Field(ge=0, le=1e6, description="standard deviation of the rows' offsets, DN")

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the signal (frame, y, x), e-, with the offsets referred to the input."""
        return add_offset(values, self.row_noise_dn * context.random.normal(("frame", "y")), context)

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it at 0.35 DN."""
        return (cls(row_noise_dn=0.35),)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of row means within their frames (moment estimate)."""
        if evidence.time is None:
            return ()
        excess, error = line_excess(evidence.time.row_readout, mean_variance(evidence, axis=1))
        if excess < WORTH_A_GUESS * error:
            return ()
        return (cls(row_noise_dn=excess**0.5 / responsivity(evidence)),)

    def shared_offset(self) -> SharedOffset:
        """Return the offset of a row."""
        return SharedOffset("row", self.row_noise_dn**2)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the offsets: exact, a Gaussian on a Gaussian."""
        return model.with_variance(dn2=self.row_noise_dn**2)
