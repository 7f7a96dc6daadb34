"""What is measured and not understood: samples that come out moved, by themselves or towards a neighbour.

Where no known effect explains the samples, their law can still be told: the law of a sample, given one that
was read beside or before it, is that of the model, mixed with moves. A move by a fixed number of DN is the
mixing law of a deconvolution, which maximum likelihood makes a few atoms of (Laird 1978; Lindsay 1983); one
towards a neighbour is an atom of the mixture transition distribution of Raftery (1985). Nothing is said
about why.
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.units import per_cent
from pchem_pipeline.effects.framework.compose import place_words
from pchem_pipeline.effects.framework.context import DIMS
from pchem_pipeline.effects.framework.effect import DEPTH, MOST_TOLD, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.neighbours import neighbour_words, neighbours
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

#: What is moved together.
Together = Literal["sample", "row", "column", "frame"]


class MixtureShift(Section):
    """A change of a sample: by a number of DN, or towards a neighbour.

    Towards a neighbour: by ``shift_dn`` where that is given, else by ``part`` of the difference, rounded down
    to whole DN. The neighbour in an earlier frame is the sample that was delivered; those in the
    same frame are as they were before any move.
    """

    weight: float = Field(default=1.0, ge=0, description="relative frequency of this move, no unit")
    shift_dn: int = Field(default=0, description="by how much, DN")
    towards: tuple[int, int, int] | None = Field(
        default=None, description="place of the neighbour: frames, rows, columns from the sample"
    )
    part: float = Field(default=1.0, ge=0, le=1, description="part of the difference to it, no unit")
    within_dn: int | None = Field(
        default=None, ge=0, description="only samples that differ from it by no more, DN; null: all"
    )

    @model_validator(mode="after")
    def _of_the_past(self) -> Self:
        if self.towards is not None and (self.towards[0] > 0 or not any(self.towards)):
            raise ValueError("towards: another sample, of this frame or an earlier one")
        if self.towards is not None and self.shift_dn < 0:
            raise ValueError("shift_dn: towards a neighbour it is not negative")
        return self

    def of(self, own: IntArray, other: IntArray | None) -> IntArray:
        """Return samples moved, DN; ``other`` are their neighbours."""
        if other is None:
            return own + self.shift_dn
        difference = other - own
        if self.shift_dn:
            step = self.shift_dn * np.sign(difference)
        else:
            step = np.floor(self.part * difference).astype(np.int64)
        if self.within_dn is not None:
            step = np.where(abs(difference) <= self.within_dn, step, 0)
        return np.asarray(own + step)

    def describe(self) -> str:
        """Return it in words."""
        if self.towards is None:
            return f"by {self.shift_dn:+d} DN"
        near = "" if self.within_dn is None else f" where they differ by at most {self.within_dn} DN"
        if self.shift_dn:
            return f"by {self.shift_dn} DN towards {neighbour_words(self.towards)}{near}"
        if self.part == 1.0:
            return f"to the value of {neighbour_words(self.towards)}{near}"
        return f"by {self.part:.2g} of the difference towards {neighbour_words(self.towards)}{near}"


@register_effect
class Empirical(Effect):
    """A share of the samples is moved, by so many DN or towards a neighbour.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    the samples without a name for what makes them so.
    """

    tag: Literal["empirical"] = Field(default="empirical", description="name of the effect")
    plane = Plane.READOUT
    along = 3
    title = "empirical shifts of samples"
    source = "Laird 1978, Lindsay 1983 (mixing laws); Raftery 1985 (mixture transitions)"
    strength = "share"
    empirical = True
    share: Ratio = Field(ge=0, le=1, description="share of shifted samples, no unit")
    moves: tuple[MixtureShift, ...] = Field(min_length=1, max_length=16, description="how; one of them each")
    together: Together = Field(
        default="sample", description="what is moved alike: each sample by itself, a row, a column or a frame"
    )
    squares: tuple[int, int] | None = Field(
        default=None,
        description="squares of 2 x 2 pixels come as their mean, rounded down, from rows and "
        "columns of this parity on (0 even, 1 odd); null: none does",
    )

    #: a hundredth of the samples 8 DN too low
    typical_values = ({"share": 0.01, "moves": (MixtureShift(shift_dn=-8),)},)

    @model_validator(mode="after")
    def _has_moves(self) -> Self:
        if not sum(move.weight for move in self.moves) > 0:
            raise ValueError("empirical: give at least one of moves a weight above 0")
        if self.squares and (self.together != "sample" or self.moves != (MixtureShift(),)):
            raise ValueError(
                "empirical: squares come as their mean and are not moved: leave moves at one of nothing"
            )
        return self

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it as it acts on some rows and columns that are taken for a sensor of their own."""
        if not self.squares:
            return self
        squares = (self.squares[0] + rows[0]) % 2, (self.squares[1] + columns[0]) % 2
        return self.model_copy(update={"squares": squares})

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return as an effect on the sensor what was found in some of its rows and columns."""
        return self.to_window(rows, columns, shape)  # of two parities each is the other of the other

    def shares(self) -> FloatArray:
        """Return the share of the samples that each move has."""
        weight = np.array([move.weight for move in self.moves])
        return np.asarray(self.share * weight / weight.sum())

    def halo(self) -> int:
        """Return how far the neighbours lie across rows, px."""
        reach = max(abs(move.towards[1]) if move.towards else int(bool(self.squares)) for move in self.moves)
        return reach * (DEPTH if self.history() else 1)

    def history(self) -> int:
        """Return how many frames before it matter: those of the neighbours, and of theirs."""
        return DEPTH * max(-move.towards[0] if move.towards else 0 for move in self.moves)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, with some samples moved."""
        drawn = context.random.uniform(DIMS[self.together])
        which = np.searchsorted(np.cumsum(self.shares()), drawn.ravel(), side="right").reshape(drawn.shape)
        own = values.astype(np.int64)
        if self.squares:
            rows, columns = context.rows % 2, np.arange(values.shape[2]) % 2
            first = (rows == self.squares[0])[:, None] & (columns == self.squares[1])
            return _averaged(own, (drawn < self.share) & first).astype(values.dtype)
        found = own
        # each pass follows the moves of earlier frames one frame further back
        for _ in range(DEPTH if self.history() else 1):
            before, found = found, own
            for number, move in enumerate(self.moves):
                here: BoolArray = which == number
                if not here.any():
                    continue
                other = None
                if move.towards is not None:
                    other, known = neighbours(before if move.towards[0] else own, move.towards)
                    here = here & known
                found = np.where(here, move.of(own, other), found)
        return found.clip(0, 2**context.bit_depth - 1).astype(values.dtype)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with satellites at the shifts: exact; what neighbours add to it is left out."""
        own = [
            (share, m.shift_dn) for share, m in zip(self.shares(), self.moves, strict=True) if not m.towards
        ]
        if not own:
            return model
        shares, shifts = np.array(own, np.float64).T
        weights = np.append(shares, max(1.0 - float(shares.sum()), 0.0))
        return model.with_noise(weights, shift_dn=np.append(shifts, 0.0))

    def describe(self) -> str:
        """Return what is known of it."""
        place = f" in {place_words(self)}" if place_words(self) else ""
        what = {
            "sample": "samples", "row": "rows", "column": "columns", "frame": "frames",
        }[self.together]  # fmt: skip
        if self.squares:
            rows, columns = (("even", "odd")[parity] for parity in self.squares)
            return (
                f"{per_cent(self.share)} of the squares of 2 x 2 pixels{place}, from {rows} rows and "
                f"{columns} columns on, equal the mean of their samples"
            )
        shares = self.shares()
        order = np.argsort(-shares)[:MOST_TOLD]
        told = [f"{per_cent(shares[i])} {self.moves[i].describe()}" for i in order]
        how = f" {self.moves[0].describe()}" if len(self.moves) == 1 else f" ({', '.join(told)})"
        return f"{per_cent(self.share)} of the {what}{place} are shifted{how}"


def _averaged(values: IntArray, chosen: BoolArray) -> IntArray:
    """Return frames (frame, y, x) whose squares from chosen pixels on are their mean; none overlap."""
    result = values.copy()
    corners = [
        (slice(y, values.shape[1] - 1 + y), slice(x, values.shape[2] - 1 + x)) for y in (0, 1) for x in (0, 1)
    ]
    mean = sum(values[:, y, x] for y, x in corners) // 4
    for y, x in corners:
        result[:, y, x] = np.where(chosen[:, :-1, :-1], mean, result[:, y, x])
    return result
