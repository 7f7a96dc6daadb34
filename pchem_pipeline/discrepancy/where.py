"""Locations of a disagreement: deviating statistics with their pixels, DN and frames.

Rare samples are listed of either tail: those beyond the support of their pixel, which up to ten of a thousand
pixels have by chance, and those of which chance makes one in the whole stack: a few pixels or frames with
heavy tails have samples that lie farther out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.null import NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.laws import FAR, chi_square
from pchem_pipeline.discrepancy.observe.tables import analog_width
from pchem_pipeline.discrepancy.scan import Stretch, Suspect, scan_event_map, scan_map, scan_series
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.effects.framework.evidence import MOST_HITS, Evidence, PixelMaps, TimeSeries
from pchem_pipeline.effects.framework.region import parse_place
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere, robust_sd

#: Maps of neighbours, along x and along y: charge with charge, readout with readout, one with the other.
PAIRS = ("x.kk", "x.rr", "x.rk", "y.kk", "y.rr", "y.rk")
_FALSE_DISCOVERY_RATE = 0.05
_MOST_LISTED = 50
_MOST_PLACES = 20
_WIDEST_CODE_WINDOW = 24
#: Sets of samples that :func:`rare_samples` gives at most.
N_SETS = 4
_REACH, _FURTHER = 12.0, 15  # electron numbers about H, in its root and beside that
_CHUNK = 256  # samples


def suspected_regions(
    evidence: Evidence, significance: float = SIGNIFICANCE, names: Collection[str] | None = None
) -> dict[str, list[Suspect]]:
    """Return where on the sensor each map of the evidence stands out from the rest of the sensor.

    The places are by map (some of :func:`pixel_maps`, or all), the most significant first; maps without any
    are absent. The p-value is corrected for all places and maps. Where ``suspect.only_there`` is false the
    rest of the sensor deviates as well, and the place may only be where pixels differ in exposure or gain.
    """
    maps = {name: m for name, m in pixel_maps(evidence).items() if names is None or name in names}
    found = {
        name: scan_map(
            values,
            evidence.maps.usable,
            significance=significance / len(maps),
            single=name.startswith(("goodness", "peaks", "spread")),
            next_along={"x": 1, "y": 0}.get(name.partition(".")[0]),
        )
        for name, values in maps.items()
    }
    return {name: places for name, places in found.items() if places}


def suspected_frames(
    evidence: Evidence, significance: float = SIGNIFICANCE, names: Collection[str] | None = None
) -> dict[str, list[Stretch]]:
    """Return in which frames each series of the evidence stands out, as :func:`suspected_regions` does."""
    series = {name: s for name, s in frame_series(evidence).items() if names is None or name in names}
    if evidence.time is None or not series:
        return {}
    numbers = evidence.time.frames
    found = {
        name: scan_series(values, numbers, significance=significance / len(series))
        for name, values in series.items()
    }
    return {name: frames for name, frames in found.items() if frames}


def unfitted_place(usable: BoolArray) -> Suspect | None:
    """Return where pixels without a reliable fit, (y, x), cluster; None where chance explains it.

    An effect of single pixels in a part of the sensor may leave only that to be seen.
    """
    alike, every = np.ones(usable.shape), np.ones(usable.shape, np.bool_)
    return next(iter(scan_event_map(~usable, alike, every, most=1)), None)


def pixel_maps(evidence: Evidence) -> dict[str, FloatArray]:
    """Return the maps behind the statistics, each about N(0, 1) where nothing is wrong, (y, x).

    ``score.C2`` and so on, ``goodness``, ``peaks``; of frames also ``lag.charge``, ``lag.readout`` and
    ``lag.cross`` (the frame before), ``spread.*`` (block means scatter), ``trend.*`` (they rise along the
    run), and ``x.kk``, ``x.rr``, ``x.rk``, ``y.kk``, ... (the next pixel along x or y): noise of rows raises
    ``x.rr`` where it is, noise of columns ``y.rr``, noise of frames both.
    """
    found = {f"score.{name}": np.asarray(m, np.float64) for name, m in evidence.scores.items()}
    found["goodness"] = np.asarray(evidence.goodness, np.float64)
    found["peaks"] = np.asarray(evidence.peaks, np.float64)
    time = evidence.time
    if time is None:
        return found
    root = np.sqrt(time.n_pairs)
    found |= {
        "lag.charge": time.lag_charge[0] * root,
        "lag.readout": time.lag_readout[0] * root,
        "lag.cross": time.lag_readout_charge * root,
    }
    for channel, blocks, std in (
        ("charge", time.block_charge, evidence.charge_std),
        ("readout", time.block_readout, evidence.readout_std),
    ):
        found[f"spread.{channel}"], found[f"trend.{channel}"] = _block_maps(time, blocks, std)
    found |= {name: np.asarray(m, np.float64) for name, m in time.neighbour_maps.items()}
    return found


def _block_maps(
    time: TimeSeries, blocks: NDArray[np.floating], std: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how much the block means of each pixel scatter, and how they rise along the run."""
    length = np.diff(np.append(np.searchsorted(time.frames, time.block_start), time.frames.size))
    weight = length.astype(np.float64)[:, None, None]
    dof = max(length.size - 1, 1)
    middle = time.block_start.astype(np.float64)
    lever = (middle - np.average(middle, weights=length))[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        centred = blocks - (weight * blocks).sum(axis=0) / weight.sum()
        chi2 = (weight * centred**2).sum(axis=0) / std**2
        trend = (weight * lever * centred).sum(axis=0) / (std * np.sqrt((weight * lever**2).sum()))
    return np.asarray(chi_square(chi2, dof)), np.asarray(trend)


def frame_series(evidence: Evidence) -> dict[str, FloatArray]:
    """Return the series behind the statistics, each about N(0, 1) where nothing is wrong, (n,).

    ``frame.charge`` and ``frame.readout`` (means of the frames), ``frame.noise`` (of the squares of their
    residuals), ``scatter.charge`` and ``scatter.readout`` (how far each mean is off, to either side),
    ``row.readout`` and so on: how much the means of the rows (columns) of a frame scatter.
    """
    time, usable = evidence.time, evidence.maps.usable
    if time is None:
        return {}
    charge, readout = (np.where(usable, std, 0.0) ** 2 for std in (evidence.charge_std, evidence.readout_std))
    exposure = float(np.where(usable, evidence.maps.quanta_exposure, 0.0).sum())
    found = {
        "frame.charge": time.frame_charge * exposure / np.sqrt(charge.sum()),
        "frame.readout": time.frame_readout * usable.sum() / np.sqrt(readout.sum()),
    }
    if time.frame_noise is not None:
        found["frame.noise"] = time.frame_noise
    for channel in ("charge", "readout"):
        found[f"scatter.{channel}"] = chi_square(found[f"frame.{channel}"] ** 2, 1.0)
    for line, axis in (("row", 1), ("column", 0)):
        for channel, variance in (("charge", charge), ("readout", readout)):
            total, number = variance.sum(axis=axis), usable.sum(axis=axis)
            some = total > 0
            if some.sum() > 2:
                # not each over its own error: an electron in a dark line would be many of these
                sums, share = (
                    getattr(time, f"{line}_{channel}")[:, some] * number[some],
                    total[some] / total.sum(),
                )
                apart = sums - np.outer(sums.sum(axis=1), share)
                covariance = total.sum() * (np.diag(share) - np.outer(share, share))
                law = np.trace(covariance), 2.0 * np.sum(covariance**2)
                found[f"{line}.{channel}"] = np.asarray(chi_square((apart**2).sum(axis=1), *law))
    return found


def map_of(statistic: str) -> str:
    """Return the map (of :func:`pixel_maps`) in which a statistic shows its place, or an empty name."""
    known = STATISTICS.get(statistic.partition("@")[0])
    return "" if known is None else known.map


def locate(evidence: Evidence, null: NullModel, z: FloatArray, significance: float) -> list[Place]:
    """Return the disagreements that are significant among all statistics, the largest first.

    The evidence is that of the train split, ``z`` the mean of the statistics of train and test, (m,).
    """
    pulls, p_values = null.pulls(z, splits=2), null.p_values(z, splits=2)
    chance = {
        int(index): look_elsewhere(float(p_values[index]), null.effective_tests)
        for index in np.argsort(-np.abs(pulls))[:_MOST_PLACES]
    }
    found = {index: p for index, p in chance.items() if p <= significance}
    names = [null.names[index] for index in found]
    # histograms alone are in no order
    wanted = {map_of(name) for name in names} if evidence.time is not None else ()
    regions = suspected_regions(evidence, significance, wanted)
    frames = suspected_frames(evidence, significance, {STATISTICS[name].series for name in names})
    maps, places = pixel_maps(evidence), []
    for index, p in found.items():
        name = null.names[index]
        spots: dict[str, Any] = {}
        for suspect in regions.get(map_of(name), ())[:1]:
            spots |= {"region": suspect.region.numbers(), "region_p": suspect.p}
            spots["region_share"] = suspect.share
        for stretch in frames.get(STATISTICS[name].series, ())[:1]:
            spots |= {"when": stretch.when.numbers(), "when_p": stretch.p}
        if "@" in name:  # of a part of the sensor: that is the place, not what stands out of it
            part = zip(("region", "when"), parse_place(name.partition("@")[2]), strict=True)
            spots |= {key: place.numbers() for key, place in part if place is not None}
        places.append(
            Place.of(
                name,
                z=float(pulls[index]),
                p=p,
                pixels=_pixels(name, evidence, maps),
                dn=_codes(name, evidence),
                frames=_frames(name, evidence),
                **spots,
            )
        )
    return places


def _pixels(name: str, evidence: Evidence, maps: Mapping[str, FloatArray]) -> tuple[tuple[int, int], ...]:
    """Return the pixels that stand out in the map behind a statistic of few pixels (Benjamini-Hochberg)."""
    parts = name.split(".")
    if parts[-1] not in ("cnt", "chi", "pixels", "count"):
        return ()
    if parts[0] == "tail":
        seen = evidence.tail_low if parts[1] == "low" else evidence.tail_high
        values = np.where(seen > 0, FAR, 0.0)
    else:
        values = maps[map_of(name)]
    deviations = np.abs(np.where(evidence.maps.usable, values, 0.0)).ravel()
    p = 2.0 * special.ndtr(-deviations)
    order = np.argsort(p, kind="stable")
    allowed = _FALSE_DISCOVERY_RATE * np.arange(1, p.size + 1) / max(int(evidence.maps.usable.sum()), 1)
    passed = np.flatnonzero(p[order] <= allowed)
    count = min(int(passed[-1]) + 1, _MOST_LISTED) if passed.size else 0
    return tuple(divmod(int(i), values.shape[1]) for i in order[:count])


def _codes(name: str, evidence: Evidence) -> tuple[int, int] | None:
    """Return the window of DN that stands out most, of any width, or the code if it is a single one."""
    if not name.startswith("code."):
        return None
    code = evidence.code
    ends = {"code.top": (code.maximum, code.maximum), "code.bottom": (code.minimum, code.minimum)}
    if name in ends:
        return ends[name]
    expected = np.maximum(code.expected, 1.0)
    deviation = (code.observed - code.expected) / np.sqrt(expected)
    total = np.concatenate([[0.0], np.cumsum(deviation)])
    best, window = 0.0, (0, 1)
    for width in range(1, 2 if name == "code.largest" else min(_WIDEST_CODE_WINDOW, deviation.size) + 1):
        sums = np.abs(total[width:] - total[:-width]) / np.sqrt(width)
        start = int(np.argmax(sums))
        if sums[start] > best:
            best, window = float(sums[start]), (start, start + width)
    return (code.first + window[0], code.first + window[1] - 1)


def _frames(name: str, evidence: Evidence) -> tuple[int, ...]:
    """Return the frames that carry a statistic."""
    time, found = evidence.time, np.zeros(0, np.int64)
    if time is None:
        return ()
    if name == "frame.repeated":
        found = time.repeated
    elif name.startswith("tail.high"):
        found = np.unique(time.hits[:, 0])
    elif name.startswith("frame.") and name.endswith(".largest"):
        series = time.frame_charge if ".charge." in name else time.frame_readout
        away = np.abs(series - np.median(series))
        order = np.argsort(-away)
        outlying = order[away[order] > 5.0 * robust_sd(series)]
        found = np.sort(time.frames[(outlying if outlying.size else order[:1])[:_MOST_LISTED]])
    return tuple(found[:_MOST_LISTED].tolist())


# -- samples that chance hardly makes ---------------------------------------------------------------


@dataclass(frozen=True)
class RareSamples:
    """Samples (frame, y, x, DN), (n, 4), as rare in all pixels, no two of them in one frame or in one pixel.

    ``expected``: how many of them chance makes in each pixel, but for a factor, (y, x).
    """

    hits: IntArray
    expected: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Which pixels have one, (y, x)."""
        found = np.zeros(self.expected.shape, np.bool_)
        found[self.hits[:, 1], self.hits[:, 2]] = True
        return found


def rare_samples(evidence: Evidence) -> Iterator[RareSamples]:
    """Yield the samples beyond the support of their pixels, and the rarer ones, of the low and the high tail.

    None of a tail of which not all samples are listed: those that are lie where they were looked for first.
    """
    time = evidence.time
    if time is None or evidence.tail_expected is None:
        return
    # by chance there is one in the whole stack
    limit = 1.0 / max(int(evidence.maps.usable.sum()), 1)
    for hits, beyond, above in zip(
        (time.low_hits, time.hits), evidence.tail_expected, (False, True), strict=True
    ):
        if len(hits) >= MOST_HITS:
            continue
        expected = np.nan_to_num(np.asarray(beyond, np.float64))
        yield RareSamples(single_samples(hits), expected)
        rarer = hits[expected_beyond(hits, evidence.maps, evidence.n_frames, above=above) < limit]
        # codes are whole: a pixel reaches some part of the limit, or none of them
        yield RareSamples(single_samples(rarer), np.minimum(expected, limit))


def single_samples(hits: IntArray) -> IntArray:
    """Return samples (frame, y, x, DN) of which no two are in one frame or in one pixel, in their order.

    One disturbed frame or row, or one odd pixel, holds many, and is no place. Which of them stays is drawn,
    so that none is favoured by its order.
    """
    frames, pixels = set[int](), set[tuple[int, int]]()
    kept = []
    for i in np.random.default_rng(1).permutation(len(hits)):
        frame, y, x = (int(number) for number in hits[i, :3])
        if frame not in frames and (y, x) not in pixels:
            frames.add(frame)
            pixels.add((y, x))
            kept.append(int(i))
    return hits[np.sort(np.array(kept, np.int64))]


def expected_beyond(hits: IntArray, maps: PixelMaps, n_frames: int, *, above: bool) -> FloatArray:
    """Return how many samples at least as far out as each hit the PCD of its pixel makes in all frames, (n,).

    Hits are frame, y, x, DN, (n, 4), above the pixel's range of codes or below it.
    """
    found = np.empty(len(hits))
    for begin in range(0, len(hits), _CHUNK):
        part = hits[begin : begin + _CHUNK]
        exposure, gain, bias, sigma = (m[part[:, 1], part[:, 2]][:, None] for m in maps.maps)
        width = analog_width(sigma)
        reach = np.ceil(_REACH * np.sqrt(exposure)) + _FURTHER
        electrons = np.maximum(np.floor(exposure) - reach, 0.0) + np.arange(2 * int(reach.max()) + 1)
        probability = special.xlogy(electrons, exposure) - exposure - special.gammaln(electrons + 1.0)
        far = part[:, 3:] + (-0.5 if above else 0.5) - bias - electrons / gain
        log_tail = special.log_ndtr((-far if above else far) / width)
        found[begin : begin + _CHUNK] = n_frames * np.exp(special.logsumexp(probability + log_tail, axis=1))
    return found
