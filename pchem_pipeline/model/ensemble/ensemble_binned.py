"""Ensemble PCD from histograms of the parameter maps, dependent and independent.

The paper approximates the joint density of the parameters by a 4-D histogram (dependent) or by the product of
four histograms (independent) and replaces the integral of eq. full_ensemble_dist by a sum (Hendrickson
et al. 2023, Sec. IV-C). Bins are equally wide over the central part of each map, with one more bin at each
end for the rest. The mean of the pixels in a cell stands for it, not its centre: without the error of first
order in the bin width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import NEGLIGIBLE
from pchem_pipeline.model.arithmetic.normal_numba import REACH
from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, electron_pmf, weighted_mass
from pchem_pipeline.model.law.parameters import UsablePixels

#: Cells for each pixel up to which a table of all of them is faster than sorting.
_MOST_CELLS = 4
#: Analog noise (DN) to which narrower cells are widened in the inversion.
_NARROWEST = 0.05
#: Distance (DN) from the axis within which the inversion keeps signals from wrapping round; only a pixel of
#: absurd parameters is beyond.
_LONGEST = 65536.0
#: Frequencies of an inversion: noise too narrow for them, beside a wide range, is widened.
_MOST_FREQUENCIES = 1 << 14
#: Ratio of exposures that are inverted together: a hot pixel has frequencies of its own.
_ALIKE = 4.0


@dataclass(frozen=True)
class Cells:
    """Occupied cells of a histogram of d parameters."""

    share: FloatArray  # part of the pixels in each cell, shape (n_cells,), adding up to 1
    values: FloatArray  # parameters that stand for each cell, shape (d, n_cells)


def joint_cells(columns: Sequence[FloatArray], bins: int) -> Cells:
    """Histogram d parameters of n pixels, each (n,), so many bins each, and keep the occupied cells only."""
    index: IntArray = np.zeros(columns[0].size, dtype=np.int64)
    edges = [_edges(column, bins) for column in columns]
    for column, edge in zip(columns, edges, strict=True):
        place = np.searchsorted(edge, column, side="right")
        place[column == edge[-1]] = edge.size - 1  # the last bin is closed
        index *= edge.size + 1
        index += place
    inverse = _occupied(index, math.prod(edge.size + 1 for edge in edges))
    occupants = np.bincount(inverse)
    values = np.array([np.bincount(inverse, weights=column) / occupants for column in columns])
    return Cells(occupants / columns[0].size, values)


def _occupied(index: IntArray, n_cells: int) -> IntArray:
    """Return for each pixel the number of its cell among those that occur."""
    if n_cells > _MOST_CELLS * index.size:
        return np.unique(index, return_inverse=True)[1]
    cells = np.flatnonzero(np.bincount(index, minlength=n_cells))
    number = np.zeros(n_cells, dtype=np.int64)
    number[cells] = np.arange(cells.size)
    return np.asarray(number[index])


def _edges(column: FloatArray, bins: int) -> FloatArray:
    """Return the edges of equal bins: the 1st to 99th percentile, and half of that on either side."""
    first, last = np.percentile(column, [1.0, 99.0])
    beyond = 0.5 * (last - first)
    low = max(float(column.min()), float(first - beyond))
    high = min(float(column.max()), float(last + beyond))
    if not high > low:  # a constant map: one bin that holds it
        return np.array([low, np.nextafter(low, np.inf)])
    return np.linspace(low, high, bins + 1)


def epcd_dependent(pixels: UsablePixels, dn: DnAxis, bins: int) -> FloatArray:
    """Return the ensemble PCD, 1/DN, with the joint density of (H, g, mu, sigma^2) from a 4-D histogram.

    Hendrickson et al. 2023, eq. full_ensemble_dist with integrals replaced by sums, dependent parameters.
    """
    *first, sigma = pixels.maps
    cells = joint_cells((*first, sigma**2), bins)
    exposure, gain, bias, variance = cells.values
    return weighted_mass(UsablePixels(exposure, gain, bias, np.sqrt(variance)), dn, cells.share)


def epcd_independent(pixels: UsablePixels, dn: DnAxis, bins: int) -> FloatArray:
    """Return the ensemble PCD, 1/DN, with the joint density as the product of four histograms.

    The product of B bins each has B^4 cells, too many to visit. Its characteristic function factors
    instead: ``E_{g,H} exp(H (e^{it/g} - 1)) * E_mu e^{it mu} * E_sigma exp(-sigma^2 t^2 / 2)``
    (Hendrickson et al. 2023, eqs. EPCD_RV_definition and full_ensemble_dist, independent parameters). It
    falls off as a Gaussian, so the trapezoidal rule inverts it to rounding error, about 1e-15, unless it is
    so wide that narrow noise is widened.
    """
    exposures, gains, biases, variances = (
        joint_cells((column,), bins) for column in (*pixels.maps[:3], pixels.read_noise_dn**2)
    )
    density = np.zeros(dn.size)
    scale = np.floor(np.log(np.maximum(exposures.values[0], 1.0)) / math.log(_ALIKE))
    for each in np.unique(scale):
        mine = scale == each
        alike = Cells(exposures.share[mine], exposures.values[:, mine])
        origin, values = _inverted(alike, gains, biases, variances, dn)
        first, end = max(origin, dn.start), min(origin + values.size, dn.start + dn.size)
        if first < end:
            density[first - dn.start : end - dn.start] += values[first - origin : end - origin]
    return np.maximum(density, 0.0)


def _inverted(
    exposures: Cells, gains: Cells, biases: Cells, variances: Cells, dn: DnAxis
) -> tuple[int, FloatArray]:
    """Invert the characteristic function of pixels of similar exposures; return first DN and density."""
    origin, period = _period(exposures, gains, biases, variances, dn)
    variance = variances.values[0]
    # the finest structure that so many frequencies resolve
    least = max(_NARROWEST, period * REACH / (2 * np.pi * _MOST_FREQUENCIES)) ** 2
    spread = np.maximum(variance - QUANTISATION_VARIANCE, least)
    n_frequencies = math.ceil(period * REACH / (2 * np.pi * math.sqrt(spread.min())))
    folded = np.zeros(period, dtype=np.complex128)
    for start in range(0, n_frequencies + 1, 64):
        order = np.arange(start, min(start + 64, n_frequencies + 1))
        t = 2 * np.pi * order / period
        noise = np.sinc(t / (2 * np.pi)) * (np.exp(-0.5 * np.multiply.outer(t**2, spread)) @ variances.share)
        offset = np.exp(1j * np.multiply.outer(t, biases.values[0] - origin)) @ biases.share
        # of K/g for independent H and g
        phase = np.exp(1j * np.multiply.outer(t, 1.0 / gains.values[0])) - 1.0
        by_gain = np.exp(np.multiply.outer(phase, exposures.values[0])) @ exposures.share
        product = noise * offset * (by_gain @ gains.share)
        # frequencies beyond the sampling of the DN grid fold onto it, and those below zero are conjugates
        np.add.at(folded, order % period, np.where(order == 0, 0.5, 1.0) * product)
    return origin, 2.0 * np.fft.fft(folded).real / period


def _period(exposures: Cells, gains: Cells, biases: Cells, variances: Cells, dn: DnAxis) -> tuple[int, int]:
    """Return the first DN of the density and its length, both no further than ``_LONGEST`` from the axis."""
    reach = (REACH + 1.0) * math.sqrt(variances.values[0].max()) + 1.0
    least, most = float(exposures.values[0].min()), _enough_k(exposures.values[0])
    fewest = max(0.0, least - 12.0 * math.sqrt(least) - 40.0)
    low = biases.values[0].min() + fewest / gains.values[0].max() - reach
    high = biases.values[0].max() + most / gains.values[0].min() + reach
    first = math.floor(min(max(low, dn.start - _LONGEST), dn.start + dn.size))
    return first, math.ceil(min(max(high, dn.start), dn.start + dn.size + _LONGEST)) - first + 1


def within_limits(
    curve: Callable[[UsablePixels, DnAxis, int], FloatArray],
    pixels: UsablePixels,
    dn: DnAxis,
    bins: int,
    limits: tuple[int, int] | None,
) -> FloatArray:
    """Return a density of the raw ensemble with the mass beyond the limits of the codes at these.

    The curve, :func:`epcd_dependent` or :func:`epcd_independent`, is of an unlimited ADC; of its first and
    last code, DN, those at an end of ``dn`` count. None: no limits.
    """
    low, high = (False, False) if limits is None else (dn.start <= limits[0], dn.start + dn.size > limits[1])
    below = 0
    if low:
        lowest = float(np.min(pixels.bias - (REACH + 1.0) * pixels.read_noise_dn))
        below = math.ceil(min(max(dn.start - lowest, 0.0), _LONGEST))
    whole = curve(pixels, DnAxis(dn.start - below, dn.size + below), bins)
    found = whole[below:].copy()
    found[0] += whole[:below].sum()
    if high:  # a density at the integers adds up to 1
        found[-1] += max(1.0 - float(found.sum()), 0.0)
    return found


def nuced_dependent(pixels: UsablePixels, axis: NucedAxis, bins: int) -> FloatArray:
    """Return the NUCed ensemble PCD, 1/e-, with the joint density of (H, sigma_e-^2) from a 2-D histogram.

    Hendrickson et al. 2023, eq. partial_ensemble_dist, dependent parameters; each value is the mean of the
    density over its bin, as in the data.
    """
    cells = joint_cells((pixels.quanta_exposure, pixels.read_noise_e**2), bins)
    return _in_bins(cells.values[0], np.zeros(cells.share.size), cells.values[1], axis, cells.share)


def nuced_independent(pixels: UsablePixels, axis: NucedAxis, bins: int) -> FloatArray:
    """Return the NUCed ensemble PCD, 1/e-, (n_bins,), with the density as the product of two histograms.

    Hendrickson et al. 2023, eq. partial_ensemble_dist, independent parameters, averaged over each bin.
    """
    mass = electron_pmf_binned(pixels.quanta_exposure, _enough_k(pixels.quanta_exposure), bins)
    noise = joint_cells((pixels.read_noise_e**2,), bins)
    share = np.multiply.outer(mass, noise.share)
    electrons, variance = np.broadcast_arrays(np.arange(mass.size)[:, None], noise.values)
    some = share > NEGLIGIBLE
    return _in_bins(np.zeros(int(some.sum())), electrons[some], variance[some], axis, share[some])


def _in_bins(
    exposure: FloatArray, offset: NDArray[Any], variance: FloatArray, axis: NucedAxis, share: FloatArray
) -> FloatArray:
    """Return the density of ``offset + K + R`` in the bins of an axis: as of codes of so many electrons."""
    width, noise = axis.width, np.sqrt(variance / axis.width**2 + QUANTISATION_VARIANCE)
    pixels = UsablePixels(exposure, np.full(exposure.size, width), offset / width, noise)
    return weighted_mass(pixels, DnAxis(axis.start, axis.size), share) / width


def electron_pmf_binned(quanta_exposure: FloatArray, n_k: int, bins: int) -> FloatArray:
    """Return the mass of the ensemble electron number, (n_k,), with the density of H, (n,), from a histogram.

    Hendrickson et al. 2023, eq. K_ensemble_pmf with the integral replaced by a sum.
    """
    cells = joint_cells((quanta_exposure,), bins)
    return electron_pmf(cells.values[0], n_k, cells.share)


def _enough_k(exposure: FloatArray) -> int:
    """Return a number of electron numbers beyond which the largest exposure has no mass."""
    largest = float(exposure.max())
    return int(largest + 12.0 * np.sqrt(largest) + 40.0)
