"""The exact law of every pixel over its codes: channel tables, efficient scores, goodness, code residuals.

The mass of a code is that of the rounded PCD (differences of normal cdfs, Hendrickson et al. 2023, eq.
PCD_RV_definition), so that coarse quantisation is no discrepancy. The scores are Rao's efficient scores: the
part of a Hermite x Charlier polynomial that is orthogonal, in the Fisher metric of the mass, to the four
directions in which the parameters move it; to first order the fit does not matter for them. To second order
it does: with the parameters fitted by maximum likelihood their sum has the expectation ``-1/2 sum_ab cov(a,
b) sum_x psi(x) D_a D_b p(x)``, and second derivatives of p along these directions are polynomials again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe.tables_numba import (
    FOLD,
    N_TESTS,
    SINGULAR,
    CodeSums,
    Fits,
    Histograms,
    compare_pixels,
    supports,
)
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE
from pchem_pipeline.model.law.inputs import kernel_counts

_SMALLEST_WIDTH = 0.1  # DN: below it peaks are single codes
#: Pixels whose law covers more codes than this are not looked at.
_LONGEST_SUPPORT = 8192
_NEGLIGIBLE = 1e-5  # samples expected beyond the electron numbers considered, in all pixels
_LONGEST_AXIS = 1 << 17
_COARSE, _MOST_BINS = 16, 256

#: What the law and the samples of a pixel give: standard deviations of k and r by the law; with the samples
#: (those beyond the support count as its ends), k and r centred, means of k^2, r^2, k r, k r^2, k^2 r^2, r^4;
#: chi-square with its mean and variance, of codes and of groups as wide as the read noise; samples seen and
#: expected below and above the support, and far below and above it.
MOMENTS = np.dtype([
    *((name, np.float64) for name in ("charge_std", "readout_std", "kk", "rr", "kr", "krr", "kkrr", "rrrr")),
    *((name, np.float64, 3) for name in ("goodness", "peaks")),
    *((name, np.float64, 2) for name in ("low", "high", "far_low", "far_high")),
])  # fmt: skip


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of n pixels."""

    counts: CodeArray  # (n, B)
    origin: IntArray  # DN of bin 0, (n,)
    outside: FloatArray  # samples below and above the histogram, (n, 2)
    ends: NDArray[np.integer[Any]] | None = None  # smallest and largest code, DN, (2, n); None: of counts

    @classmethod
    def of(cls, frames: CodeArray) -> PixelHistograms:
        """Count the samples of each pixel of frames (frame, y, x), DN."""
        found = histogram_frames(frames)
        outside = np.stack([found.under.ravel(), found.over.ravel()], axis=1).astype(np.float64)
        ends = np.stack([found.minimum.ravel(), found.maximum.ravel()])
        counts = found.counts.reshape(-1, found.counts.shape[2])
        return cls(counts, found.origin.ravel().astype(np.int64), outside, ends)

    @classmethod
    def alone(cls, counts: CodeArray, origin: NDArray[np.integer[Any]]) -> PixelHistograms:
        """Take ready-made histograms (n, B) that hold all samples of their pixels."""
        return cls(counts, origin.astype(np.int64), np.zeros((len(counts), 2)))

    def extremes(self, some: BoolArray) -> tuple[int, int]:
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


class PixelLaws(NamedTuple):
    """What the fitted law of n pixels and their histograms give."""

    good: BoolArray  # pixels with a law, (n,); all else is meaningless elsewhere
    moments: NDArray[np.void]  # fields of :data:`MOMENTS`, (n,)
    scores: FloatArray  # standardised score, its skewness and its kurtosis excess, (n, 3, N_TESTS)
    support: IntArray  # first DN, number of codes, first row in ``tables``, (n, 3); (0, 1, 0) where not good
    tables: Float32Array  # k (e-) and r (DN) of codes, less their mean over the samples, (rows, 2)
    codes: CodeSums  # sums over all pixels


