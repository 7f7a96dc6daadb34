"""The ensemble of pixels: exact mean of the pixels' PCDs, the data on the same axes, and sums over tiles.

The ensemble PCD is ``f_E(x) = E_theta f_X(x | theta)`` (Hendrickson et al. 2023, eq. full_ensemble_dist).
With one parameter vector per pixel that expectation is the mean over the pixels; nothing need be binned.
The binned forms of the paper are in :mod:`pchem_pipeline.model.ensemble.ensemble_binned`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE, SMALLEST_MASS
from pchem_pipeline.model.ensemble import ensemble_numba
from pchem_pipeline.model.errors.expected_information import covariance_from
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.law.mass import parts_of_similar_width, sample_mass, sample_slopes
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Pixels of ordinary errors that are taken of a sensor. The variances that they add scatter by 1.4 times the
#: mean: 16,384 give the standard error of a curve to 0.6 % of itself (4 % at its ends, where few add much).
ERROR_PIXELS = 1 << 14
#: Sum over the four parameters of their variances over those of resolved peaks: what half of the pixels of a
#: sensor with a read noise of 0.3 e- stay below.
_ORDINARY = 20.0
#: Places that follow each other by this part of a cycle are spread as evenly as can be.
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
#: Sizes of error of the electron numbers told apart; the last one is: and more.
ERROR_SIZES = 8

_INTEGERS = (
    "pixels",
    "excluded",
    "outside",
    "outside_all",
    "nuced_outside",
    "electrons_beyond",
    "compared",
    "signed_error",
)
_FLOATS = (
    "nuced_sum",
    "nuced_sum_square",
    "nuced_predicted_sum",
    "nuced_predicted_sum_square",
    "error",
    "error_variance",
)
#: Variances of the predictions by the errors of the maps.
MODEL_ERRORS = ("pcd_error", "nuced_error")


@dataclass(frozen=True)
class DnAxis:
    """Consecutive integer DN."""

    start: int  # first DN
    size: int  # number of DN

    @property
    def dn(self) -> IntArray:
        """The DN, shape (size,)."""
        return np.arange(self.start, self.start + self.size, dtype=np.int64)


@dataclass(frozen=True)
class NucedAxis:
    """Equal bins of the NUCed value ``(x - mu) g``; bin j is centred on ``(start + j) width``."""

    width: float  # bin width, e-
    start: int  # index of the first bin; bin 0 is centred on 0 e-
    size: int  # number of bins

    @property
    def electrons(self) -> FloatArray:
        """Centres of the bins, e-, shape (size,)."""
        return np.arange(self.start, self.start + self.size, dtype=np.float64) * self.width


@dataclass(frozen=True)
class EnsembleAxes:
    """The axes of the ensemble, and where each sum stands in the rows of a tile."""

    dn: DnAxis  # DN of the raw ensemble
    nuced: NucedAxis  # bins of the NUCed ensemble
    n_k: int  # number of electron numbers

    @cached_property
    def integers(self) -> dict[str, slice]:
        """Place of each tally in the row of integers."""
        lengths = {"counts": self.dn.size, "counts_all": self.dn.size, "nuced_counts": self.nuced.size}
        lengths |= {"electron_counts": self.n_k, "error_sizes": ERROR_SIZES}
        return _places(lengths | dict.fromkeys(_INTEGERS, 1))

    @cached_property
    def floats(self) -> dict[str, slice]:
        """Place of each sum in the row of floats."""
        lengths = dict.fromkeys(("pcd", "pcd_variance", "share", "share_all"), self.dn.size)
        lengths |= dict.fromkeys(("nuced", "nuced_variance", "nuced_share"), self.nuced.size)
        lengths |= dict.fromkeys(("electron_share", "electron_expected"), self.n_k)
        lengths |= dict(zip(MODEL_ERRORS, (self.dn.size, self.nuced.size), strict=True))
        return _places(lengths | dict.fromkeys(_FLOATS, 1))


def _places(lengths: dict[str, int]) -> dict[str, slice]:
    ends = np.cumsum(list(lengths.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(lengths.items(), ends, strict=True)}


@dataclass(frozen=True)
class EnsembleTotals:
    """The sums over all tiles.

    Attributes:
        axes: axes of the ensemble.
        integers: total of the rows of integers.
        floats: total of the rows of floats.
        samples: chosen frames of a pixel, all frames of a pixel; (1, 1) for ready-made histograms.
    """

    axes: EnsembleAxes
    integers: IntArray
    floats: FloatArray
    samples: tuple[int, int]

    def count(self, name: str) -> int:
        """Return a tally that is one number."""
        return int(self.integers[self.axes.integers[name]][0])

    def counts(self, name: str) -> IntArray:
        """Return a tally along an axis."""
        return self.integers[self.axes.integers[name]]

    def mean(self, name: str) -> FloatArray:
        """Return the mean over the pixels of a sum."""
        return self.floats[self.axes.floats[name]] / self.count("pixels")

    def variance(self, name: str) -> FloatArray:
        """Return the variance of the mean over the pixels, from the sum of the pixels' variances."""
        return self.mean(name) / self.count("pixels")


