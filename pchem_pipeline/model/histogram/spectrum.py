"""The spectrum of the samples of a frame over rows and columns: what is picked up while they are read.

Noise that runs on from sample to sample, with as much from row to row, is one wave across the frame, whatever
the gap between rows. Where each row, or column, has a phase of its own, the power averaged over the lines of
a frame shows it. The samples of each pixel are standardised; without such noise the mean power over T frames
is 1 at every frequency, with a standard deviation of 1/sqrt(T) (Fisher 1929).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import fft, ndimage, special

from pchem_pipeline.base.arrays import CodeArray

#: Samples that are looked at, of the first frames.
MOST_SAMPLES = 1 << 22
#: Rows and columns that a spectrum needs; frames of a series in time likewise.
FEWEST_LINES = 8
#: Factor by which zeros lengthen either axis of a frame: the step between frequencies is so much smaller.
_PADDED = 2
#: Frequencies on either side, along rows or columns, whose median is the noise of the one in their middle.
_AROUND = 3 * _PADDED
#: Fraction of the power of a wave midway between two frequencies, along either axis, that one of them shows.
SEEN_MIDWAY = float(np.sinc(0.5 / _PADDED)) ** 4


class FrameSpectrum:
    """The mean power of the frames that come in, of the same rows each."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """Begin with no frames of some rows and columns."""
        self._shape = _PADDED * shape[0], _PADDED * shape[1]
        self._power = np.zeros((max(self._shape[0] - 1, 0), self._shape[1] // 2))
        self.most = MOST_SAMPLES // max(shape[0] * shape[1], 1) if min(shape) >= FEWEST_LINES else 0
        self._n, self._pixels, self._sd = 0, 0, 0.0
        self._lines = [np.zeros((2, length // 2)) for length in shape]

    def add(self, frames: CodeArray) -> None:
        """Add frames, (frame, y, x), until enough have come."""
        frames = frames[: self.most - self._n]
        if len(frames) < 2:
            return
        u = frames.astype(np.float32)
        u -= u.mean(axis=0)
        sd = np.sqrt(np.mean(u * u, axis=0))
        weight = np.divide(1.0, sd, where=sd > 0, out=np.zeros_like(sd))  # none is a frame
        u *= weight
        # an offset of a frame, and other light, which moves pixels as their variances are, are no waves
        q = np.linalg.qr(np.stack([weight, sd], axis=-1).reshape(-1, 2))[0]
        flat = u.reshape(len(u), -1)
        flat -= (flat @ q) @ q.T
        rest = np.sqrt(np.mean(u * u, axis=0))
        u /= np.where(rest > 0, rest, 1.0)
        sd *= rest
        for frame in u:
            wave = fft.rfft2(frame, self._shape)[1:, 1:]
            self._power += wave.real**2 + wave.imag**2
        for axis, lines in enumerate(self._lines):
            spectra = fft.rfft(u, axis=axis + 1).swapaxes(1, axis + 1)[:, 1:]
            power = sum(np.einsum("tkl,tkl->tk", part, part) for part in (spectra.real, spectra.imag))
            power /= max(np.count_nonzero(sd), 1)
            lines += power.sum(axis=0), (power**2).sum(axis=0)
        self._n += len(frames)
        self._pixels, self._sd = int(np.count_nonzero(sd)), float(np.median(sd))

    def line(self) -> dict[str, float]:
        """Return the frequency that stands out most of those around it; empty where nothing was looked at.

        ``ratio`` is its mean power over that of the noise, ``frames`` of how many, the largest of so many
        ``cells``; ``size`` is the root mean square of its wave, DN, and ``unit`` that of a power of 1.
        """
        if not self._n or not self._pixels:
            return {}
        power = self._power / (self._n * self._pixels)
        rows, columns = self._shape
        power[rows // 2 - 1, -1] /= 2.0  # a real wave, of one phase
        filters = ((2 * _AROUND + 1, 1), (1, 2 * _AROUND + 1))
        noise = np.maximum.reduce(
            [*(ndimage.median_filter(power, size) for size in filters), np.ones_like(power)]
        )
        ratio = power / noise
        y, x = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
        # a wave between two frequencies is in those around both
        near, wide = (
            power[max(y - r, 0) : y + r + 1, max(x - r, 0) : x + r + 1] for r in (2 * _PADDED, 7 * _PADDED)
        )
        excess = (float(near.sum()) - near.size * float(np.median(wide))) / _PADDED**2
        unit = self._sd * (2.0 / self._pixels) ** 0.5
        return {
            "ratio": float(ratio[y, x]),
            "cells": float(ratio.size),
            "frames": float(self._n),
            "size": unit * max(excess, 0.0) ** 0.5,
            "unit": unit,
            "cycles_per_row": ((y + 1) / rows + 0.5) % 1.0 - 0.5,
            "cycles_per_column": (x + 1) / columns,
            **self._of_lines(),
        }

    def _of_lines(self) -> dict[str, float]:
        """Return the frequency along rows, or columns, that stands out most if each line has its own phase.

        A mean over frames is compared with its standard error (Student's test); what raises all frequencies
        alike, or with their cosine (neighbours that are correlated), is taken off.
        """
        looks = float(sum(lines.shape[1] for lines in self._lines))
        best = {"line_p": math.inf}
        for name, length, lines in zip(("row", "column"), self._shape, self._lines, strict=True):
            length //= _PADDED
            mean = lines[0] / self._n
            error = np.sqrt(np.maximum(lines[1] / self._n - mean**2, 1e-300) / (self._n - 1.0))
            cycles = np.arange(1, mean.size + 1) / length
            smooth = np.stack([np.ones(mean.size), np.cos(2.0 * np.pi * cycles)], axis=1) / error[:, None]
            q = np.linalg.qr(smooth)[0]
            scaled = mean / error
            rest = scaled - q @ (q.T @ scaled)
            z = rest / np.sqrt(np.maximum(1.0 - (q**2).sum(axis=1), 1e-6))
            at = int(z.argmax())
            p = float(special.stdtr(self._n - 1.0, -z[at]))
            if p < best["line_p"]:
                near = np.maximum((rest * error)[max(at - 1, 0) : at + 2], 0.0)
                real = 1.0 if 2 * (at + 1) == length else 2.0
                size = self._sd * (real * float(near.sum()) / length) ** 0.5
                best = {"line_p": p, "line_size": size, f"line_cycles_per_{name}": float(cycles[at])}
        return {**best, "line_looks": looks}
