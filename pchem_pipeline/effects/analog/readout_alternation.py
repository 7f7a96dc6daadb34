"""Readout alternation: even and odd frames differ by a constant offset.

Two banks of sampling capacitors or ADCs that take turns, or two frame buffers with their own references,
leave ``x += (-1)^t d``. (Banks that take turns along columns or rows leave a fixed pattern, which is part of
the bias map.)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.families.offsets import OffsetEffect
from pchem_pipeline.effects.framework.effect import Dn, SharedOffset, register_effect
from pchem_pipeline.effects.types import EffectContext, FloatArray


@register_effect
class ReadoutAlternation(OffsetEffect):
    """Offset of alternating sign, the same in every pixel: ``+alternation_dn`` in frames 0, 2, 4, ...

    Signature: the mean readout residual of even frames exceeds that of odd ones by ``2 alternation_dn``;
    lag 1 is anticorrelated as much as lag 2 is correlated. A pixel's own histogram becomes two copies
    ``2 |alternation_dn|`` apart.
    """

    tag: Literal["readout_alternation"] = Field(
        default="readout_alternation", description="name of the effect"
    )
    title = "even-odd readout alternation (ping-pong offset)"
    source = "Black and Hodges 1980, IEEE J. Solid-State Circuits 15, 1022 (interleaved ADCs)"
    signature = ("frame.readout.alternating", "frame.readout.lag1")
    strength = "alternation_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "periodic_pickup": "another frame rate: pickup leaves half the frame rate",
        "frame_noise": "spectrum of the frame means: alternation is a line at half the frame rate",
    }
    alternation_dn: Dn = Field(
        ge=-1e6, le=1e6, description="offset of even frames, and minus that of odd ones, DN"
    )

    #: at 0.024 DN, with both signs
    typical_values = ({"alternation_dn": 0.024}, {"alternation_dn": -0.024})

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the frames, DN; draws nothing."""
        sign = 1.0 - 2.0 * (context.frames % 2)
        return np.asarray((self.alternation_dn * sign)[:, None, None], np.float64)

    def offset_values(self) -> FloatArray:
        """Return the offsets of even and of odd frames, DN."""
        return self.alternation_dn * np.array([-1.0, 1.0])

    def shared_offset(self) -> SharedOffset:
        """Return the offset of a frame, either of two."""
        return SharedOffset("frame", self.alternation_dn**2)
