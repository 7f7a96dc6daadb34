"""One pass over the frames of a split: everything along time and between pixels, as sums.

Tables of k and r (centred on each pixel's own samples) turn codes into the two channels. Given the
histograms, frames without any effect are in random order; means and variances of all sums follow from that
alone, so a poor fit of a pixel's histogram does not imitate an effect in time or space. Centred series of n
frames have ``E[u_t u_s] = -1 / (n - 1)`` of their variance at different times, exactly. Every mean takes that
into account, and what the removal of a common mode does to the pixels that share it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe import sums
from pchem_pipeline.discrepancy.observe.laws import SLOWEST, best, chi_square
from pchem_pipeline.discrepancy.observe.observe_numba import add_frames, sum_rows
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.effects.framework.evidence import PixelMaps

_Slices = tuple[slice, slice]

_LAGS = 3
#: Products of pairs of samples, by the statistics made of them: the frames from the second sample to the
#: first, the rows and columns from the first to the second, and the channels of both; several are summed.
PRODUCTS: dict[str, tuple[tuple[int, int, int], tuple[tuple[int, int], ...]]] = {
    **{
        f"time.lag{lag}.{name}": ((lag, 0, 0), ((channel, channel),))
        for channel, name in enumerate(sums.CHANNELS)
        for lag in range(1, _LAGS + 1)
    },
    "time.cross.readout_charge": ((1, 0, 0), ((1, 0),)),
    "time.cross.charge_readout": ((1, 0, 0), ((0, 1),)),
    **{
        f"space.{axis}.{kind}": (distance, channels)
        for axis, distance in (("x", (0, 0, 1)), ("y", (0, 1, 0)))
        for kind, channels in (("kk", ((0, 0),)), ("rr", ((1, 1),)), ("rk", ((1, 0), (0, 1))))
    },
}
#: Sums of each line: of k, of r, and weighted ones of r^2, less their mean.
OF_LINES = (*sums.CHANNELS, "noise")
_CHUNK_SAMPLES = 1 << 16


@dataclass(frozen=True)
class Correlation:
    """The correlation of samples at a distance, without what chance makes of it."""

    of_pixels: FloatArray  # without the frames' common modes; NaN where one of the two is not usable, (y, x)
    mean: float  # over all pixels; NaN where there is none
    count: int  # pairs of samples of a pixel

    @property
    def deviations(self) -> FloatArray:
        """That of each pixel, N(0, 1) by chance, (y, x)."""
        return np.asarray(self.of_pixels * np.sqrt(self.count))


@dataclass(frozen=True)
class FrameView:
    """Sums over a split of n frames in b blocks, and what they are by chance."""

    pixels: sums.PixelStatistics  # moments of the pixels
    numbers: IntArray  # frame numbers, (n,)
    edges: IntArray  # positions of the blocks, (b + 1,)
    block_frames: int  # frames in a full block
    halves: FloatArray  # k and r of the left and the right half of each row, (2, 2, n, y)
    noise: FloatArray  # weighted sums of r^2 of each row, less their mean, (n, y)
    columns: FloatArray  # the sums :data:`OF_LINES` of each column, (3, n, x)
    gain: FloatArray  # relative deviation of the gain of each frame, (n,)
    blocks: FloatArray  # sums of k and r in each block, (b, 2, y, x)
    products: dict[str, FloatArray]  # means of :data:`PRODUCTS` without the frames' common modes, (y, x) each

    @classmethod
    def of(
        cls, frames: NDArray[Any], numbers: IntArray, block_frames: int, laws: PixelLaws, maps: PixelMaps
    ) -> FrameView:
        """Sum over frames, codes (n, y, x), whose numbers in the run are increasing; no block spans a gap."""
        (n, ny, nx), edges = frames.shape, sums.blocks_of(numbers, block_frames)
        pixels = sums.pixel_statistics(laws, maps)
        samples = sums.Samples.by_laws(sums.FrameBlocks.of(frames), laws, maps, standardised=False)
        halves, gain = np.zeros((2, 2, n, ny)), np.zeros(n)
        noise, columns = np.zeros((n, ny)), np.zeros((3, n, nx))
        blocks = np.zeros((edges.size - 1, 2, ny, nx))
        products = {name: np.zeros(ny * nx) for name in PRODUCTS}
        modes, shares = pixels.mode.astype(np.float32), pixels.weights.astype(np.float32)
        weights = np.stack([pixels.factor, pixels.shift, pixels.square]).astype(np.float32)
        for block, (at, end) in zip(blocks, pairwise(edges.tolist()), strict=True):
            before = np.zeros((2, 0, ny, nx), np.float32)
            in_block = replace(samples, frames=sums.FrameBlocks.of(frames[at:end]), most=_CHUNK_SAMPLES)
            for u in in_block.chunks():
                some = slice(at, at + u.shape[1])
                sum_rows(u, weights, halves[:, :, some], gain[some], noise[some])
                columns[:2, some] = u.sum(axis=2)
                columns[2, some] = (weights[2] * u[1] * u[1]).sum(axis=1)
                block += u.sum(axis=1, dtype=np.float64)
                u -= np.einsum("ctyx,cyx->ct", u, shares)[:, :, None, None] * modes[:, None]
                joined = np.concatenate([before, u], axis=1)
                _add_products(joined, before.shape[1], products)
                at, before = some.stop, joined[:, -_LAGS:]
        for lines in (noise, columns[2]):
            lines -= lines.mean(axis=0)
        gain = (gain - pixels.gain_offset) / max(pixels.gain_norm, 1e-300)
        means = {
            name: total.reshape(ny, nx) / max(_count(edges, PRODUCTS[name][0][0]), 1)
            for name, total in products.items()
        }
        return cls(pixels, numbers, edges, block_frames, halves, noise, columns, gain, blocks, means)

    @property
    def n(self) -> int:
        """Number of frames."""
        return int(self.numbers.size)

    @cached_property
    def rows(self) -> FloatArray:
        """The sums :data:`OF_LINES` of each row, (3, n, y)."""
        return np.concatenate([self.halves.sum(axis=1), self.noise[None]])

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of what :data:`OF_LINES` are sums of, in each pixel, (3, y, x)."""
        noise = (self.pixels.square * self.pixels.variance[1]) ** 2 * self.pixels.noise
        return np.concatenate([self.pixels.variance, noise[None]])

    @cached_property
    def mode(self) -> FloatArray:
        """What a change common to all pixels makes of that: of exposure, bias and noise, (3, y, x)."""
        noise = self.pixels.square * self.pixels.variance[1]
        return np.concatenate([self.pixels.mode, noise[None]])

    @cached_property
    def series(self) -> dict[str, FloatArray]:
        """Sums of the frames, of variance 1 by chance, (n,) each: :data:`OF_LINES` and the gain."""
        found = {
            name: of_rows.sum(axis=1) / np.sqrt(max(variance.sum(), 1e-300))
            for name, of_rows, variance in zip(OF_LINES, self.rows, self.variance, strict=True)
        }
        deviation = np.sqrt(max(self.pixels.gain_variance, 1e-300))
        return {**found, "gain": self.gain * self.pixels.gain_norm / deviation}

    @cached_property
    def remaining(self) -> FloatArray:
        """Variance of k and r after the frame's common mode was removed, 1 in unusable pixels, (2, y, x)."""
        v, h, w = self.pixels.variance, self.pixels.mode, self.pixels.weights
        left = v - h**2 * (w**2 * v).sum(axis=(1, 2), keepdims=True)
        return np.where(self.pixels.usable, np.maximum(left, 1e-3 * np.where(v > 0, v, 1.0)), 1.0)

    @cached_property
    def correlations(self) -> dict[str, Correlation]:
        """Correlations of samples by the names of :data:`PRODUCTS`."""
        return {name: self._correlation(*PRODUCTS[name], mean) for name, mean in self.products.items()}

    def _correlation(
        self, distance: tuple[int, int, int], channels: tuple[tuple[int, int], ...], mean: FloatArray
    ) -> Correlation:
        usable, cross, (lag, dy, dx) = self.pixels.usable, self.pixels.cross, distance
        ny, nx = usable.shape
        one, two = (slice(ny - dy), slice(nx - dx)), (slice(dy, None), slice(dx, None))
        both = usable[one] & usable[two]
        excess, variance, scale = mean[one].copy(), np.zeros(both.shape), np.zeros(both.shape)
        for a, b in channels:
            product = self.remaining[a][one] * self.remaining[b][two]
            variance += product
            scale += np.sqrt(product)
            if not lag:
                excess -= self._shared(a, b, one, two)
            else:  # a centred series is anticorrelated with itself
                excess += (self.remaining[a] if a == b else cross) / (self.n - 1.0)
        if len(channels) > 1:
            variance += 2.0 * cross[one] * cross[two]
        of_pixels = np.full(usable.shape, np.nan)
        of_pixels[one][both] = excess[both] / np.sqrt(variance[both])
        average = float(np.mean(excess[both] / scale[both])) if both.any() else float("nan")
        return Correlation(of_pixels, average, _count(self.edges, lag))

    def _shared(self, a: int, b: int, one: _Slices, two: _Slices) -> FloatArray:
        """Return what removing the common modes adds to covariances of channels a and b of two pixels."""
        # with a' = a - m sum(w a), m the mode and w its weights, and likewise b'
        pixels = self.pixels
        covariance = (pixels.variance[0], pixels.cross, pixels.variance[1])[a + b]
        (m, w), (other, v) = ((pixels.mode[each], pixels.weights[each]) for each in (a, b))
        left = m[one] * other[two] * (w * v * covariance).sum() - m[one] * (w * covariance)[two]
        return np.asarray(left - other[two] * (v * covariance)[one])

    @property
    def freedom(self) -> float:
        """Expectation of sum_b (sum of u in block b)^2 / n_b of a centred series of variance 1."""
        b = self.edges.size - 1
        return b - (self.n - b) / (self.n - 1.0)

    def full_blocks(self, series: FloatArray) -> FloatArray:
        """Return the full blocks of a series (n, ...) as (blocks, block_frames, ...)."""
        starts = self.edges[:-1][np.diff(self.edges) == self.block_frames]
        return np.asarray(series[starts[:, None] + np.arange(self.block_frames)])

    def slow(self, series: FloatArray, freedom: int = 1) -> float:
        """Return the statistic of slow variation of centred series of variance 1, from :meth:`block_sums`.

        The squares of the slowest 2, 4, 8 ... waves over the blocks are summed, and those of all; the most
        significant sum counts (the adaptive test of Neyman, Fan 1996). ``freedom`` series are independent.
        """
        root = np.sqrt(np.diff(self.edges).astype(np.float64))
        middle = 0.5 * (self.edges[:-1] + self.edges[1:]) / self.n
        order = np.arange(min(root.size, 1 + SLOWEST[-1]))
        # orthonormal waves, the slowest first; centring leaves nothing of the constant
        waves, _ = np.linalg.qr(np.cos(np.pi * order * middle[:, None]) * root[:, None])
        energy = np.cumsum(np.sum((waves[:, 1:].T @ series) ** 2, axis=1))
        unit = freedom * self.n / (self.n - 1.0)
        cuts = [c for c in SLOWEST if c < self.edges.size - 2]
        z = [chi_square(energy[c - 1], c * unit, 2.0 * c * freedom) for c in cuts]
        z.append(chi_square(np.sum(series**2), freedom * self.freedom))
        # sums that share terms are alike
        return best(*(float(value) for value in z), independent=0.5 * (1 + len(z)))

    def block_sums(self, series: FloatArray) -> FloatArray:
        """Return ``sum of each block / sqrt(n_b)`` of a series (n, ...), (b, ...)."""
        lengths = np.diff(self.edges).reshape(-1, *[1] * (series.ndim - 1))
        return np.asarray(np.add.reduceat(series, self.edges[:-1], axis=0) / np.sqrt(lengths))


def _count(edges: IntArray, lag: int) -> int:
    """Return how many pairs of frames of a block are so many frames apart."""
    return int(np.maximum(np.diff(edges) - lag, 0).sum())


def _add_products(u: Float32Array, known: int, products: dict[str, FloatArray]) -> None:
    """Add the products of frames (2, t, y, x) with those before; the first ``known`` are that only."""
    # a product with the pixel behind the end of a row is none of neighbours, and is not used
    flat = u.reshape(2, u.shape[1], -1)
    for name, ((lag, dy, dx), channels) in PRODUCTS.items():
        ahead, first = dy * u.shape[3] + dx, max(known, lag)
        one = flat[:, first:, : flat.shape[2] - ahead]
        two = flat[:, first - lag : flat.shape[1] - lag, ahead:]
        (a, b), *others = channels
        total = one[a] * two[b]
        for a, b in others:
            total += one[a] * two[b]
        add_frames(total, products[name])
