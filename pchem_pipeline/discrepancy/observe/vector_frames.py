"""The part of the vector that needs frames: families time, frame and space.

Given the histograms, frames without an effect are in random order. Centred series of n frames then have
``E[u_t u_s] = -1 / (n - 1)`` of their variance at different times, exactly; every mean below takes that into
account, and likewise what the removal of a common mode does to the pixels that share it. Every form is taken
of every series, or of all lines, or of all pixels; those that are no statistics of the catalogue are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.sums import CHANNELS, PixelStatistics, pairs_at_lags
from pchem_pipeline.discrepancy.observe.sums_numba import FrameSums
from pchem_pipeline.discrepancy.observe.vector import named, pixel_forms

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_Slices = tuple[slice, slice]

SHORTEST_PERIODOGRAM = 8


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

    def lines(self, channel: int, axis: int) -> FloatArray:
        """Sums of k or r of each row (axis 1) or column (axis 0), (n, lines)."""
        if axis == 0:
            return np.asarray(self.sums.columns[channel], np.float64)
        return np.asarray(self.sums.rows[2 * channel : 2 * channel + 2].sum(axis=0))

    def remaining(self, channel: int) -> FloatArray:
        """Variance of each pixel after the frame's common mode was removed, 1 in unusable pixels, (y, x)."""
        v, h = self.variance(channel), self.mode(channel)
        share = h / h.sum()
        left = v * (1.0 - 2.0 * share) + share**2 * v.sum()
        return np.where(self.pixels.usable, np.maximum(left, 1e-3 * np.where(v > 0, v, 1.0)), 1.0)

    @property
    def noise_variance(self) -> FloatArray:
        """Variance of the weighted squares of r in each pixel, (y, x)."""
        return np.asarray((self.pixels.square * self.pixels.readout) ** 2 * self.pixels.noise)

    @cached_property
    def series(self) -> dict[str, FloatArray]:
        """Sums of the frames, of variance 1 by chance, (n,) each.

        Of k, of r, of their product for the gain, and of the squares of r less their mean (the noise).
        """
        sums, pixels = self.sums, self.pixels
        found = {
            name: self.lines(channel, 1).sum(axis=1) / np.sqrt(self.variance(channel).sum())
            for channel, name in enumerate(CHANNELS)
        }
        found["gain"] = sums.gain * pixels.gain_norm / np.sqrt(max(pixels.gain_variance, 1e-300))
        found["noise"] = sums.row_noise.sum(axis=1) / np.sqrt(max(self.noise_variance.sum(), 1e-300))
        return found

    @cached_property
    def neighbours(self) -> dict[str, Neighbours]:
        """Correlations of neighbours: x.kk, x.rr, x.rk, y.kk and so on."""
        return {f"{axis}.{kind}": seen for axis in "xy" for kind, seen in _neighbours(self, axis).items()}

    def full_blocks(self, series: FloatArray) -> FloatArray:
        """Return the full blocks of a series (n, ...) as (blocks, block_frames, ...)."""
        starts = self.edges[:-1][np.diff(self.edges) == self.block_frames]
        return np.asarray(series[starts[:, None] + np.arange(self.block_frames)])

    def slow_modes(self) -> FloatArray:
        """Return orthonormal waves along the blocks, slowest first, that centring leaves, (modes, b)."""
        root = np.sqrt(np.diff(self.edges).astype(np.float64))
        middle = 0.5 * (self.edges[:-1] + self.edges[1:]) / self.n
        order = np.arange(min(root.size, 1 + laws.SLOWEST[-1]))
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
        cuts = [c for c in laws.SLOWEST if c < self.edges.size - 2]
        z = [laws.chi_square(energy[c - 1], c * unit, 2.0 * c * freedom) for c in cuts]
        z.append(laws.chi_square(np.sum(series**2), freedom * self.freedom))
        # sums that share terms are alike
        return laws.best(*(float(value) for value in z), independent=0.5 * (1 + len(z)))

    def block_sums(self, series: FloatArray) -> FloatArray:
        """Return ``sum of each block / sqrt(n_b)`` of a series (n, ...), (b, ...)."""
        lengths = np.diff(self.edges).reshape(-1, *[1] * (series.ndim - 1))
        return np.asarray(np.add.reduceat(series, self.edges[:-1], axis=0) / np.sqrt(lengths))


