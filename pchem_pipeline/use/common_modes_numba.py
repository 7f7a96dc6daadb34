"""Loops that find the offset of each frame, row and column of known pixels."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ROUNDS = 5  # of the expansion in the offsets
_SWEEPS = 4  # of frame, rows and columns within one
_LEAST_INFORMATION = 0.05  # of that of a sample whose electron number is known


class Waves(NamedTuple):
    """Periodic patterns: the angle of a sample is the sum of those of its row and of its column.

    Attributes:
        down: cosine and sine of the angle of each row, shape (wave, 2, y).
        along: of each column, shape (wave, 2, x).
        variances: of the coefficients of cosine and sine, DN^2, shape (wave,).
        parts: number of the part of the sensor, shape (wave,).
    """

    down: FloatArray
    along: FloatArray
    variances: FloatArray
    parts: NDArray[np.int64]


class Pixels(NamedTuple):
    """What is known of the pixels, shape (y, x) each.

    Attributes:
        exposure: H to expect, e-; NaN: a pixel that is left out.
        gain: g, e-/DN.
        bias: mu, DN.
        sigma: noise of the pixel alone, DN.
    """

    exposure: FloatArray
    gain: FloatArray
    bias: FloatArray
    sigma: FloatArray


class Modes(NamedTuple):
    """Which offsets there are.

    Attributes:
        parts: pixels that share offsets, shape (part, y, x).
        variances: of the offsets of frames, rows and columns of each part, DN^2, shape (part, 3).
        waves: periodic patterns.
    """

    parts: BoolArray
    variances: FloatArray
    waves: Waves


class Offsets(NamedTuple):
    """Offsets of frames.

    Attributes:
        rows: DN, that of the whole frame with it, shape (frame, part, y).
        columns: DN, shape (frame, part, x).
        coefficients: of cosine and sine of the waves, DN, shape (frame, wave, 2).
        left: variance of a sample's offset after all that is known, DN^2, shape (frame, part).
    """

    rows: FloatArray
    columns: FloatArray
    coefficients: FloatArray
    left: FloatArray


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
def _from_means(frame: NDArray[Any], pixels: Pixels, form: FloatArray) -> None:
    """Fill the quadratic form of the offsets by the means of the samples.

    They tell offsets beyond half an electron apart.
    """
    exposure, gain, bias, sigma = pixels
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if not math.isnan(exposure[y, x]):
                step = 1.0 / gain[y, x]
                form[1, y, x] = 1.0 / (exposure[y, x] * step * step + sigma[y, x] ** 2)
                form[0, y, x] = form[1, y, x] * (frame[y, x] - bias[y, x] - exposure[y, x] * step)


@kernel
def _from_electrons(frame: NDArray[Any], pixels: Pixels, offset: FloatArray, form: FloatArray) -> None:
    """Fill the quadratic form of the offsets by the electron numbers of the samples, around some offsets."""
    exposure, gain, bias, sigma = pixels
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if math.isnan(exposure[y, x]):
                continue
            reach = 2 + math.ceil(4.0 * sigma[y, x] * gain[y, x])
            difference = frame[y, x] - bias[y, x] - offset[y, x]
            score, information = _score(difference, exposure[y, x], gain[y, x], sigma[y, x], reach)
            # the form is that of the offset itself, not of its change
            form[0, y, x], form[1, y, x] = score + information * offset[y, x], information


@kernel
def _add(
    mask: BoolArray, sign: float, whole: float, row: FloatArray, column: FloatArray, out: FloatArray
) -> None:
    """Add the offsets of a part of the sensor to those of its samples."""
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                out[y, x] += sign * (whole + row[y] + column[x])


@kernel
def _of_part(form: FloatArray, mask: BoolArray, offset: FloatArray, out: FloatArray) -> None:
    """Fill the form of what a part's pixels share, the offsets of all other parts held."""
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            weight = form[1, y, x] if mask[y, x] else 0.0
            out[1, y, x] = weight
            out[0, y, x] = form[0, y, x] - weight * offset[y, x] if mask[y, x] else 0.0


