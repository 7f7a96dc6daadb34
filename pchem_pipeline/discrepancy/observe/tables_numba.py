"""Loops of :mod:`pchem_pipeline.discrepancy.observe.tables`: what a pixel's law and its histogram give."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe.law_numba import (
    NOTHING,
    pixel_scores,
    whiten,
    within,
)
from pchem_pipeline.model.law.cell_scores_numba import N_COLUMNS, N_NUISANCE, fill_law

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Columns of ``moments``, see :func:`_channels` for the first eight.
N_MOMENTS = 22
MODEL_STD_K, MODEL_STD_R, MEAN_KK, MEAN_RR, MEAN_KR, MEAN_KRR, MEAN_KKRR, MEAN_RRRR = range(8)
CHI2, CHI2_MEAN, CHI2_VARIANCE, EXPECTED_LOW, EXPECTED_HIGH, SEEN_LOW, SEEN_HIGH = range(8, 15)
EXPECTED_FAR_LOW, EXPECTED_FAR_HIGH, SEEN_FAR_LOW, SEEN_FAR_HIGH = range(15, 19)
PEAKS_CHI2, PEAKS_MEAN, PEAKS_VARIANCE = range(19, 22)
#: Codes are summed by their number modulo this.
FOLD = 16


class Fitted(NamedTuple):
    """Histograms of n pixels, and the law that was fitted to each.

    Attributes:
        counts: (n, B).
        origin: DN of bin 0, (n,).
        outside: samples below and above the histogram, (n, 2).
        parameters: H, 1/g, mu, analog read noise in DN, (n, 4).
        electrons: range of electron numbers, (n, 2).
        window: range of codes of the law, (n, 2).
    """

    counts: NDArray[Any]
    origin: IntArray
    outside: FloatArray
    parameters: FloatArray
    electrons: IntArray
    window: IntArray


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
        moments: columns by the constants above, (n, N_MOMENTS).
        scores: standardised score, its skewness and its kurtosis excess, (n, 3, N_TESTS).
        support: first DN, number of codes, first row in ``tables``, (n, 3); (0, 1, 0) where not good.
        tables: k (e-) and r (DN) of every code of the support, minus their mean over the samples, (rows, 2).
        codes: sums over all pixels.
    """

    good: NDArray[np.bool_]
    moments: FloatArray
    scores: FloatArray
    support: IntArray
    tables: NDArray[np.float32]
    codes: CodeSums


@kernel
def _total(values: NDArray[Any]) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


@kernel
def _goodness(
    law: FloatArray, seen: FloatArray, expected: FloatArray, n: float, smallest: float, shortest: int
) -> tuple[float, float, float]:
    """Return Pearson's chi-square of merged codes, its mean and variance with the parameters fitted.

    So many samples are expected of a group at least, and so many codes are in it.
    """
    chi2 = mean = inverse = 0.0
    groups = merged = 0
    observed = wanted = 0.0
    remaining = n
    taken = np.zeros(N_NUISANCE)
    last = seen.size - 1
    for x in range(seen.size):
        merged += 1
        observed += seen[x]
        wanted += expected[x]
        for i in range(N_NUISANCE):
            taken[i] += law[x, i]
        full = wanted >= smallest and merged >= shortest
        if (full and remaining - wanted >= smallest) or x == last:
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
    variance = 2.0 * mean + max(0.0, inverse - (groups * groups + 2.0 * groups - 2.0) / n)
    return chi2, mean, variance


@kernel
def _channels(
    mass: FloatArray,
    charge: FloatArray,
    readout: FloatArray,
    seen: FloatArray,
    low: float,
    high: float,
    out: FloatArray,
) -> None:
    """Fill ``out`` with moments of the two channels, and centre their tables.

    0, 1: standard deviations of k and r by the law. 2 .. 7 with the samples (those beyond the support count
    as its ends), k and r centred: means of k^2, r^2, k r, k r^2, k^2 r^2, r^4.
    """
    last = mass.size - 1
    total = mean_k = mean_r = square_k = square_r = 0.0
    for x in range(mass.size):
        total += mass[x]
        mean_k += mass[x] * charge[x]
        mean_r += mass[x] * readout[x]
        square_k += mass[x] * charge[x] * charge[x]
        square_r += mass[x] * readout[x] * readout[x]
    out[0] = math.sqrt(max(0.0, square_k / total - (mean_k / total) ** 2))
    out[1] = math.sqrt(max(0.0, square_r / total - (mean_r / total) ** 2))
    n = low + high
    mean_k, mean_r = low * charge[0] + high * charge[last], low * readout[0] + high * readout[last]
    for x in range(mass.size):
        n += seen[x]
        mean_k += seen[x] * charge[x]
        mean_r += seen[x] * readout[x]
    mean_k /= n
    mean_r /= n
    for x in range(mass.size):
        charge[x] -= mean_k
        readout[x] -= mean_r
        c = seen[x] + (low if x == 0 else 0.0) + (high if x == last else 0.0)
        k, r = charge[x], readout[x]
        out[2] += c * k * k / n
        out[3] += c * r * r / n
        out[4] += c * k * r / n
        out[5] += c * k * r * r / n
        out[6] += c * k * k * r * r / n
        out[7] += c * r * r * r * r / n


