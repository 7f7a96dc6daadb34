"""Repeated lines: a row or column of a frame that is delivered twice, the second time in place of the next.

A line buffer that is read again before the next line is in it, or a lost line that a driver fills with the
one before. In analog data two lines are never equal by chance, so a single case is proof.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.context import DIMS
from pchem_pipeline.effects.framework.effect import FEWEST_SHOWN, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.neighbours import along_axis
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, IntArray


@register_effect
class RepeatedLines(Effect):
    """In some frames a row, or a column, is the one before it, sample by sample.

    Signature: lines that equal the one before in the same frame; then also correlations of neighbours across
    the lines. A pixel's own histogram gets a share of its neighbour's samples, with that one's bias and
    gain, so it has no law of its own.
    """

    tag: Literal["repeated_lines"] = Field(default="repeated_lines", description="name of the effect")
    plane = Plane.READOUT
    along = 2
    title = "repeated rows or columns"
    source = "exact-equality test of neighbouring lines; GenICam / GigE Vision (packet resend)"
    signature = ("space.repeated.rows", "space.repeated.columns")
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "neighbouring lines: repeated ones are exactly equal, coupled ones not",
        "repeated_frames": "neighbouring lines of a frame, not successive frames, are equal",
        "row_noise": "neighbouring lines: repeated ones are exactly equal, noisy ones not",
    }
    share: Ratio = Field(ge=0, le=0.5, description="probability that a line repeats the one before, no unit")
    lines: Literal["rows", "columns"] = Field(default="rows", description="which lines")

    #: one row, and one column, in a thousand
    typical_values = ({"share": 1e-3}, {"share": 1e-3, "lines": "columns"})

    def halo(self) -> int:
        """Return 1 for rows: the one above."""
        return 1 if self.lines == "rows" else 0

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with repeats; the first line has none before it."""
        axis, along = (1, "row") if self.lines == "rows" else (2, "column")
        repeats = context.random.uniform(DIMS[along]) < self.share
        return along_axis(values, np.where(repeats, -1, 0), axis)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the share of lines that equal the one before."""
        if evidence.time is None:
            return ()
        found: list[Self] = []
        rows, columns = evidence.maps.usable.shape
        for lines, pairs in (("rows", rows - 1), ("columns", columns - 1)):
            # in a sensor of one pixel's width or height lines are equal by chance
            if f"space.repeated.{lines}" in evidence.z and evidence.time.repeated_lines.get(lines, 0):
                share = evidence.time.repeated_lines[lines] / (pairs * evidence.n_frames)
                found.append(cls.model_validate({"share": min(share, 0.5), "lines": lines}))
        return sorted(found, key=lambda one: -one.share)

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return rare repeats more often than they are, and how much rarer they are."""
        return self._shown_at_least("share", FEWEST_SHOWN / max(frames.size, 1), 0.5)
