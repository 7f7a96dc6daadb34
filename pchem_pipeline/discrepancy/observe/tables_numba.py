"""Loops over the codes of pixels: what the fitted law of each and its histogram give, see `tables`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.significance import SMALLEST_EXPECTATION
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE, REACH, electron_range, fill_law

N_TESTS = N_COLUMNS - N_NUISANCE
#: Codes are summed by their number modulo this.
FOLD = 16
#: Squared length of a column, over that before, below which it is none of its own.
SINGULAR = 1e-9
_ALLOWED = 1e-2  # samples expected beyond the codes of a pixel, on either side, at most
# probability below which a code carries no information on the shape
_NOTHING = 1e-14
_TOTAL, _CUBE, _FOURTH = N_TESTS, N_TESTS + 1, N_TESTS + 2


class Histograms(NamedTuple):
    """Histograms of n pixels: counts (n, B), DN of bin 0 (n,), samples below and above (n, 2)."""

    counts: NDArray[Any]
    origin: IntArray
    outside: FloatArray


class Fits(NamedTuple):
    """Laws of n pixels: H, 1/g, mu, analog read noise in DN (n, 4); ranges of electrons, of codes (n, 2)."""

    parameters: FloatArray
    electrons: IntArray
    codes: IntArray


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


@kernel
def supports(parameters: FloatArray, log_negligible: float, electrons: IntArray, codes: IntArray) -> None:
    """Fill the ranges of electron numbers and of codes, (n, 2), that the law of each pixel covers.

    Parameters as of :class:`Fits`; electron numbers of negligible probability (its logarithm) are left out.
    """
    for p in range(parameters.shape[0]):
        exposure, step, bias, width = parameters[p]
        first, last = electron_range(exposure, log_negligible)
        electrons[p, 0], electrons[p, 1] = first, last
        codes[p, 0] = math.floor(bias + first * step - REACH * width)
        codes[p, 1] = math.ceil(bias + last * step + REACH * width)


@kernel
def _support(law: FloatArray, samples: float, allowed: float) -> tuple[int, int, float, float]:
    """Return the first and last code of the support, and what is expected below and above it."""
    low, below = 0, 0.0
    while low < law.shape[0] - 1 and samples * (below + law[low, 0]) < allowed:
        below += law[low, 0]
        low += 1
    high, above = law.shape[0] - 1, 0.0
    while high > low and samples * (above + law[high, 0]) < allowed:
        above += law[high, 0]
        high -= 1
    return low, high, samples * below, samples * above


@kernel
def whiten(law: FloatArray, inverse: FloatArray, factor: FloatArray) -> None:
    """Make the first columns of a law orthonormal, and the tests orthogonal to them (Gram and Schmidt).

    A parameter on which the law does not depend here, or not in a way of its own, takes nothing from the
    tests: its column becomes 0. The read noise is one where each electron number has the same two codes.

    Args:
        law: columns times mass; changed in place, (code, N_COLUMNS).
        inverse: 1/p, or 0 for codes to be left out, (code,).
        factor: out, triangular: column j was ``sum_i factor[i, j] (new column i)``, (N_NUISANCE, N_COLUMNS).
    """
    factor[:] = 0.0
    for x in range(law.shape[0]):
        for i in range(N_NUISANCE):
            for j in range(N_COLUMNS):
                factor[i, j] += law[x, i] * inverse[x] * law[x, j]
    # elimination of the Gram matrix
    for i in range(N_NUISANCE):
        scale = 1.0 / math.sqrt(factor[i, i]) if factor[i, i] > SINGULAR else 0.0
        for j in range(N_COLUMNS):
            factor[i, j] *= scale if j >= i else 0.0
        for k in range(i + 1, N_NUISANCE):
            for j in range(N_COLUMNS):
                factor[k, j] -= factor[i, k] * factor[i, j]
    for x in range(law.shape[0]):
        for i in range(N_NUISANCE):
            law[x, i] = law[x, i] / factor[i, i] if factor[i, i] > 0.0 else 0.0
            for j in range(i + 1, N_COLUMNS):
                law[x, j] -= factor[i, j] * law[x, i]


@kernel
def sum_scores(law: FloatArray, inverse: FloatArray, seen: FloatArray, sums: FloatArray) -> None:
    """Sum over the codes of a whitened law what the scores of its tests are made of.

    Args:
        law: whitened, (code, N_COLUMNS).
        inverse: 1/p, or 0 for codes to be left out, (code,).
        seen: samples of each code, (code,).
        sums: out, for each test its products with all tests, the sum over the samples, and its third and
            fourth power, (N_TESTS, N_TESTS + 3).
    """
    sums[:] = 0.0
    for x in range(law.shape[0]):
        for i in range(N_TESTS):
            test = law[x, N_NUISANCE + i]
            score = test * inverse[x]
            for j in range(N_TESTS):
                sums[i, j] += score * law[x, N_NUISANCE + j]
            sums[i, _TOTAL] += score * seen[x]
            sums[i, _CUBE] += score * score * test
            sums[i, _FOURTH] += score * score * score * test


@kernel
def _count(
    counts: NDArray[Any], start: int, ends: tuple[int, int, int, int], within: FloatArray, moments: Any
) -> None:
    """Fill the samples of each code of the support; add those beyond it, and far beyond, to the moments."""
    low, high, far_low, far_high = ends
    for b in range(counts.size):
        count, x = float(counts[b]), start + b
        moments.low[0] += count if x < low else 0.0
        moments.high[0] += count if x > high else 0.0
        moments.far_low[0] += count if x < far_low else 0.0
        moments.far_high[0] += count if x > far_high else 0.0
        if low <= x <= high:
            within[x - low] = count


@kernel
def _expect(law: FloatArray, inverse: FloatArray, seen: FloatArray, expected: FloatArray) -> None:
    """Add the samples expected of each code, the parameters moved, to first order, to suit the samples."""
    for i in range(N_NUISANCE):
        moved = 0.0
        for x in range(seen.size):
            moved += law[x, i] * seen[x] * inverse[x]
        for x in range(seen.size):
            expected[x] += moved * law[x, i]


@kernel
def _goodness(
    law: FloatArray, seen: FloatArray, expected: FloatArray, shortest: float
) -> tuple[float, float, float]:
    """Return Pearson's chi-square of groups of codes, with its mean and variance for fitted parameters."""
    taken = np.zeros(N_NUISANCE)
    n = remaining = seen.sum()
    chi2 = mean = inverse = observed = wanted = 0.0
    groups = merged = 0
    for x in range(seen.size):
        merged += 1
        observed += seen[x]
        wanted += expected[x]
        for i in range(N_NUISANCE):
            taken[i] += law[x, i]
        full = wanted >= SMALLEST_EXPECTATION and merged >= shortest
        if (full and remaining - wanted >= SMALLEST_EXPECTATION) or x == seen.size - 1:
            if wanted <= 0.0:
                break
            chi2 += (observed - wanted) ** 2 / wanted
            used = 0.0
            for i in range(N_NUISANCE):
                used += taken[i] * taken[i]
                taken[i] = 0.0
            mean += max(0.0, 1.0 - used * n / wanted)
            inverse += 1.0 / wanted
            groups += 1
            remaining -= wanted
            observed = wanted = 0.0
            merged = 0
    return chi2, mean, 2.0 * mean + max(0.0, inverse - (groups * groups + 2.0 * groups - 2.0) / n)