@dataclass(frozen=True)
class AxisSums:
    """Sums over pixels on the two axes, of predicted masses or of samples."""

    raw: FloatArray  # of what lies at each whole DN, shape (n_dn,)
    raw_square: FloatArray  # of its square
    nuced: FloatArray  # of what lies in each bin of the NUCed axis, shape (n_bins,)
    nuced_square: FloatArray  # of its square
    nuced_sum: float  # of the NUCed values, e-
    nuced_sum_square: float  # of their squares, e-^2


def nuced_axis(pixels: UsablePixels, dn: DnAxis, *, width: float | None = None) -> NucedAxis:
    """Choose the bins of the NUCed histogram.

    A pixel's NUCed values lie on a lattice of pitch g. A bin of width w holds ``floor(w/g)`` or one more
    of its points: a noise on the histogram that no number of frames removes, smallest where w is a whole
    multiple of the typical g: the median g, unless a width, e-, is given.

    The axis reaches no further than the raw one does for the 1st to 99th percentile of g and mu, so that one
    strange gain cannot stretch it.
    """
    gain, bias = pixels.conversion_gain, pixels.bias
    bin_width = float(np.median(gain)) if width is None else width
    tail = 10.0 * float(np.percentile(pixels.read_noise_e, 99))
    largest_gain = float(np.percentile(gain, 99))
    lowest = max(-tail, (dn.start - float(np.percentile(bias, 99))) * largest_gain)
    highest = (dn.start + dn.size - float(np.percentile(bias, 1))) * largest_gain
    start = math.floor(lowest / bin_width)
    return NucedAxis(bin_width, start, max(math.ceil(highest / bin_width) - start, 1))


def mass_sums(
    mass: FloatArray, first: IntArray, start: IntArray, pixels: UsablePixels, dn: DnAxis, nuced: NucedAxis
) -> AxisSums:
    """Sum the masses that any law gives to the codes of pixels, at the integer DN and sorted into NUCed bins.

    The mean over pixels of the raw masses is the ensemble (Hendrickson et al. 2023, eq. full_ensemble_dist),
    with the mass of each whole code in place of the density. The sorted masses are what the NUCed data must
    show, lattice and all: each DN of a pixel lies at ``(x - mu) g`` and falls into one bin as a whole (eq.
    partial_ensemble_dist, before the lattice is smoothed over).

    The masses are of successive codes, one pixel after the other, from the first code of each, DN, (n,), at
    the place ``start``, (n + 1,). The raw axis should hold all of the data.
    """
    end = np.minimum(start[1:], start[:-1] + dn.start + dn.size - first)
    codes = np.maximum(first, dn.start), start[:-1] + np.maximum(dn.start - first, 0), end
    return _on_axes(mass[:, None], codes, np.ones((1, 1, 1)), pixels, dn, nuced)


