"""Misplaced lines: rows or columns of a frame whose samples are delivered as those of other pixels.

Two lines that change places, a line that comes a sample early or late, a sample or a whole line that is lost
or delivered twice so that all that follow move up or down: what a frame grabber makes of a lost clock, a
cable of the end of a packet. Every sample is then a good one, of another pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.context import Dim
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.evidence import PLACES
from pchem_pipeline.effects.framework.neighbours import along_axis
from pchem_pipeline.effects.types import AnyArray, BoolArray, EffectContext, Evidence, FloatArray, IntArray

Move = Literal["swapped", "early", "late", "sample_lost", "sample_twice", "line_lost", "line_twice"]

_Y, _X = 1, 2  # axes
_DIMS: Mapping[int, Dim] = {_Y: "y", _X: "x"}
_WHERE = 1  # draw of the sample or line from which on others follow
# of the shares of lines from the line after and before, by which two that are alike differ at most
_ALIKE = 2.0
# share of the lines that moves make, of those they can make, by which a guess is worth a try
_WORTH = 0.1
_HIDDEN = 2.5  # lines there may be for each that is seen


@register_effect
class MisplacedLines(Effect):
    """In some frames a row, or a column, holds the samples of other pixels.

    Signature: samples of a line that are likelier by the histograms of the pixels beside it than by their
    own, all together; nothing where pixels are alike. A pixel's own histogram gets a share of its neighbour's
    samples, with that one's bias and gain, so it has no law of its own.
    """

    tag: Literal["misplaced_lines"] = Field(default="misplaced_lines", description="name of the effect")
    plane = Plane.READOUT
    along = 2
    title = "misplaced rows or columns"
    source = "GenICam / GigE Vision (packet resend); likelihood ratio of lines at other places"
    signature = ("space.misplaced.rows", "space.misplaced.columns")
    strength = "share"
    reach_rows = 2  # whether a row changes places with the next depends on the two before
    separate: ClassVar[Mapping[str, str]] = {
        "repeated_lines": "neighbouring lines: repeated lines are equal, misplaced ones are not",
        "interpixel_capacitance": "whole lines: capacitance changes all slightly, misplacement single ones",
    }
    share: Ratio = Field(
        ge=0,
        le=0.5,
        description="probability per line, no unit; of a line lost or delivered twice: per frame",
    )
    move: Move = Field(
        default="swapped",
        description="swapped: with the next line; early, late: by one sample; sample_lost, sample_twice: "
        "the same from a random sample of the line on; line_lost, line_twice: all lines from a random one on "
        "hold those after or before them",
    )
    lines: Literal["rows", "columns"] = Field(default="rows", description="which lines")

    #: rows that change places, come late, and lose a sample, one in a hundred
    typical_values = (
        {"share": 1e-2},
        {"share": 1e-2, "move": "late"},
        {"share": 1e-2, "move": "sample_lost"},
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN; at the end of a line the last sample is repeated."""
        across, along = (_Y, _X) if self.lines == "rows" else (_X, _Y)
        if self.move == "swapped":
            return along_axis(values, self._exchanged(context, across), across)
        of_lines = self.move in ("line_lost", "line_twice")
        axis = across if of_lines else along
        drawn: tuple[Dim, ...] = ("frame",) if of_lines else ("frame", _DIMS[across])
        hit = context.random.uniform(drawn) < self.share
        if self.move not in ("early", "late"):
            size, place = _places(context, axis)
            hit = hit & (place >= np.floor(context.random.uniform(drawn, _WHERE) * size))
        later = self.move in ("early", "sample_lost", "line_lost")
        return along_axis(values, np.where(hit, 1 if later else -1, 0), axis)

    def _exchanged(self, context: EffectContext, across: int) -> IntArray:
        """Return from how many lines later each line comes; of overlapping pairs the first one counts."""
        size, place = _places(context, across)
        hit = (context.random.uniform(("frame", _DIMS[across])) < self.share) & (place < size - 1)
        first = hit & ~_before(hit, across)
        return np.where(first, 1, np.where(_before(first, across), -1, 0))

    def displaced(self) -> Mapping[Literal["rows", "columns"], FloatArray]:
        """Return the shares of lines that hold the samples of other pixels."""
        some = self.share / 2.0  # of the lines of a frame those after a random one
        found = {
            "swapped": {"next": self.share, "before": self.share},
            "early": {"early": self.share},
            "late": {"late": self.share},
            "sample_lost": {"lost": self.share},
            "sample_twice": {"twice": self.share},
            "line_lost": {"next": some},
            "line_twice": {"before": some},
        }[self.move]
        return {self.lines: np.array([found.get(place, 0.0) for place in PLACES])}

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the moves that leave lines where they are found, with the shares found there."""
        if evidence.time is None:
            return ()
        seen: list[tuple[float, Move, str]] = []
        for lines, shares in evidence.time.misplaced_lines.items():
            share = dict(zip(PLACES, (float(s) for s in shares), strict=True))
            after, before = share["next"], share["before"]
            guesses: dict[Move, float] = {"early": share["early"], "late": share["late"]}
            guesses |= {"sample_lost": share["lost"], "sample_twice": share["twice"]}
            if min(after, before) * _ALIKE > max(after, before):
                guesses["swapped"] = (after + before) / 2.0
            else:
                # from a random line on: half of them
                guesses["line_lost"], guesses["line_twice"] = 2.0 * after, 2.0 * before
            most = max(guesses.values())
            seen += [(guess, move, lines) for move, guess in guesses.items() if guess > _WORTH * most]
        # the histograms hold the misplaced samples, too, so that of many lines few are seen
        return [
            cls.model_validate({"share": min(times * guess, 0.5), "move": move, "lines": lines})
            for guess, move, lines in sorted(seen, key=lambda one: -one[0])
            for times in (1.0, _HIDDEN)
        ]


def _places(context: EffectContext, axis: int) -> tuple[int, IntArray]:
    """Return how many rows (columns) the sensor has, and which those here are, (1, y, 1) or (1, 1, x)."""
    if axis == _Y:
        return context.shape[0], context.rows[None, :, None]
    return context.shape[1], np.arange(context.shape[1])[None, None, :]


def _before(lines: BoolArray, axis: int) -> BoolArray:
    """Return for each line whether the one before it is marked; the first one has none."""
    moved = np.roll(lines, 1, axis)
    moved[(slice(None),) * axis + (0,)] = False
    return moved
