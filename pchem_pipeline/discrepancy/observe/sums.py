"""The two channels of the samples of pixels: their moments, the codes that have them, and those beyond."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.effects.framework.evidence import MOST_HITS, PixelMaps

#: What a sample is split into: k and r.
CHANNELS = ("charge", "readout")
#: Blocks whose means are compared, and frames whose course along time is looked at, at least.
MINIMUM_BLOCKS, FEWEST_FRAMES = 4, 64
_LEAST_NOISE = 0.5  # of the variance of r^2: residuals of hardly two values tell nothing of their size


@dataclass(frozen=True)
class PixelStatistics:
    """Moments of the channels over the samples of each pixel, 0 in unusable ones, (y, x) each.

    Attributes:
        usable: pixels that count.
        mode: patterns of what is common to all pixels: H for a change of the exposure, 1 for one of the bias,
            (2, y, x).
        variance: of k (e-^2) and r (DN^2), (2, y, x).
        cross: covariance of k and r, e- DN.
        factor, shift: weights ``r (factor k + shift)`` whose sum over a frame, less ``gain_offset``, is
            ``gain_norm`` times the relative deviation of the gain: least squares of r on k / g, what is
            common to all pixels taken away.
        gain_variance: variance of that sum in one frame.
        noise: variance of r^2, in that of r squared: 2 for Gaussian residuals.
        square: weights of r^2 by which a common relative change of the noise is told best.
    """

    usable: BoolArray
    mode: FloatArray
    variance: FloatArray
    cross: FloatArray
    factor: FloatArray
    shift: FloatArray
    gain_offset: float
    gain_norm: float
    gain_variance: float
    noise: FloatArray
    square: FloatArray


def blocks_of(numbers: IntArray, block_frames: int) -> IntArray:
    """Return the positions where blocks begin, and the number of frames, (b + 1,); no block spans a gap."""
    breaks = np.concatenate([[0], np.flatnonzero(np.diff(numbers) != 1) + 1, [numbers.size]])
    starts = [np.arange(a, b, block_frames) for a, b in pairwise(breaks)]
    return np.concatenate([*starts, [numbers.size]]).astype(np.int64)


def pixel_statistics(laws: PixelLaws, maps: PixelMaps) -> PixelStatistics:
    """Collect the moments of the channels; pixels in which one of them is constant do not count."""
    moments, shape = laws.moments, maps.usable.shape
    exposure, gain = maps.quanta_exposure.ravel(), maps.conversion_gain.ravel()
    kk, rr, kr, krr, kkrr, rrrr = (moments[name] for name in ("kk", "rr", "kr", "krr", "kkrr", "rrrr"))
    usable = laws.good & (kk > 1e-12) & (rr > 1e-12)

    def masked(values: FloatArray) -> FloatArray:
        return np.where(usable, values, 0.0)

    step = masked(1.0 / np.where(usable, gain, 1.0))
    h = masked(exposure)
    weight = masked(1.0 / np.where(usable, rr, 1.0))
    factor = step * weight
    pattern = masked(h * step - (h * step * weight).sum() / max(weight.sum(), 1e-300))
    shift = pattern * weight
    spread = factor**2 * (kkrr - kr**2) + 2.0 * factor * shift * krr + shift**2 * rr
    noise = masked(np.maximum(rrrr * weight**2 - 1.0, 0.0))
    kk, rr, kr = masked(kk), masked(rr), masked(kr)
    return PixelStatistics(
        usable=usable.reshape(shape),
        mode=np.stack([h, usable]).reshape(2, *shape),
        variance=np.stack([kk, rr]).reshape(2, *shape),
        cross=kr.reshape(shape),
        factor=factor.reshape(shape),
        shift=shift.reshape(shape),
        gain_offset=float((factor * kr).sum()),
        gain_norm=float((factor * step * kk).sum() + shift @ pattern),
        gain_variance=float(masked(spread).sum()),
        noise=noise.reshape(shape),
        square=masked(weight / np.maximum(noise, _LEAST_NOISE)).reshape(shape),
    )


def code_ranges(laws: PixelLaws, usable: BoolArray) -> NDArray[np.int32]:
    """Return first code, last code and first row of the tables, (3, y, x); row 0 (zeros) where not usable."""
    first, length, start = np.where(usable.reshape(-1, 1), laws.support, [0, 1, 0]).T
    return np.stack([first, first + length - 1, start]).reshape(3, *usable.shape).astype(np.int32)


def samples_beyond(frames: NDArray[Any], laws: PixelLaws, usable: BoolArray, *, above: bool) -> IntArray:
    """Return the samples above or below the support of their pixel, by frame: position, y, x, DN."""
    seen = (laws.moments["high" if above else "low"][:, 0] > 0).reshape(usable.shape) & usable
    samples, (first, length) = frames[:, seen].T, laws.support[seen.ravel(), :2].T[:, :, None]
    pixel, frame = np.nonzero(samples > first + length - 1 if above else samples < first)
    pixel, frame = pixel[:MOST_HITS], frame[:MOST_HITS]
    y, x = np.nonzero(seen)
    hits = np.stack([frame, y[pixel], x[pixel], samples[pixel, frame]], axis=1).astype(np.int64)
    return hits[np.lexsort((hits[:, 2], hits[:, 1], hits[:, 0]))]