@kernel
def _code_sums(
    law: FloatArray,
    seen: FloatArray,
    expected: FloatArray,
    shift: FloatArray,
    n: float,
    first: int,
    sums: CodeSums,
) -> None:
    """Add a pixel's residuals and covariance: per code, per code modulo 16, per bin of codes.

    In the bins they are weighted with what a shift of the scale does to each code, so that they sum to the
    shift of the scale there.
    Only the lower triangles of the covariances are filled.
    """
    size, origin, coarse = seen.size, sums.first, sums.coarse
    folded = np.zeros((N_NUISANCE, FOLD))
    begin = (first - origin) // coarse
    n_bins = (first + size - 1 - origin) // coarse - begin + 1
    binned = np.zeros((N_NUISANCE, n_bins))
    for x in range(size):
        residual = seen[x] - expected[x]
        at, modulo = first + x - origin, (first + x) % FOLD
        b = at // coarse
        used = 0.0
        for i in range(N_NUISANCE):
            u = law[x, i]
            used += u * u
            folded[i, modulo] += u
            binned[i, b - begin] += u * shift[x]
        sums.single[2, at] += residual
        sums.single[3, at] += max(0.0, expected[x] - n * used)
        sums.fold[modulo] += residual
        sums.fold_covariance[modulo, modulo] += expected[x]
        sums.bins[0, b] += residual * shift[x]
        sums.bins[1, b] += expected[x] * shift[x] ** 2
        sums.bins[2, b] += expected[x]
        sums.bin_covariance[b, b] += expected[x] * shift[x] ** 2
    for i in range(N_NUISANCE):
        for a in range(FOLD):
            value = n * folded[i, a]
            for b in range(a + 1):
                sums.fold_covariance[a, b] -= value * folded[i, b]
        for a in range(n_bins):
            value = n * binned[i, a]
            for b in range(a + 1):
                sums.bin_covariance[begin + a, begin + b] -= value * binned[i, b]


@kernel
def _count(
    counts: NDArray[Any], origin: int, first: int, seen: FloatArray, axis: int, codes: FloatArray
) -> tuple[float, float]:
    """Spread a histogram over the support; return how many samples lie below and above it."""
    for x in range(seen.size):
        seen[x] = 0.0
    low = high = 0.0
    for b in range(counts.size):
        c = float(counts[b])
        if c > 0.0:
            x = origin + b - first
            if x < 0:
                low += c
            elif x >= seen.size:
                high += c
            else:
                seen[x] = c
            at = origin + b - axis
            if 0 <= at < codes.shape[1]:
                codes[0, at] += c
    return low, high


@kernel
def _fill_tables(
    law: FloatArray,
    inverse: FloatArray,
    exposure: float,
    step: float,
    offset: float,
    electrons: IntArray,
    table: FloatArray,
) -> None:
    """Fill ``table`` (2, code) with k = E[K | x] and r = x - mu - k / g; ``offset``: mu from the first DN."""
    root = math.sqrt(exposure)
    for x in range(law.shape[0]):
        if inverse[x] > 0.0:
            k = exposure + root * law[x, 1] * inverse[x]
        else:  # between two peaks far apart
            k = min(max(math.floor((x - offset) / step + 0.5), float(electrons[0])), float(electrons[1]))
        table[0, x] = k
        table[1, x] = x - offset - k * step


@kernel
def _expect(law: FloatArray, inverse: FloatArray, seen: FloatArray, expected: FloatArray) -> None:
    """Fill what is expected of each code, the parameters moved (first order) to suit the samples."""
    total = np.zeros(N_NUISANCE)
    for x in range(seen.size):
        weight = seen[x] * inverse[x]
        if weight > 0.0:
            for i in range(N_NUISANCE):
                total[i] += weight * law[x, i]
    for x in range(seen.size):
        for i in range(N_NUISANCE):
            expected[x] += total[i] * law[x, i]


