"""Places and frames in which rare samples come together: a scan of events, as :mod:`.scan` is of values.

Samples beyond all that the PCD allows are few, and maps of their numbers nothing like normal. Given how many
there are in all, each lies by chance in a place with the share of it that the laws of the pixels give, and in
a range of frames with the share of its frames. Probabilities are those of binomial laws; as in :mod:`.scan`
they count every place and range that was looked at, and only more than chance makes has a place. How many
are expected in all does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.scan import (
    FEWEST,
    SIGNIFICANCE,
    Contrast,
    Found,
    Stretch,
    Suspect,
    best_place,
    regions,
    successive,
)
from pchem_pipeline.effects.framework.region import Region, When

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MOST = 500  # frames with an event that are looked at: so many drawn of them tell a range as well
_SEED = 1


def scan_event_map(
    seen: BoolArray,
    expected: FloatArray,
    usable: BoolArray,
    *,
    significance: float = SIGNIFICANCE,
    most: int = 3,
) -> list[Suspect]:
    """Return the places with more events than their share, the most significant first.

    Args:
        seen: pixels with an event, (y, x).
        expected: number of events in each, in proportion, (y, x).
        usable: pixels that count, (y, x).
        significance: largest probability of a chance.
        most: places at most.

    Returns:
        Places; ``inside`` and ``outside`` are events beyond those expected per pixel.
    """

    def best(left: BoolArray) -> tuple[BoolArray, Suspect] | None:
        events, chance = np.where(left, seen, 0.0), np.where(left, expected, 0.0)
        if events.sum() < FEWEST:
            return None
        contrast = _Events(events, chance / chance.sum(), 1.0)
        found = best_place(contrast, regions(contrast))
        if found is None or (log_p := contrast.exact(found)) > math.log(significance):
            return None
        means = replace(found, log_p=log_p).means(events - chance, left)
        share = max(means["inside"], 0.0)
        return found.mask, Suspect(**means, region=Region.of_mask(found.mask), share=share)

    return successive(best, usable & (expected > 0.0), most)


@dataclass(frozen=True)
class _Events(Contrast):
    """Events by pixel, and in ``some`` the share of all that chance puts there."""

    def z(self, sums: NDArray[np.floating], counts: NDArray[np.floating]) -> FloatArray:
        """Return the signed root of the likelihood ratio of events beyond their share, 0 where they are less.

        Args:
            sums: events of places.
            counts: their shares.
        """
        total = float(self.values.sum())
        share = np.clip(counts, 1e-12, 1.0 - 1e-12)
        events = np.clip(sums, 0.0, total)
        information = special.rel_entr(events, total * share) + special.rel_entr(
            total - events, total * (1.0 - share)
        )
        more = (events > total * share) & (events > self.fewest - 0.5)
        return np.where(more, np.sqrt(2.0 * np.maximum(information, 0.0)), 0.0)

    def exact(self, found: Found) -> float:
        """Return the logarithm of the probability of a place by the binomial law itself."""
        places = found.log_p - float(special.log_ndtr(-abs(found.z)))
        seen, share = (float(values[found.mask].sum()) for values in (self.values, self.some))
        return min(0.0, places + log_binomial_tail(seen, float(self.values.sum()), share))


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
    as many terms as there are pairs of events.

    Args:
        positions: of the frames with an event, increasing, none twice, (m,).
        numbers: of all frames in the run, increasing, (n,).
        expected: number of events in all frames.
        significance: largest probability of a chance.
        shortest: frames that a range must have.

    Returns:
        The range; ``inside`` and ``outside`` are events beyond those expected per frame.
    """
    if positions.size > _MOST:
        expected *= _MOST / positions.size
        positions = np.sort(np.random.default_rng(_SEED).choice(positions, _MOST, replace=False))
    m, n = positions.size, numbers.size
    if m < FEWEST or n < 2 * shortest:
        return None
    first, last = np.triu_indices(m, FEWEST - 1)
    length = positions[last] - positions[first] + 1
    log_p = _log_tails(last - first, m - 1, np.maximum(length, shortest) / n)
    at = int(np.argmin(log_p))
    value = min(0.0, float(log_p[at]) + math.log(m * (m - 1) / 2))
    if value > math.log(significance):
        return None
    begin, end = _ends(int(positions[first[at]]), int(positions[last[at]]), int(last[at] - first[at]), n)
    inside = (positions >= begin) & (positions < end)
    seen = (float(inside.sum()), end - begin), (float((~inside).sum()), max(n - end + begin, 1))
    rates = [events / frames - expected / n for events, frames in seen]
    when = When(range=((int(numbers[begin]), int(numbers[end - 1]) + 1),))
    z = float(-special.ndtri_exp(float(log_p[at])))
    return Stretch(family="range", z=z, log_p=value, inside=rates[0], outside=rates[1], when=when)


def _ends(first: int, last: int, gaps: int, n: int) -> tuple[int, int]:
    """Return a range of frames about its first and last event, as wide as a constant rate asks for."""
    beyond = round((last - first) / max(gaps, 1) / 2)
    return max(first - beyond, 0), min(last + beyond + 1, n)


def _log_tails(k: IntArray, n: int, share: FloatArray) -> FloatArray:
    """Return the logarithms of the probabilities of at least k (one or more) of n events in a share, (m,)."""
    tail = special.betainc(k, n - k + 1.0, np.minimum(share, 1.0))
    return np.asarray(np.log(np.maximum(tail, 1e-300)))


def log_binomial_tail(k: float, n: float, share: float) -> float:
    """Return the logarithm of the probability of at least k (one or more) of n events in a share."""
    return float(_log_tails(np.array([round(k)]), round(n), np.array([share]))[0])
