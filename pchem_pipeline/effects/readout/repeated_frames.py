"""Repeated frames: a frame that is delivered twice.

A frame buffer that is read again before the next frame is in it, or a driver that fills a gap, hands out
the frame before once more: every sample is the same. In analog data that never happens by chance, so a
single case is proof (an equality test without false alarms).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, field_validator

from pchem_pipeline.effects.framework.effect import FEWEST_SHOWN, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, IntArray

# longer runs of repeats are left out of the simulation if they are rarer than this
_RARE = 1e-12


@register_effect
class RepeatedFrames(Effect):
    """Frame t is, sample by sample, frame t - 1 as it was delivered (which may itself be a repeat).

    Or a part of its rows is, where frames are transferred in parts.

    Signature: pairs of successive frames that are equal everywhere; then also correlations at lag 1, in
    charge and readout alike. A pixel's own histogram does not change, only fewer of its samples count.
    """

    tag: Literal["repeated_frames"] = Field(default="repeated_frames", description="name of the effect")
    plane = Plane.READOUT
    along = 2
    title = "repeated (duplicated) frames"
    source = "GenICam / GigE Vision frame identifiers; exact-equality test of successive frames"
    signature = (
        "frame.repeated",
        "frame.repeated_rows",
        "time.lag1.charge.mean",
        "time.lag1.readout.mean",
    )
    strength = "probability"
    separate: ClassVar[Mapping[str, str]] = {
        "analog_memory": "successive frames: repeated ones are exactly equal, memory leaves differences",
        "flicker_noise": "successive frames: repeated ones are exactly equal, 1/f noise leaves differences",
    }
    probability: Ratio = Field(
        default=0.0, ge=0, le=0.5, description="probability that a frame repeats the one before, no unit"
    )
    frames: tuple[int, ...] = Field(
        default=(), max_length=1 << 20, description="numbers of further frames that repeat the one before"
    )

    rows: tuple[int, int] | None = Field(
        default=None, description="repeated rows: first and last + 1; null: all"
    )

    #: at one frame in a thousand
    typical_values = ({"probability": 1e-3},)

    @field_validator("rows")
    @classmethod
    def _some_rows(cls, rows: tuple[int, int] | None) -> tuple[int, int] | None:
        if rows is not None and not 0 <= rows[0] < rows[1]:
            raise ValueError(f"repeated_frames: rows {list(rows)} hold none; give [first, last + 1]")
        return rows

    @field_validator("frames")
    @classmethod
    def _after_the_first(cls, frames: tuple[int, ...]) -> tuple[int, ...]:
        if any(frame < 1 for frame in frames):
            raise ValueError("repeated_frames: frame 0 is the first and repeats none; list frames from 1 on")
        return tuple(sorted(set(frames)))

    def history(self) -> int:
        """Return how long a run of repeats can get, frames."""
        random = math.ceil(math.log(_RARE) / math.log(self.probability)) if self.probability > 0 else 0
        return random + self._longest_listed()

    def _longest_listed(self) -> int:
        """Return the length of the longest run of successive numbers in ``frames``."""
        if not self.frames:
            return 0
        breaks = np.flatnonzero(np.diff(self.frames) != 1) + 1
        return int(np.diff(np.concatenate([[0], breaks, [len(self.frames)]])).max())

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with repeats in place of their frames."""
        frames = context.frames
        repeats = np.isin(frames, np.array(self.frames, np.int64))
        if self.probability > 0:
            repeats |= context.random.uniform(("frame",))[:, 0, 0] < self.probability
        # the first frame of the run has none before it
        repeats &= frames > 0
        index = np.arange(frames.size)
        source = np.maximum.accumulate(np.where(repeats, -1, index))
        # an original is looked for no further back than history reaches, so that it is the same one
        # whatever block is simulated; in a longer run of repeats the later ones are left as they are
        source = np.where((source < 0) | (index - source > self.history()), index, source)
        if self.rows is None:
            return np.asarray(values[source])
        chosen = np.flatnonzero((context.rows >= self.rows[0]) & (context.rows < self.rows[1]))
        result: AnyArray = values.copy()
        result[:, chosen] = values[source][:, chosen]
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the fraction of frames that equal the one before.

        The list of them would be that of one split only, and say nothing of the others. Where only rows are
        equal, a quarter of the rows stands for those that are: evidence has their number and not their place.
        """
        if evidence.time is None:
            return ()
        time, found = evidence.time, []
        pairs = max(int((np.diff(time.frames) == 1).sum()), 1)
        if time.repeated.size:
            found = [cls(probability=min(time.repeated.size / pairs, 0.5))]
        if time.repeated_rows:
            part = max(time.row_readout.shape[1] // 4, 1)
            found.append(cls(probability=min(time.repeated_rows / part / pairs, 0.5), rows=(0, part)))
        return found

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return repeats spread evenly over the frames, and how many more or fewer there are in the mean."""
        second = frames[1:][np.diff(frames) == 1]
        if self.frames or not self.probability * second.size > 0:
            return self, 1.0
        mean = self.probability * second.size
        shown = min(max(round(mean), FEWEST_SHOWN), second.size)
        places = (np.arange(shown) * second.size) // shown
        listed = tuple(int(frame) for frame in second[places])
        return type(self)(frames=listed, rows=self.rows), mean / shown