@kernel
def _beyond(
    counts: NDArray[Any], origin: int, ends: tuple[int, int], outside: FloatArray
) -> tuple[float, float]:
    """Return the samples of a pixel below and above two DN, those outside of its histogram included."""
    below, above = outside
    for b in range(counts.size):
        if origin + b < ends[0]:
            below += counts[b]
        elif origin + b > ends[1]:
            above += counts[b]
    return below, above


@kernel
def _add_expected(
    mass: FloatArray, n: float, expected: FloatArray, low: int, place: int, total: FloatArray
) -> None:
    """Add the counts expected of a pixel's codes: ``expected`` from the code ``low`` on, n p elsewhere."""
    for x in range(mass.size):
        if 0 <= place + x < total.size:
            total[place + x] += expected[x - low] if low <= x < low + expected.size else n * mass[x]


@kernel
def summarise_pixels(fitted: Fitted, allowed: float, allowed_far: float, laws: PixelLaws) -> None:
    """Fill tables and sums of all pixels.

    Of covariances only the lower triangles are filled.

    Args:
        fitted: the pixels.
        allowed: samples expected beyond the support on either side, at most.
        allowed_far: the same for samples far beyond.
        laws: to fill, with rows of tables enough for all; ``good`` says which pixels are to be done, and is
            unset where no code has any mass.
    """
    gram = np.empty((N_NUISANCE, N_COLUMNS))
    used = 1  # row 0 is that of the pixels without a law
    codes, axis = laws.codes, laws.codes.first
    for p in range(fitted.counts.shape[0]):
        if not laws.good[p]:
            continue
        counts, outside, window, electrons = (
            fitted.counts[p], fitted.outside[p], fitted.window[p], fitted.electrons[p],
        )  # fmt: skip
        exposure, step, bias, width = fitted.parameters[p]
        full = np.empty((window[1] - window[0] + 1, N_COLUMNS))
        fill_law(exposure, step, bias - window[0], width, electrons[0], electrons[1], False, full)
        n = outside[0] + outside[1] + _total(counts)
        low, high, below, above = within(full, n, allowed)
        law, first = full[low : high + 1], window[0] + low
        size = high - low + 1
        mass, inverse, seen, expected = np.empty(size), np.empty(size), np.empty(size), np.zeros(size)
        for x in range(size):
            mass[x] = law[x, 0]
            inverse[x] = 1.0 / mass[x] if mass[x] > NOTHING else 0.0
        table = np.empty((2, size))
        _fill_tables(law, inverse, exposure, step, bias - first, electrons, table)
        if not whiten(law, inverse, gram):
            laws.good[p] = False
            continue
        under, over = _count(counts, fitted.origin[p], first, seen, axis, codes.single)
        _expect(law, inverse, seen, expected)
        _add_expected(full[:, 0], n, expected, low, window[0] - axis, codes.single[1])
        pixel_scores(law, inverse, seen, gram, exposure, laws.scores[p])
        out = laws.moments[p]
        inside = _total(seen)
        out[CHI2], out[CHI2_MEAN], out[CHI2_VARIANCE] = _goodness(law, seen, expected, inside, 5.0, 1)
        out[PEAKS_CHI2], out[PEAKS_MEAN], out[PEAKS_VARIANCE] = _goodness(
            law, seen, expected, inside, 5.0, max(1, round(width))
        )
        out[EXPECTED_LOW], out[EXPECTED_HIGH] = below, above
        out[SEEN_LOW], out[SEEN_HIGH] = under + outside[0], over + outside[1]
        _channels(mass, table[0], table[1], seen, out[SEEN_LOW], out[SEEN_HIGH], out)
        far_low, far_high, out[EXPECTED_FAR_LOW], out[EXPECTED_FAR_HIGH] = within(full, n, allowed_far)
        far = far_low + window[0], far_high + window[0]
        out[SEEN_FAR_LOW], out[SEEN_FAR_HIGH] = _beyond(counts, fitted.origin[p], far, outside)
        laws.support[p, 0], laws.support[p, 1], laws.support[p, 2] = first, size, used
        for x in range(size):
            laws.tables[used + x, 0], laws.tables[used + x, 1] = table[0, x], table[1, x]
        used += size
        if first >= axis and first + size <= axis + codes.single.shape[1]:
            shift = table[1] / (width * width + QUANTISATION_VARIANCE)
            _code_sums(law, seen, expected, shift, inside, first, codes)
