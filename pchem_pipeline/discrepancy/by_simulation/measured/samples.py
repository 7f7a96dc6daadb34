"""The samples of a part of sensor and run, of the data or simulated, and what is measured in them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, IntArray
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.observe.sums import FrameBlocks, Samples, laws_of_frames
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps

#: Frames, rows and columns between two samples.
Distance = tuple[int, int, int]
#: Frames, rows and columns between samples that are compared, at most.
FARTHEST = 3
Answer = TypeVar("Answer")


class Measurement(NamedTuple):
    """What was measured, by how much likelier the samples are with it, nats, and what it may be as well."""

    effect: Effect
    gain: float
    others: tuple[Effect, ...] = ()


@dataclass(frozen=True, eq=False)
class PartSamples:
    """Samples of a part of sensor and run.

    Attributes:
        stack: all seen frames of the run, (frame, y, x), DN.
        stack_numbers: theirs in the run, increasing, shape (frame,).
        maps: plain fit of these frames, or of more of the same pixels.
        evidence: of the frames of the data, with the errors of charge and residuals.
        inside: pixels of the part, shape (y, x).
        whole_lines: kinds of lines ("row", "column") that are here from end to end.
        known: what was measured in them.
    """

    stack: NDArray[np.unsignedinteger]
    stack_numbers: IntArray
    maps: PixelMaps
    evidence: Evidence
    inside: BoolArray
    part: Part = field(default_factory=Part)
    whole_lines: Collection[str] = ("row", "column")
    known: dict[Callable[[PartSamples], object], object] = field(default_factory=dict, repr=False)

    @cached_property
    def frames(self) -> NDArray[np.unsignedinteger]:
        """The frames of the part, (frame, y, x), DN."""
        return self.stack[self.part.frames(self.stack_numbers)]

    @cached_property
    def numbers(self) -> IntArray:
        """Their numbers in the run, shape (frame,)."""
        return self.stack_numbers[self.part.frames(self.stack_numbers)]

    @cached_property
    def laws(self) -> PixelLaws:
        """Laws of the samples of the pixels."""
        return laws_of_frames(self.frames, self.maps)

    def of(self, measure: Callable[[PartSamples], Answer]) -> Answer:
        """Return what a function measures in them; each is asked once."""
        if measure not in self.known:
            self.known[measure] = measure(self)
        return cast(Answer, self.known[measure])

    def scores(self, kind: int, inside: BoolArray, *box: slice) -> Float32Array:
        """Return standardised expected electrons (kind 0) or readout residuals (1) of pixels of a box.

        0 where they are not known, shape (frame, y, x).
        """
        samples = Samples.by_laws(FrameBlocks.of(self.frames), self.laws, self.maps).without(~inside)
        return np.concatenate([chunk for (chunk,) in samples.chunks((kind,), *box)])


def frames_apart(numbers: IntArray, step: int) -> tuple[IntArray, IntArray]:
    """Return the places of the frames that have one ``step`` later in the run, and of those, (n,) each."""
    later = np.searchsorted(numbers, numbers + step).clip(max=numbers.size - 1)
    first = np.flatnonzero(numbers[later] == numbers + step)
    return first, later[first]
