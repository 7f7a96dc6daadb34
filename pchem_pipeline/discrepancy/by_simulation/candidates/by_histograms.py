"""Guesses by the histograms of pixels on which an effect acts: its numbers, and what no estimator sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    FEW_PIXELS,
    PixelLikelihood,
    identifiable_from_histograms,
)
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps

BoolArray = NDArray[np.bool_]

_FEWEST_PIXELS, _FEWEST_FRAMES = 16, 200  # of a place, whose histograms tell numbers
_MOST_IN_A_PART = 2  # effects for which no estimator speaks
# nats of few pixels, and share of what the best one explains, by which an effect is far behind that
_FAR, _FAR_SHARE = 10.0, 0.1


@dataclass
class Histograms:
    """The pixels of a stack, place by place.

    Attributes:
        frames: (frame, y, x), DN.
        maps: of their pixels under the model.
        present: effects of the model.
        effort: counts the work.
        samples_of: returns the frames, (frame,), and the pixels, (y, x), of a part.
        defects: effects that failed, and why; more come to them.
        told: effects of which the numbers are those that the histograms tell.
    """

    frames: NDArray[np.unsignedinteger]
    maps: PixelMaps
    present: Sequence[Effect]
    effort: Effort
    samples_of: Callable[[Part], tuple[BoolArray, BoolArray]]
    defects: dict[str, str] = field(default_factory=dict)
    told: list[Effect] = field(default_factory=list)
    _known: dict[Part, PixelLikelihood | None] = field(default_factory=dict, repr=False)

    def with_numbers(self, guesses: Sequence[Effect]) -> list[Effect]:
        """Return guesses with the numbers that histograms tell, the likeliest of an effect in a place first.

        Those of effects with a law, by the samples on which they act: a strong effect has moved the pixels
        from which its estimator takes a strength. Others, and those that no pixel can be fitted with, stay as
        they are. Guesses that come to the same are one.
        """
        by_place: dict[Part, dict[str, list[Effect]]] = {}
        for g in guesses:
            by_place.setdefault(Part(g.region, g.when), {}).setdefault(g.tag, []).append(g)
        likely: dict[tuple[str, Part], list[Effect]] = {}
        for place, own in by_place.items():
            anywhere = {tag: [g.at_place(None) for g in there] for tag, there in own.items()}
            told = {
                tag: there
                for tag, there in anywhere.items()
                if any(identifiable_from_histograms(g) for g in there)
            }
            by = self._of(place) if told else None
            for tag, effects in {} if by is None else _likeliest(by, told).items():
                likely[tag, place] = [e.at_place(place.region, place.when) for e in effects]
        found: list[Effect] = []
        for tag in dict.fromkeys(g.tag for g in guesses):
            for place, own in by_place.items():
                found += likely.get((tag, place)) or own.get(tag, [])
        self.told += [effect for effects in likely.values() for effect in effects]
        return found

    def suggested(
        self, classes: Mapping[str, type[Effect]], parts: Sequence[Part], guesses: Sequence[Effect]
    ) -> list[Effect]:
        """Return what explains much of the histograms of parts, of effects that are not guessed there."""
        found: list[Effect] = []
        for part in parts:
            known = {g.tag for g in guesses if (g.region, g.when) == (part.region, part.when)}
            by = self._of(part)
            kinds = [kind for tag, kind in classes.items() if tag not in known]
            likely = [] if by is None else by.suggested(kinds)[:_MOST_IN_A_PART]
            found += [effect.at_place(part.region, part.when) for effect in likely]
        self.told += found
        return found

    def _of(self, part: Part) -> PixelLikelihood | None:
        """Return the likelihood of the samples of a part; None: they are too few, or have no one law."""
        if part not in self._known:
            some, inside = self.samples_of(part)
            usable = self.maps.usable & inside
            enough = usable.sum() >= _FEWEST_PIXELS and some.sum() >= _FEWEST_FRAMES
            told = enough and all(each.everywhere for each in self.present)
            own = self.frames if some.all() else self.frames[some]
            maps = replace(self.maps, usable=usable)
            of = own, maps, self.present, self.effort, FEW_PIXELS
            self._known[part] = PixelLikelihood(*of, self.defects) if told else None
        return self._known[part]


def _likeliest(by: PixelLikelihood, guesses: Mapping[str, Sequence[Effect]]) -> dict[str, list[Effect]]:
    """Return the numbers of effects in a place, by tag: as a part of its pixels tells them first.

    As all of them do where an effect comes near the best one; the others are in vain, or beside it, where
    numbers that were fitted without it say little.
    """
    few = by.fewer()
    rough = {tag: few.fitted(own) for tag, own in guesses.items()}
    best = max((fits[0][0] for fits in rough.values() if fits), default=0.0)
    found = {}
    for tag, fits in rough.items():
        near = bool(fits) and fits[0][0] > (1.0 - _FAR_SHARE) * best - _FAR
        fits = by.fitted([effect for _, effect in fits]) if near and few is not by else fits
        found[tag] = [effect for _, effect in fits]
    return found