def _on_axes(
    values: NDArray[Any],
    codes: tuple[IntArray, IntArray, IntArray],
    forms: FloatArray,
    pixels: UsablePixels,
    dn: DnAxis,
    nuced: NucedAxis,
) -> AxisSums:
    """Return sums, with forms in place of squares; see :func:`.ensemble_numba.add_to_axes`."""
    sums = raw, bins, moments = np.zeros((2, dn.size)), np.zeros((2, nuced.size + 2)), np.zeros(2)
    _, gain, bias, _ = pixels.maps
    axis, held = (float(nuced.width), nuced.start), np.zeros(values.shape[1])
    values = np.asarray(values, np.float64)
    ensemble_numba.add_to_axes(values, codes, forms, gain, bias, dn.start, axis, *sums, held)
    return AxisSums(*raw, *bins[:, 1:-1], *moments.tolist())


def weighted_mass(pixels: UsablePixels, dn: DnAxis, share: FloatArray) -> FloatArray:
    """Return ``sum_i share_i P_i(x)``, shape (n_dn,), with the mass of each code under the PCD of a pixel."""
    out = np.zeros(dn.size)
    law = SampleLaw()
    for some, first, n_codes in parts_of_similar_width(law, pixels, (dn.start, dn.start + dn.size - 1)):
        codes = first[:, None] + np.arange(n_codes)
        mass = share[some, None] * sample_mass(law, pixels.of(some), codes, smallest=1e-17)
        out += np.bincount((codes - dn.start).ravel(), mass.ravel(), dn.size + n_codes)[: dn.size]
    return out


@dataclass(frozen=True)
class PixelErrors:
    """Errors of the maps of n pixels, of which some stand for all where their variances are summed.

    A standard error need not be known to better than a per cent of itself, so of a large sensor some pixels
    are enough: each is taken with a known probability and counts for its inverse (Horvitz and Thompson 1952),
    the more probably the larger its errors are, so that the few that fit badly do not decide by chance.
    """

    stderr: FloatArray  # of (H, g, mu, sigma), shape (n, 4); NaN where not known
    correlation: FloatArray  # of the estimates, shape (n, 6)
    place: IntArray  # number of each pixel on the sensor, shape (n,): which ones are taken depends on no tile
    share: float = 1.0  # of ordinary pixels that is taken

    def of(self, pixels: BoolArray | IntArray) -> PixelErrors:
        """Return those of some pixels."""
        return PixelErrors(self.stderr[pixels], self.correlation[pixels], self.place[pixels], self.share)

    def sampled(self, pixels: UsablePixels, samples: IntegerArray) -> tuple[BoolArray, FloatArray]:
        """Return which pixels are taken, (n,), and their covariances, each times the pixels it stands for.

        The parameters of the pixels are given, and the number of samples behind each, shape (n,).
        """
        chance = np.clip(self.share * self._badness(pixels, samples), self.share, 1.0)
        some = self.place * _GOLDEN % 1.0 < chance
        covariance = covariance_from(self.stderr[some], self.correlation[some])
        return some, covariance / chance[some, None, None]

    def _badness(self, pixels: UsablePixels, samples: IntegerArray) -> FloatArray:
        """Return how many times larger than ordinary the variances are."""
        exposure, gain, _, sigma = pixels.maps
        noise = sigma**2
        per_sample = (
            1.0 / np.maximum(exposure, 1e-3),
            exposure * (1.0 + exposure) / (gain**4 * noise),
            1.0 / noise,
            2.0 / noise,
        )
        known = np.nan_to_num(self.stderr**2, posinf=0.0)
        return np.asarray(samples / _ORDINARY * np.sum(known.T * np.stack(per_sample), axis=0))


