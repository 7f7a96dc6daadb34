"""Parts of the sensor and of the run that differ from the rest: guesses of the place of an effect.

From scans of maps of pixels and series of frames (:mod:`pchem_pipeline.discrepancy.where`), of pairs of
pixels that share a row, a column or a frame (:mod:`pchem_pipeline.discrepancy.scan_pairs`), where a common
mode of a part is far larger, and of rare events (:mod:`pchem_pipeline.discrepancy.scan`). A part is judged by
the samples that it was chosen by: its probability counts all places that were looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.ndimage import binary_dilation

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.laws import FAR, chi_square
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.observe.sums import FEWEST_FRAMES, FrameBlocks, Samples
from pchem_pipeline.discrepancy.scan import (
    Cluster,
    Stretch,
    Suspect,
    scan_event_frames,
    scan_event_map,
    scan_series,
    sharpest_range,
)
from pchem_pipeline.discrepancy.scan_pairs import FEWEST_PIXELS, LARGEST, Shared, scan_pairs, shared_elsewhere
from pchem_pipeline.discrepancy.where import N_SETS, frame_series, pixel_maps, rare_samples, suspected_regions
from pchem_pipeline.effects.framework.evidence import Evidence, TimeSeries
from pchem_pipeline.effects.framework.region import When
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import robust_sd

#: Of a place among all places of all maps: maps rest on fits, whose errors are not quite normal. What is
#: found among pairs, series and rare samples rests on the order of the frames and the number of samples.
_SIGNIFICANCE_OF_MAPS = 1e-4
_SIGNIFICANCE_OF_GUESSES = 1.0  # of a place in all maps, which other maps must bear out
_MOST = 2  # regions, and ranges of frames
_AS_CLEAR = 0.5  # of the standard deviations of the clearest region
_TREND = 0.7  # of the deviation of a range, what a trend from end to end may explain

_C = TypeVar("_C", bound=Cluster)


def suspected_parts(evidence: Evidence, frames: NDArray[np.unsignedinteger[Any]]) -> tuple[Part, ...]:
    """Return the parts of frames (n, y, x) that stand out most: two regions, two ranges, one crossing."""
    time, usable = evidence.time, evidence.maps.usable
    if time is None:
        return ()
    samples = Samples.of(frames, evidence.maps)
    shared = scan_pairs(samples, most=_MOST)
    regions = [*_regions(evidence), *_regions_of_rare(evidence), *shared]
    # one that touches another, as a tap does, must be nearly as clear: else it is the edge of that
    masked = ((each, each.region.mask(usable.shape)) for each in regions)
    places = [Part(each.region) for each in _apart(masked, binary_dilation)]
    # of what all outside share, too, but not with those inside, a second tap say, no map shows anything
    rest = shared_elsewhere(samples, shared[0]) if shared else None
    places += [] if rest is None or len(places) == _MOST else [Part(rest)]
    stretches = [*_stretches(evidence, time), *_stretches_of_rare(evidence, time)]
    chosen = _apart(((each, each.when.frames(time.frames)) for each in stretches), np.asarray)
    ranges = [with_ends(Part(None, each.when), evidence) for each in chosen]
    crossings = [*_frames_of_places(shared, samples, time), *_places_of_frames(ranges, samples, frames, time)]
    if places and ranges and not crossings:
        crossings = [Part(places[0].region, ranges[0].when)]
    return (*places, *ranges, *crossings[:1])


def with_ends(part: Part, evidence: Evidence) -> Part:
    """Return a part with the ends of its range of frames sharpened by all series of the frames."""
    time = evidence.time
    if time is None or part.when is None or len(part.when.range) != 1:
        return part
    at = np.flatnonzero(part.frames(time.frames))
    # deviations of the means say nothing beside the means
    known = frame_series(evidence).items()
    series = np.array([values for name, values in known if not name.startswith("scatter.")])
    if at.size < FEWEST_FRAMES or not np.isfinite(series).all():
        return part
    first, last = sharpest_range(series, int(at[0]), int(at[-1]) + 1, FEWEST_FRAMES)
    when = When(range=((int(time.frames[first]), int(time.frames[last - 1]) + 1),))
    return Part(part.region, _with_unseen(when, time.frames))


def _apart(found: Iterable[tuple[_C, BoolArray]], grown: Callable[[BoolArray], BoolArray]) -> list[_C]:
    """Return what stands out most and does not overlap, if far less clear not even with grown masks."""
    ordered = sorted(found, key=lambda one: -one[0].z)
    chosen: list[_C] = []
    taken = np.zeros_like(ordered[0][1]) if ordered else np.zeros(0, np.bool_)
    for each, own in ordered:
        beside = taken if each.z > _AS_CLEAR * ordered[0][0].z else grown(taken)
        if len(chosen) < _MOST and not (own & beside).any():
            chosen.append(each)
            taken = taken | own
    return chosen


def _is_part(inside: BoolArray, every: BoolArray, fewest: int) -> bool:
    """Return whether some pixels or frames are enough to be looked at by themselves, and not nearly all."""
    return bool(fewest <= (inside & every).sum() <= LARGEST * every.sum())


def _among(frames: IntArray, when: When) -> bool:
    """Return whether some frames are enough to be looked at by themselves, and not nearly all."""
    return _is_part(when.frames(frames), np.ones(frames.size, np.bool_), FEWEST_FRAMES)


def _frames_of_places(shared: Sequence[Shared], samples: Samples, time: TimeSeries) -> Iterator[Part]:
    """Yield places in those frames only in which their pixels share noise."""
    for each in shared:
        inside = samples.usable & each.region.mask(samples.usable.shape)
        energy = samples.energies(each.channel, each.mode, inside)
        values = (energy - np.median(energy)) / max(robust_sd(energy), 1e-300)
        for one in scan_series(values, time.frames, most=1, shortest=FEWEST_FRAMES):
            if _among(time.frames, one.when) and one.inside > one.outside:
                yield Part(each.region, _with_unseen(one.when, time.frames))


def _places_of_frames(
    ranges: Sequence[Part], samples: Samples, frames: NDArray[np.unsignedinteger[Any]], time: TimeSeries
) -> Iterator[Part]:
    """Yield ranges of frames in those pixels only that share noise there."""
    for part in ranges:
        chosen = FrameBlocks.of(frames[part.frames(time.frames)])
        for each in scan_pairs(replace(samples, frames=chosen), most=1):
            yield Part(each.region, part.when)


def _regions(evidence: Evidence) -> Iterator[Suspect]:
    """Yield the places, no scattered pixels, that alone stand out in a map or in all shapes of histograms."""
    usable = evidence.maps.usable
    shapes, log_maps = _shapes(evidence), float(np.log(len(pixel_maps(evidence))))
    for suspects in suspected_regions(evidence, _SIGNIFICANCE_OF_GUESSES).values():
        for one in suspects:
            mask = usable & one.region.mask(usable.shape)
            if not one.only_there or one.family == "pixels" or not _is_part(mask, usable, FEWEST_PIXELS):
                continue
            z = shapes(mask)
            together = float(special.log_ndtr(-z)) + one.log_places
            if min(one.log_p + log_maps, together) <= np.log(_SIGNIFICANCE_OF_MAPS):
                yield replace(one, z=max(abs(one.z), z))


def _shapes(evidence: Evidence) -> Callable[[BoolArray], float]:
    """Return a function of pixels (y, x): how far their mean histogram shapes are off (Hotelling 1931)."""
    usable = evidence.maps.usable
    maps = [evidence.goodness, evidence.peaks, *evidence.scores.values()]
    values = np.nan_to_num(np.array([each[usable] for each in maps], np.float64))
    # means of places are nearly normal, single pixels less so
    values = np.clip(values - np.median(values, axis=1, keepdims=True), -FAR, FAR)
    precision = np.linalg.pinv(np.atleast_2d(np.cov(values)), hermitian=True)

    def deviation(mask: BoolArray) -> float:
        inside = mask[usable]
        apart = values[:, inside].mean(axis=1) - values[:, ~inside].mean(axis=1)
        number = 1.0 / (1.0 / inside.sum() + 1.0 / (~inside).sum())
        distance = number * float(apart @ precision @ apart)
        return float(chi_square(np.array(distance), len(values)))

    return deviation


def _regions_of_rare(evidence: Evidence) -> Iterator[Suspect]:
    """Yield the places of samples that chance hardly makes, while few of them are elsewhere."""
    usable, limit = evidence.maps.usable, SIGNIFICANCE / N_SETS
    for rare in rare_samples(evidence):
        for one in scan_event_map(rare.seen, rare.expected, usable, significance=limit):
            if one.only_there and _is_part(one.region.mask(usable.shape), usable, FEWEST_PIXELS):
                yield one


def _stretches_of_rare(evidence: Evidence, time: TimeSeries) -> Iterator[Stretch]:
    """Yield the frames of samples that chance hardly makes."""
    for rare in rare_samples(evidence):
        one = scan_event_frames(
            np.searchsorted(time.frames, rare.hits[:, 0]),
            time.frames,
            expected=float(rare.expected.sum()),
            significance=SIGNIFICANCE / N_SETS,
            shortest=FEWEST_FRAMES,
        )
        if one is not None and one.only_there and _among(time.frames, one.when):
            yield replace(one, when=_with_unseen(one.when, time.frames))


def _stretches(evidence: Evidence, time: TimeSeries) -> Iterator[Stretch]:
    """Yield the frames of series that stand out, but for what goes on rising from end to end of the run."""
    series = frame_series(evidence)
    for name, values in series.items():
        limit = SIGNIFICANCE / len(series)
        for one in scan_series(values, time.frames, significance=limit, shortest=FEWEST_FRAMES):
            some = _among(time.frames, one.when)
            # a scatter that is less is that of the frames beside it which is more
            some = some and (one.inside > one.outside or name.startswith("frame."))
            # levels that alternate or beat are effects in all frames, which have names
            some = some and not (one.when.every and name.startswith("frame."))
            trend = _correlated(values, np.arange(values.size))
            if some and _correlated(values, one.when.frames(time.frames)) * _TREND > trend:
                yield replace(one, z=abs(one.z), when=_with_unseen(one.when, time.frames))


def _with_unseen(when: When, seen: IntArray) -> When:
    """Return a range with half of the unseen frames at its ends."""
    if len(when.range) != 1:
        return when
    first, last = when.range[0]
    before, after = seen[seen < first], seen[seen >= last]
    first -= int(first - before[-1] - 1) // 2 if before.size else 0
    last += int(after[0] - last) // 2 if after.size else 0
    return when.model_copy(update={"range": ((first, last),)})


def _correlated(values: FloatArray, form: NDArray[Any]) -> float:
    """Return by how many standard deviations a series is correlated with another one."""
    return float(abs(np.corrcoef(form, values)[0, 1]) * np.sqrt(values.size))