@kernel
def _climb_parts(
    form: FloatArray,
    modes: Modes,
    whole: FloatArray,
    lines: tuple[FloatArray, FloatArray, FloatArray],
    offset: FloatArray,
    own: FloatArray,
) -> None:
    """Bring the offsets of all parts to the top of a quadratic form, part by part, wave by wave.

    Args:
        form: of the samples, shape (2, y, x).
        modes: which offsets there are.
        whole: in and out, of the frame, shape (part,).
        lines: in and out, of the rows, of the columns, and coefficients of the waves.
        offset: in and out, of the samples, shape (y, x).
        own: working memory, shape of the form.
    """
    parts, variances, waves = modes
    rows, columns, coefficients = lines
    for _ in range(1 if len(parts) + len(coefficients) == 1 else _SWEEPS):
        for wave in range(len(coefficients)):
            _climb_wave(form, parts[waves.parts[wave]], waves, wave, coefficients[wave], offset)
        for part in range(len(parts)):
            mask, row, column = parts[part], rows[part], columns[part]
            _add(mask, -1.0, whole[part], row, column, offset)
            _of_part(form, mask, offset, own)
            whole[part] = _climb(own, variances[part], whole[part], row, column)
            _add(mask, 1.0, whole[part], row, column, offset)


@kernel
def _climb_wave(
    form: FloatArray,
    mask: BoolArray,
    waves: Waves,
    wave: int,
    coefficients: FloatArray,
    offset: FloatArray,
) -> None:
    """Bring the two coefficients of a wave to the top, all else held; move the offsets of its samples."""
    down, along = waves.down[wave], waves.along[wave]
    both = across = other = 0.0  # sums of the squares of cosine and sine, and of their product
    top_c = top_s = 0.0
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                c = down[0, y] * along[0, x] - down[1, y] * along[1, x]
                s = down[1, y] * along[0, x] + down[0, y] * along[1, x]
                weight = form[1, y, x]
                rest = offset[y, x] - coefficients[0] * c - coefficients[1] * s
                slope = form[0, y, x] - weight * rest
                top_c, top_s = top_c + slope * c, top_s + slope * s
                both, across, other = both + weight * c * c, across + weight * c * s, other + weight * s * s
    both, other = both + 1.0 / waves.variances[wave], other + 1.0 / waves.variances[wave]
    size = both * other - across * across
    move_c = (other * top_c - across * top_s) / size - coefficients[0]
    move_s = (both * top_s - across * top_c) / size - coefficients[1]
    coefficients[0] += move_c
    coefficients[1] += move_s
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                c = down[0, y] * along[0, x] - down[1, y] * along[1, x]
                s = down[1, y] * along[0, x] + down[0, y] * along[1, x]
                offset[y, x] += move_c * c + move_s * s


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
def _unknown(weight: FloatArray, mask: BoolArray, variances: FloatArray) -> float:
    """Return the variance of a sample's offset after all that is known, DN^2."""
    ny, nx = mask.shape
    found = 0.0
    total, n_rows = 0.0, 0
    crossed = np.zeros(nx, np.bool_)
    for y in range(ny):
        some = False
        for x in range(nx):
            if mask[y, x]:
                total += weight[y, x]
                some = crossed[x] = True
        n_rows += some
    sizes = (1, max(n_rows, 1), max(crossed.sum(), 1))
    for i in range(3):
        if variances[i] > 0.0:
            found += 1.0 / (total / sizes[i] + 1.0 / variances[i])
    return found


@kernel
def find_offsets(frames: NDArray[Any], pixels: Pixels, modes: Modes, out: Offsets) -> None:
    """Fill the most probable offsets of rows, columns and waves of each frame.

    That of the whole frame is with its rows. Offsets are normal with the given variances; 0 is no such
    offset. The log-likelihood of all pixels is expanded around the offsets, and the quadratic form is climbed
    by turns.

    Args:
        frames: DN, shape (frame, y, x).
        pixels: what is known of them.
        modes: which offsets there are.
        out: out.
    """
    parts, variances, waves = modes
    n_parts, ny, nx = parts.shape
    form, own, offset = np.empty((2, ny, nx)), np.empty((2, ny, nx)), np.empty((ny, nx))
    whole = np.empty(n_parts)
    for t in range(len(frames)):
        whole[:] = 0.0
        lines = out.rows[t], out.columns[t], out.coefficients[t]
        for line in lines:
            line[:] = 0.0
        offset[:] = 0.0
        _from_means(frames[t], pixels, form)
        _climb_parts(form, modes, whole, lines, offset, own)
        for _ in range(_ROUNDS - 1):
            _from_electrons(frames[t], pixels, offset, form)
            _climb_parts(form, modes, whole, lines, offset, own)
        for part in range(n_parts):
            out.rows[t, part] += whole[part]
            out.left[t, part] = _unknown(form[1], parts[part], variances[part])
        for wave, part in enumerate(waves.parts):
            # each coefficient is known by half of the samples' information, and cos^2 + sin^2 = 1
            known = 0.5 * np.sum(form[1] * parts[part])
            out.left[t, part] += 1.0 / (known + 1.0 / waves.variances[wave])