def curve_errors(
    law: SampleLaw, pixels: UsablePixels, covariance: FloatArray, dn: DnAxis, nuced: NucedAxis
) -> tuple[FloatArray, FloatArray]:
    """Return the sums of the variances of the predicted masses by the errors of the pixels' parameters.

    By the delta method, pixels being independent: ``D' C D`` with the slopes D of the mass of a code, or of a
    NUCed bin, in (H, g, mu, sigma). The standard error of a mean over n pixels is ``sqrt(sum) / n``.

    The law is that without free satellites; entries of the covariance, (n, 4, 4), that are not known count as
    0. For each whole DN, shape (n_dn,), and each NUCed bin, shape (n_bins,).
    """
    raw, bins = np.zeros(dn.size), np.zeros(nuced.size)
    known = np.where(np.isfinite(covariance), covariance, 0.0)
    for some, first, n_codes in parts_of_similar_width(law, pixels, (dn.start, dn.start + dn.size - 1)):
        part, begin = pixels.of(some), np.arange(some.size) * n_codes
        slopes = _mass_slopes(law.of(some), part, first, n_codes).swapaxes(1, 2).reshape(-1, 4)
        codes = first, begin, begin + np.minimum(n_codes, dn.start + dn.size - first)
        sums = _on_axes(slopes, codes, known[some], part, dn, nuced)
        raw += sums.raw_square
        bins += sums.nuced_square
    return raw, bins


def _mass_slopes(law: SampleLaw, pixels: UsablePixels, first: IntArray, n_codes: int) -> FloatArray:
    """Return the slopes of the mass of successive codes in (H, g, mu, sigma), shape (n, 4, n_codes)."""
    exposure, gain, _, sigma = pixels.maps
    _, slopes = sample_slopes(law, pixels, first, n_codes)
    analog = np.maximum(sigma**2 - QUANTISATION_VARIANCE, LEAST_VARIANCE)
    unit = 1.0 / np.maximum(exposure, SMALLEST_MASS), -(gain**-2.0), np.ones_like(gain), 2.0 * sigma / analog
    return np.asarray(slopes * np.stack(unit, axis=1)[:, :, None])


def tally(
    counts: IntegerArray,
    origin: IntegerArray,
    pixels: UsablePixels,
    dn: DnAxis,
    nuced: NucedAxis | None = None,
) -> AxisSums:
    """Sort the histograms of n pixels onto the axes of the ensemble; without squares.

    The counts are of shape (n, n_bins), the DN of bin 0 of shape (n,); the parameters of the pixels give the
    two-point NUC ``(x - mu) g``.
    """
    rows, no_squares = kernel_counts(counts), np.zeros((1, 1, 1))
    begin = np.arange(len(rows)) * rows.shape[1]
    codes = np.asarray(origin, np.int64), begin, begin + rows.shape[1]
    return _on_axes(rows.reshape(-1, 1), codes, no_squares, pixels, dn, nuced or NucedAxis(1.0, 0, 0))


def electron_pmf(quanta_exposure: FloatArray, n_k: int, share: FloatArray | None = None) -> FloatArray:
    """Return the mass of the ensemble electron number (Hendrickson et al. 2023, eq. K_ensemble_pmf), (n_k,).

    H, e-, (n,), is of each pixel, or of each bin of the map's histogram with its share of the pixels, (n,),
    adding up to 1; None: equal shares.
    """
    exposure = np.asarray(quanta_exposure, np.float64)
    weights = np.full(exposure.size, 1.0 / exposure.size) if share is None else share
    return poisson_sums(exposure, weights[:, None], n_k)[:, 0]


def poisson_sums(exposure: FloatArray, columns: FloatArray, n_k: int) -> FloatArray:
    """Return the sums over pixels ``sum_i P(K = k; H_i) c_i`` of columns c, (n, m), for k < n_k: (n_k, m)."""
    order = np.argsort(exposure)
    sorted_h, table = exposure[order], columns[order]
    log_h, reach = np.log(np.maximum(sorted_h, SMALLEST_MASS)), 12.0 * np.sqrt(sorted_h) + 40.0
    k = np.arange(n_k)
    begin = np.searchsorted(sorted_h + reach, k)
    end = np.searchsorted(np.maximum.accumulate(sorted_h - reach), k, side="right")
    out, log_factorial = np.zeros((n_k, table.shape[1])), gammaln(k + 1.0)
    for i in np.flatnonzero(begin < end):
        some = slice(begin[i], end[i])
        out[i] = np.exp(i * log_h[some] - sorted_h[some] - log_factorial[i]) @ table[some]
    return out
