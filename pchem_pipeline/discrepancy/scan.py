"""Scan statistics: the place on a map, or the stretch of a series, whose values stand out most.

Each value is about N(0, 1) and independent of the others where nothing is wrong. Of every place of some
family (:mod:`.families`: bands of rows or columns, rectangles, discs, lines at a period, single pixels) the
mean inside is compared with the mean outside, so that a uniform deviation has no place. A series is a map of
one row: its bands are ranges of frames, its pixels single frames. The p-value is corrected for all places of
all families (the union bound).

Samples beyond the support of the PCD are rare events. Given their total number, each lies by chance in a
place with the probability that the laws of the pixels give, and in a range of frames with the share of its
frames. So their number in a place is binomial; only an excess counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy import families
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE

_FRAME_PERIODS = range(2, 33)
_SWEEPS = 3  # of the ends of a range over the frames
_RIDGE = 1e-3  # of a covariance of series that may all but coincide
_LITTLE = 0.25  # of the mean inside a place, that outside
_MOST_SINGLE = 1000  # frames that are listed
_MOST_EVENTS = 500  # frames with an event that are looked at: so many drawn of them tell a range as well


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A part of a map or of a series that stands out."""

    family: str  # rows, columns, rectangle, disc, period or pixels; of frames range, period or frames
    z: float  # deviation of its mean from that of the rest, standard errors
    log_p: float  # logarithm of the probability of such a deviation by chance in any place
    inside: float  # mean there
    outside: float  # mean elsewhere
    share: float = 0.0  # of its pixels that deviate, at least (at 95 %, for all places at once)

    @property
    def p(self) -> float:
        """Probability of such a deviation by chance, at least 1e-300."""
        return math.exp(max(self.log_p, math.log(SMALLEST_MASS)))

    @property
    def log_places(self) -> float:
        """Logarithm of the number of places that were looked at."""
        return max(self.log_p - float(special.log_ndtr(-abs(self.z))), 0.0)

    @property
    def only_there(self) -> bool:
        """Whether little of it is elsewhere."""
        return abs(self.outside) < _LITTLE * abs(self.inside)


@dataclass(frozen=True, kw_only=True)
class Suspect(Cluster):
    """A place on the sensor where a map stands out."""

    region: Region


@dataclass(frozen=True, kw_only=True)
class Stretch(Cluster):
    """Frames in which a series stands out."""

    when: When


def scan_map(
    values: FloatArray,
    usable: BoolArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 3,
    single: bool = True,
    next_along: int | None = None,
) -> list[Suspect]:
    """Return the places that stand out of a map, the most significant first, each without those before it.

    Values are N(0, 1) where nothing is wrong, (y, x). ``single`` pixels are looked for, too, but not where
    far tails are heavier than normal. If values are of pixels and those ``next_along`` an axis, places reach
    one further.
    """
    some = usable & np.isfinite(values)

    def best(left: BoolArray) -> families.Place | None:
        contrast = families.contrast_of_map(values, left)
        found = families.best_place([*_regions(contrast), families.single(values, left) if single else None])
        return _significant(found, values, left, significance, either_side=True)

    return [
        Suspect(
            **place.means(values, left),
            region=Region.of_mask(_reaching(place.mask, next_along)),
            share=affected_share(math.copysign(1.0, place.z) * values[some], (place.mask & left)[some]),
        )
        for place, left in families.successive(best, some, most)
    ]


def scan_series(
    values: FloatArray,
    numbers: IntArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 2,
    shortest: int = families.FEWEST,
) -> list[Stretch]:
    """Return the frames that stand out of a series, the most significant first, ``most`` stretches.

    Values are N(0, 1) and independent where nothing is wrong, (n,), of frames with increasing numbers. A
    range or a phase of a period has ``shortest`` frames at least.
    """
    row = values[None]

    def best(left: BoolArray) -> families.Place | None:
        contrast = families.contrast_of_map(row, left, shortest, numbers)
        found = [
            families.box_of_map(contrast, "columns", shortest),
            # a multiple of a period is no better than it
            families.every_nth(contrast, 1, _FRAME_PERIODS, cycles=4, better=1.02),
            families.single(row, left),
        ]
        return _significant(families.best_place(found, better=0.0), row, left, significance)

    found = []
    for place, left in families.successive(best, np.isfinite(row), most):
        family, when = _frames(place, numbers)
        found.append(Stretch(**place.means(row, left) | {"family": family}, when=when))
    return found


