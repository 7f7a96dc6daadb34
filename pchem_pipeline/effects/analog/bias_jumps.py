"""Jumps of the bias: the level of an output changes suddenly, at random times.

Each quadrant or half, as if it had an amplifier of its own, sits on one of several levels and jumps to
another. The bias jumps of the CCDs of HST/WFPC2 (a tenth of a DN and more; WFPC2 Data Handbook) and the
"popcorn mesa" noise of HgCdTe arrays are of this kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.effects.estimators.change_points import likeliest_parts
from pchem_pipeline.effects.estimators.common_modes import responsivity
from pchem_pipeline.effects.families.offsets import OffsetEffect, quantile_means
from pchem_pipeline.effects.framework.effect import Count, Dn, PerFrame, SharedOffset, register_effect
from pchem_pipeline.effects.types import (
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    TimeSeries,
)
from pchem_pipeline.model.arithmetic.significance import CLEAR

Path = tuple[tuple[int, float], ...]

# how the quadrants' means add up to those of the parts that jump together
Parts = Literal["quadrants", "top_bottom", "left_right"]
_PARTS: dict[Parts, FloatArray] = {
    "quadrants": np.eye(4),
    "top_bottom": np.array([[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]]),
    "left_right": np.array([[0.5, 0.0, 0.5, 0.0], [0.0, 0.5, 0.0, 0.5]]),
}


@register_effect
class BiasJumps(OffsetEffect):
    """Piecewise constant offset of each quadrant or half of the sensor, independent of the others.

    An odd middle row or column belongs to the bottom or right.

    Signature: means of the readout residual wander in one quadrant and not in the others, in sudden steps;
    the charge does not. A pixel's own histogram becomes copies of itself at the levels.
    """

    tag: Literal["bias_jumps"] = Field(default="bias_jumps", description="name of the effect")
    title = "bias jumps (popcorn mesa noise)"
    source = "WFPC2 Data Handbook (STScI), bias jumps; Rauscher 2015, PASP 127, 1144"
    signature = (
        "frame.readout.quadrants",
        "frame.readout.slow",
        "frame.readout.lag1",
        "time.lag1.readout.mean",
    )
    random_realisation = True
    strength = "amplitude_dn"
    power = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "bias_drift": "means of the quadrants, frame by frame: a drift is slow and common to all",
        "flicker_noise": "means of the quadrants: 1/f noise of single pixels averages out",
        "rts_noise": "histograms of single pixels: RTS affects few, jumps a whole quadrant",
    }
    amplitude_dn: Dn = Field(
        ge=0, le=1e6, description="distance between adjacent levels, DN; the scale of `path` if given"
    )
    rate: PerFrame = Field(default=1e-3, ge=0, le=0.5, description="jumps per frame of each part")
    levels: Count = Field(default=2, ge=2, le=64, description="number of evenly spaced levels")
    parts: Parts = Field(default="quadrants", description="parts of the sensor with separate outputs")
    path: tuple[Path, ...] = Field(
        default=(),
        description="the jumps as they were, instead of random ones: for each part (top left, top right, "
        "bottom left, bottom right; top, bottom; left, right) a list of [frame, level from that frame on "
        "in units of amplitude_dn]",
    )

    #: at 0.085 DN, with rare and with frequent jumps, and those of halves
    typical_values = (
        {"amplitude_dn": 0.085, "rate": 1e-3},
        {"amplitude_dn": 0.085, "rate": 1e-2},
        {"amplitude_dn": 0.085, "rate": 1e-2, "parts": "top_bottom"},
        {"amplitude_dn": 0.085, "rate": 1e-2, "parts": "left_right"},
    )

    @model_validator(mode="after")
    def _path_for_each_part(self) -> Self:
        wanted = len(_PARTS[self.parts])
        if len(self.path) not in (0, wanted):
            raise ValueError(
                f"bias_jumps: path needs one list for each of {wanted} {self.parts}, got {len(self.path)}"
            )
        for part in self.path:
            if any(a[0] >= b[0] for a, b in pairwise(part)):
                raise ValueError("bias_jumps: frames of a path must increase; sort them")
        return self

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the offsets of the parts in a block of frames, DN."""
        below, right = {"quadrants": (2, 1), "top_bottom": (1, 0), "left_right": (0, 1)}[self.parts]
        rows, columns = (size // 2 for size in context.shape)
        part = below * (context.rows >= rows)[:, None] + right * (np.arange(context.shape[1]) >= columns)
        return np.asarray(self.amplitude_dn * self._levels(context)[:, part])

    def offset_values(self) -> FloatArray:
        """Return the levels, DN; of paths those of all parts, since the pixels' places are not known here."""
        if self.path:
            values = _values(self.path)
        else:
            values = np.asarray(np.arange(self.levels) - (self.levels - 1) / 2.0, np.float64)
        return self.amplitude_dn * quantile_means(values)

    def _levels(self, context: EffectContext) -> FloatArray:
        """Return the levels at the block's frames in units of ``amplitude_dn``, (frame, part)."""
        frames = context.frames.clip(0, context.n_frames - 1)
        found = np.zeros((frames.size, len(_PARTS[self.parts])))
        for part in range(found.shape[1]):
            if self.path:
                starts, levels = _steps(self.path[part], context.n_frames)
            else:
                starts, levels = self._drawn(context, part)
            if levels.size:
                found[:, part] = levels[np.searchsorted(starts[1:], frames, side="right")]
        return found

    def _drawn(self, context: EffectContext, part: int) -> tuple[IntArray, FloatArray]:
        """Return the frames at which random levels begin, the first being 0, and the levels."""
        generator = context.random.generator(draw=part)
        starts, first = [np.zeros(1, np.int64)], generator.integers(self.levels)
        size = int(self.rate * context.n_frames * 1.2) + 16
        while self.rate > 0 and starts[-1][-1] < context.n_frames:
            starts.append(starts[-1][-1] + np.cumsum(generator.geometric(self.rate, size)))
        frames = np.concatenate(starts)
        # a jump always goes to another level
        moves = generator.integers(1, self.levels, frames.size - 1)
        levels = (first + np.concatenate([[0], np.cumsum(moves)])) % self.levels
        return frames, np.asarray(levels - (self.levels - 1) / 2.0, np.float64)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return change points of the means of quadrants or halves, and random jumps of like size and rate.

        What is common to all is taken out first, so that neither a drift nor frame noise is taken for jumps.
        Jumps too many or too small to be told apart still leave a correlation in time: what is typical.
        """
        if evidence.time is None or evidence.time.frames.size < 16:
            return ()
        time = evidence.time
        means = time.quadrant_readout / responsivity(evidence)
        gaps = np.diff(time.frames, prepend=-1).astype(np.float64)
        parts, found = likeliest_parts(means, gaps, _PARTS)
        jumps = np.concatenate([np.diff(steps.levels) for steps in found])
        slow = evidence.strongest(*cls.signature[1:]) > CLEAR
        typical = cls.typical_as_seen(evidence, cls.signature[0]) if slow else []
        if not jumps.size:
            return typical
        size = float(np.sqrt((jumps**2).mean()))
        covered = len(found) * (int(time.frames[-1]) - int(time.frames[0]) + 1)
        rate = min(max(jumps.size / covered, 1e-6), 0.5)
        path = tuple(_as_path(time, steps.starts, steps.levels / size) for steps in found)
        as_seen = cls(amplitude_dn=size, rate=rate, parts=parts, path=path)
        faster = [one for one in typical if one.parts == parts and one.rate > rate]
        return [as_seen, as_seen.model_copy(update={"path": ()}), *faster]

    def shared_offset(self) -> SharedOffset:
        """Return that frames have one: at which level others are is not known."""
        return SharedOffset("frame", None)


def _steps(path: Path, n_frames: int) -> tuple[IntArray, FloatArray]:
    """Return the frames at which levels begin and the levels, zero on average over the run."""
    starts = np.array([frame for frame, _ in path], np.int64)
    levels = np.array([level for _, level in path], np.float64)
    if not levels.size:
        return starts, levels
    # the first level holds from the beginning of the run
    lasting = np.diff(np.concatenate([[0], starts[1:].clip(0, n_frames), [n_frames]]))
    return starts, levels - float((levels * lasting).sum() / n_frames)


def _values(paths: tuple[Path, ...]) -> FloatArray:
    """Return the levels that the paths go through, each as often as it lasts, zero on average.

    The length of the run is not known here: the last level is taken to last as long as the others do.
    """
    last = max((path[-1][0] for path in paths if path), default=0)
    end = last + max(1, last // max(1, max(len(path) for path in paths) - 1))
    found = [np.zeros(1)]
    for path in paths:
        starts, levels = _steps(path, end)
        if levels.size:
            lasting = np.diff(np.concatenate([[0], starts[1:], [end]]))
            found.append(np.repeat(levels, np.maximum(lasting * 512 // end, 1)))
    return np.concatenate(found)


def _as_path(time: TimeSeries, starts: IntArray, levels: FloatArray) -> Path:
    """Return levels with the frames at which they begin (the middle of a gap in time)."""
    cuts = starts[1:]
    begins = [int(time.frames[0]), *((time.frames[cuts - 1] + time.frames[cuts] + 1) // 2).tolist()]
    return tuple(zip(begins, np.round(levels, 6).tolist(), strict=True))
