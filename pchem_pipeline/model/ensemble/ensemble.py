"""The ensemble of pixels: exact mean of the pixels' PCDs, and the data on the same axes.

The ensemble PCD is ``f_E(x) = E_theta f_X(x | theta)`` (Hendrickson et al. 2023, eq. full_ensemble_dist).
With one parameter vector per pixel that expectation is the mean over the pixels; nothing need be binned.
The binned forms of the paper are in :mod:`pchem_pipeline.model.ensemble.ensemble_binned`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.ensemble import ensemble_numba
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.law.parameters import FloatArray, UsablePixels

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class DnAxis:
    """Consecutive integer DN.

    Attributes:
        start: first DN.
        size: number of DN.
    """

    start: int
    size: int

    @property
    def dn(self) -> IntArray:
        """The DN, shape (size,)."""
        return np.arange(self.start, self.start + self.size, dtype=np.int64)


@dataclass(frozen=True)
class NucedAxis:
    """Equal bins of the NUCed value ``(x - mu) g``; bin j is centred on ``(start + j) width``.

    Attributes:
        width: bin width, e-.
        start: index of the first bin; bin 0 is centred on 0 e-.
        size: number of bins.
    """

    width: float
    start: int
    size: int

    @property
    def electrons(self) -> FloatArray:
        """Centres of the bins, e-, shape (size,)."""
        return np.arange(self.start, self.start + self.size, dtype=np.float64) * self.width


@dataclass(frozen=True)
class EnsembleSums:
    """Sums over pixels of the predicted mass of each bin, and of its square.

    Attributes:
        n_pixels: number of pixels in the sums.
        raw: sum of f_X at the integer DN, 1/DN, shape (n_dn,).
        raw_square: sum of its square.
        nuced: sum of the mass in the bins of the NUCed axis, shape (n_bins,).
        nuced_square: sum of its square.
    """

    n_pixels: int
    raw: FloatArray
    raw_square: FloatArray
    nuced: FloatArray
    nuced_square: FloatArray


@dataclass(frozen=True)
class Tally:
    """The data of a set of pixels on the axes of the ensemble.

    Attributes:
        raw: samples at each DN, shape (n_dn,).
        nuced: samples in each bin of the NUCed axis, shape (n_bins,).
        outside: samples beyond the DN axis.
        nuced_outside: samples beyond the NUCed axis.
        nuced_sum: sum of the NUCed values of all samples, e-.
        nuced_sum_square: sum of their squares, e-^2.
    """

    raw: IntArray
    nuced: IntArray
    outside: int
    nuced_outside: int
    nuced_sum: float
    nuced_sum_square: float


def nuced_axis(pixels: UsablePixels, dn: DnAxis, *, width: float | None = None, steps: int = 1) -> NucedAxis:
    """Choose the bins of the NUCed histogram.

    A pixel's NUCed values lie on a lattice of pitch g. A bin of width w holds ``floor(w/g)`` or one more
    of its points, and their jitter from pixel to pixel is noise on the histogram that no number of frames
    removes. It is smallest where w is a whole multiple of the typical g, hence the default.

    Args:
        pixels: the pixels.
        dn: axis of the raw data; the NUCed axis reaches no further than it does for the median pixel's
            neighbours (1st to 99th percentile of g and mu), so that one strange gain cannot stretch it.
        width: bin width, e-; None: ``steps`` times the median g.
        steps: DN per bin where ``width`` is None.

    Returns:
        The axis.
    """
    gain, bias = pixels.conversion_gain, pixels.bias
    pitch = float(np.median(gain))
    bin_width = steps * pitch if width is None else width
    tail = 10.0 * float(np.percentile(pixels.read_noise_e, 99))
    largest_gain = float(np.percentile(gain, 99))
    lowest = max(-tail, (dn.start - float(np.percentile(bias, 99))) * largest_gain)
    highest = (dn.start + dn.size - float(np.percentile(bias, 1))) * largest_gain
    start = math.floor(lowest / bin_width)
    return NucedAxis(bin_width, start, max(math.ceil(highest / bin_width) - start, 1))


def ensemble_sums(pixels: UsablePixels, dn: DnAxis, nuced: NucedAxis | None = None) -> EnsembleSums:
    """Sum the pixels' PCDs at the integer DN, and the same masses sorted into NUCed bins.

    The sorted masses are what the NUCed data must show, lattice and all: each DN of a pixel lies at ``(x
    - mu) g`` and falls into one bin as a whole (Hendrickson et al. 2023, eq. partial_ensemble_dist,
    before the lattice is smoothed over).

    Args:
        pixels: the pixels.
        dn: axis of the raw prediction; it should hold all of the data.
        nuced: axis of the NUCed prediction, or None for none.

    Returns:
        The sums; divide by ``n_pixels`` for the means.
    """
    raw, bins = _raw_sums(dn), _nuced_sums(nuced)
    ensemble_numba.sum_pcd_pixels(tuple(pixels.maps), raw, bins)
    return EnsembleSums(len(pixels), raw.total, raw.square, bins.total, bins.square)


def _raw_sums(dn: DnAxis) -> ensemble_numba.AxisSums:
    return ensemble_numba.AxisSums(dn.start, 1.0, *np.zeros((2, dn.size)))


def _nuced_sums(nuced: NucedAxis | None) -> ensemble_numba.AxisSums:
    if nuced is None:
        return ensemble_numba.AxisSums(0, 0.0, *np.zeros((2, 0)))
    return ensemble_numba.AxisSums(nuced.start, nuced.width, *np.zeros((2, nuced.size)))


def mass_sums(
    mass: FloatArray, first: IntArray, start: IntArray, pixels: UsablePixels, dn: DnAxis, nuced: NucedAxis
) -> tuple[EnsembleSums, FloatArray]:
    """Sum the masses that any law gives to the codes of pixels, at the integer DN and sorted into NUCed bins.

    Their mean replaces that of the PCDs (Hendrickson et al. 2023, eq. full_ensemble_dist).

    Args:
        mass: of successive codes, one pixel after the other.
        first: first code of each pixel, DN, shape (n,).
        start: place of its mass, shape (n + 1,).
        pixels: the n pixels.
        dn: axis of the raw prediction; it should hold all of the data.
        nuced: axis of the NUCed prediction.

    Returns:
        The sums, and those of the means of the NUCed value (e-) and of its square (e-^2), shape (2,).
    """
    raw, bins, moments = _raw_sums(dn), _nuced_sums(nuced), np.zeros(2)
    _, gain, bias, _ = pixels.maps
    ensemble_numba.sort_masses(mass, first, start, gain, bias, raw, bins, moments)
    return EnsembleSums(len(pixels), raw.total, raw.square, bins.total, bins.square), moments


def curve_errors(
    pixels: UsablePixels, covariance: FloatArray, dn: DnAxis, nuced: NucedAxis
) -> tuple[FloatArray, FloatArray]:
    """Sum the pixels' variances of the two predicted densities that the errors of their parameters cause.

    By the delta method, pixels being independent; the standard error of a mean over n pixels is
    ``sqrt(sum) / n``. After correction only H and sigma_e- matter.

    Args:
        pixels: n pixels.
        covariance: of (H, g, mu, sigma), shape (n, 4, 4); entries that are not known count as 0.
        dn: axis of the raw prediction.
        nuced: axis of the NUCed prediction.

    Returns:
        Sums of the variances of f_X, 1/DN^2, shape (n_dn,), and of the NUCed density, 1/e-^2, shape
        (n_bins,).
    """
    raw, bins = np.zeros(dn.size), np.zeros(nuced.size)
    plain = pixels.columns
    ensemble_numba.curve_variance(plain, np.ascontiguousarray(covariance), float(dn.start), 1.0, raw)
    n, (_, gain, _, noise) = len(pixels), pixels.maps
    corrected = np.stack([pixels.quanta_exposure, np.ones(n), np.zeros(n), pixels.read_noise_e], axis=1)
    known = np.where(np.isfinite(covariance), covariance, 0.0)
    moved = np.zeros((n, 4, 4))  # sigma_e- = g sigma
    moved[:, 0, 0] = known[:, 0, 0]
    moved[:, 0, 3] = moved[:, 3, 0] = noise * known[:, 0, 1] + gain * known[:, 0, 3]
    moved[:, 3, 3] = noise * noise * known[:, 1, 1] + gain * gain * known[:, 3, 3]
    moved[:, 3, 3] += 2.0 * noise * gain * known[:, 1, 3]
    ensemble_numba.curve_variance(corrected, moved, nuced.start * nuced.width, nuced.width, bins)
    return raw, bins


def tally(
    counts: NDArray[np.integer[Any]],
    origin: NDArray[np.integer[Any]],
    pixels: UsablePixels,
    dn: DnAxis,
    nuced: NucedAxis | None = None,
) -> Tally:
    """Sort the histograms of pixels onto the axes of the ensemble.

    Args:
        counts: samples per bin, shape (n, n_bins), integer.
        origin: DN of bin 0, shape (n,).
        pixels: parameters of the same n pixels, which give the two-point NUC ``(x - mu) g``.
        dn: axis of the raw histogram.
        nuced: axis of the NUCed histogram, or None for none.

    Returns:
        The tally; what falls beyond an axis is counted, not lost in silence.
    """
    raw = np.zeros(dn.size, dtype=np.int64)
    bins = np.zeros(nuced.size if nuced else 0, dtype=np.int64)
    start, width = (nuced.start, nuced.width) if nuced else (0, 0.0)
    sums = np.zeros((len(pixels), 2))
    outside, nuced_outside = ensemble_numba.tally_counts(
        kernel_counts(counts),
        np.asarray(origin, dtype=np.int64),
        pixels.conversion_gain,
        pixels.bias,
        ensemble_numba.AxisCounts(dn.start, 1.0, raw),
        ensemble_numba.AxisCounts(start, width, bins),
        sums,
    )
    return Tally(raw, bins, int(outside), int(nuced_outside), math.fsum(sums[:, 0]), math.fsum(sums[:, 1]))


def electron_pmf(quanta_exposure: FloatArray, n_k: int, share: FloatArray | None = None) -> FloatArray:
    """Probability mass of the ensemble electron number (Hendrickson et al. 2023, eq. K_ensemble_pmf).

    Args:
        quanta_exposure: H of each pixel, or of each bin of the map's histogram, e-, shape (n,).
        n_k: number of masses, for k = 0 .. n_k - 1.
        share: part of the pixels that each H stands for, shape (n,), adding up to 1; None: equal parts.

    Returns:
        p_Ke(k), shape (n_k,).
    """
    exposure = np.ascontiguousarray(quanta_exposure, dtype=np.float64)
    weights = np.full(exposure.size, 1.0 / exposure.size) if share is None else share
    out = np.zeros(n_k)
    ensemble_numba.sum_poisson(weights, exposure, out)
    return out
