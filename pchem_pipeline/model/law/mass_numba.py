"""What each electron number of a known pixel gives to its codes, and the mass of these.

With g, mu and sigma held, ``P(x) = sum_k P(k; H) W_k(x)`` under any law of the samples
(:mod:`pchem_pipeline.model.law.sample_law`), and only P(k; H) depends on the exposure. A code may be a whole
DN or a fraction of one (``1 / parts``) where an offset was taken from the samples: the cell of a sample is
still 1 DN wide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE, SMALLEST_MASS
from pchem_pipeline.model.arithmetic.normal_numba import FARTHEST, REACH, normal_mass, reach_of
from pchem_pipeline.model.arithmetic.simd_math_numba import simd_tail
from pchem_pipeline.model.arithmetic.simd_numba import SIMD_WIDTH, fused, simd_load, simd_store
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Component, Law, cell_of, component, fill_masses, resolve
from pchem_pipeline.model.law.electron_laws_numba import electron_number
from pchem_pipeline.model.law.pixel_numba import Pixel, Sample, Scratch, make_pixel, make_scratch, sample_of

_TOP_REACH = 12.0
_SEEN = 7.5  # standard deviations within which samples are seen
_LEAST_MASS = 1e-14  # of an electron number that is looked at
_MOST_EXPOSURE = 1e6  # e-: each electron number costs, and cumulants may ask for 1e13 of them


class Codes(NamedTuple):
    """Codes of a pixel: ``first + i / parts`` DN after a whole code, i < n."""

    first: float
    parts: int
    n: int


@kernel
def place_codes(
    index: int, first: int, n: int, parts: int, law: Law, satellites: FloatArray, pixel: Pixel
) -> tuple[Pixel, Codes]:
    """Fill what the law says of a pixel whose codes are ``(first + i) / parts`` DN; return both."""
    value = first / parts
    whole = math.floor(value + 0.5)
    codes = Codes(value - whole, parts, n)
    n_whole = math.floor(codes.first + (n - 1) / parts + 0.5) + 1
    pixel.facts[0].n_bins, pixel.facts[0].first = n_whole, 0.0
    found = Pixel(pixel.bins, pixel.facts, pixel.laws, pixel.peaks, pixel.mixtures, whole, 0.0)
    resolve(law, index, satellites[index, 0], found)
    return found, codes


@kernel
def share_scratch(n_codes: int) -> FloatArray:
    """Return an array for what electron numbers give to so many codes, see `fill_level`."""
    return np.zeros((2, n_codes + 2 * SIMD_WIDTH))


@kernel(borrows=True)
def number_mass(k: int, exposure: float, cells: Sample) -> float:
    """Return P(k; H) of a pixel; H may be 0."""
    mass: float = electron_number(
        cells.law.count_law, cells.law.dispersion, k, max(exposure, SMALLEST_MASS), cells.mixtures
    )[0]
    return mass


@kernel(borrows=True)
def _span(k: int, theta: FloatArray, cells: Sample, codes: Codes, reach: float) -> tuple[int, int, float]:
    """Return the codes that an electron number reaches, ends excluded, and how far up it lies at least."""
    low, high = codes.n, 0
    nearest = math.inf
    for peak in range(cells.facts.n_peaks):
        if cells.peaks[px.SHARE, peak] == 0.0 and cells.peaks[px.SHARE_SLOPE, peak] == 0.0:
            continue
        part = component(float(k), peak, theta, cells, REACH)
        width = min(FARTHEST, max(reach, theta[1] / part.sd)) * part.sd + 0.5 + cells.facts.margin
        bottom, top = part.mean - width - codes.first, part.mean + width - codes.first
        nearest = min(nearest, bottom + codes.first)
        low = min(low, int(min(max(math.ceil(bottom * codes.parts), 0.0), float(codes.n))))
        high = max(high, int(min(max(math.floor(top * codes.parts) + 1.0, 0.0), float(codes.n))))
    # beyond the limits of the ADC all is counted at the limit
    if cells.facts.bottom >= 0:
        high = max(high, min(codes.n, (cells.facts.bottom + 1) * codes.parts))
        low = 0 if high > 0 and nearest < codes.first else low
    if cells.facts.top <= cells.facts.n_bins:
        low = max(0, min(low, (cells.facts.top - 1) * codes.parts - codes.parts // 2))
        high = codes.n
    return low, high, nearest


@kernel(borrows=True)
def reach_of_law(exposure: float, index: int, theta: FloatArray, pixel: Pixel, law: Law) -> tuple[int, int]:
    """Return the first and last whole code that samples of a pixel show, after its centre."""
    cells = sample_of(pixel, 0)
    factor = added = 0.0
    for i in range(cells.mixtures.shape[1]):
        factor = max(factor, cells.mixtures[px.EXPOSURE_FACTOR, i])
        added = max(added, cells.mixtures[px.ADDED_EXPOSURE, i])
    margin = 1.0
    row = index if law.edge_shift.shape[1] > 1 else 0
    for i in range(law.edge_shift.shape[2]):
        margin = max(margin, 1.0 + abs(law.edge_shift[0, row, i]))
    low, high = math.inf, -math.inf
    k = 0
    while True:
        seen = number_mass(k, exposure, cells) > _LEAST_MASS
        if not seen and k > exposure * factor + added:
            break
        for peak in range(cells.facts.n_peaks if seen else 0):
            part = component(float(k), peak, theta, cells, REACH)
            reach = _SEEN * part.sd + margin
            low, high = min(low, part.mean - reach), max(high, part.mean + reach)
        k += 1
    bottom, top = cells.law.clip_low - pixel.centre, cells.law.clip_high - pixel.centre
    low, high = min(max(low, bottom), top), max(min(high, top), bottom)
    return math.floor(low), math.ceil(high)


@kernel(borrows=True)
def _add_whole(cells: Sample, part: Component, weight: float, low: int, high: int, share: FloatArray) -> None:
    """Add the mass of whole codes to the first row of ``share``; the second gets the tails at their edges."""
    mean, inverse = part.mean, 1.0 / part.sd
    for i in range(low, high + 1, SIMD_WIDTH):
        tail, _, _ = simd_tail((simd_load(cells.bins, px.EDGE, i) - mean) * inverse)
        simd_store(share, 1, i - low, tail)
    for i in range(0, high - low, SIMD_WIDTH):
        inside = simd_load(share, 1, i + 1) - simd_load(share, 1, i)
        simd_store(share, 0, i, fused(inside, weight, simd_load(share, 0, i)))
    middle = cell_of(mean, cells, low, high)
    if low <= middle < high:  # both tails are those beyond its edges
        share[0, middle - low] += weight


@kernel(borrows=True)
def number_range(theta: FloatArray, cells: Sample, codes: Codes) -> tuple[int, int]:
    """Return the first electron number that reaches the codes, and the one after the last."""
    last = codes.first + (codes.n - 1) / codes.parts
    to_top = cells.facts.top <= cells.facts.n_bins
    most = max((last - theta[2]) / theta[1], 0.0)
    most = most + _TOP_REACH * math.sqrt(most + 1.0) + _TOP_REACH
    first, end = -1, 0
    k = 0
    while True:
        low, high, nearest = _span(k, theta, cells, codes, REACH)
        if (nearest > last + 1.0 and not to_top) or k > 4.0 * most + 1e3 or (to_top and k > most):
            break
        if low < high:
            first = k if first < 0 else first
            end = k + 1
        k += 1
    return max(first, 0), end


@kernel(borrows=True)
def fill_level(
    k: int, likely: float, theta: FloatArray, cells: Sample, codes: Codes, share: FloatArray
) -> tuple[int, int]:
    """Fill P(code | k) of the codes that an electron number reaches; return these, the end excluded.

    One of little probability (``likely``) is given fewer codes. They go to the first row of the ``share``,
    see :func:`share_scratch`; the second one is worked in.
    """
    low, high, _ = _span(k, theta, cells, codes, reach_of(math.log(likely)))
    for i in range(high - low):
        share[0, i] = 0.0
    for peak in range(cells.facts.n_peaks if low < high else 0):
        weight = cells.peaks[px.SHARE, peak] + theta[4] * cells.peaks[px.SHARE_SLOPE, peak]
        if weight == 0.0:
            continue
        part = component(float(k), peak, theta, cells, REACH)
        if codes.parts == 1:
            _add_whole(cells, part, weight, low, high, share)
            continue
        for i in range(low, high):
            value = codes.first + i / codes.parts
            whole = math.floor(value + 0.5)
            aside = value - whole
            lower, upper = cells.bins[px.EDGE, whole] + aside, cells.bins[px.EDGE, whole + 1] + aside
            inside = normal_mass((lower - part.mean) / part.sd, (upper - part.mean) / part.sd)
            share[0, i - low] += weight * inside
    return low, max(low, high)


@kernel
def pixel_scratch(n_bins: int, law: Law) -> tuple[Pixel, Scratch]:
    """Return room for one sample of so many bins."""
    n_peaks = law.peaks.shape[3] * (1 + law.pattern.shape[0])
    n_exposures = max(law.exposures.shape[3], law.added.shape[3])
    pixel = make_pixel(np.zeros(1, np.bool_), n_bins, n_peaks, n_exposures)
    return pixel, make_scratch(1, n_bins, True)


@kernel
def known_theta(parameters: FloatArray, centre: int, weight: float, theta: FloatArray) -> bool:
    """Fill a sample's own theta from (H, g, mu, sigma); False unless known, and H that of a pixel."""
    if not (math.isfinite(parameters.sum()) and parameters[0] < _MOST_EXPOSURE):
        return False
    theta[0] = math.log(max(parameters[0], SMALLEST_MASS))
    theta[1] = 1.0 / parameters[1]
    theta[2] = parameters[2] - centre
    theta[3] = math.log(max(parameters[3] * parameters[3] - QUANTISATION_VARIANCE, LEAST_VARIANCE))
    theta[4] = weight
    return True


