"""One pass over the frames of a split: everything along time and between pixels, as sums.

Tables of k and r (centred on each pixel's own samples) turn codes into the two channels. Given the
histograms, frames without any effect are in random order; means and variances of all sums follow from that
alone, so a poor fit of a pixel's histogram does not imitate an effect in time or space.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import sums_numba as kernel
from pchem_pipeline.discrepancy.observe import tables_numba as columns_of
from pchem_pipeline.discrepancy.observe.tables_numba import PixelLaws
from pchem_pipeline.effects.framework.evidence import PixelMaps

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: What a sample is split into: k and r.
CHANNELS = ("charge", "readout")
#: Blocks of frames, whose means are compared.
MINIMUM_BLOCKS = 4
MOST_HITS = 20_000
_NO_CODE = np.iinfo(np.int64).max  # above all
_CHUNK_SAMPLES = 1 << 16
_LEAST_NOISE = 0.5  # of the variance of r^2: residuals of hardly two values tell nothing of their size


@dataclass(frozen=True)
class PixelStatistics:
    """Moments of the channels over the samples of each pixel, 0 in unusable ones, (y, x) each.

    Attributes:
        usable: pixels that count.
        exposure: H, e-.
        step: 1/g, DN.
        charge, readout: variances of k (e-^2) and r (DN^2).
        cross: covariance of k and r, e- DN.
        factor, shift: weights ``r (factor k + shift)`` whose sum over a frame, less ``gain_offset``, is
            ``gain_norm`` times the relative deviation of the gain: least squares of r on k / g, what is
            common to all pixels taken away.
        gain_variance: variance of that sum in one frame.
        noise: variance of r^2, in that of r squared: 2 for Gaussian residuals.
        square: weights of r^2 by which a common relative change of the noise is told best.
    """

    usable: NDArray[np.bool_]
    exposure: FloatArray
    step: FloatArray
    charge: FloatArray
    readout: FloatArray
    cross: FloatArray
    factor: FloatArray
    shift: FloatArray
    gain_offset: float
    gain_norm: float
    gain_variance: float
    noise: FloatArray
    square: FloatArray


@dataclass(frozen=True)
class FrameSums:
    """Sums over a split of n frames in b blocks.

    Attributes:
        rows: k of the left and the right half, r of the left and the right half of each row, (4, n, y).
        columns: k and r of each column, (2, n, x).
        gain: relative deviation of the gain of each frame, (n,).
        blocks: sums of k and r in each block, (b, 2, y, x).
        lags: mean products after removal of the frames' common modes: kk and rr at lags 1, 2, 3, then r with
            the k before, k with the r before, (8, y, x).
        row_noise: weighted sums of r^2 of each row, less their means, (n, y).
        column_noise: the same of each column, (n, x).
        n_pairs: number of products behind each of them.
        next_column, next_row: mean products kk, rr and rk + kr with the next column or row, (3, y, x).
        hits: samples above the support of their pixel: frame position, y, x, DN, (n_hits, 4).
        low_hits: the same below it.
    """

    rows: FloatArray
    columns: NDArray[np.float32]
    gain: FloatArray
    blocks: FloatArray
    lags: FloatArray
    row_noise: FloatArray
    column_noise: FloatArray
    n_pairs: tuple[int, ...]
    next_column: FloatArray
    next_row: FloatArray
    hits: IntArray
    low_hits: IntArray


def blocks_of(numbers: IntArray, block_frames: int) -> IntArray:
    """Return the positions where blocks begin, and the number of frames, (b + 1,); no block spans a gap."""
    breaks = np.concatenate([[0], np.flatnonzero(np.diff(numbers) != 1) + 1, [numbers.size]])
    starts = [np.arange(a, b, block_frames) for a, b in pairwise(breaks)]
    return np.concatenate([*starts, [numbers.size]]).astype(np.int64)


def pixel_statistics(laws: PixelLaws, maps: PixelMaps) -> PixelStatistics:
    """Collect the moments of the channels; pixels in which one of them is constant do not count."""
    moments, shape = laws.moments, maps.usable.shape
    exposure, gain = maps.quanta_exposure.ravel(), maps.conversion_gain.ravel()
    kk, rr, kr = (moments[:, c] for c in (columns_of.MEAN_KK, columns_of.MEAN_RR, columns_of.MEAN_KR))
    usable = laws.good & (kk > 1e-12) & (rr > 1e-12)

    def masked(values: FloatArray) -> FloatArray:
        return np.where(usable, values, 0.0)

    step = masked(1.0 / np.where(usable, gain, 1.0))
    h = masked(exposure)
    weight = masked(1.0 / np.where(usable, rr, 1.0))
    factor = step * weight
    pattern = masked(h * step - (h * step * weight).sum() / max(weight.sum(), 1e-300))
    shift = pattern * weight
    krr, kkrr = moments[:, columns_of.MEAN_KRR], moments[:, columns_of.MEAN_KKRR]
    spread = factor**2 * (kkrr - kr**2) + 2.0 * factor * shift * krr + shift**2 * rr
    noise = masked(np.maximum(moments[:, columns_of.MEAN_RRRR] * weight**2 - 1.0, 0.0))
    h, step, kk, rr, kr, factor, shift = (
        values.reshape(shape) for values in (h, step, masked(kk), masked(rr), masked(kr), factor, shift)
    )
    return PixelStatistics(
        usable.reshape(shape), h, step, kk, rr, kr, factor, shift,
        gain_offset=float((factor * kr).sum()),
        gain_norm=float((factor * step * kk).sum() + shift.ravel() @ pattern),
        gain_variance=float(masked(spread).sum()),
        noise=noise.reshape(shape),
        square=masked(weight / np.maximum(noise, _LEAST_NOISE)).reshape(shape),
    )  # fmt: skip


def sum_frames(frames: NDArray[Any], edges: IntArray, laws: PixelLaws, pixels: PixelStatistics) -> FrameSums:
    """Sum over the frames (n, y, x) of a split whose blocks begin at ``edges``."""
    n, ny, nx = frames.shape
    size = max(1, min(n, _CHUNK_SAMPLES // (ny * nx)))
    charge, readout = np.zeros((2, kernel.LAGS + size, ny, nx), np.float32)
    rows, columns, gain = np.zeros((4, n, ny)), np.zeros((n, 2, nx), np.float32), np.zeros(n)
    blocks = np.zeros((edges.size - 1, 2, ny, nx))
    lags, next_column, next_row = np.zeros((8, ny, nx)), np.zeros((3, ny, nx)), np.zeros((3, ny, nx))
    row_noise, column_noise = np.zeros((n, ny)), np.zeros((n, nx), np.float32)
    channels = kernel.Channels(
        support=_packed_support(laws, pixels.usable),
        tables=laws.tables,
        modes=np.stack([pixels.exposure, pixels.usable]).astype(np.float32),
        weights=np.stack([pixels.factor, pixels.shift, pixels.square]).astype(np.float32),
        norms=np.array([pixels.exposure.sum(), pixels.usable.sum()], np.float64),
    )
    for b, (first, last) in enumerate(pairwise(edges)):
        block = kernel.BlockSums(
            rows[:, first:last], columns[first:last], gain[first:last], blocks[b], lags,
            next_column, next_row, row_noise[first:last], column_noise[first:last],
        )  # fmt: skip
        kernel.sum_block(frames[first:last], channels, charge, readout, block)
    lengths = np.diff(edges)
    pairs = tuple(int(np.maximum(lengths - lag, 0).sum()) for lag in (1, 2, 3, 1, 2, 3, 1, 1))
    lags /= np.maximum(pairs, 1)[:, None, None]
    gain = (gain - pixels.gain_offset) / max(pixels.gain_norm, 1e-300)
    return FrameSums(
        rows, columns.transpose(1, 0, 2), gain, blocks, lags,
        row_noise - row_noise.mean(axis=0), column_noise - column_noise.mean(axis=0, dtype=np.float64),
        pairs, next_column / n, next_row / n,
        _hits(frames, laws, pixels.usable, above=True), _hits(frames, laws, pixels.usable, above=False),
    )  # fmt: skip


def _packed_support(laws: PixelLaws, usable: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return first code, last code and first table row as (y, 3, x); row 0 (zeros) for unusable pixels."""
    first, length, start = np.where(usable.reshape(-1, 1), laws.support, [0, 1, 0]).T
    packed = np.stack([first, first + length - 1, start]).reshape(3, *usable.shape)
    return np.ascontiguousarray(packed.transpose(1, 0, 2), np.int32)


def _hits(frames: NDArray[Any], laws: PixelLaws, usable: NDArray[np.bool_], *, above: bool) -> IntArray:
    """Return the samples above or below the support of their pixel, by frame: position, y, x, DN."""
    column = columns_of.SEEN_HIGH if above else columns_of.SEEN_LOW
    seen = (laws.moments[:, column] > 0).reshape(usable.shape) & usable
    first, length = laws.support[seen.ravel(), 0], laws.support[seen.ravel(), 1]
    ends = np.stack(
        [np.full_like(first, -1), first + length - 1] if above else [first, np.full_like(first, _NO_CODE)], 1
    )
    hits = np.zeros((MOST_HITS, 4), np.int64)
    found = kernel.find_hits(frames, np.ascontiguousarray(np.argwhere(seen)), ends, hits)
    hits = hits[: min(found, MOST_HITS)]
    return hits[np.lexsort((hits[:, 2], hits[:, 1], hits[:, 0]))]
