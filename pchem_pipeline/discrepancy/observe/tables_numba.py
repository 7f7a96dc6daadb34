"""Loops of :mod:`pchem_pipeline.discrepancy.observe.tables`, over pixels one by one."""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.cell_scores_numba import N_NUISANCE, REACH, electron_range, fill_law


@kernel
def supports(parameters: FloatArray, log_negligible: float, electrons: IntArray, codes: IntArray) -> None:
    """Fill the ranges of electron numbers and of codes (n, 2) that the law of each pixel covers.

    Args:
        parameters: H, 1/g, mu, analog read noise in DN, (n, 4).
        log_negligible: logarithm of the probability of electron numbers that are left out.
        electrons: to fill.
        codes: to fill.
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
def fill_laws(
    parameters: FloatArray,
    electrons: IntArray,
    codes: IntArray,
    samples: FloatArray,
    allowed: tuple[float, float],
    expected: FloatArray,
    law: FloatArray,
    ends: IntArray,
    beyond: FloatArray,
) -> None:
    """Fill the laws of n pixels from the first code of their support on.

    Args:
        parameters: H, 1/g, mu, analog read noise in DN, (n, 4).
        electrons: ranges of electron numbers, (n, 2).
        codes: ranges of codes, DN, (n, 2).
        samples: of each pixel, (n,).
        allowed: samples expected beyond the support on either side, and far beyond it, at most.
        expected: to fill with the samples expected of all codes, (n, code).
        law: to fill, (n, code, column); both stay as they are behind the last code of a pixel.
        ends: to fill with the first and last code of the support, and those that are not far beyond it, DN,
            (n, 4).
        beyond: to fill with the samples expected below and above these, (n, 4).
    """
    for p in range(law.shape[0]):
        exposure, step, bias, width = parameters[p]
        full = np.empty((codes[p, 1] - codes[p, 0] + 1, law.shape[2]))
        fill_law(exposure, step, bias - codes[p, 0], width, electrons[p, 0], electrons[p, 1], False, full)
        for which in range(2):
            low, high, below, above = _support(full, samples[p], allowed[which])
            ends[p, 2 * which], ends[p, 2 * which + 1] = codes[p, 0] + low, codes[p, 0] + high
            beyond[p, 2 * which], beyond[p, 2 * which + 1] = below, above
        first = ends[p, 0] - codes[p, 0]
        for x in range(full.shape[0]):
            expected[p, x] = samples[p] * full[x, 0]
        for x in range(ends[p, 1] - ends[p, 0] + 1):
            for column in range(law.shape[2]):
                law[p, x, column] = full[first + x, column]


@kernel
def goodness(
    law: FloatArray,
    seen: FloatArray,
    expected: FloatArray,
    size: IntArray,
    smallest: float,
    shortest: FloatArray,
    out: FloatArray,
) -> None:
    """Fill Pearson's chi-square of merged codes, its mean and variance with the parameters fitted, (n, 3).

    Args:
        law: its columns of the parameters, whitened, (N_NUISANCE, n, code).
        seen: samples of each code, (n, code).
        expected: those expected.
        size: codes of the support, which come first, (n,).
        smallest: samples expected of a group, at least.
        shortest: codes in a group of each pixel, at least, (n,).
        out: to fill.
    """
    taken = np.zeros(N_NUISANCE)
    for p in range(seen.shape[0]):
        n = 0.0
        for x in range(size[p]):
            n += seen[p, x]
        chi2 = mean = inverse = 0.0
        groups = merged = 0
        observed = wanted = 0.0
        remaining = n
        for i in range(N_NUISANCE):
            taken[i] = 0.0
        for x in range(size[p]):
            merged += 1
            observed += seen[p, x]
            wanted += expected[p, x]
            for i in range(N_NUISANCE):
                taken[i] += law[i, p, x]
            full = wanted >= smallest and merged >= shortest[p]
            if (full and remaining - wanted >= smallest) or x == size[p] - 1:
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
        out[p, 0], out[p, 1], out[p, 2] = chi2, mean, variance
