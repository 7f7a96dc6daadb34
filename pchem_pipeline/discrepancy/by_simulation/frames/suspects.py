"""Parts of the sensor and of the run that differ from the rest: guesses of the place of an effect.

What the scans of :mod:`pchem_pipeline.discrepancy.where` find in maps of pixels and series of frames, and
what :mod:`pchem_pipeline.discrepancy.scan_pairs` finds in the pairs of pixels that share a row, a column or a
frame: a common mode of a part is far larger in those than in any map. Samples that chance hardly makes, which
no mean shows, are events with a scan of their own (:mod:`pchem_pipeline.discrepancy.scan_events`). A part was
chosen by the samples that it is then judged by, so none may be a chance: the probabilities count all places
that were looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.ndimage import binary_dilation

from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.pairs import Samples, Stack
from pchem_pipeline.discrepancy.observe.places import FEWEST_FRAMES, FEWEST_PIXELS, Part
from pchem_pipeline.discrepancy.observe.rare import N_SETS, rare_samples
from pchem_pipeline.discrepancy.scan import scan_series, sharpest_range
from pchem_pipeline.discrepancy.scan_events import scan_event_frames, scan_event_map
from pchem_pipeline.discrepancy.scan_pairs import Limits, Shared, scan_pairs
from pchem_pipeline.discrepancy.where import frame_series, pixel_maps, suspected_regions
from pchem_pipeline.effects.framework.evidence import Evidence, TimeSeries
from pchem_pipeline.effects.framework.region import When
from pchem_pipeline.model.arithmetic.robust import robust_sd

FloatArray = NDArray[np.float64]

#: Of a place among all places of all maps; maps rest on fits, whose errors are not quite normal.
_SIGNIFICANCE_OF_MAPS = 1e-4
_SIGNIFICANCE_OF_GUESSES = 1.0  # of a place in all maps, which other maps must bear out
_FARTHEST = 6.0  # standard deviations of a pixel's shape
#: Of a place among all pairs, of frames among all series, and of either among rare samples: these follow from
#: the order of the frames, and from the number of the samples.
_SIGNIFICANCE = 1e-3
_LARGEST = 0.6  # of sensor or run
_MOST = 2  # regions, and ranges of frames
_AS_CLEAR = 0.5  # of the standard deviations of the clearest region
_TREND = 0.7  # of the deviation of a range, what a trend from end to end may explain


class _Found(NamedTuple):
    """A part, and by how many standard deviations it differs from the rest."""

    z: float
    part: Part


def suspected_parts(evidence: Evidence, frames: NDArray[np.unsignedinteger[Any]]) -> tuple[Part, ...]:
    """Return the parts that stand out most from the rest: two regions and two ranges at most, and a crossing.

    Args:
        evidence: of the frames.
        frames: codes (n, y, x), DN.
    """
    time = evidence.time
    if time is None:
        return ()
    usable = evidence.maps.usable
    samples = Samples.of(frames, evidence.maps)
    shared = scan_pairs(
        samples, significance=_SIGNIFICANCE, most=_MOST, limits=Limits(FEWEST_PIXELS, _LARGEST)
    )
    regions = [
        *_regions(evidence, usable),
        *_regions_of_rare(evidence),
        *(_Found(each.z, Part(each.region)) for each in shared),
    ]
    places = _apart(regions, usable.shape)
    stretches = [*_stretches(evidence, time), *_stretches_of_rare(evidence, time)]
    ranges = [with_ends(part, evidence) for part in _told_apart(stretches, time.frames)]
    crossings = [*_frames_of_places(shared, samples, time), *_places_of_frames(ranges, samples, frames, time)]
    if places and ranges and not crossings:
        crossings = [_Found(0.0, Part(places[0].region, ranges[0].when))]
    return (*places, *ranges, *(each.part for each in crossings[:1]))


def with_ends(part: Part, evidence: Evidence) -> Part:
    """Return a part with the ends of its range of frames as all series of the frames tell them."""
    time = evidence.time
    if time is None or part.when is None or len(part.when.range) != 1:
        return part
    at = np.flatnonzero(part.frames(time.frames))
    # how far the means are off says nothing beside the means
    known = frame_series(evidence).items()
    series = np.array([values for name, values in known if not name.startswith("scatter.")])
    if at.size < FEWEST_FRAMES or not np.isfinite(series).all():
        return part
    first, last = sharpest_range(series, int(at[0]), int(at[-1]) + 1, FEWEST_FRAMES)
    when = When(range=((int(time.frames[first]), int(time.frames[last - 1]) + 1),))
    return Part(part.region, _with_unseen(when, time.frames))


def _apart(found: list[_Found], shape: tuple[int, ...]) -> list[Part]:
    """Return the regions that stand out most and do not overlap.

    One that touches another, as a tap does, must be nearly as clear: else it is the edge of that.
    """
    parts: list[Part] = []
    taken = np.zeros(shape, np.bool_)
    found = sorted(found, key=lambda one: -one.z)
    for each in found:
        assert each.part.region is not None
        mask = each.part.region.mask((shape[0], shape[1]))
        beside = taken if each.z > _AS_CLEAR * found[0].z else binary_dilation(taken)
        if len(parts) < _MOST and not (mask & beside).any():
            parts.append(each.part)
            taken |= mask
    return parts


def _told_apart(found: Sequence[_Found], frames: NDArray[np.int64]) -> list[Part]:
    """Return the frames that stand out most and do not overlap."""
    parts: list[Part] = []
    taken = np.zeros(frames.size, np.bool_)
    for each in sorted(found, key=lambda one: -one.z):
        chosen = each.part.frames(frames)
        if len(parts) < _MOST and not (chosen & taken).any():
            parts.append(each.part)
            taken |= chosen
    return parts


def _frames_of_places(shared: Sequence[Shared], samples: Samples, time: TimeSeries) -> Iterator[_Found]:
    """Yield places in those frames only in which their pixels share noise."""
    for each in shared:
        mask = samples.usable & each.region.mask((samples.usable.shape[0], samples.usable.shape[1]))
        energy = samples.energies(each.channel, each.mode, mask)
        values = (energy - np.median(energy)) / max(robust_sd(energy), 1e-300)
        for one in scan_series(
            values, time.frames, significance=_SIGNIFICANCE, most=1, shortest=FEWEST_FRAMES
        ):
            inside = one.when.frames(time.frames).sum()
            if FEWEST_FRAMES <= inside <= _LARGEST * time.frames.size and one.inside > one.outside:
                yield _Found(one.z, Part(each.region, _with_unseen(one.when, time.frames)))


def _places_of_frames(
    ranges: Sequence[Part], samples: Samples, frames: NDArray[np.unsignedinteger[Any]], time: TimeSeries
) -> Iterator[_Found]:
    """Yield ranges of frames in those pixels only that share noise there."""
    for part in ranges:
        chosen = Stack(frames[part.frames(time.frames)])
        for each in scan_pairs(
            replace(samples, frames=chosen),
            significance=_SIGNIFICANCE,
            most=1,
            limits=Limits(FEWEST_PIXELS, _LARGEST),
        ):
            yield _Found(each.z, Part(each.region, part.when))


def _regions(evidence: Evidence, usable: NDArray[np.bool_]) -> Iterator[_Found]:
    """Yield the places that stand out in a map, or in all shapes of the histograms together.

    Where little of it is elsewhere, and not scattered pixels: effects of few pixels are simulated in others,
    and would never do to these what the data do.
    """
    shapes, log_maps = _Shapes(evidence), float(np.log(len(pixel_maps(evidence))))
    for suspects in suspected_regions(evidence, _SIGNIFICANCE_OF_GUESSES).values():
        for one in suspects:
            mask = usable & one.region.mask((usable.shape[0], usable.shape[1]))
            if not one.only_there or one.family == "pixels":
                continue
            if not FEWEST_PIXELS <= mask.sum() <= _LARGEST * usable.sum():
                continue
            z = shapes.z(mask)
            together = float(special.log_ndtr(-z)) + one.log_places
            if min(one.log_p + log_maps, together) <= np.log(_SIGNIFICANCE_OF_MAPS):
                yield _Found(max(abs(one.z), z), Part(one.region))


class _Shapes:
    """The maps of the shapes of the histograms, of which effects move several at once."""

    def __init__(self, evidence: Evidence):
        self.usable = evidence.maps.usable
        maps = [evidence.goodness, evidence.peaks, *evidence.scores.values()]
        values = np.nan_to_num(np.array([each[self.usable] for each in maps], np.float64))
        # means of places are nearly normal, single pixels less so
        middle = np.median(values, axis=1, keepdims=True)
        self.values = np.clip(values - middle, -_FARTHEST, _FARTHEST)
        self.precision = np.linalg.pinv(np.atleast_2d(np.cov(self.values)), hermitian=True)

    def z(self, mask: NDArray[np.bool_]) -> float:
        """Return by how many standard deviations the means of pixels, (y, x), are off (Hotelling 1931)."""
        inside = mask[self.usable]
        apart = self.values[:, inside].mean(axis=1) - self.values[:, ~inside].mean(axis=1)
        number = 1.0 / (1.0 / inside.sum() + 1.0 / (~inside).sum())
        distance = number * float(apart @ self.precision @ apart)
        return float(chi_square(np.array(distance), len(self.values)))


def _regions_of_rare(evidence: Evidence) -> Iterator[_Found]:
    """Yield the places of samples that chance hardly makes, while few of them are elsewhere."""
    usable = evidence.maps.usable
    for rare in rare_samples(evidence):
        for one in scan_event_map(rare.seen, rare.expected, usable, significance=_SIGNIFICANCE / N_SETS):
            inside = int((usable & one.region.mask((usable.shape[0], usable.shape[1]))).sum())
            if one.only_there and FEWEST_PIXELS <= inside <= _LARGEST * usable.sum():
                yield _Found(one.z, Part(one.region))


def _stretches_of_rare(evidence: Evidence, time: TimeSeries) -> Iterator[_Found]:
    """Yield the frames of samples that chance hardly makes."""
    for rare in rare_samples(evidence):
        at = np.searchsorted(time.frames, rare.hits[:, 0])
        one = scan_event_frames(
            at,
            time.frames,
            expected=float(rare.expected.sum()),
            significance=_SIGNIFICANCE / N_SETS,
            shortest=FEWEST_FRAMES,
        )
        if one is not None:
            inside = int(one.when.frames(time.frames).sum())
            if one.only_there and FEWEST_FRAMES <= inside <= _LARGEST * time.frames.size:
                yield _Found(one.z, Part(None, _with_unseen(one.when, time.frames)))


def _stretches(evidence: Evidence, time: TimeSeries) -> list[_Found]:
    """Return the frames of series that stand out, but for what goes on rising from end to end of the run."""
    found = []
    series = frame_series(evidence)
    for name, values in series.items():
        limit = _SIGNIFICANCE / len(series)
        for one in scan_series(values, time.frames, significance=limit, shortest=FEWEST_FRAMES):
            inside = int(one.when.frames(time.frames).sum())
            some = FEWEST_FRAMES <= inside <= _LARGEST * time.frames.size
            # a scatter that is less is that of the frames beside it which is more
            some = some and (one.inside > one.outside or name.startswith("frame."))
            # levels that alternate or beat are effects in all frames, which have names
            some = some and not (one.when.every and name.startswith("frame."))
            if some and _follows(values, one.when.frames(time.frames)) * _TREND > _slope(values):
                found.append(_Found(abs(one.z), Part(None, _with_unseen(one.when, time.frames))))
    return found


def _with_unseen(when: When, seen: NDArray[np.int64]) -> When:
    """Return a range with half of the frames at its ends that were not looked at."""
    if len(when.range) != 1:
        return when
    first, last = when.range[0]
    before, after = seen[seen < first], seen[seen >= last]
    first -= int(first - before[-1] - 1) // 2 if before.size else 0
    last += int(after[0] - last) // 2 if after.size else 0
    return when.model_copy(update={"range": ((first, last),)})


def _follows(values: FloatArray, form: NDArray[Any]) -> float:
    """Return by how many standard deviations a series goes with another one."""
    return float(abs(np.corrcoef(form, values)[0, 1]) * np.sqrt(values.size))


def _slope(values: FloatArray) -> float:
    """Return by how many standard deviations a series rises or falls along the run."""
    return _follows(values, np.arange(values.size))
