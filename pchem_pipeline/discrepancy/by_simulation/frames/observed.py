"""The frames of a search, observed: the parts that differ, and the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.suspects import suspected_parts
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.verdict import Examined, Surveyed
from pchem_pipeline.discrepancy.where import unfitted_place
from pchem_pipeline.effects.framework.evidence import Evidence

_FEWEST_PIXELS = 32
_NOT_IDENTIFIED = 0.5  # share of ambiguous pixels from which their parameters are no ground for a verdict


@dataclass(frozen=True)
class ObservedFrames:
    """The frames of a search, with the parts of sensor and run that differ, observed."""

    frames: FrameStack
    plain: Evidence  # evidence of train and test frames together, fitted without effects
    parts: tuple[Evidence, Evidence, Evidence]  # evidence of train, test and final frames, each near that fit

    @classmethod
    def of(cls, frames: FrameStack) -> ObservedFrames:
        """Observe train and test frames together, then each part near their fit.

        Raises:
            InputError: usable pixels are too few.
        """
        plain = frames.observe(frames.seen)
        _check(plain)
        found = suspected_parts(plain, frames.seen_stack)
        frames = frames.with_parts(found).with_ends(plain.maps)
        splits = frames.splits
        train, test, final = (
            frames.observe(part, plain.maps) for part in (splits.train, splits.test, splits.final)
        )
        return cls(frames, plain, (train, test, final))

    def statistics(self) -> list[dict[str, float]]:
        """Return the statistics of train, test and final frames, as replicates have them."""
        splits = self.frames.splits
        parts = splits.train, splits.test, splits.final
        return [self.frames.statistics(part, e) for part, e in zip(parts, self.parts, strict=True)]

    def names(self, vectors: Sequence[Mapping[str, float]]) -> tuple[str, ...]:
        """Return the statistics that all vectors have, without those that rest on unidentified parameters."""
        names = tuple(name for name in vectors[0] if all(name in each for each in vectors[1:]))
        if self.doubt():
            names = tuple(np.array(names)[free_of_parameters(names, self.plain.maps)].tolist())
        return names

    @property
    def final_samples(self) -> int:
        """Samples of usable pixels in the final frames."""
        return self.frames.splits.final.size * int(self.parts[0].maps.usable.sum())

    @property
    def samples(self) -> int:
        """Samples of train and test frames, those of each part that differs counted again."""
        return sum(self.frames.samples(part) for part in (Part(), *self.frames.parts))

    def examined(self) -> Examined:
        """Return what is looked at, and where the pixels are that have no fit to be relied upon."""
        frames, usable = self.frames, self.plain.maps.usable
        known, place = frames.splits.examined(frames.stack.shape), unfitted_place(usable)
        spots = []
        if place is not None and (region := frames.sensor_window.on_sensor(place.region)) is not None:
            spots.append(Surveyed(map="unfitted", region=region.numbers(), p=place.p))
        return known.model_copy(update={"unfitted": int((~usable).sum()), "places": tuple(spots)})

    def doubt(self) -> str:
        """Say which share of the pixels is not identified, and what would help; empty below a half."""
        share, usable = self.plain.ambiguous, float(np.mean(self.plain.maps.usable))
        if share < _NOT_IDENTIFIED and usable > 1.0 - _NOT_IDENTIFIED:
            return ""
        maps, frames = self.plain.maps, self.frames.numbers.size
        noise = np.nanmedian(maps.read_noise_dn * maps.conversion_gain)
        lost = (
            f"the bias of {100 * share:.0f} % of the pixels may be off by an electron"
            if share >= _NOT_IDENTIFIED
            else f"only {100 * usable:.0f} % of the pixels have a reliable fit"
        )
        return (
            f"{lost} (read noise {noise:.2f} e-, {frames:,} frames); fit several exposures jointly (pchem "
            "joint), or take many more frames"
        )


def _check(plain: Evidence) -> None:
    usable = plain.maps.usable
    if usable.size < _FEWEST_PIXELS:
        raise InputError(
            f"a sensor of {usable.size} pixels is too small to compare; {_FEWEST_PIXELS} are needed"
        )
    if usable.sum() < _FEWEST_PIXELS:
        raise InputError(
            f"{int(usable.sum())} of {usable.size} pixels have a usable fit, "
            f"fewer than {_FEWEST_PIXELS}: nothing can be compared; see fit_status, or take more frames"
        )
