"""Lines in the spectra of row and column means: where, how large, and whether they stand out.

The means of the readout residual are a field over frames t and lines y (rows or columns). A sine in it is
found in the periodogram over both, or, if its phase is new in every frame, in the periodogram over y alone,
averaged over frames (Bretthorst 1988: the periodogram is the likelihood of a single line in white noise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.types import AnyArray, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import FALSE_ALARM

# frames of a spectrum over frames and lines: enough to tell a line, and bounded memory
_MOST_CELLS = 1 << 24
# slow changes that are no lines: cosines of up to so many half periods per run
_SLOW_WAVES = 6
# frequencies along frames over which the noise is taken as one
_STRETCH = 128
# lowest frequencies along lines (at half the resolution's steps), each with a noise of its own
_FRAME_LIKE = 5


@dataclass(frozen=True)
class Line:
    """A line of a spectrum.

    Attributes:
        amplitude: of the sine in the means, DN.
        along: cycles per row (column).
        per_frame: cycles per frame; 0 for an incoherent line.
        phase: of the sine at row (column) 0 of frame 0, rad; 0 for an incoherent line.
        excess: how far its power stands out: log of the inverse chance of such a power, less the log of the
            number of places where it could have been.
    """

    amplitude: float
    along: float
    per_frame: float
    phase: float
    excess: float


def coherent_line(means: AnyArray, frames: IntArray, n_run: int) -> Line | None:
    """Return the highest line over frames and lines, or None where none stands out.

    What is constant in time (part of the bias map), drifts (slower than three cycles per run) and alternation
    (half the frame rate) are taken away first.

    Args:
        means: (n, lines), DN; lines with NaN do not count.
        frames: frame number of each, shape (n,); there may be gaps.
        n_run: number of frames of the run.
    """
    field, lines = _prepared(means)
    if field.shape[0] < 64 or field.shape[1] < 1:
        return None
    n_lines = 2 * means.shape[1] if means.shape[1] > 1 else 1
    length = min(n_run, max(64, _MOST_CELLS // n_lines))
    inside = frames - frames[0] < length
    numbers = frames[inside]
    field = _without_slow(field[inside], numbers)
    grid = np.zeros((length, n_lines), np.float32)
    grid[np.ix_(numbers - numbers[0], lines)] = field
    power = _half_plane(grid)
    ratio = power / _level(power)
    place = np.unravel_index(int(ratio.argmax()), ratio.shape)
    excess = float(ratio[place]) - np.log(ratio.size)
    if excess < -np.log(FALSE_ALARM):
        return None
    start = (float(np.fft.fftfreq(length)[place[0]]), float(place[1] / n_lines))
    return _refined(field, numbers, lines, start, (1.0 / length, 1.0 / n_lines), float(excess))


def incoherent_line(means: AnyArray) -> Line | None:
    """Return the highest line within frames whose phase is new in every frame, or None.

    Args:
        means: (n, lines), DN; lines with NaN do not count.
    """
    field, lines = _prepared(means)
    if field.shape[0] < 16 or field.shape[1] < 8:
        return None
    field = field - field.mean(axis=1, keepdims=True)
    n_lines = 4 * means.shape[1]
    power = _mean_power(field, lines, np.arange(n_lines // 2 + 1) / n_lines)
    # the mean of a frame is gone, and with it the lowest frequencies
    kept = slice(6, None)
    level = float(np.median(power[kept]))
    place = 6 + int(power[kept].argmax())
    sigma = (power[place] / level - 1.0) * np.sqrt(field.shape[0])
    excess = float(sigma**2 / 2.0 - np.log(n_lines / 2.0)) if sigma > 0 else 0.0
    if excess < -np.log(FALSE_ALARM):
        return None
    fine = np.clip((place + np.linspace(-1.0, 1.0, 41)) / n_lines, 0.0, 0.5)
    peaks = _mean_power(field, lines, fine)
    best = int(peaks.argmax())
    amplitude = 2.0 * np.sqrt(max(float(peaks[best]) - level, 0.0) / lines.size)
    return Line(float(amplitude), float(fine[best]), 0.0, 0.0, excess)


def _prepared(means: AnyArray) -> tuple[FloatArray, IntArray]:
    """Return the means of the lines that have pixels, constant pattern removed, and their numbers."""
    lines = np.flatnonzero(np.isfinite(means).all(axis=0))
    field = means[:, lines].astype(np.float64)
    return field - field.mean(axis=0), lines


def _half_plane(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the power at all frequencies along frames and the non-negative ones along lines."""
    spectrum = np.fft.fft(np.fft.rfft(grid, axis=1).astype(np.complex64), axis=0)
    return np.asarray(np.abs(spectrum) ** 2, np.float32)


