"""The exact law of every pixel over its codes: channel tables, efficient scores, goodness, code residuals.

The mass of a code is that of the rounded PCD (differences of normal cdfs, Hendrickson et al. 2023, eq.
PCD_RV_definition), so that coarse quantisation is no discrepancy. The scores are Rao's efficient scores: the
part of a Hermite x Charlier polynomial that is orthogonal, in the Fisher metric of the mass, to the four
directions in which the parameters move it; to first order the fit does not matter for them. To second order
it does: with the parameters fitted by maximum likelihood their sum has the expectation ``-1/2 sum_ab cov(a,
b) sum_x psi(x) D_a D_b p(x)``, and second derivatives of p along these directions are polynomials again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe import observe_numba as kernel
from pchem_pipeline.model.arithmetic.significance import SMALLEST_EXPECTATION
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE

N_TESTS = N_COLUMNS - N_NUISANCE
_SINGULAR = 1e-9  # squared length of a column, over that before
_SMALLEST_WIDTH = 0.1  # DN: below it peaks are single codes
_ALLOWED = 1e-2  # samples expected beyond the codes of a pixel, on either side, at most
#: Pixels whose law covers more codes than this are not looked at.
_LONGEST_SUPPORT = 8192
_NEGLIGIBLE = 1e-5  # samples expected beyond the electron numbers considered, in all pixels
#: Probability below which a code carries no information on the shape.
_NOTHING = 1e-14
_LONGEST_AXIS = 1 << 17
_COARSE, _MOST_BINS = 16, 256
_AT_ONCE = 1 << 14  # codes of all pixels that are done together, which stay in the cache
#: Codes are summed by their number modulo this.
FOLD = 16

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
    """Histograms of n pixels.

    Attributes:
        counts: (n, B).
        origin: DN of bin 0, (n,).
        outside: samples below and above the histogram, (n, 2).
        ends: smallest and largest code of each, DN, (2, n); None: those of the histograms.
    """

    counts: CodeArray
    origin: IntArray
    outside: FloatArray
    ends: NDArray[np.integer[Any]] | None = None

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


class CodeSums(NamedTuple):
    """Sums over pixels by code.

    Attributes:
        first: DN of the first one.
        coarse: codes in a bin.
        single: counts, expectation, residual and its variance, (4, n_codes).
        fold, fold_covariance: residuals by DN modulo 16, (16,), (16, 16).
        bins: score of a shift of the scale, its variance for given expectations, and expectation by bin,
            (3, n_bins).
        bin_covariance: of these scores.
    """

    first: int
    coarse: int
    single: FloatArray
    fold: FloatArray
    fold_covariance: FloatArray
    bins: FloatArray
    bin_covariance: FloatArray


class PixelLaws(NamedTuple):
    """What the fitted law of n pixels and their histograms give.

    Attributes:
        good: pixels with a law, (n,); all else is meaningless elsewhere.
        moments: fields of :data:`MOMENTS`, (n,).
        scores: standardised score, its skewness and its kurtosis excess, (n, 3, N_TESTS).
        support: first DN, number of codes, first row in ``tables``, (n, 3); (0, 1, 0) where not good.
        tables: k (e-) and r (DN) of every code of the support, minus their mean over the samples, (rows, 2).
        codes: sums over all pixels.
    """

    good: BoolArray
    moments: NDArray[np.void]
    scores: FloatArray
    support: IntArray
    tables: Float32Array
    codes: CodeSums


def pixel_laws(seen: PixelHistograms, parameters: FloatArray, usable: BoolArray) -> PixelLaws:
    """Compare the histogram of every usable pixel with its fitted law.

    Args:
        seen: histograms of n pixels.
        parameters: H, g, mu, sigma (with quantisation), (n, 4); anything where not usable.
        usable: pixels to look at, (n,).
    """
    n = usable.size
    # harmless numbers for unusable pixels
    exposure, gain, bias, sigma = np.where(usable[:, None], parameters, [1.0, 1.0, 0.0, 1.0]).T
    natural = np.ascontiguousarray(np.stack([exposure, 1.0 / gain, bias, analog_width(sigma)], axis=1))
    window, electrons = np.zeros((n, 2), np.int64), np.zeros((n, 2), np.int64)
    samples = float(seen.counts.sum(axis=1).max(initial=1)) + float(seen.outside.sum(axis=1).max(initial=0.0))
    kernel.supports(natural, np.log(_NEGLIGIBLE / (samples * n)), electrons, window)
    length = window[:, 1] - window[:, 0] + 1
    good = usable & (length <= _LONGEST_SUPPORT)
    axis, n_codes = _code_axis(window[good])
    coarse = _COARSE
    while n_codes > coarse * _MOST_BINS:
        coarse *= 2
    n_bins = n_codes // coarse + 1
    laws = PixelLaws(
        good=good,
        moments=np.zeros(n, MOMENTS),
        scores=np.full((n, 3, N_TESTS), np.nan),
        support=np.tile(np.array([0, 1, 0]), (n, 1)),
        tables=np.zeros((1 + int(length[good].sum()), 2), np.float32),
        codes=CodeSums(
            first=axis,
            coarse=coarse,
            single=np.zeros((4, n_codes)),
            fold=np.zeros(FOLD),
            fold_covariance=np.zeros((FOLD, FOLD)),
            bins=np.zeros((3, n_bins)),
            bin_covariance=np.zeros((n_bins, n_bins)),
        ),
    )
    allowed = _ALLOWED, _ALLOWED / max(int(good.sum()), 1)
    used = 1  # row 0 of the tables is that of the pixels without a law
    for pixels in _batches(np.flatnonzero(good), length):
        used = _summarise(pixels, seen, (natural, electrons, window), allowed, laws, used)
    return laws


def _batches(pixels: IntArray, length: IntArray) -> Iterator[IntArray]:
    """Yield pixels in their order, so many that together they have no more codes than are done at once."""
    first, widest = 0, 0
    for i, codes in enumerate(length[pixels]):
        if i > first and (i - first + 1) * max(widest, codes) > _AT_ONCE:
            yield pixels[first:i]
            first, widest = i, 0
        widest = max(widest, codes)
    if pixels.size:
        yield pixels[first:]


def _summarise(
    pixels: IntArray,
    seen: PixelHistograms,
    fitted: tuple[FloatArray, IntArray, IntArray],
    allowed: tuple[float, float],
    laws: PixelLaws,
    used: int,
) -> int:
    """Fill tables and sums of some pixels, and return the first row of the tables behind theirs.

    Args:
        pixels: their numbers, (p,).
        seen: histograms of all pixels.
        fitted: of all pixels H, 1/g, mu and analog read noise, (n, 4), ranges of electron numbers and of
            codes, (n, 2).
        allowed: samples expected beyond the support on either side, and far beyond, at most.
        laws: to fill.
        used: first row of the tables that is free.
    """
    natural, electrons, window = (each[pixels] for each in fitted)
    exposure, step, bias, width = natural.T[:, :, None]
    counts, outside = seen.counts[pixels].astype(np.float64), seen.outside[pixels]
    samples = outside.sum(axis=1) + counts.sum(axis=1)
    expected_of_all = np.zeros((pixels.size, int(np.diff(window).max()) + 1))
    by_code = np.zeros((*expected_of_all.shape, N_COLUMNS))
    ends, beyond = np.zeros((pixels.size, 4), np.int64), np.zeros((pixels.size, 4))
    kernel.fill_laws(natural, electrons, window, samples, allowed, expected_of_all, by_code, ends, beyond)
    size = ends[:, 1] - ends[:, 0] + 1
    # the columns first
    law = np.ascontiguousarray(np.moveaxis(by_code[:, : size.max()], 2, 0))
    del by_code
    x, first = np.arange(law.shape[2]), ends[:, :1]
    inside = x < size[:, None]
    mass = law[0].copy()
    inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > _NOTHING)
    known = inverse.any(axis=1)
    if not known.all():
        laws.good[pixels[~known]] = False
        return _summarise(pixels[known], seen, fitted, allowed, laws, used) if known.any() else used
    codes, moments = laws.codes, np.zeros(pixels.size, MOMENTS)
    at = seen.origin[pixels, None] + np.arange(counts.shape[1])
    for i, name in enumerate(("low", "high", "far_low", "far_high")):
        out = at > ends[:, i, None] if i % 2 else at < ends[:, i, None]
        moments[name] = np.stack([(counts * out).sum(axis=1) + outside[:, i % 2], beyond[:, i]], axis=1)
    # k = E[K | x] and r = x - mu - k / g
    offset = bias - first
    between = np.clip(np.floor((x - offset) / step + 0.5), electrons[:, :1], electrons[:, 1:])
    k = np.where(inverse > 0.0, exposure + np.sqrt(exposure) * law[1] * inverse, between)
    r = x - offset - k * step
    within, some = np.zeros_like(mass), (at >= first) & (at <= ends[:, 1:2])
    within[np.nonzero(some)[0], (at - first)[some]] = counts[some]
    factor = whiten(law, inverse)
    slopes = law[:N_NUISANCE]
    # the parameters moved, to first order, to suit the samples
    expected = np.einsum("ip,ipx->px", np.einsum("ipx,px->ip", slopes, within * inverse), slopes)
    in_window = (first - window[:, :1]) + x
    expected_of_all[np.nonzero(inside)[0], in_window[inside]] = expected[inside]
    in_window = window[:, :1] + np.arange(expected_of_all.shape[1])
    for total, place, values in (
        (codes.single[0], at, counts),
        (codes.single[1], in_window, expected_of_all),
    ):
        some = (values != 0.0) & (place >= codes.first) & (place < codes.first + total.size)
        np.add.at(total, place[some] - codes.first, values[some])
    laws.scores[pixels] = efficient_scores(law, inverse, within, factor, exposure[:, 0])
    for name, shortest in (("goodness", np.ones(pixels.size)), ("peaks", np.rint(width[:, 0]))):
        kernel.goodness(slopes, within, expected, size, SMALLEST_EXPECTATION, shortest, moments[name])
    _centre(mass, k, r, within, size - 1, moments)
    rows = used + np.cumsum(size) - size
    laws.moments[pixels], laws.support[pixels] = moments, np.stack([first[:, 0], size, rows], axis=1)
    behind = used + int(size.sum())
    laws.tables[used:behind] = np.stack([k[inside], r[inside]], axis=1)
    shift = r / (width**2 + QUANTISATION_VARIANCE)
    _add_codes(slopes, within, expected, shift, first + x - codes.first, inside, codes)
    return behind


def _centre(
    mass: FloatArray,
    k: FloatArray,
    r: FloatArray,
    seen: FloatArray,
    last: IntArray,
    moments: NDArray[np.void],
) -> None:
    """Subtract from the tables k and r their means over the samples, and fill the moments of the channels."""
    total = mass.sum(axis=1)
    weight, every = seen.copy(), np.arange(len(seen))
    weight[:, 0] += moments["low"][:, 0]
    weight[every, last] += moments["high"][:, 0]
    weight /= weight.sum(axis=1, keepdims=True)
    for name, values in (("charge_std", k), ("readout_std", r)):
        mean, square = (each.sum(axis=1) / total for each in (mass * values, mass * values**2))
        moments[name] = np.sqrt(np.maximum(square - mean**2, 0.0))
        values -= (weight * values).sum(axis=1, keepdims=True)
    for name in ("kk", "rr", "kr", "krr", "kkrr", "rrrr"):
        moments[name] = math.prod((k if letter == "k" else r for letter in name), start=weight).sum(axis=1)


def _add_codes(
    slopes: FloatArray,
    seen: FloatArray,
    expected: FloatArray,
    shift: FloatArray,
    at: IntArray,
    inside: BoolArray,
    sums: CodeSums,
) -> None:
    """Add residuals and their covariance: per code, per code modulo 16, per bin of codes.

    In the bins they are weighted with what a shift of the scale does to each code, so that they sum to the
    shift of the scale there.
    """
    on_axis = (at >= 0) & (at < sums.single.shape[1])
    some = inside & (on_axis | ~inside).all(axis=1, keepdims=True)
    pixel, n = np.nonzero(some)[0], seen.sum(axis=1)
    at, columns, wanted, moved = at[some], slopes[:, some], expected[some], shift[some]
    residual, modulo, bins = seen[some] - wanted, (at + sums.first) % FOLD, at // sums.coarse
    for total, place, values in (
        (sums.single[2], at, residual),
        (sums.single[3], at, np.maximum(wanted - n[pixel] * (columns**2).sum(axis=0), 0.0)),
        (sums.fold, modulo, residual),
        (sums.fold_covariance.reshape(-1), modulo * (FOLD + 1), wanted),
        (sums.bins[0], bins, residual * moved),
        (sums.bins[1], bins, wanted * moved**2),
        (sums.bins[2], bins, wanted),
        (sums.bin_covariance.reshape(-1), bins * (sums.bins.shape[1] + 1), wanted * moved**2),
    ):
        np.add.at(total, place, values)
    for covariance, place, weighted in (
        (sums.fold_covariance, modulo, columns),
        (sums.bin_covariance, bins, columns * moved),
    ):
        size = len(covariance)
        for column in weighted:
            total = np.bincount(pixel * size + place, column, n.size * size).reshape(n.size, size)
            covariance -= total.T @ (n[:, None] * total)


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


# -- efficient scores: arrays of n pixels over x codes, without mass beyond the codes of a pixel ----


def whiten(law: FloatArray, inverse: FloatArray) -> FloatArray:
    """Make the first columns of ``law`` orthonormal, and the tests orthogonal to them.

    A parameter on which the law does not depend here, or not in a way of its own, takes nothing from the
    tests: its column becomes 0. The read noise is one where each electron number has the same two codes.

    Args:
        law: columns times mass; changed in place, (N_COLUMNS, n, x).
        inverse: 1/p, or 0 for codes to be left out, (n, x).

    Returns:
        The triangular factor: column j was ``sum_i factor[i, j] (new column i)``, (N_NUISANCE, N_COLUMNS, n).
    """
    factor: FloatArray = np.einsum("ipx,jpx->ijp", law[:N_NUISANCE] * inverse, law)
    # Gaussian elimination of the Gram matrix is Gram-Schmidt of the columns
    for i in range(N_NUISANCE):
        regular = factor[i, i] > _SINGULAR
        factor[i] *= np.where(regular, 1.0 / np.sqrt(np.where(regular, factor[i, i], 1.0)), 0.0)
        factor[i, :i] = 0.0
        for k in range(i + 1, N_NUISANCE):
            factor[k] -= factor[i, k] * factor[i]
        law[i] /= np.where(regular, factor[i, i], np.inf)[:, None]
        law[i + 1 :] -= factor[i, i + 1 :, :, None] * law[i]
    return factor


def efficient_scores(
    law: FloatArray, inverse: FloatArray, seen: FloatArray, factor: FloatArray, exposure: FloatArray
) -> FloatArray:
    """Compute the standardised efficient scores of the samples, their skewness and kurtosis, (n, 3, N_TESTS).

    Args:
        law: whitened, (N_COLUMNS, n, x).
        inverse: 1/p, or 0 for codes to be left out, (n, x).
        seen: samples of each code, (n, x).
        factor: of the whitening.
        exposure: H, e-, (n,).

    Returns:
        NaN where a score has no variance.
    """
    tests = law[N_NUISANCE:]
    scores = tests * inverse
    products = np.einsum("ipx,jpx->ijp", scores, tests)
    variance, samples = np.einsum("iip->ip", products), seen.sum(axis=1)
    total = np.einsum("ipx,px->ip", scores, seen)
    bias = -0.5 * np.einsum("jp,ijp->ip", _curvature(_fit_covariance(factor), exposure), products)
    cubes = scores * scores * tests
    third, fourth = cubes.sum(axis=2), np.einsum("ipx,ipx->ip", cubes, scores)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = [
            (total - bias) / np.sqrt(samples * variance),
            third / (variance * np.sqrt(variance * samples)),
            (fourth / variance**2 - 3.0) / samples,
        ]
    known = (variance > _SINGULAR) & (samples > 0.0)
    return np.asarray(np.where(known, found, np.nan).transpose(2, 0, 1))


def _fit_covariance(factor: FloatArray) -> FloatArray:
    """Return the covariance of the fit, times the samples, along C1, He1, He1 C1, He2, (4, 4, n)."""
    of_fit = np.moveaxis(factor[1:, 1:N_NUISANCE], 2, 0)
    known = np.diagonal(of_fit, axis1=1, axis2=2) > 0.0
    both = known[:, :, None] & known[:, None, :]
    inverse = np.linalg.inv(np.where(both, of_fit, np.eye(N_NUISANCE - 1))) * both
    return np.asarray(np.einsum("pik,pjk->ijp", inverse, inverse))


def _curvature(covariance: FloatArray, exposure: FloatArray) -> FloatArray:
    """Return the coefficients of the tests in ``sum_ab cov(a, b) D_a D_b p``, in their order, (N_TESTS, n).

    The directions multiply the terms of the law by C1, He1, He1 C1, He2; two of them by the products, of
    which only what is not spanned by the parameters matters.
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
