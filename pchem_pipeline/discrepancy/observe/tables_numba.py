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
from pchem_pipeline.model.arithmetic.simd_numba import (
    SIMD_WIDTH,
    counting,
    fused,
    simd_load,
    simd_store,
    simd_sum,
)
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE, REACH, electron_range, fill_law

N_TESTS = N_COLUMNS - N_NUISANCE
#: Rows of the table of a pixel after the columns of its law: 1/p, or 0 for codes to be left out, and samples.
INVERSE, SEEN = N_COLUMNS, N_COLUMNS + 1
N_ROWS = N_COLUMNS + 2
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
def _product(table: FloatArray, i: int, j: int) -> float:
    """Return ``sum_x a b / p`` of two rows of a table over all codes."""
    total = counting() * 0.0
    for x in range(0, table.shape[1], SIMD_WIDTH):
        total = fused(simd_load(table, i, x) * simd_load(table, INVERSE, x), simd_load(table, j, x), total)
    return simd_sum(total)


@kernel
def whiten(table: FloatArray, factor: FloatArray) -> None:
    """Make the first columns of a law orthonormal, and the tests orthogonal to them (Gram and Schmidt).

    A parameter on which the law does not depend here, or not in a way of its own, takes nothing from the
    tests: its column becomes 0. The read noise is one where each electron number has the same two codes.

    Args:
        table: columns times mass, 1/p (`INVERSE`; 0 for codes to be left out), samples (`SEEN`), by codes, to
            a whole number of vectors; the columns are changed in place, (N_ROWS, code).
        factor: out, triangular: column j was ``sum_i factor[i, j] (new column i)``, (N_NUISANCE, N_COLUMNS).
    """
    for i in range(N_NUISANCE):
        for j in range(N_COLUMNS):
            factor[i, j] = _product(table, i, j) if j >= i else 0.0
    # elimination of the Gram matrix
    for i in range(N_NUISANCE):
        scale = 1.0 / math.sqrt(factor[i, i]) if factor[i, i] > SINGULAR else 0.0
        for j in range(N_COLUMNS):
            factor[i, j] *= scale if j >= i else 0.0
        for k in range(i + 1, N_NUISANCE):
            for j in range(N_COLUMNS):
                factor[k, j] -= factor[i, k] * factor[i, j]
    for i in range(N_NUISANCE):
        scale = 1.0 / factor[i, i] if factor[i, i] > 0.0 else 0.0
        for x in range(0, table.shape[1], SIMD_WIDTH):
            own = simd_load(table, i, x) * scale
            simd_store(table, i, x, own)
            for j in range(i + 1, N_COLUMNS):
                simd_store(table, j, x, fused(own, -factor[i, j], simd_load(table, j, x)))


@kernel
def sum_scores(table: FloatArray, sums: FloatArray) -> None:
    """Sum over the codes of a whitened table what the scores of its tests are made of.

    ``sums``: out, for each test its products with all tests, the sum over the samples, and its third and
    fourth power, (N_TESTS, N_TESTS + 3).
    """
    for i in range(N_TESTS):
        for j in range(i + 1):
            sums[i, j] = sums[j, i] = _product(table, N_NUISANCE + i, N_NUISANCE + j)
        sums[i, _TOTAL] = _product(table, N_NUISANCE + i, SEEN)
        cube = fourth = counting() * 0.0
        for x in range(0, table.shape[1], SIMD_WIDTH):
            test = simd_load(table, N_NUISANCE + i, x)
            score = test * simd_load(table, INVERSE, x)
            square = score * test
            cube = fused(square, score, cube)
            fourth = fused(square * score, score, fourth)
        sums[i, _CUBE], sums[i, _FOURTH] = simd_sum(cube), simd_sum(fourth)


@kernel
def _count(
    counts: NDArray[Any], start: int, ends: tuple[int, int, int, int], within: FloatArray, moments: Any
) -> None:
    """Fill the samples of each code of the support; add those beyond it, and far beyond, to the moments."""
    low, high, far_low, far_high = ends
    for b in range(counts.size):
        if counts[b] == 0:
            continue
        count, x = float(counts[b]), start + b
        moments.low[0] += count if x < low else 0.0
        moments.high[0] += count if x > high else 0.0
        moments.far_low[0] += count if x < far_low else 0.0
        moments.far_high[0] += count if x > far_high else 0.0
        if low <= x <= high:
            within[x - low] = count


