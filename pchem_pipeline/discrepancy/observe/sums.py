"""The two channels of the samples of pixels: their moments, the codes that have them, and frames of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.discrepancy.observe.observe_numba import look_up
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, PixelLaws, pixel_laws
from pchem_pipeline.effects.framework.evidence import MOST_HITS, PixelMaps

#: What a sample is split into: k and r.
CHANNELS = ("charge", "readout")
#: Blocks whose means are compared, and frames whose course along time is looked at, at least.
MINIMUM_BLOCKS, FEWEST_FRAMES = 4, 64
_LEAST_NOISE = 0.5  # of the variance of r^2: residuals of hardly two values tell nothing of their size


@dataclass(frozen=True)
class PixelStatistics:
    """Moments of the channels over the samples of each pixel, 0 in unusable ones, (y, x) each.

    The sum of ``r (factor k + shift)`` over a frame, less ``gain_offset``, is ``gain_norm`` times the
    relative deviation of the gain: least squares of r on k / g, what is common to all pixels taken away.
    """

    usable: BoolArray  # pixels that count
    mode: FloatArray  # common to all: H for a change of exposure, 1 for one of the bias, (2, y, x)
    variance: FloatArray  # of k (e-^2) and r (DN^2), (2, y, x)
    cross: FloatArray  # covariance of k and r, e- DN
    factor: FloatArray
    shift: FloatArray
    gain_offset: float
    gain_norm: float
    gain_variance: float  # variance of that sum in one frame
    noise: FloatArray  # variance of r^2, in that of r squared: 2 for Gaussian residuals
    square: FloatArray  # weights of r^2 that measure a common relative change of the noise best

    @cached_property
    def weights(self) -> FloatArray:
        """Weights ``(m / v) / sum(m^2 / v)`` of modes m: least squares of what a frame shares, (2, y, x)."""
        scaled = np.where(self.usable, self.mode / np.where(self.usable, self.variance, 1.0), 0.0)
        norm = (scaled * self.mode).sum(axis=(1, 2), keepdims=True)
        return np.asarray(scaled / np.maximum(norm, np.finfo(np.float64).tiny))


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


def samples_beyond(
    frames: NDArray[Any], numbers: IntArray, laws: PixelLaws, usable: BoolArray, *, above: bool
) -> IntArray:
    """Return the samples above or below the support of their pixel: number of the frame, y, x, DN."""
    seen = (laws.moments["high" if above else "low"][:, 0] > 0).reshape(usable.shape) & usable
    samples, (first, length) = frames[:, seen].T, laws.support[seen.ravel(), :2].T[:, :, None]
    pixel, frame = np.nonzero(samples > first + length - 1 if above else samples < first)
    pixel, frame = pixel[:MOST_HITS], frame[:MOST_HITS]
    y, x = np.nonzero(seen)
    hits = np.stack([numbers[frame], y[pixel], x[pixel], samples[pixel, frame]], axis=1).astype(np.int64)
    return hits[np.lexsort((hits[:, 2], hits[:, 1], hits[:, 0]))]


# -- frames as deviations of their pixels ------------------------------------------------------------


@dataclass(frozen=True)
class FrameBlocks:
    """Frames of some rows; ``blocks`` yields about so many successive ones at a time, (frame, y, x), DN."""

    n_frames: int
    blocks: Callable[[int], Iterable[CodeArray]]

    @classmethod
    def of(cls, frames: CodeArray, chosen: IntArray | None = None, together: int = 1) -> FrameBlocks:
        """Take frames in memory, codes (n, y, x): those at chosen positions (None: all).

        Groups of ``together`` successive ones are never split between blocks.
        """
        n_frames = frames.shape[0] if chosen is None else chosen.size

        def blocks(size: int) -> Iterator[CodeArray]:
            size = together * max(size // together, 1)
            for some in (slice(begin, begin + size) for begin in range(0, n_frames, size)):
                yield frames[some if chosen is None else chosen[some]]

        return cls(n_frames, blocks)


def laws_of_frames(frames: CodeArray, maps: PixelMaps) -> PixelLaws:
    """Compare the histograms of frames (n, y, x) with the fit of their pixels."""
    return pixel_laws(PixelHistograms.of(frames), maps.columns, maps.usable.ravel())


@dataclass(frozen=True)
class Samples:
    """Frames as standardised deviations of their pixels, of both channels."""

    frames: FrameBlocks  # codes (n, y, x), DN
    first: NDArray[np.int32]  # smallest code of each pixel's table, (y, x)
    last: NDArray[np.int32]  # largest code of each pixel's table, (y, x)
    start: NDArray[np.int32]  # row of the first one in ``tables``, (y, x)
    tables: Float32Array  # k and r of each code over their standard deviation, (rows, 2)
    usable: BoolArray  # pixels that count, (y, x)
    most: int = 1 << 20  # samples that are looked at at a time, whole frames

    @classmethod
    def of(cls, frames: CodeArray, maps: PixelMaps) -> Samples:
        """Prepare frames by the fit of their pixels."""
        return cls.by_laws(FrameBlocks.of(frames), laws_of_frames(frames, maps), maps)

    @classmethod
    def by_laws(
        cls, frames: FrameBlocks, laws: PixelLaws, maps: PixelMaps, *, standardised: bool = True
    ) -> Samples:
        """Prepare frames by the laws of their pixels, made of all samples of the frames or of more.

        If not ``standardised``, k (e-) and r (DN) stay as they are.
        """
        pixels = pixel_statistics(laws, maps)
        usable, tables = pixels.usable, laws.tables
        if standardised:
            length = np.where(laws.good, laws.support[:, 1], 0)
            deviation = np.sqrt(np.where(usable, pixels.variance, 1.0)).reshape(2, -1).astype(np.float32)
            tables = tables[: 1 + length.sum()].copy()
            tables[1:] /= np.repeat(deviation.T, length, axis=0)
            # a track of a particle is no common mode
            np.clip(tables, -FAR, FAR, out=tables)
        # of pixels that do not count the row 0, of zeros
        first, length, start = np.where(usable.reshape(-1, 1), laws.support, [0, 1, 0]).T
        ranges = np.stack([first, first + length - 1, start]).reshape(3, *usable.shape).astype(np.int32)
        return cls(frames, ranges[0], ranges[1], ranges[2], tables, usable)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.frames.n_frames

    def without(self, pixels: BoolArray) -> Samples:
        """Return the samples without some pixels, (y, x)."""
        return replace(self, usable=self.usable & ~pixels)

    def chunks(
        self, channels: tuple[int, ...] = (0, 1), rows: slice = slice(None), columns: slice = slice(None)
    ) -> Iterator[Float32Array]:
        """Yield some frames at a time as deviations (channel, frame, y, x), 0 where not usable."""
        box = rows, columns
        first, last, start, weight = (
            np.ascontiguousarray(each[box])
            for each in (self.first, self.last, self.start, self.usable.astype(np.float32))
        )
        for block in self.frames.blocks(max(1, self.most // self.usable.size)):
            codes = np.ascontiguousarray(block[:, rows, columns])
            values = np.empty((2, *codes.shape), np.float32)
            look_up(codes, first, last, start, self.tables, weight, values)
            yield values[channels[0] : channels[-1] + 1]

    def energies(self, channel: int, mode: str, pixels: BoolArray) -> FloatArray:
        """Return the sum of the products of pairs of some pixels that share a mode, in each frame, (n,)."""
        rows, columns = (np.flatnonzero((self.usable & pixels).any(axis=axis)) for axis in (1, 0))
        if rows.size == 0:
            return np.zeros(self.n_frames)
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        inside = pixels[box].astype(np.float32)
        found = [energies(u * inside, mode) for (u,) in self.chunks((channel,), *box)]
        return np.concatenate(found)


def energies(u: Float32Array, mode: str) -> FloatArray:
    """Return the sum of the products of all pairs that share a mode, of frames (t, y, x)."""
    own = np.einsum("tyx,tyx->t", u, u, dtype=np.float64)
    rows, columns = (u.sum(axis=axis, dtype=np.float64) for axis in (2, 1))
    of_rows, of_columns = ((sums**2).sum(axis=1) for sums in (rows, columns))
    if mode == "frame":
        return np.asarray(rows.sum(axis=1) ** 2 - of_rows - of_columns + own) / 2.0
    return np.asarray((of_rows if mode == "row" else of_columns) - own) / 2.0
