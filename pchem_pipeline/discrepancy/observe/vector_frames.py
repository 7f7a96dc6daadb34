"""The part of the vector that needs frames: families time and frame.

Given the histograms, frames without an effect are in random order. Centred series of n frames then have
``E[u_t u_s] = -1 / (n - 1)`` of their variance at different times, exactly; every mean below takes that into
account, and likewise what the removal of a common mode does to the pixels that share it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.sums import FrameSums, PixelStatistics
from pchem_pipeline.discrepancy.observe.vector import outliers

__all__ = [
    "CHANNELS",
    "SHORTEST_PERIODOGRAM",
    "FrameView",
    "frame_statistics",
    "pixel_lags",
    "quadrant_series",
    "quadrant_sums",
    "time_statistics",
    "without_mode",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHANNELS = ("charge", "readout")
SHORTEST_PERIODOGRAM = 8
_SLOWEST = (2, 4, 8, 16, 32)


@dataclass(frozen=True)
class FrameView:
    """What all these statistics look at.

    Attributes:
        sums: of the pass over the frames.
        pixels: moments of the pixels.
        numbers: frame numbers, (n,).
        edges: positions of the blocks, (b + 1,).
        block_frames: frames in a full block.
    """

    sums: FrameSums
    pixels: PixelStatistics
    numbers: IntArray
    edges: IntArray
    block_frames: int

    @property
    def n(self) -> int:
        """Number of frames."""
        return int(self.numbers.size)

    @property
    def freedom(self) -> float:
        """Expectation of sum_b (sum of u in block b)^2 / n_b of a centred series of variance 1."""
        b = self.edges.size - 1
        return b - (self.n - b) / (self.n - 1.0)

    def variance(self, channel: int) -> FloatArray:
        """Variance of k or r in each pixel, (y, x)."""
        return self.pixels.readout if channel else self.pixels.charge

    def mode(self, channel: int) -> FloatArray:
        """Pattern of what is common to all pixels: H for a change of the exposure, 1 for one of the bias."""
        return self.pixels.usable.astype(np.float64) if channel else self.pixels.exposure

    def remaining(self, channel: int) -> FloatArray:
        """Variance of each pixel after the frame's common mode was removed, 1 in unusable pixels, (y, x)."""
        v, h = self.variance(channel), self.mode(channel)
        share = h / h.sum()
        left = v * (1.0 - 2.0 * share) + share**2 * v.sum()
        return np.where(self.pixels.usable, np.maximum(left, 1e-3 * np.where(v > 0, v, 1.0)), 1.0)

    def full_blocks(self, series: FloatArray) -> FloatArray:
        """Return the full blocks of a series (n, ...) as (blocks, block_frames, ...)."""
        starts = self.edges[:-1][np.diff(self.edges) == self.block_frames]
        return np.asarray(series[starts[:, None] + np.arange(self.block_frames)])

    def slow_modes(self) -> FloatArray:
        """Return orthonormal waves along the blocks, slowest first, that centring leaves, (modes, b)."""
        root = np.sqrt(np.diff(self.edges).astype(np.float64))
        middle = 0.5 * (self.edges[:-1] + self.edges[1:]) / self.n
        order = np.arange(min(root.size, 1 + _SLOWEST[-1]))
        basis, _ = np.linalg.qr(np.cos(np.pi * order * middle[:, None]) * root[:, None])
        return np.asarray(basis[:, 1:].T)

    def slow(self, series: FloatArray, freedom: int = 1) -> float:
        """Return the statistic of slow variation of centred series of variance 1.

        The squares of the slowest 2, 4, 8 ... waves over the blocks are summed, and those of all; the most
        significant sum counts (the adaptive test of Neyman, Fan 1996).

        Args:
            series: sums over the blocks, divided by the root of their length, (b, m).
            freedom: independent series among the m.
        """
        energy = np.cumsum(np.sum((self.slow_modes() @ series) ** 2, axis=1))
        unit = freedom * self.n / (self.n - 1.0)
        cuts = [c for c in _SLOWEST if c < self.edges.size - 2]
        z = [laws.chi_square(energy[c - 1], c * unit, 2.0 * c * freedom) for c in cuts]
        z.append(laws.chi_square(np.sum(series**2), freedom * self.freedom))
        # sums that share terms are alike
        return laws.best(*(float(value) for value in z), independent=0.5 * (1 + len(z)))

    def block_sums(self, series: FloatArray) -> FloatArray:
        """Return ``sum of each block / sqrt(n_b)`` of a series (n, ...), (b, ...)."""
        lengths = np.diff(self.edges).reshape(-1, *[1] * (series.ndim - 1))
        return np.asarray(np.add.reduceat(series, self.edges[:-1], axis=0) / np.sqrt(lengths))