def _without_slow(field: FloatArray, frames: IntArray) -> FloatArray:
    """Return the field without what no pickup does: the mean, slow changes and alternation of each line.

    They are fitted and not only left out of the spectrum, where gaps between the frames spread them widely.
    """
    position = (frames - frames[0]) / max(int(frames[-1] - frames[0]), 1)
    waves = [np.cos(np.pi * j * position) for j in range(_SLOW_WAVES + 1)]
    basis = np.linalg.qr(np.stack([*waves, 1.0 - 2.0 * (frames % 2)], axis=1))[0]
    return np.asarray(field - basis @ (basis.T @ field), np.float64)


def _level(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the noise power around each place, so that broad humps of the spectrum are no lines.

    By stretches of frequencies along frames: at each of the lowest frequencies along lines, where jumps and
    noise of frames are, and at all the others together. The median of exponentially distributed powers is
    log 2 of their mean.
    """
    level = np.empty_like(power)
    length = power.shape[0]
    for piece in np.array_split(np.arange(length), max(length // _STRETCH, 1)):
        level[piece, :_FRAME_LIKE] = np.median(power[piece, :_FRAME_LIKE], axis=0)
        if power.shape[1] > _FRAME_LIKE:
            level[piece, _FRAME_LIKE:] = np.median(power[piece, _FRAME_LIKE:])
    # what was fitted and taken away leaves holes: never less than half the typical level
    return np.asarray(np.maximum(level, np.float32(0.5) * np.median(level)) / np.log(2.0), np.float32)


def _mean_power(field: FloatArray, lines: IntArray, frequencies: FloatArray) -> FloatArray:
    """Return the power along the lines at these frequencies, averaged over frames, per line."""
    waves = np.exp(-2j * np.pi * np.outer(lines, frequencies))
    return np.asarray((np.abs(field @ waves) ** 2).mean(axis=0) / lines.size, np.float64)


def _refined(
    field: FloatArray,
    frames: IntArray,
    lines: IntArray,
    start: tuple[float, float],
    width: tuple[float, float],
    excess: float,
) -> Line:
    """Return the line near a peak of the spectrum: ever finer grids around the best place."""
    (f_frame, f_line), (w_frame, w_line) = start, width
    steps = np.linspace(-1.0, 1.0, 9)
    for _ in range(8):
        per_frame = f_frame + w_frame * steps
        along = f_line + w_line * steps if f_line else np.zeros(1)
        rows = field @ np.exp(-2j * np.pi * np.outer(lines, along))
        sums = np.exp(-2j * np.pi * np.outer(per_frame, frames)) @ rows
        i, j = np.unravel_index(int(np.abs(sums).argmax()), sums.shape)
        f_frame, f_line, best = float(per_frame[i]), float(along[j]), complex(sums[i, j])
        w_frame, w_line = w_frame / 2.5, w_line / 2.5
    # a sine is half the sum of two waves; at 0 and half a cycle per line and frame they fall together
    doubled = 1.0 if (f_line % 0.5 == 0.0 and f_frame % 0.5 == 0.0) else 2.0
    amplitude = doubled * abs(best) / field.size
    phase = float(np.angle(best) + np.pi / 2.0)
    if f_line == 0.0 and f_frame < 0.0:
        # along frames alone the negative frequency is the same line
        f_frame, phase = -f_frame, np.pi - phase
    return Line(amplitude, _wrapped(f_line), _wrapped(f_frame), phase, excess)


def _wrapped(frequency: float) -> float:
    """Return the same frequency within half a cycle on either side of 0."""
    return float((frequency + 0.5) % 1.0 - 0.5)
