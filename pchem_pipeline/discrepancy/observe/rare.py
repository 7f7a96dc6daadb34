"""Samples that chance hardly makes, of either tail: those beyond the support of their pixel, and rarer ones.

Of a thousand pixels up to ten have one beyond their support by chance. Those hide a dozen of a few pixels or
frames with heavy tails, which lie farther out: so the samples are also looked at by themselves of which
chance makes one in the whole stack.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.tables import analog_width
from pchem_pipeline.effects.framework.evidence import MOST_HITS, Evidence, PixelMaps

#: Sets of samples that :func:`rare_samples` gives at most.
N_SETS = 4
_BY_CHANCE = 1.0  # of the rarer samples, in the whole stack
_REACH, _FURTHER = 12.0, 15  # electron numbers about H, in its root and beside that
_CHUNK = 256  # samples
SEED = 1


@dataclass(frozen=True)
class RareSamples:
    """Samples that are as rare in all pixels, no two of them in one frame or in one pixel.

    Attributes:
        hits: frame, y, x, DN, (n, 4), by frame.
        expected: how many of them chance makes in each pixel, but for a factor, (y, x).
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
    limit = _BY_CHANCE / max(int(evidence.maps.usable.sum()), 1)
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
    for i in np.random.default_rng(SEED).permutation(len(hits)):
        frame, y, x = (int(number) for number in hits[i, :3])
        if frame not in frames and (y, x) not in pixels:
            frames.add(frame)
            pixels.add((y, x))
            kept.append(int(i))
    return hits[np.sort(np.array(kept, np.int64))]


def expected_beyond(hits: IntArray, maps: PixelMaps, n_frames: int, *, above: bool) -> FloatArray:
    """Return how many samples as far out, or farther, the PCD of each pixel makes in all frames, (n,).

    Args:
        hits: frame, y, x, DN, (n, 4).
        maps: fitted parameters.
        n_frames: samples of a pixel.
        above: of the high tail; False: of the low one.
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
