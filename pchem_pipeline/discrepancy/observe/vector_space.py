"""The part of the vector that compares pixels of the same frame: family space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.discrepancy.observe.vector_frames import (
    CHANNELS,
    SHORTEST_PERIODOGRAM,
    FrameView,
    without_mode,
)

__all__ = ["neighbour_sums", "space_statistics"]

FloatArray = NDArray[np.float64]
_Slices = tuple[slice, slice]


def space_statistics(view: FrameView) -> dict[str, float]:
    """Return the family space."""
    found: dict[str, float] = {}
    for channel, name in enumerate(CHANNELS):
        rows = view.sums.rows[2 * channel : 2 * channel + 2].sum(axis=0)
        columns = view.sums.columns[channel].astype(np.float64)
        for line, values, axis in (("row", rows, 1), ("column", columns, 0)):
            variance, mode = view.variance(channel).sum(axis), view.mode(channel).sum(axis)
            found |= {
                f"space.{line}.{what}": z
                for what, z in _line_statistics(view, values, variance, mode, name).items()
            }
    for along in ("x", "y"):
        for pair, (correlation, pairs, z) in neighbour_sums(view, along).items():
            if pairs and np.isfinite(correlation):
                found[f"space.{along}.{pair}"] = z
    return found


def _line_statistics(
    view: FrameView, values: FloatArray, variance: FloatArray, mode: FloatArray, name: str
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
    found = {f"{name}.variance": float(laws.chi_square(np.sum(rest**2), view.n * (m - 1.0)))}
    adjacent = np.flatnonzero(some[:-1] & some[1:])
    if adjacent.size and m > 2:
        weights = np.zeros(some.size)
        weights[some] = pattern / np.sqrt(pattern @ pattern)
        shared = float(weights[adjacent] @ weights[adjacent + 1])
        products = float(np.sum(rest[:, adjacent] * rest[:, adjacent + 1]))
        found[f"{name}.lag1"] = (products + view.n * shared) / np.sqrt(view.n * adjacent.size)
    if name == "readout" and m >= SHORTEST_PERIODOGRAM:
        line = _line_over_lines(view, rest, m)
        if line is not None:
            found[f"{name}.line"] = line
    return found


def _line_over_lines(view: FrameView, rest: FloatArray, used: int) -> float | None:
    """Return the statistic of a wave across the lines, coherent over a block or over one frame only."""
    blocks = view.full_blocks(rest)
    count, length, lines = blocks.shape
    if count == 0 or length < SHORTEST_PERIODOGRAM:
        return None
    power = np.abs(np.fft.fft(np.fft.rfft(blocks, axis=2)[:, :, 1:], axis=1)) ** 2 / (length * used)
    single = power[:, :, : (lines - 1) // 2].mean(axis=(0, 1))
    moving = np.ones(length, np.bool_)
    moving[[0, length // 2]] = False
    coherent = power.mean(axis=0)[moving]
    return laws.best(laws.largest_power(coherent, count), laws.largest_power(single, count * length))


def neighbour_sums(view: FrameView, axis: str) -> dict[str, tuple[float, int, float]]:
    """Return mean correlation, number of products and statistic of neighbours along x or y, by kind."""
    pixels, n = view.pixels, view.n
    products = view.sums.beside if axis == "x" else view.sums.below
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
        z = float(np.sum(excess / np.sqrt(variance[both])) * np.sqrt(n / pairs))
        found[kind] = (float(np.mean(excess / size[both])), n * pairs * (2 if kind == "rk" else 1), z)
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