def _frames(place: families.Place, numbers: IntArray) -> tuple[str, When]:
    """Return the frames of a place in a series, and what they are."""
    at = numbers[place.mask[0]]
    if place.family == "columns":
        return "range", When(range=((int(at[0]), int(at[-1]) + 1),))
    if place.family == "period":
        period = int(np.gcd.reduce(np.diff(at)))
        return "period", When(every=period, phase=int(at[0]) % period)
    return "frames", When(single=tuple(int(number) for number in at[:_MOST_SINGLE]))


def _regions(contrast: families.Contrast) -> list[families.Place | None]:
    """Return the best place of a map of every family but single pixels, the simpler ones first."""
    return [
        families.box_of_map(contrast, "rows"),
        families.box_of_map(contrast, "columns"),
        families.every_nth(contrast, 0),
        families.every_nth(contrast, 1),
        families.box_of_map(contrast, "rectangle"),
        families.disc(contrast),
    ]


def _reaching(mask: BoolArray, axis: int | None) -> BoolArray:
    """Return a mask of pixels whose pairs with the next pixel along an axis are in the place."""
    if axis is None:
        return mask
    grown = mask.copy()
    after, before = (np.s_[1:], np.s_[:-1]) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
    grown[after] |= mask[before]
    return grown


def _significant(
    place: families.Place | None,
    values: FloatArray,
    some: BoolArray,
    significance: float,
    *,
    either_side: bool = False,
) -> families.Place | None:
    """Return a place with its deviation over the scatter inside and outside (Welch's t), if significant.

    ``either_side``: the place, or all outside of it where that is what deviates from 0.
    """
    if place is None:
        return None
    inside, outside = values[some & place.mask], values[some & ~place.mask]
    if either_side and abs(inside.mean()) < abs(outside.mean()):
        place = replace(place, mask=~place.mask, z=-place.z)
        inside, outside = outside, inside
    if place.family != "pixels":
        variance = max(inside.var(), 1.0) / inside.size + max(outside.var(), 1.0) / outside.size
        z = float((inside.mean() - outside.mean()) / np.sqrt(variance))
        if abs(z) < abs(place.z):
            place = replace(place, z=z)
    return place if place.log_p <= math.log(significance) else None


def affected_share(z: FloatArray, inside: BoolArray) -> float:
    """Return a lower bound of the share of the values inside a place that are larger than by chance.

    All-resolutions inference (Rosenblatt et al. 2018; Goeman and Solari 2011): closed testing with Simes'
    test bounds the number of true deviations of all sets at once, so that the place may have been chosen
    after looking: ``max_u (1 - u + #{i inside: m p_i <= u a})`` with all m values (Hommel's smaller
    number would do, and give a little more). Any of these bounds is too large with the probability a = SURE.
    The deviations z of all values, (m,), are one-sided, N(0, 1) by chance.
    """
    n = int(inside.sum())
    if n == 0:
        return 0.0
    p = np.sort(special.ndtr(-z[inside]))
    # the smallest u for which the i-th value counts
    u = np.maximum(np.ceil(z.size * p / families.SURE), 1.0)
    bound = 1.0 - u + np.arange(1, n + 1)
    return float(max(bound.max(), 0.0) / n)


def sharpest_range(series: FloatArray, first: int, last: int, shortest: int) -> tuple[int, int]:
    """Return the range of frames, its end excluded, with which all series together are most probable.

    Inside and outside, all series, (s, n), are normal with different means and covariances (a change point of
    either, Hinkley 1970); of each only the inverse hyperbolic sine counts, so that single frames far off
    decide nothing. The given ends (the last one excluded) stay where a range does not raise the likelihood by
    as many nats as it has parameters (Akaike 1974) and as choosing one of all ranges gains. At least
    ``shortest`` frames are inside and outside.
    """
    x = np.arcsinh(series - np.median(series, axis=1, keepdims=True)).T
    total, square = (
        np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        for values in (x, x[:, :, None] * x[:, None, :])
    )
    n = len(x)

    def nats(a: IntArray, b: IntArray) -> FloatArray:
        inside, whole = (total[b] - total[a], square[b] - square[a]), (total[-1], square[-1])
        outside = whole[0] - inside[0], whole[1] - inside[1]
        likelihood = _log_likelihood(b - a, *inside) + _log_likelihood(n - b + a, *outside)
        return np.where(np.minimum(b - a, n - b + a) >= shortest, likelihood, -np.inf)

    every, given = np.arange(n + 1), (first, last)
    for _ in range(_SWEEPS):
        first = int(np.argmax(nats(every[:last], np.full(last, last))))
        last = first + 1 + int(np.argmax(nats(np.full(n - first, first), every[first + 1 :])))
    with_range = nats(np.array([first]), np.array([last]))
    gain = float((with_range - _log_likelihood(np.array([n]), total[-1:], square[-1:]))[0])
    price = len(series) * (len(series) + 3) / 2 + math.log(n**2 / 2)
    return (first, last) if gain > price else given