def _lag1(view: FrameView, u: FloatArray) -> float:
    """Return the statistic of products of successive frames of a block."""
    inside = np.ones(view.n, np.bool_)
    inside[view.edges[:-1]] = False
    t = np.flatnonzero(inside)
    products = u[t] * u[t - 1]
    return float((products.sum() + products.size / (view.n - 1.0)) / np.sqrt(max(products.size, 1)))


def _line(view: FrameView, u: FloatArray) -> float:
    blocks = view.full_blocks(u)
    length = blocks.shape[1]
    if length < SHORTEST_PERIODOGRAM or blocks.shape[0] == 0:
        return float("nan")
    power = np.abs(np.fft.rfft(blocks, axis=1)[:, 1 : (length + 1) // 2]) ** 2 / length
    return laws.largest_power(power.mean(axis=0), blocks.shape[0])


def _series_forms(view: FrameView, u: FloatArray) -> dict[str, float]:
    """Return the statistics of a series of the frames, of variance 1 by chance, (n,)."""
    time = view.numbers - view.numbers.mean()
    sign = np.where(view.numbers % 2 == 0, 1.0, -1.0)
    sign -= sign.mean()
    return {
        "variance": float(laws.chi_square(u @ u, view.n)),
        "lag1": _lag1(view, u),
        "slow": view.slow(view.block_sums(u)[:, None]),
        "trend": float(time @ u / np.sqrt(time @ time) * np.sqrt((view.n - 1.0) / view.n)),
        "line": _line(view, u),
        "alternating": float(sign @ u / np.sqrt(max(float(sign @ sign), 1e-300))),
        "largest": laws.largest_normal(u),
    }


def frame_statistics(view: FrameView) -> dict[str, float]:
    """Return the family frame but for repeats."""
    pixels, series = view.pixels, view.series
    found: dict[str, float] = {}
    for name, u in series.items():
        found |= named(f"frame.{name}", _series_forms(view, u))
    for channel, name in enumerate(CHANNELS):
        found[f"frame.{name}.quadrants"] = _quadrants(view, channel)
    rho = float(pixels.cross.sum() / np.sqrt(pixels.charge.sum() * pixels.readout.sum()))
    product = float(series["charge"] @ series["readout"])
    found["frame.covariance"] = (product - view.n * rho) / np.sqrt(view.n * (1.0 + rho**2))
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


def _quadrants(view: FrameView, channel: int) -> float:
    variance = quadrant_sums(view.variance(channel))
    some = variance > 0
    if some.sum() < 2:
        return float("nan")
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
    names = [f"time.lag{lag}.{name}" for name in CHANNELS for lag in (1, 2, 3)]
    names += ["time.cross.readout_charge", "time.cross.charge_readout"]
    for name, values, pairs in zip(names, lags, pairs_at_lags(view.edges), strict=True):
        if pairs:
            forms = pixel_forms(values[usable] * np.sqrt(pairs))
            found |= {name: forms["mean"], **named(name, forms)}
    for channel, name in enumerate(CHANNELS):
        sums, mode = view.sums.blocks[:, channel], view.mode(channel)
        rest = sums - (sums.sum(axis=(1, 2)) / mode.sum())[:, None, None] * mode
        lengths = np.diff(view.edges)[:, None]
        u = rest[:, usable] / np.sqrt(lengths * view.remaining(channel)[usable])
        chi2 = np.sum(u**2, axis=0)
        forms = pixel_forms(laws.chi_square(chi2, view.freedom), two_sided=False)
        found |= named(f"time.block.{name}", {**forms, "chi": view.slow(u, chi2.size)})
    return found


def space_statistics(view: FrameView) -> dict[str, float]:
    """Return the family space, as far as it is of lines and neighbours."""
    found: dict[str, float] = {}
    sums, pixels = view.sums, view.pixels
    for line, axis in (("row", 1), ("column", 0)):
        for channel, name in enumerate(CHANNELS):
            variance, mode = view.variance(channel).sum(axis), view.mode(channel).sum(axis)
            values = view.lines(channel, axis)
            forms = _line_forms(view, values, variance, mode, waves=name == "readout")
            found |= named(f"space.{line}.{name}", forms)
        noise = sums.column_noise if axis == 0 else sums.row_noise
        # of a common relative change of the noise
        mode = (pixels.square * pixels.readout).sum(axis)
        found |= named(f"space.{line}.noise", _line_forms(view, noise, view.noise_variance.sum(axis), mode))
    return found | {f"space.{name}": seen.z for name, seen in view.neighbours.items()}


def _line_forms(
    view: FrameView, values: FloatArray, variance: FloatArray, mode: FloatArray, *, waves: bool = False
) -> dict[str, float]:
    """Return the statistics of sums over lines (n, lines), the common mode of each frame removed."""
    some = variance > 0
    m = int(some.sum())
    if m < 2:
        return {}
    scale = np.sqrt(variance[some])
    pattern = mode[some] / scale
    rest = np.zeros(values.shape)
    rest[:, some] = without_mode(values[:, some] / scale, pattern)
    found = {"variance": float(laws.chi_square(np.sum(rest**2), view.n * (m - 1.0)))}
    adjacent = np.flatnonzero(some[:-1] & some[1:])
    if adjacent.size and m > 2:
        weights = np.zeros(some.size)
        weights[some] = pattern / np.sqrt(pattern @ pattern)
        shared = float(weights[adjacent] @ weights[adjacent + 1])
        products = float(np.sum(rest[:, adjacent] * rest[:, adjacent + 1]))
        found["lag1"] = (products + view.n * shared) / np.sqrt(view.n * adjacent.size)
    return {**found, "line": _line_over_lines(view, rest, m)} if waves else found


def _line_over_lines(view: FrameView, rest: FloatArray, used: int) -> float:
    """Return the statistic of a wave across the lines, coherent over a block or over one frame only."""
    blocks = view.full_blocks(rest)
    count, length, lines = blocks.shape
    if count == 0 or min(length, used) < SHORTEST_PERIODOGRAM:
        return float("nan")
    power = np.abs(np.fft.fft(np.fft.rfft(blocks, axis=2)[:, :, 1:], axis=1)) ** 2 / (length * used)
    single = power[:, :, : (lines - 1) // 2].mean(axis=(0, 1))
    moving = np.ones(length, np.bool_)
    moving[[0, length // 2]] = False
    coherent = power.mean(axis=0)[moving]
    return laws.best(laws.largest_power(coherent, count), laws.largest_power(single, count * length))


@dataclass(frozen=True)
class Neighbours:
    """The correlation of neighbours along an axis.

    Attributes:
        correlation: mean over all pairs.
        products: number of them.
        z: statistic of all pairs.
        deviation: of each pixel and the next one, N(0, 1) by chance; NaN where one is not usable, (y, x).
    """

    correlation: float
    products: int
    z: float
    deviation: FloatArray


def _neighbours(view: FrameView, axis: str) -> dict[str, Neighbours]:
    """Return the correlation of neighbours along x or y, by kind."""
    pixels, n = view.pixels, view.n
    products = view.sums.next_column if axis == "x" else view.sums.next_row
    every, front, back = slice(None), slice(None, -1), slice(1, None)
    one, two = ((every, front), (every, back)) if axis == "x" else ((front, every), (back, every))
    both = pixels.usable[one] & pixels.usable[two]
    pairs = int(both.sum())
    if pairs == 0:
        return {}
    found = {}
    for kind, (a, b), index in (("kk", (0, 0), 0), ("rr", (1, 1), 1), ("rk", (1, 0), 2)):
        va, vb = view.remaining(a), view.remaining(b)
        variance, expected = va[one] * vb[two], _after_removal(view, a, b, one, two)
        size = np.sqrt(variance)
        if kind == "rk":
            expected = expected + _after_removal(view, a, b, two, one)
            size = size + np.sqrt(va[two] * vb[one])
            variance = variance + va[two] * vb[one] + 2.0 * pixels.cross[one] * pixels.cross[two]
        excess = (products[index][: both.shape[0], : both.shape[1]] - expected)[both]
        deviation = np.full(pixels.usable.shape, np.nan)
        deviation[one][both] = excess * np.sqrt(n / variance[both])
        found[kind] = Neighbours(
            float(np.mean(excess / size[both])),
            n * pairs * (2 if kind == "rk" else 1),
            float(np.sum(deviation[one][both]) / np.sqrt(pairs)),
            deviation,
        )
    return found


def _after_removal(view: FrameView, a: int, b: int, one: _Slices, two: _Slices) -> FloatArray:
    """Return what removing the common modes adds to the covariance of channel a of pixels with b of others.

    With ``a' = a - s sum(a)`` and ``b' = b - t sum(b)``, s and t the shares of the pixels in the modes.
    """
    pixels = view.pixels
    covariance = (pixels.charge, pixels.cross, pixels.readout)[a + b]
    share_a, share_b = view.mode(a) / view.mode(a).sum(), view.mode(b) / view.mode(b).sum()
    left = share_a[one] * share_b[two] * covariance.sum()
    return np.asarray(left - share_b[two] * covariance[one] - share_a[one] * covariance[two])