@kernel
def _centre(mass: FloatArray, k: FloatArray, r: FloatArray, seen: FloatArray, moments: Any) -> None:
    """Subtract from k and r their means over the samples, and fill the moments of the channels.

    Samples beyond the support count as its ends.
    """
    total, n = mass.sum(), seen.sum()
    spread = np.zeros(2)
    for i in range(2):
        values = k if i == 0 else r
        mean = square = centre = 0.0
        for x in range(mass.size):
            mean += mass[x] * values[x] / total
            square += mass[x] * values[x] * values[x] / total
            centre += seen[x] * values[x] / n
        spread[i] = math.sqrt(max(square - mean * mean, 0.0))
        for x in range(mass.size):
            values[x] -= centre
    moments.charge_std, moments.readout_std = spread[0], spread[1]
    for x in range(mass.size):
        weight, kk, rr = seen[x] / n, k[x] * k[x], r[x] * r[x]
        moments.kk += weight * kk
        moments.rr += weight * rr
        moments.kr += weight * k[x] * r[x]
        moments.krr += weight * k[x] * rr
        moments.kkrr += weight * kk * rr
        moments.rrrr += weight * rr * rr


@kernel
def _add_codes(
    law: FloatArray, seen: FloatArray, expected: FloatArray, shift: FloatArray, first: int, sums: CodeSums
) -> None:
    """Add residuals of a pixel and their covariance: per code (from ``first`` on), modulo 16, and by bin.

    In the bins they are weighted with ``shift``, what a shift of the scale does to each code.
    """
    last, n = first + seen.size - 1, seen.sum()
    if first < 0 or last >= sums.single.shape[1]:
        return
    low = first // sums.coarse
    folds, bins = np.zeros((N_NUISANCE, FOLD)), np.zeros((N_NUISANCE, last // sums.coarse - low + 1))
    for x in range(seen.size):
        at, fold, place = first + x, (first + x + sums.first) % FOLD, (first + x) // sums.coarse
        residual, explained = seen[x] - expected[x], 0.0
        for i in range(N_NUISANCE):
            explained += law[x, i] * law[x, i]
            folds[i, fold] += law[x, i]
            bins[i, place - low] += law[x, i] * shift[x]
        sums.single[2, at] += residual
        sums.single[3, at] += max(expected[x] - n * explained, 0.0)
        sums.fold[fold] += residual
        sums.fold_covariance[fold, fold] += expected[x]
        sums.bins[0, place] += residual * shift[x]
        sums.bins[1, place] += expected[x] * shift[x] * shift[x]
        sums.bins[2, place] += expected[x]
        sums.bin_covariance[place, place] += expected[x] * shift[x] * shift[x]
    for i in range(N_NUISANCE):
        for a in range(FOLD):
            for b in range(FOLD):
                sums.fold_covariance[a, b] -= n * folds[i, a] * folds[i, b]
        for a in range(bins.shape[1]):
            for b in range(bins.shape[1]):
                sums.bin_covariance[low + a, low + b] -= n * bins[i, a] * bins[i, b]


@kernel
def compare_pixels(
    seen: Histograms,
    fits: Fits,
    good: BoolArray,
    moments: Any,
    factors: FloatArray,
    score_sums: FloatArray,
    support: IntArray,
    tables: Float32Array,
    codes: CodeSums,
) -> None:
    """Compare the histogram of each pixel with its law.

    Args:
        seen: the histograms.
        fits: the laws.
        good: pixels to compare, (n,); out: those with a law.
        moments: out, see :data:`~.tables.MOMENTS`, (n,).
        factors: out, see `whiten`, (n, N_NUISANCE, N_COLUMNS).
        score_sums: out, see `sum_scores`, (n, N_TESTS, N_TESTS + 3).
        support: out, first DN, number of codes, first row in the tables, (n, 3).
        tables: out, k and r of every code, centred, (rows, 2); row 0 is that of pixels without a law.
        codes: to add to.
    """
    row, n_good = 1, max(good.sum(), 1)
    for p in range(good.size):
        if not good[p]:
            continue
        exposure, step, bias, width = fits.parameters[p]
        samples = seen.outside[p, 0] + seen.outside[p, 1] + seen.counts[p].sum()
        window, full = fits.codes[p, 0], np.empty((fits.codes[p, 1] - fits.codes[p, 0] + 1, N_COLUMNS))
        fill_law(exposure, step, bias - window, width, fits.electrons[p, 0], fits.electrons[p, 1], full)
        low, high, below, above = _support(full, samples, _ALLOWED)
        far_low, far_high, far_below, far_above = _support(full, samples, _ALLOWED / n_good)
        first, size = window + low, high - low + 1
        law, mass, inverse = np.empty((size, N_COLUMNS)), np.empty(size), np.zeros(size)
        k, r, within, expected = np.empty(size), np.empty(size), np.zeros(size), np.zeros(size)
        for x in range(size):
            for column in range(N_COLUMNS):
                law[x, column] = full[low + x, column]
            mass[x] = law[x, 0]
            value = x + first - bias
            k[x] = min(max(math.floor(value / step + 0.5), fits.electrons[p, 0]), fits.electrons[p, 1])
            if mass[x] > _NOTHING:
                inverse[x] = 1.0 / mass[x]
                k[x] = exposure + math.sqrt(exposure) * law[x, 1] * inverse[x]
            r[x] = value - k[x] * step
        if not inverse.any():
            good[p] = False
            continue
        found = moments[p]
        found.low[1], found.high[1] = below, above
        found.far_low[1], found.far_high[1] = far_below, far_above
        found.low[0] = found.far_low[0] = seen.outside[p, 0]
        found.high[0] = found.far_high[0] = seen.outside[p, 1]
        _count(seen.counts[p], seen.origin[p] - window, (low, high, far_low, far_high), within, found)
        whiten(law, inverse, factors[p])
        sum_scores(law, inverse, within, score_sums[p])
        _expect(law, inverse, within, expected)
        for b in range(seen.counts.shape[1]):
            at = seen.origin[p] + b - codes.first
            if 0 <= at < codes.single.shape[1]:
                codes.single[0, at] += seen.counts[p, b]
        for x in range(full.shape[0]):
            at = window + x - codes.first
            if 0 <= at < codes.single.shape[1]:
                codes.single[1, at] += expected[x - low] if low <= x <= high else samples * full[x, 0]
        found.goodness[0], found.goodness[1], found.goodness[2] = _goodness(law, within, expected, 1.0)
        found.peaks[0], found.peaks[1], found.peaks[2] = _goodness(law, within, expected, np.rint(width))
        ends = within.copy()
        ends[0] += found.low[0]
        ends[-1] += found.high[0]
        _centre(mass, k, r, ends, found)
        support[p, 0], support[p, 1], support[p, 2] = first, size, row
        for x in range(size):
            tables[row + x, 0], tables[row + x, 1] = k[x], r[x]
        row += size
        for x in range(size):
            r[x] /= width * width + QUANTISATION_VARIANCE
        _add_codes(law, within, expected, r, first - codes.first, codes)