def _log_likelihood(count: IntArray, sums: FloatArray, squares: FloatArray) -> FloatArray:
    """Return the largest log likelihood of normal vectors, given their number, sums and sums of squares."""
    m = np.maximum(count, 1)[:, None]
    mean = sums / m
    covariance = squares / m[:, :, None] - mean[:, :, None] * mean[:, None, :]
    ridge = _RIDGE * np.eye(sums.shape[-1])
    return np.asarray(-0.5 * m[:, 0] * np.linalg.slogdet(covariance + ridge)[1])


def scan_event_map(
    seen: BoolArray,
    expected: FloatArray,
    usable: BoolArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 3,
) -> list[Suspect]:
    """Return the places with more events than their share, the most significant first.

    Given are the pixels with an event, (y, x), and the number expected in each, but for a factor. ``inside``
    and ``outside`` of a place are events beyond those expected per pixel.
    """

    def best(left: BoolArray) -> families.Place | None:
        events, chance = np.where(left, seen, 0.0), np.where(left, expected, 0.0)
        total, share = float(events.sum()), chance / chance.sum()
        place = families.best_place(
            _regions(families.Contrast.of_pixels(events, share, families.events(total)))
        )
        if place is None:
            return None
        tail = float(families.log_binomial_tails(events[place.mask].sum(), total, share[place.mask].sum()))
        exact = replace(place, log_places=place.log_places + tail - float(special.log_ndtr(-place.z)))
        return exact if exact.log_p <= math.log(significance) else None

    found = []
    for place, left in families.successive(best, usable & (expected > 0.0), most):
        means = place.means(seen - expected, left)
        region = Region.of_mask(place.mask)
        found.append(Suspect(**means, region=region, share=max(means["inside"], 0.0)))
    return found


def scan_event_frames(
    positions: IntArray,
    numbers: IntArray,
    *,
    expected: float = 0.0,
    significance: float = SIGNIFICANCE,
    shortest: int = 1,
) -> Stretch | None:
    """Return the range of frames in which events come together most; None where chance explains it.

    Of n events in random order, those that follow the i-th by k in a share w of the frames are at least k of
    the others with the probability of a binomial law, which is uniform whatever i and k: the union bound has
    as many terms as there are pairs of events. ``inside`` and ``outside`` are events beyond those expected
    per frame.

    ``positions`` are those of the frames with an event, increasing, none twice, (m,); ``numbers`` are of all
    frames in the run, (n,), in which ``expected`` events are by chance. A range has ``shortest`` frames or
    more.
    """
    if positions.size > _MOST_EVENTS:
        expected *= _MOST_EVENTS / positions.size
        positions = np.sort(np.random.default_rng(1).choice(positions, _MOST_EVENTS, replace=False))
    m, n = positions.size, numbers.size
    if m < families.FEWEST or n < 2 * shortest:
        return None
    first, last = np.triu_indices(m, families.FEWEST - 1)
    length = positions[last] - positions[first] + 1
    log_p = families.log_binomial_tails(last - first, m - 1, np.maximum(length, shortest) / n)
    at = int(np.argmin(log_p))
    value = min(0.0, float(log_p[at]) + math.log(m * (m - 1) / 2))
    if value > math.log(significance):
        return None
    # as wide as a constant rate asks for
    begin, end = int(positions[first[at]]), int(positions[last[at]])
    beyond = round((end - begin) / max(int(last[at] - first[at]), 1) / 2)
    begin, end = max(begin - beyond, 0), min(end + beyond + 1, n)
    inside = (positions >= begin) & (positions < end)
    seen = (float(inside.sum()), end - begin), (float((~inside).sum()), max(n - end + begin, 1))
    rates = [events / frames - expected / n for events, frames in seen]
    when = When(range=((int(numbers[begin]), int(numbers[end - 1]) + 1),))
    z = float(-special.ndtri_exp(float(log_p[at])))
    return Stretch(family="range", z=z, log_p=value, inside=rates[0], outside=rates[1], when=when)
