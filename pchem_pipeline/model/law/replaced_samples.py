"""The law of samples of which some come out as another number of their frame.

Where a sample x exceeds what stands in for it, y, by more than t, a share s of the time y comes out. Both are
independent, and so

``P(v) = P(x = v) [1 - s P(y < v - t)] + s P(y = v) P(x > v + t)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray, IntegerArray


@dataclass(frozen=True)
class ReplacedSamples:
    """What becomes of the samples of n pixels, by their code."""

    stays: FloatArray  # chance that a sample comes out as it is, at successive codes, shape (n, c)
    comes: FloatArray  # chance that y is that code, times s, shape (n, c)
    excess: IntegerArray  # t, DN, or c where that is less, shape (n,)

    @classmethod
    def by(
        cls, values: IntegerArray, excess: IntegerArray, share: FloatArray, first: IntegerArray, n_codes: int
    ) -> ReplacedSamples:
        """Return it by a sample of what stands in for each pixel: y, DN, shape (frame, n).

        With t, DN, and s of each pixel, (n,), for so many codes from the first of each on, DN, (n,).
        """
        n_frames, n = values.shape
        stays, comes = np.empty((n, n_codes)), np.empty((n, n_codes))
        for i, (own, t, s) in enumerate(zip(values.T, excess, share, strict=True)):
            codes = first[i] + np.arange(n_codes)
            below, to, beyond = np.searchsorted(np.sort(own), [codes - t, codes, codes + 1]) / n_frames
            stays[i], comes[i] = 1.0 - s * below, s * (beyond - to)
        # no sample lies beyond the codes
        return cls(stays, comes, np.minimum(excess, n_codes))

    def of(self, pixels: IndexArray | BoolArray | slice) -> ReplacedSamples:
        """Return it for some of the pixels."""
        return ReplacedSamples(self.stays[pixels], self.comes[pixels], self.excess[pixels])

    def mass_and_slopes(self, mass: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mass of the codes that come out, (n, c), and its slopes, (n, a, c).

        Those given are of the samples, DN by DN, at least c + the largest excess of them.
        """
        width = self.stays.shape[1]
        values = np.concatenate([mass[:, None], slopes], axis=1)
        place = np.arange(width) + self.excess[:, None]
        below = np.take_along_axis(np.cumsum(values, axis=2), place[:, None], axis=2)
        total = np.zeros((values.shape[1], 1))
        total[0] = 1.0  # of a mass; that of a slope is 0
        found = self.stays[:, None] * values[:, :, :width] + self.comes[:, None] * (total - below)
        return found[:, 0], found[:, 1:]
