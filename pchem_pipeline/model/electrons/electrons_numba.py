"""Loops of :mod:`pchem_pipeline.model.electrons.electrons`: tables from code to electron number."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import NEGLIGIBLE, SMALLEST_MASS
from pchem_pipeline.model.law.cells_numba import Law
from pchem_pipeline.model.law.mass_numba import (
    fill_level,
    known_theta,
    number_mass,
    number_range,
    pixel_scratch,
    place_codes,
    share_scratch,
)
from pchem_pipeline.model.law.pixel_numba import OWN, sample_of

#: Exposure that stands for a prior in which all electron numbers are alike.
NO_PRIOR = -1.0


class PixelLaws(NamedTuple):
    """What n pixels and their samples follow."""

    parameters: FloatArray  # (H, g, mu, sigma), shape (n, 4)
    satellites: FloatArray  # amplitude (e-) and weight of free satellites, shape (n, 2)
    law: Law  # of the samples


class CodeTables(NamedTuple):
    """What each code of n pixels says of the electron number, one pixel after the other."""

    first: IntArray  # first code of each pixel, shape (n,)
    start: IntArray  # place of it in the tables; the last element is their length, shape (n + 1,)
    number: NDArray[Any]  # the most probable one; the largest value of the type: none
    mass: FloatArray  # P(code); empty: not wanted
    right: FloatArray  # P(code, and the number is right); likewise
    expected: Float32Array  # E[k | x], e-; likewise, and NaN where the law expects no such code


class Numbers(NamedTuple):
    """Electron numbers of samples, each array of the shape of the frames.

    Attributes:
        number: the most probable one; the largest value of the type where a pixel has no parameters.
        probability: that it is right; empty where the tables have none.
        expected: E[k | x], e-; empty where it was not asked for.
    """

    number: NDArray[Any]
    probability: Float32Array
    expected: Float32Array


@kernel
def fill_tables(
    tables: CodeTables, parts: int, prior: FloatArray, pixels: PixelLaws, largest: int, missing: int
) -> None:
    """Fill, for each code of each pixel, the most probable electron number, how probable, and the mean.

    Args:
        tables: in, the codes, in parts of a DN; out, the rest, NaN for pixels without parameters.
        parts: codes in a DN.
        prior: exposure to expect, e-; ``NO_PRIOR``: all numbers alike; shape (n,).
        pixels: what they follow.
        largest: electron numbers above are cut to this.
        missing: what codes of pixels without parameters get.
    """
    first, start, number, mass, right, expected = tables
    parameters, satellites, law = pixels
    most = 1
    for p in range(first.size):
        most = max(most, start[p + 1] - start[p])
    pixel, scratch = pixel_scratch(most + 2, law)
    detailed, share = mass.size > 0, share_scratch(most)
    theta, sums = scratch.small[OWN], np.empty((3, most))
    for p in range(first.size):
        at, n = start[p], start[p + 1] - start[p]
        for i in range(n):
            number[at + i] = missing
            if detailed:
                mass[at + i] = right[at + i] = math.nan
                expected[at + i] = np.float32(math.nan)
        if n == 0 or math.isnan(prior[p]):
            continue
        placed, codes = place_codes(p, first[p], n, parts, law, satellites, pixel)
        if not known_theta(parameters[p], placed.centre, satellites[p, 1], theta):
            continue
        cells = sample_of(placed, 0)
        for i in range(n):
            sums[0, i] = sums[1, i] = sums[2, i] = 0.0
            number[at + i] = 0
        lowest, end = number_range(theta, cells, codes)
        for k in range(lowest, end):
            likely = 1.0 if prior[p] < 0.0 else number_mass(k, prior[p], cells)
            if likely < NEGLIGIBLE:
                continue
            low, high = fill_level(k, likely, theta, cells, codes, share)
            for i in range(low, high):
                joint = likely * share[0, i - low]
                sums[0, i] += joint
                sums[1, i] += k * joint
                if joint > sums[2, i]:
                    sums[2, i] = joint
                    number[at + i] = min(k, largest)
        rest = 1.0 - cells.law.outlier_share
        for i in range(n):
            if detailed:
                mass[at + i] = rest * sums[0, i] + cells.law.outlier_mass
                right[at + i] = rest * sums[2, i]
            if sums[0, i] > SMALLEST_MASS:
                if detailed:
                    expected[at + i] = np.float32(sums[1, i] / sums[0, i])
            elif prior[p] != 0.0:  # farther from all levels than any sample of the law: the nearest
                value = (codes.first + i / parts - theta[2]) / theta[1]
                number[at + i] = min(max(math.floor(value + 0.5), 0), largest)


@kernel
def convert_frames(frames: NDArray[Any], tables: CodeTables, missing: int, out: Numbers) -> None:
    """Look every code, shape (frame, n), up in the table of its pixel; one that is not there is missing."""
    first, start, number, mass, right, expected = tables
    with_probability, with_expected = out.probability.size > 0, out.expected.size > 0
    for t in range(frames.shape[0]):
        for p in range(frames.shape[1]):
            i = start[p] + np.int64(frames[t, p]) - first[p]
            known = start[p] <= i < start[p + 1]
            out.number[t, p] = number[i] if known else missing
            if with_probability:
                sure = known and mass[i] > SMALLEST_MASS
                out.probability[t, p] = np.float32(right[i] / mass[i] if sure else math.nan)
            if with_expected:
                out.expected[t, p] = expected[i] if known else np.float32(math.nan)


@kernel
def count_numbers(
    counts: NDArray[Any], origin: IntArray, tables: CodeTables, missing: int, out: IntArray
) -> None:
    """Count the samples of histograms by their electron number; those without one are left out.

    The counts are of shape (n, n_bins), the DN of bin 0 (n,). They are added to ``out``, in whose last place
    are the samples of that number and of larger ones.
    """
    start, number = tables.start, tables.number
    for p in range(origin.size):
        place = start[p] + origin[p] - tables.first[p]
        for i in range(max(0, start[p] - place), min(counts.shape[1], start[p + 1] - place)):
            if number[place + i] != missing:
                out[min(int(number[place + i]), out.size - 1)] += int(counts[p, i])
