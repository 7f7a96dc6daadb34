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
def _from_means(
    frame: NDArray[Any],
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    form: FloatArray,
) -> None:
    """Fill the quadratic form of the offsets by the means of the samples.

    They tell offsets beyond half an electron apart.
    """
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if not math.isnan(exposure[y, x]):
                step = 1.0 / gain[y, x]
                form[1, y, x] = 1.0 / (exposure[y, x] * step * step + sigma[y, x] ** 2)
                form[0, y, x] = form[1, y, x] * (frame[y, x] - bias[y, x] - exposure[y, x] * step)


@kernel
def _from_electrons(
    frame: NDArray[Any],
    exposure: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    sigma: FloatArray,
    offsets: tuple[float, FloatArray, FloatArray],
    form: FloatArray,
) -> None:
    """Fill the quadratic form of the offsets by the electron numbers of the samples, around some offsets."""
    whole, row, column = offsets
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if math.isnan(exposure[y, x]):
                continue
            offset = whole + row[y] + column[x]
            reach = 2 + math.ceil(4.0 * sigma[y, x] * gain[y, x])
            difference = frame[y, x] - bias[y, x] - offset
            score, information = _score(difference, exposure[y, x], gain[y, x], sigma[y, x], reach)
            # the form is that of the offset itself, not of its change
            form[0, y, x], form[1, y, x] = score + information * offset, information


@kernel
def _climb(
    form: FloatArray, variances: FloatArray, whole: float, row: FloatArray, column: FloatArray
) -> float:
    """Bring the offsets of rows and columns to the top of a quadratic form, by turns; return the frame's."""
    slope, weight = form[0], form[1]
    _, ny, nx = form.shape
    for _ in range(_SWEEPS):
        if variances[0] > 0.0:
            top, bottom = 0.0, 1.0 / variances[0]
            for y in range(ny):
                for x in range(nx):
                    top += slope[y, x] - weight[y, x] * (row[y] + column[x])
                    bottom += weight[y, x]
            whole = top / bottom
        if variances[1] > 0.0:
            _climb_lines(slope, weight, 1.0 / variances[1], whole, column, row)
        if variances[2] > 0.0:
            _climb_lines(slope.T, weight.T, 1.0 / variances[2], whole, row, column)
    return whole


@kernel
def _climb_lines(
    slope: FloatArray, weight: FloatArray, precision: float, whole: float, across: FloatArray, out: FloatArray
) -> None:
    """Bring the offsets of the lines of the first axis to the top, those of frame and crossing lines held."""
    for i in range(slope.shape[0]):
        top, bottom = 0.0, precision
        for j in range(slope.shape[1]):
            top += slope[i, j] - weight[i, j] * (whole + across[j])
            bottom += weight[i, j]
        out[i] = top / bottom


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
    form = np.empty((2, ny, nx))
    row, column = np.empty(ny), np.empty(nx)
    sizes = (1, ny, nx)
    for t in range(n_frames):
        row[:] = 0.0
        column[:] = 0.0
        _from_means(frames[t], exposure, gain, bias, sigma, form)
        whole = _climb(form, variances, 0.0, row, column)
        for _ in range(_ROUNDS - 1):
            _from_electrons(frames[t], exposure, gain, bias, sigma, (whole, row, column), form)
            whole = _climb(form, variances, whole, row, column)
        for y in range(ny):
            rows[t, y] = whole + row[y]
        for x in range(nx):
            columns[t, x] = column[x]
        total = form[1].sum()
        left[t] = 0.0
        for i in range(3):
            if variances[i] > 0.0:
                left[t] += 1.0 / (total / sizes[i] + 1.0 / variances[i])
