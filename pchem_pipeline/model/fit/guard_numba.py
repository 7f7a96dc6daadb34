"""Loops of :mod:`pchem_pipeline.model.fit.guard`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE
from pchem_pipeline.model.fit.climb_numba import Limits
from pchem_pipeline.model.fit.search_numba import AMPLITUDE, SATELLITE_WEIGHT
from pchem_pipeline.model.fit.tile_numba import Answers, Histograms, load_pixel, make_room, theta_of
from pchem_pipeline.model.law.cells_numba import Law, resolve
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    CENTRE,
    COUNTED,
    EXPECTATIONS,
    EXPECTED,
    FIRST,
    HERE,
    LEFT_OUT,
    LOG_VARIANCE,
    N_BINS,
    N_FRAMES,
    SATELLITE,
    SET_ASIDE,
    WEIGHT,
    make_scratch,
)

_CORE_TAIL = 0.02  # share of the frames beyond either end of the core
_FAR = 0.6  # widths of the core: a wider gap beyond it makes a sample far
_FEW_DN = 4.0


@kernel(inline=True)
def core_ends(counts: NDArray[np.generic], n: float) -> tuple[int, int]:
    """Return first and end of the bins that no gap cuts off from the core, which holds 96 % of the frames.

    The model has no say here: far samples would otherwise lead the search for its parameters astray, where
    peaks hundreds of DN apart explain them.
    """
    low, high, below, above = 0, counts.size - 1, 0.0, 0.0
    while low < high and below + counts[low] < _CORE_TAIL * n:
        below += counts[low]
        low += 1
    while high > low and above + counts[high] < _CORE_TAIL * n:
        above += counts[high]
        high -= 1
    gap = _FAR * (high - low + 1.0) + _FEW_DN
    first = last = low
    for i in range(low, -1, -1):
        if counts[i] > 0:
            if first - i > gap:
                break
            first = i
    last = high
    for i in range(high, counts.size):
        if counts[i] > 0:
            if i - last > gap:
                break
            last = i
    return first, last + 1


@kernel(inline=True)
def inner_ends(counts: NDArray[np.generic], n: float, share: float) -> tuple[int, int]:
    """Return first and end of the bins left when a share of the frames is cut off, half at each end."""
    low, high, below, above = 0, counts.size, 0.0, 0.0
    while low < high - 1 and below + counts[low] <= 0.5 * share * n:
        below += counts[low]
        low += 1
    while high > low + 1 and above + counts[high - 1] <= 0.5 * share * n:
        above += counts[high - 1]
        high -= 1
    return low, high


@kernel
def cut_tile(
    given: Histograms,
    chosen: NDArray[np.int64],
    share: float,
    mask: NDArray[np.uint8],
    gone: NDArray[np.float64],
) -> None:
    """Leave out both ends of each histogram, a share of its frames, or what a gap cuts off from its core.

    Args:
        given: histograms.
        chosen: pixels.
        share: of the frames; 0: what a gap cuts off.
        mask: out, of all pixels or of none: then nothing is left out, only counted.
        gone: out, how many samples are left out, shape (n,).
    """
    for index in chosen:
        gone[index] = 0.0
        for j in range(given.dark.size):
            start, stop = given.places[j], given.places[j + 1]
            while start < stop and given.counts[index, start] == 0:
                start += 1
            while stop > start and given.counts[index, stop - 1] == 0:
                stop -= 1
            counts = given.counts[index, start:stop]
            n = 0.0
            for i in range(counts.size):
                n += counts[i]
            if share > 0.0:
                first, end = inner_ends(counts, n, share)
            else:
                first, end = core_ends(counts, n)
            if first == 0 and end == counts.size and mask.shape[0] == 0:
                continue
            for i in range(counts.size):
                inside = first <= i < end or given.mask[index, start + i] == SET_ASIDE
                if not inside:
                    gone[index] += counts[i]
                if mask.shape[0] > 0 and given.mask[index, start + i] != SET_ASIDE:
                    mask[index, start + i] = COUNTED if inside else LEFT_OUT


@kernel
def leave_out_tile(
    given: Histograms,
    chosen: NDArray[np.int64],
    law: Law,
    limits: Limits,
    evaluate: Any,
    answers: Answers,
    gone: NDArray[np.float64],
    changed: NDArray[np.bool_],
) -> None:
    """Leave out the samples that the last fit does not expect, and take back the others.

    Args:
        given: histograms; their mask is updated.
        chosen: pixels.
        law: of the samples.
        limits: bounds and limits.
        evaluate: the likelihood.
        answers: the last fit.
        gone: in and out, how many samples are left out, shape (n,).
        changed: out, whether those are others than before, shape (n,).
    """
    n = given.dark.size
    room = make_room(given, law)
    scratch = make_scratch(n, room.bins.shape[2] - 1, limits.cells)
    theta = scratch.small[HERE]
    before = np.empty(given.mask.shape[1], np.uint8)
    for index in chosen:
        mask = given.mask[index]
        for i in range(mask.size):
            before[i] = mask[i]
            if mask[i] == LEFT_OUT:
                mask[i] = COUNTED
        pixel = load_pixel(given, index, room)
        if limits.cells:
            resolve(law, index, answers.out[index, AMPLITUDE], pixel)
        theta_of(answers.parameters[index], pixel, limits, theta)
        if limits.cells:
            variance = np.exp(theta[n + LOG_VARIANCE]) - QUANTISATION_VARIANCE
            theta[n + LOG_VARIANCE] = np.log(max(variance, LEAST_VARIANCE))
            theta[n + SATELLITE] = answers.out[index, SATELLITE_WEIGHT]
        total = 0.0
        for j in range(n):
            total += pixel.facts[j, N_FRAMES]
        for j in range(n):
            pixel.facts[j, N_FRAMES] *= (total - gone[index]) / total
        for j in range(n):  # what is far out need not be known to the last digit
            for b in range(int(pixel.facts[j, N_BINS])):
                pixel.bins[j, WEIGHT, b] = 0.0
        evaluate(pixel, theta, EXPECTATIONS, scratch, scratch.evaluations[AT])
        gone[index], changed[index] = 0.0, False
        for j in range(n):
            lowest = pixel.centre + int(pixel.facts[j, CENTRE] + pixel.facts[j, FIRST])
            first = given.places[j] + lowest - given.origin[index, j]
            for b in range(int(pixel.facts[j, N_BINS])):
                place = first + b
                count = given.counts[index, place]
                if count == 0 or before[place] == SET_ASIDE:
                    continue
                expected = pixel.bins[j, EXPECTED, b]
                stays = expected >= limits.floor or not np.isfinite(expected)
                if not stays:
                    mask[place] = LEFT_OUT
                    gone[index] += count
                changed[index] = changed[index] or stays != (before[place] == COUNTED)