def _frame_series(view: FrameView, channel: int) -> FloatArray:
    total = view.sums.rows[2 * channel : 2 * channel + 2].sum(axis=(0, 2))
    return np.asarray(total / np.sqrt(view.variance(channel).sum()))


def _trend(view: FrameView, u: FloatArray) -> float:
    time = view.numbers - view.numbers.mean()
    return float(time @ u / np.sqrt(time @ time) * np.sqrt((view.n - 1.0) / view.n))


def _lag1(view: FrameView, u: FloatArray) -> float:
    """Return the statistic of products of successive frames of a block, summed over the other axes."""
    inside = np.ones(view.n, np.bool_)
    inside[view.edges[:-1]] = False
    t = np.flatnonzero(inside)
    products = u[t] * u[t - 1]
    return float((products.sum() + products.size / (view.n - 1.0)) / np.sqrt(max(products.size, 1)))


def _line(view: FrameView, u: FloatArray) -> float | None:
    blocks = view.full_blocks(u)
    length = blocks.shape[1]
    if length < SHORTEST_PERIODOGRAM or blocks.shape[0] == 0:
        return None
    power = np.abs(np.fft.rfft(blocks, axis=1)[:, 1 : (length + 1) // 2]) ** 2 / length
    return laws.largest_power(power.mean(axis=0), blocks.shape[0])


def frame_statistics(view: FrameView, expected_repeats: tuple[float, float]) -> dict[str, float]:
    """Return the family frame; ``expected_repeats`` of frames and of rows by chance."""
    found: dict[str, float] = {}
    series = []
    for channel, name in enumerate(CHANNELS):
        u = _frame_series(view, channel)
        series.append(u)
        sign = np.where(view.numbers % 2 == 0, 1.0, -1.0)
        sign -= sign.mean()
        found[f"frame.{name}.variance"] = float(laws.chi_square(u @ u, view.n))
        found[f"frame.{name}.lag1"] = _lag1(view, u)
        found[f"frame.{name}.slow"] = view.slow(view.block_sums(u)[:, None])
        found[f"frame.{name}.trend"] = _trend(view, u)
        line = _line(view, u)
        if line is not None:
            found[f"frame.{name}.line"] = line
        found[f"frame.{name}.alternating"] = float(sign @ u / np.sqrt(max(float(sign @ sign), 1e-300)))
        found[f"frame.{name}.largest"] = laws.largest_normal(u)
        quadrants = _quadrants(view, channel)
        if quadrants is not None:
            found[f"frame.{name}.quadrants"] = quadrants
    k, r = series
    pixels = view.pixels
    rho = float(pixels.cross.sum() / np.sqrt(pixels.charge.sum() * pixels.readout.sum()))
    found["frame.covariance"] = float((k @ r - view.n * rho) / np.sqrt(view.n * (1.0 + rho**2)))
    gain = view.sums.gain * pixels.gain_norm / np.sqrt(max(pixels.gain_variance, 1e-300))
    found["frame.gain.slow"] = view.slow(view.block_sums(gain)[:, None])
    found["frame.gain.trend"] = _trend(view, gain)
    found["frame.repeated"] = laws.repeats(view.sums.repeated.size, expected_repeats[0])
    found["frame.repeated_rows"] = laws.repeats(view.sums.repeated_rows, expected_repeats[1])
    return found


def quadrant_sums(values: FloatArray) -> FloatArray:
    """Return the sums of a map over top left, top right, bottom left, bottom right, (4,)."""
    y, x = values.shape[0] // 2, values.shape[1] // 2
    parts = (values[:y, :x], values[:y, x:], values[y:, :x], values[y:, x:])
    return np.array([part.sum() for part in parts])


def quadrant_series(rows: FloatArray) -> FloatArray:
    """Return the sums of each frame over the quadrants, (n, 4), from those of half rows, (2, n, y)."""
    y = rows.shape[2] // 2
    return np.stack(
        [rows[half][:, part].sum(axis=1) for part in (slice(0, y), slice(y, None)) for half in (0, 1)], 1
    )


def without_mode(values: FloatArray, pattern: FloatArray) -> FloatArray:
    """Return standardised values (..., m) without their projection on a pattern (m,)."""
    unit = pattern / np.sqrt(pattern @ pattern)
    return np.asarray(values - (values @ unit)[..., None] * unit)


def _quadrants(view: FrameView, channel: int) -> float | None:
    variance = quadrant_sums(view.variance(channel))
    some = variance > 0
    if some.sum() < 2:
        return None
    scale = np.sqrt(variance[some])
    u = quadrant_series(view.sums.rows[2 * channel : 2 * channel + 2])[:, some] / scale
    rest = without_mode(view.block_sums(u), quadrant_sums(view.mode(channel))[some] / scale)
    return view.slow(rest, int(some.sum()) - 1)


def pixel_lags(view: FrameView) -> FloatArray:
    """Return the autocorrelations of each pixel, (8, y, x): kk and rr at lags 1 to 3, r k(-1), k r(-1)."""
    k, r = view.remaining(0), view.remaining(1)
    both = np.sqrt(k * r)
    scale = np.stack([k, k, k, r, r, r, both, both])
    correlation = view.sums.lags / scale
    # a centred series is anticorrelated with itself
    correlation[:6] += 1.0 / (view.n - 1.0)
    correlation[6:] += view.pixels.cross / both / (view.n - 1.0)
    return np.asarray(correlation * view.pixels.usable)


def time_statistics(view: FrameView, lags: FloatArray) -> dict[str, float]:
    """Return the family time from the autocorrelations of :func:`pixel_lags`."""
    found: dict[str, float] = {}
    usable = view.pixels.usable
    n_pixels = int(usable.sum())
    for channel, name in enumerate(CHANNELS):
        for lag in (1, 2, 3):
            if view.sums.n_pairs[lag - 1] == 0:
                continue
            z = lags[3 * channel + lag - 1][usable] * np.sqrt(view.sums.n_pairs[lag - 1])
            found[f"time.lag{lag}.{name}.mean"] = float(z.sum() / np.sqrt(n_pixels))
            if lag == 1:
                found[f"time.lag1.{name}.chi"] = float((z @ z - n_pixels) / np.sqrt(2.0 * n_pixels))
                found[f"time.lag1.{name}.cnt"] = outliers(z, two_sided=True)
        found |= _block_statistics(view, channel, name)
    if view.sums.n_pairs[0]:
        root = np.sqrt(view.sums.n_pairs[0] / n_pixels)
        found["time.cross.readout_charge"] = float(lags[6].sum() * root)
        found["time.cross.charge_readout"] = float(lags[7].sum() * root)
    return found


def _block_statistics(view: FrameView, channel: int, name: str) -> dict[str, float]:
    sums, mode = view.sums.blocks[:, channel], view.mode(channel)
    rest = sums - (sums.sum(axis=(1, 2)) / mode.sum())[:, None, None] * mode
    lengths = np.diff(view.edges)[:, None]
    u = rest[:, view.pixels.usable] / np.sqrt(lengths * view.remaining(channel)[view.pixels.usable])
    chi2 = np.sum(u**2, axis=0)
    return {
        f"time.block.{name}.chi": view.slow(u, chi2.size),
        f"time.block.{name}.cnt": outliers(laws.chi_square(chi2, view.freedom), two_sided=False),
    }