@kernel
def _expect(table: FloatArray, expected: FloatArray) -> None:
    """Add the samples expected of each code, the parameters moved, to first order, to suit the samples."""
    for i in range(N_NUISANCE):
        moved = _product(table, i, SEEN)
        for x in range(expected.size):
            expected[x] += moved * table[i, x]


@kernel
def _goodness(
    table: FloatArray, seen: FloatArray, expected: FloatArray, shortest: float
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
            taken[i] += table[i, x]
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
            mean += mass[x] * values[x]
            square += mass[x] * values[x] * values[x]
            centre += seen[x] * values[x]
        spread[i] = math.sqrt(max(square / total - (mean / total) ** 2, 0.0))
        for x in range(mass.size):
            values[x] -= centre / n
    moments.charge_std, moments.readout_std = spread[0], spread[1]
    kk = rr = kr = krr = kkrr = rrrr = 0.0
    for x in range(mass.size):
        of_k, of_r = seen[x] * k[x], r[x] * r[x]
        kk += of_k * k[x]
        rr += seen[x] * of_r
        kr += of_k * r[x]
        krr += of_k * of_r
        kkrr += of_k * k[x] * of_r
        rrrr += seen[x] * of_r * of_r
    moments.kk, moments.rr, moments.kr = kk / n, rr / n, kr / n
    moments.krr, moments.kkrr, moments.rrrr = krr / n, kkrr / n, rrrr / n


@kernel
def _add_codes(
    table: FloatArray, seen: FloatArray, expected: FloatArray, shift: FloatArray, first: int, sums: CodeSums
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
            explained += table[i, x] * table[i, x]
            folds[i, fold] += table[i, x]
            bins[i, place - low] += table[i, x] * shift[x]
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
        table = np.zeros((N_ROWS, -(-size // SIMD_WIDTH) * SIMD_WIDTH))
        inverse, within = table[INVERSE, :size], table[SEEN, :size]
        mass, k, r, expected = np.empty(size), np.empty(size), np.empty(size), np.zeros(size)
        for x in range(size):
            for column in range(N_COLUMNS):
                table[column, x] = full[low + x, column]
            mass[x] = table[0, x]
            value = x + first - bias
            k[x] = min(max(math.floor(value / step + 0.5), fits.electrons[p, 0]), fits.electrons[p, 1])
            if mass[x] > _NOTHING:
                inverse[x] = 1.0 / mass[x]
                k[x] = exposure + math.sqrt(exposure) * table[1, x] * inverse[x]
            r[x] = value - k[x] * step
        before, beyond = seen.outside[p] > 0.0
        end = seen.origin[p] + seen.counts.shape[1]
        # what lies outside of a window that is narrower than the law may be within the law
        if not inverse.any() or (before and first < seen.origin[p]) or (beyond and first + size > end):
            good[p] = False
            continue
        found = moments[p]
        found.low[1], found.high[1] = below, above
        found.far_low[1], found.far_high[1] = far_below, far_above
        found.low[0] = found.far_low[0] = seen.outside[p, 0]
        found.high[0] = found.far_high[0] = seen.outside[p, 1]
        _count(seen.counts[p], seen.origin[p] - window, (low, high, far_low, far_high), within, found)
        whiten(table, factors[p])
        sum_scores(table, score_sums[p])
        _expect(table, expected)
        for b in range(seen.counts.shape[1]):
            at = seen.origin[p] + b - codes.first
            if 0 <= at < codes.single.shape[1]:
                codes.single[0, at] += seen.counts[p, b]
        for x in range(full.shape[0]):
            at = window + x - codes.first
            if 0 <= at < codes.single.shape[1]:
                codes.single[1, at] += expected[x - low] if low <= x <= high else samples * full[x, 0]
        found.goodness[0], found.goodness[1], found.goodness[2] = _goodness(table, within, expected, 1.0)
        found.peaks[0], found.peaks[1], found.peaks[2] = _goodness(table, within, expected, np.rint(width))
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
        _add_codes(table, within, expected, r, first - codes.first, codes)
