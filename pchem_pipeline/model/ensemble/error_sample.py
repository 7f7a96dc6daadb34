"""Pixels that stand for all where the errors of a predicted curve are summed over the sensor.

The variance of a curve by the errors of the maps is a sum over pixels. A standard error need not be known to
better than a per cent of itself, so of a large sensor some pixels are enough: each is taken with a known
probability and counts for its inverse (Horvitz and Thompson 1952), the more probably the larger its errors
are, so that the few that fit badly do not decide by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.model.errors.expected_information import covariance_from
from pchem_pipeline.model.law.parameters import UsablePixels

#: Pixels of ordinary errors that are taken of a sensor. The variances that they add scatter by 1.4 times the
#: mean: 16,384 give the standard error of a curve to 0.6 % of itself (4 % at its ends, where few add much).
WANTED = 1 << 14
#: Sum over the four parameters of their variances over those of resolved peaks: what half of the pixels of a
#: sensor with a read noise of 0.3 e- stay below.
_ORDINARY = 20.0
#: Places that follow each other by this part of a cycle are spread as evenly as can be.
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class PixelErrors:
    """Errors of the maps of n pixels.

    Attributes:
        stderr: of (H, g, mu, sigma), shape (n, 4); NaN where not known.
        correlation: of the estimates, shape (n, 6).
        place: number of each pixel on the sensor, shape (n,): which ones are taken depends on no tile.
        share: of ordinary pixels that is taken.
    """

    stderr: FloatArray
    correlation: FloatArray
    place: IntArray
    share: float = 1.0

    def of(self, pixels: BoolArray | IntArray) -> PixelErrors:
        """Return those of some pixels."""
        return PixelErrors(self.stderr[pixels], self.correlation[pixels], self.place[pixels], self.share)

    def sampled(self, pixels: UsablePixels, samples: IntegerArray) -> tuple[BoolArray, FloatArray]:
        """Return which pixels are taken, (n,), and their covariances, each times the pixels it stands for.

        The parameters of the pixels are given, and the number of samples behind each, shape (n,).
        """
        chance = np.clip(self.share * self._badness(pixels, samples), self.share, 1.0)
        some = self.place * _GOLDEN % 1.0 < chance
        covariance = covariance_from(self.stderr[some], self.correlation[some])
        return some, covariance / chance[some, None, None]

    def _badness(self, pixels: UsablePixels, samples: IntegerArray) -> FloatArray:
        """Return how many times larger than ordinary the variances are."""
        exposure, gain, _, sigma = pixels.maps
        noise = sigma**2
        per_sample = (
            1.0 / np.maximum(exposure, 1e-3),
            exposure * (1.0 + exposure) / (gain**4 * noise),
            1.0 / noise,
            2.0 / noise,
        )
        known = np.nan_to_num(self.stderr**2, posinf=0.0)
        return np.asarray(samples / _ORDINARY * np.sum(known.T * np.stack(per_sample), axis=0))
