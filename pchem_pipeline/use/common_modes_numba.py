"""Loops that find the offset of each frame, row and column of known pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

__all__ = ["find_offsets"]

FloatArray = NDArray[np.float64]

_ROUNDS = 5  # of the expansion in the offsets
_SWEEPS = 4  # of frame, rows and columns within one
_LEAST_INFORMATION = 0.05  # of that of a sample whose electron number is known


@kernel
def _score(difference: float, exposure: float, gain: float, sigma: float, reach: int) -> tuple[float, float]:
    """Return the slope of the log-likelihood in an offset, 1/DN, and the information, 1/DN^2.

    Args:
        difference: x - mu - offset, DN.
        exposure: H, e-.
        gain: g, e-/DN.
        sigma: DN.
        reach: electron numbers on either side of the nearest that are summed.
    """
    precision = 1.0 / (sigma * sigma)
    nearest = max(math.floor(difference * gain + 0.5), 0)
    low = max(nearest - reach, 0)
    prior, total, first, second = 1.0, 0.0, 0.0, 0.0
    base = (difference - nearest / gain) ** 2
    for k in range(low, nearest + reach + 1):
        residual = difference - k / gain
        weight = prior * math.exp(0.5 * precision * (base - residual * residual))
        total += weight
        first += weight * residual
        second += weight * residual * residual
        prior *= exposure / (k + 1.0)
    mean = first / total
    variance = second / total - mean * mean
    information = precision - variance * precision * precision
    return mean * precision, max(information, _LEAST_INFORMATION * precision)


@kernel
def find_offsets(
    frames: NDArray[Any],
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    variances: FloatArray,
    rows: FloatArray,
    columns: FloatArray,
    left: FloatArray,
) -> None:
    """Fill the most probable offsets of rows and columns of each frame, that of the frame with its rows.

    Offsets are normal with the given variances; 0 is no such offset. The log-likelihood of all pixels is
    expanded around the offsets, and the quadratic form is climbed by turns.

    Args:
        frames: DN, shape (frame, y, x).
        exposure: H to expect, e-, shape (y, x); NaN: a pixel that is left out.
        gain: g, e-/DN, shape (y, x).
        bias: mu, DN, shape (y, x).
        sigma: noise of the pixel alone, DN, shape (y, x).
        variances: of the offsets of frames, rows and columns, DN^2, shape (3,).
        rows: out, DN, shape (frame, y).
        columns: out, DN, shape (frame, x).
        left: out, variance of a sample's offset after all that is known, DN^2, shape (frame,).
    """
    n_frames, ny, nx = frames.shape
    slope, weight = np.empty((ny, nx)), np.empty((ny, nx))
    row, column = np.empty(ny), np.empty(nx)
    for t in range(n_frames):
        whole = 0.0
        row[:] = 0.0
        column[:] = 0.0
        for turn in range(_ROUNDS):
            for y in range(ny):
                for x in range(nx):
                    slope[y, x] = weight[y, x] = 0.0
                    if math.isnan(exposure[y, x]):
                        continue
                    difference = frames[t, y, x] - bias[y, x]
                    if turn == 0:  # from the means: they tell offsets beyond half an electron apart
                        step = 1.0 / gain[y, x]
                        weight[y, x] = 1.0 / (exposure[y, x] * step * step + sigma[y, x] ** 2)
                        slope[y, x] = weight[y, x] * (difference - exposure[y, x] * step)
                        continue
                    offset = whole + row[y] + column[x]
                    reach = 2 + math.ceil(4.0 * sigma[y, x] * gain[y, x])
                    score, information = _score(
                        difference - offset, exposure[y, x], gain[y, x], sigma[y, x], reach
                    )
                    # the quadratic form is that of the offset itself, not of its change
                    slope[y, x], weight[y, x] = score + information * offset, information
            for _ in range(_SWEEPS):
                if variances[0] > 0.0:
                    top, bottom = 0.0, 1.0 / variances[0]
                    for y in range(ny):
                        for x in range(nx):
                            top += slope[y, x] - weight[y, x] * (row[y] + column[x])
                            bottom += weight[y, x]
                    whole = top / bottom
                if variances[1] > 0.0:
                    for y in range(ny):
                        top, bottom = 0.0, 1.0 / variances[1]
                        for x in range(nx):
                            top += slope[y, x] - weight[y, x] * (whole + column[x])
                            bottom += weight[y, x]
                        row[y] = top / bottom
                if variances[2] > 0.0:
                    for x in range(nx):
                        top, bottom = 0.0, 1.0 / variances[2]
                        for y in range(ny):
                            top += slope[y, x] - weight[y, x] * (whole + row[y])
                            bottom += weight[y, x]
                        column[x] = top / bottom
        for y in range(ny):
            rows[t, y] = whole + row[y]
        for x in range(nx):
            columns[t, x] = column[x]
        total = 0.0
        for y in range(ny):
            for x in range(nx):
                total += weight[y, x]
        left[t] = 0.0
        sizes = (1, ny, nx)
        for i in range(3):
            if variances[i] > 0.0:
                left[t] += 1.0 / (total / sizes[i] + 1.0 / variances[i])