def pixel_laws(seen: PixelHistograms, parameters: FloatArray, usable: BoolArray) -> PixelLaws:
    """Compare the histogram of every usable pixel, of n, with its fitted law.

    The parameters are H, g, mu, sigma (with quantisation), (n, 4), anything where not usable.
    """
    n = usable.size
    # harmless numbers for unusable pixels
    exposure, gain, bias, sigma = np.where(usable[:, None], parameters, [1.0, 1.0, 0.0, 1.0]).T
    natural = np.ascontiguousarray(np.stack([exposure, 1.0 / gain, bias, analog_width(sigma)], axis=1))
    fits = Fits(natural, np.zeros((n, 2), np.int64), np.zeros((n, 2), np.int64))
    samples = float(seen.counts.sum(axis=1).max(initial=1)) + float(seen.outside.sum(axis=1).max(initial=0.0))
    supports(natural, np.log(_NEGLIGIBLE / (samples * n)), fits.electrons, fits.codes)
    length = fits.codes[:, 1] - fits.codes[:, 0] + 1
    good = usable & (length <= _LONGEST_SUPPORT)
    axis, n_codes = _code_axis(fits.codes[good])
    coarse = _COARSE
    while n_codes > coarse * _MOST_BINS:
        coarse *= 2
    n_bins = n_codes // coarse + 1
    codes = CodeSums(
        first=axis,
        coarse=coarse,
        single=np.zeros((4, n_codes)),
        fold=np.zeros(FOLD),
        fold_covariance=np.zeros((FOLD, FOLD)),
        bins=np.zeros((3, n_bins)),
        bin_covariance=np.zeros((n_bins, n_bins)),
    )
    moments, support = np.zeros(n, MOMENTS), np.tile(np.array([0, 1, 0]), (n, 1))
    tables = np.zeros((1 + int(length[good].sum()), 2), np.float32)
    factors, sums = np.zeros((n, N_NUISANCE, N_COLUMNS)), np.zeros((n, N_TESTS, N_TESTS + 3))
    histograms = Histograms(kernel_counts(seen.counts), seen.origin, seen.outside)
    compare_pixels(histograms, fits, good, moments, factors, sums, support, tables, codes)
    scores = np.full((n, 3, N_TESTS), np.nan)
    inside = seen.samples - moments["low"][:, 0] - moments["high"][:, 0]
    scores[good] = efficient_scores(sums[good], factors[good], inside[good], exposure[good])
    return PixelLaws(good, moments, scores, support, tables, codes)


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


def efficient_scores(
    sums: FloatArray, factors: FloatArray, samples: FloatArray, exposure: FloatArray
) -> FloatArray:
    """Compute the standardised efficient scores of the samples, their skewness and kurtosis, (n, 3, N_TESTS).

    NaN where a score has no variance. The sums are (n, N_TESTS, N_TESTS + 3), see `tables_numba`, the factors
    of the whitening (n, N_NUISANCE, N_COLUMNS), samples and exposures (H, e-) of each pixel (n,).
    """
    products, (total, third, fourth) = sums[:, :, :N_TESTS], np.moveaxis(sums[:, :, N_TESTS:], 2, 0)
    variance, samples = np.einsum("pii->pi", products), samples[:, None]
    bias = -0.5 * np.einsum("jp,pij->pi", _curvature(_fit_covariance(factors), exposure), products)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = [
            (total - bias) / np.sqrt(samples * variance),
            third / (variance * np.sqrt(variance * samples)),
            (fourth / variance**2 - 3.0) / samples,
        ]
    known = (variance > SINGULAR) & (samples > 0.0)
    return np.asarray(np.where(known, found, np.nan).transpose(1, 0, 2))


def _fit_covariance(factors: FloatArray) -> FloatArray:
    """Return the covariance of the fit, times the samples, along C1, He1, He1 C1, He2, (4, 4, n)."""
    of_fit = factors[:, 1:, 1:N_NUISANCE]
    known = np.diagonal(of_fit, axis1=1, axis2=2) > 0.0
    both = known[:, :, None] & known[:, None, :]
    inverse = np.linalg.inv(np.where(both, of_fit, np.eye(N_NUISANCE - 1))) * both
    return np.asarray(np.einsum("pik,pjk->ijp", inverse, inverse))


def _curvature(covariance: FloatArray, exposure: FloatArray) -> FloatArray:
    """Return the coefficients of the tests in ``sum_ab cov(a, b) D_a D_b p``, in their order, (N_TESTS, n).

    D_a multiplies the terms of the law by C1, He1, He1 C1, He2. Of their products only what the parameters do
    not span matters.
    """
    c, root2 = covariance, np.sqrt(2.0)
    return np.stack([
        root2 * c[0, 0],  # C2
        np.zeros_like(exposure),  # C3
        2.0 * c[1, 3],  # He3
        c[3, 3],  # He4
        2.0 * (c[0, 3] + c[1, 2]) + c[2, 2] / np.sqrt(exposure),  # He2C1
        2.0 * root2 * c[0, 2],  # He1C2
        root2 * c[2, 2],  # He2C2
        2.0 * c[2, 3],  # He3C1
    ])  # fmt: skip
