"""An offset whose sign the two colours of pixels swap from frame to frame."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane


class ChessboardOffset(Effect):
    """The black pixels get +d in even and -d in odd frames, the white ones the opposite."""

    tag: Literal["chessboard_offset"] = "chessboard_offset"
    plane: ClassVar[Plane] = Plane.ADC
    title: ClassVar[str] = "alternating chessboard offset"
    source: ClassVar[str] = "made up, to show how an effect of one's own is added"
    signature: ClassVar[tuple[str, ...]] = (
        "time.lag1.readout.mean",
        "space.x.rr",
        "space.y.rr",
        "time.lag2.readout.mean",
    )
    strength: ClassVar[str] = "offset_dn"
    # all that it moves are products of two samples
    power: ClassVar[float] = 2.0
    separate: ClassVar[dict[str, str]] = {
        "readout_alternation": "read every second row alone: the chessboard becomes an alternation of frames"
    }

    offset_dn: float = Field(default=0.2, ge=0, description="offset d of a pixel, DN")

    def apply(self, values, context):
        colour = (context.rows[:, None] + np.arange(values.shape[2])) % 2
        sign = 1.0 - 2.0 * ((context.frames[:, None, None] + colour) % 2)
        return values + self.offset_dn * sign

    @classmethod
    def typical(cls):
        return (cls(),)

    @classmethod
    def estimate(cls, evidence):
        if evidence.time is None or evidence.strongest(*cls.signature) < 3.0:
            return ()
        # successive residuals of a pixel have opposite signs: their covariance is -d^2
        covariance = -evidence.time.lag_readout[0] * evidence.readout_std**2
        square = float(np.mean(covariance[evidence.maps.usable]))
        return (cls(offset_dn=np.sqrt(square)),) if square > 0 else ()

    def sample_law(self, model, maps):
        return model.with_noise([0.5, 0.5], shift_dn=[-self.offset_dn, self.offset_dn])
