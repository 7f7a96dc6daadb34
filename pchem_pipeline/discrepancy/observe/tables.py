"""The exact law of every pixel over its codes: channel tables, efficient scores, goodness, code residuals.

The mass of a code is that of the rounded PCD (differences of normal cdfs, Hendrickson et al. 2023, eq.
PCD_RV_definition), so that coarse quantisation is no discrepancy. The scores are Rao's efficient scores: the
part of a Hermite x Charlier polynomial that is orthogonal, in the Fisher metric of the mass, to the four
directions in which the parameters move it; to first order the fit does not matter for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe import tables_numba as kernel
from pchem_pipeline.discrepancy.observe.law_numba import N_TESTS, supports
from pchem_pipeline.discrepancy.observe.tables_numba import CodeSums, Fitted, PixelLaws
from pchem_pipeline.model.histogram.count import histogram_frames

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SMALLEST_WIDTH = 0.1  # DN: below it peaks are single codes
_ALLOWED = 1e-2  # samples expected beyond the codes of a pixel, on either side, at most
#: Pixels whose law covers more codes than this are not looked at.
_LONGEST_SUPPORT = 8192
_NEGLIGIBLE = 1e-5  # samples expected beyond the electron numbers considered, in all pixels
_LONGEST_AXIS = 1 << 17
_COARSE, _MOST_BINS = 16, 256


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of n pixels.

    Attributes:
        counts: (n, B).
        origin: DN of bin 0, (n,).
        outside: samples below and above the histogram, (n, 2).
        ends: smallest and largest code of each, DN, (2, n); None: those of the histograms.
    """

    counts: NDArray[np.unsignedinteger[Any]]
    origin: IntArray
    outside: FloatArray
    ends: NDArray[np.integer[Any]] | None = None

    @classmethod
    def of(cls, frames: NDArray[np.unsignedinteger[Any]]) -> PixelHistograms:
        """Count the samples of each pixel of frames (frame, y, x), DN."""
        found = histogram_frames(frames)
        outside = np.stack([found.under.ravel(), found.over.ravel()], axis=1).astype(np.float64)
        ends = np.stack([found.minimum.ravel(), found.maximum.ravel()])
        counts = found.counts.reshape(-1, found.counts.shape[2])
        return cls(counts, found.origin.ravel().astype(np.int64), outside, ends)

    @classmethod
    def alone(
        cls, counts: NDArray[np.unsignedinteger[Any]], origin: NDArray[np.integer[Any]]
    ) -> PixelHistograms:
        """Take ready-made histograms (n, B) that hold all samples of their pixels."""
        return cls(counts, origin.astype(np.int64), np.zeros((len(counts), 2)))

    def extremes(self, some: NDArray[np.bool_]) -> tuple[int, int]:
        """Return the smallest and the largest code of some pixels, (n,), DN."""
        if self.ends is not None:
            return int(self.ends[0, some].min()), int(self.ends[1, some].max())
        filled, origin = self.counts[some] > 0, self.origin[some]
        last = origin + filled.shape[1] - 1 - np.argmax(filled[:, ::-1], axis=1)
        return int((origin + np.argmax(filled, axis=1)).min()), int(last.max())

    @property
    def samples(self) -> FloatArray:
        """Samples of each pixel, those outside included, (n,)."""
        return np.asarray(self.counts.sum(axis=1) + self.outside.sum(axis=1))


def pixel_laws(seen: PixelHistograms, parameters: FloatArray, usable: NDArray[np.bool_]) -> PixelLaws:
    """Compare the histogram of every usable pixel with its fitted law.

    Args:
        seen: histograms of n pixels.
        parameters: H, g, mu, sigma (with quantisation), (n, 4); anything where not usable.
        usable: pixels to look at, (n,).
    """
    n = usable.size
    natural = _natural(parameters, usable)
    window, electrons = np.zeros((n, 2), np.int64), np.zeros((n, 2), np.int64)
    samples = float(seen.counts.sum(axis=1).max(initial=1)) + float(seen.outside.sum(axis=1).max(initial=0.0))
    supports(*np.ascontiguousarray(natural.T), np.log(_NEGLIGIBLE / (samples * n)), electrons, window)
    length = window[:, 1] - window[:, 0] + 1
    good = usable & (length <= _LONGEST_SUPPORT)
    axis, n_codes = _code_axis(window[good])
    coarse = _COARSE
    while n_codes > coarse * _MOST_BINS:
        coarse *= 2
    n_bins = n_codes // coarse + 1
    codes = CodeSums(
        first=axis,
        coarse=coarse,
        single=np.zeros((4, n_codes)),
        fold=np.zeros(kernel.FOLD),
        fold_covariance=np.zeros((kernel.FOLD, kernel.FOLD)),
        bins=np.zeros((3, n_bins)),
        bin_covariance=np.zeros((n_bins, n_bins)),
    )
    laws = PixelLaws(
        good=good,
        moments=np.zeros((n, kernel.N_MOMENTS)),
        scores=np.full((n, 3, N_TESTS), np.nan),
        support=np.tile(np.array([0, 1, 0]), (n, 1)),
        tables=np.zeros((1 + int(length[good].sum()), 2), np.float32),
        codes=codes,
    )
    fitted = Fitted(seen.counts, seen.origin, seen.outside, natural, electrons, window)
    kernel.summarise_pixels(fitted, _ALLOWED, _ALLOWED / max(int(good.sum()), 1), laws)
    for covariance in (codes.fold_covariance, codes.bin_covariance):
        covariance += np.tril(covariance, -1).T
    return laws


def _natural(parameters: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    """Return H, 1/g (DN), mu and the analog read noise (DN); harmless numbers for unusable pixels."""
    exposure, gain, bias, sigma = np.where(usable[:, None], parameters, [1.0, 1.0, 0.0, 1.0]).T
    return np.ascontiguousarray(np.stack([exposure, 1.0 / gain, bias, analog_width(sigma)], axis=1))


def analog_width(sigma: FloatArray) -> FloatArray:
    """Return the analog read noise of a read noise with quantisation, DN; not below that of single codes."""
    return np.asarray(np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, _SMALLEST_WIDTH**2)))


def _code_axis(window: IntArray) -> tuple[int, int]:
    """Return the first DN and the length of the axis that holds the windows, or most of them."""
    if window.size == 0:
        return 0, 1
    first, last = int(window[:, 0].min()), int(window[:, 1].max())
    if last - first >= _LONGEST_AXIS:
        first = max(first, int(np.median(window[:, 0])) - _LONGEST_AXIS // 2)
        last = min(last, first + _LONGEST_AXIS - 1)
    return first, last - first + 1