@kernel
def find_reach(parameters: FloatArray, satellites: FloatArray, law: Law, out: IntArray) -> None:
    """Fill the first and last code that each pixel shows, DN, shape (n, 2); (0, -1) without parameters."""
    pixel, scratch = pixel_scratch(2, law)
    theta = scratch.small[px.OWN]
    for p in range(parameters.shape[0]):
        out[p, 0], out[p, 1] = 0, -1
        placed, _ = place_codes(p, 0, 1, 1, law, satellites, pixel)
        if known_theta(parameters[p], placed.centre, satellites[p, 1], theta):
            out[p, 0], out[p, 1] = reach_of_law(parameters[p, 0], p, theta, placed, law)


@kernel
def mass_tile(
    first: IntArray,
    parameters: FloatArray,
    satellites: FloatArray,
    law: Law,
    stage: int,
    out: FloatArray,
    slopes: FloatArray,
) -> None:
    """Fill the mass of successive codes of every pixel whose parameters are finite, and its slopes.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        satellites: amplitude (e-) and weight of each pixel's free satellite peaks, shape (n, 2).
        law: of the samples.
        stage: how far the tails go, see :func:`.cells_numba.fill_masses`.
        out: out, shape (n, n_codes); comes as NaN.
        slopes: out, in log H, 1/g, mu and log sigma_R^2, shape (n, 4, n_codes), comes as NaN; or (0, 4,
            n_codes).
    """
    n_codes = out.shape[1]
    room, scratch = pixel_scratch(n_codes, law)
    theta, what = scratch.small[px.OWN], px.DERIVATIVES if slopes.shape[0] > 0 else px.LOGLIK_ALONE
    room.facts[0].n_bins, room.facts[0].first = n_codes, 0.0
    for index in range(parameters.shape[0]):
        if not known_theta(parameters[index], first[index], satellites[index, 1], theta):
            continue
        pixel = Pixel(room.bins, room.facts, room.laws, room.peaks, room.mixtures, first[index], 0.0)
        resolve(law, index, satellites[index, 0], pixel)
        cells = sample_of(pixel, 0)
        fill_masses(theta, cells, stage, what, scratch.numbers, scratch.edges, scratch.cells[0])
        for i in range(n_codes):
            out[index, i] = scratch.cells[0, px.MASS, i]
        for j in range(px.N_BLOCK - 1 if slopes.shape[0] > 0 else 0):
            for i in range(n_codes):
                slopes[index, j, i] = scratch.cells[0, px.SLOPES + j, i]
