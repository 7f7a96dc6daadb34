"""Electron numbers of samples under the law of their own pixel, and how often they are wrong.

The most probable k has the largest membership ``P(k; H) P(x | k)`` (Hendrickson et al. 2023, eq.
demarg_K_eqn), with the mass of the whole code x under any law of the samples. Each pixel has a table from
code to number; a sample is looked up in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, ndtr, xlogy

from pchem_pipeline.base.arrays import CodeArray, FloatArray, IndexArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE
from pchem_pipeline.model.electrons import electrons_numba
from pchem_pipeline.model.electrons.electrons_numba import NO_PRIOR, CodeTables, Numbers, PixelLaws
from pchem_pipeline.model.ensemble.ensemble import EnsembleTotals
from pchem_pipeline.model.law.inputs import kernel_counts, pack, satellites_of
from pchem_pipeline.model.law.mass import code_ranges
from pchem_pipeline.model.law.parameters import Parameters, UsablePixels, columns_of, usable_pixels
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Stored where a pixel has no parameters and so no electron number.
NO_NUMBER = 65535
#: Larger electron numbers are cut to this.
LARGEST_NUMBER = NO_NUMBER - 1
#: A pixel's table holds no more codes than this.
_MOST_CODES = 1 << 17
_AT_ONCE = 4096  # pixels


@dataclass(frozen=True)
class KnownPixels:
    """Pixels whose samples are turned into electron numbers.

    Attributes:
        parameters: (H, g, mu, sigma), each of the shape of the pixels; NaN where there are none.
        law: of the samples of the pixels in C order.
        satellites: amplitude (e-) and weight of their free satellites; None: none.
    """

    parameters: Parameters
    law: SampleLaw
    satellites: tuple[ArrayLike, ArrayLike] | None = None

    def of(self, pixels: IndexArray) -> KnownPixels:
        """Return some of the pixels, by their places in C order."""
        own = self.satellites
        some = None if own is None else (np.asarray(own[0])[pixels], np.asarray(own[1])[pixels])
        return KnownPixels(list(columns_of(self.parameters)[pixels].T), self.law.of(pixels), some)

    @property
    def exposure(self) -> FloatArray:
        """H, e-, shape (n,); NaN where there are no usable parameters."""
        columns = columns_of(self.parameters)
        return np.where(usable_pixels(*columns.T), columns[:, 0], np.nan)

    def kernel_inputs(self) -> PixelLaws:
        """Return parameters, free satellites and law as the loops take them."""
        columns = columns_of(self.parameters)
        n = len(columns)
        columns[np.isnan(self.exposure)] = np.nan
        return PixelLaws(columns, satellites_of(self.satellites, n), pack([self.law], n))

    def codes(
        self, counts: IntegerArray | None = None, origin: IntegerArray | None = None
    ) -> tuple[IntArray, IntArray]:
        """Return the first and last code that pixels show, DN, shape (n,); none without parameters.

        Those of samples are among them, too, if histograms (n, n_bins) and the DN of bin 0 (n,) are given.
        """
        low, high = code_ranges(self.law, self.parameters, self.satellites)
        if counts is None or origin is None:
            return low, np.minimum(high, low + _MOST_CODES)
        seen = counts > 0
        first = origin + seen.argmax(axis=1)
        last = origin + counts.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
        known = high >= low
        low, high = np.maximum(low, last - _MOST_CODES), np.minimum(high, first + _MOST_CODES)
        return np.where(known, np.minimum(low, first), first), np.where(known, np.maximum(high, last), last)


class NumberTables(CodeTables):
    """What each code of each pixel says of the electron number."""

    @property
    def missing(self) -> int:
        """What stands for no number."""
        return int(np.iinfo(self.number.dtype).max)

    def convert(self, frames: CodeArray, *, expected: bool = False, lift: int = 0) -> Numbers:
        """Return the electron numbers of samples; none for codes that are not in the table of their pixel.

        The codes, (frame, y, x), were raised by ``lift``; the mean is there if it is ``expected``.
        """
        n_frames, n = frames.shape[0], self.first.size
        number = np.empty((n_frames, n), self.number.dtype)
        probability = np.empty((n_frames, n) if self.mass.size else (0, 0), np.float32)
        mean = np.empty((n_frames, n) if expected else (0, 0), np.float32)
        lifted, out = self._replace(first=self.first + lift), Numbers(number, probability, mean)
        electrons_numba.convert_frames(frames.reshape(n_frames, n), lifted, self.missing, out)
        details = (each.reshape(frames.shape) if each.size else each for each in (probability, mean))
        return Numbers(number.reshape(frames.shape), *details)

    def tally(self, counts: IntegerArray, origin: IntegerArray, n_k: int) -> tuple[IntArray, int]:
        """Return the samples of each electron number k < n_k, and how many have a larger one.

        The histograms have the shape (n, n_bins), the DN of bin 0 the shape (n,).
        """
        out = np.zeros(n_k + 1, np.int64)
        first = np.asarray(origin, np.int64)
        electrons_numba.count_numbers(kernel_counts(counts), first, self, self.missing, out)
        return out[:-1], int(out[-1])

    def outcomes(self, n_k: int) -> tuple[FloatArray, FloatArray]:
        """Return the sum over pixels of P(k~ = k), (n_k,), and P(k~ != K) of each, (n,); of detailed tables.

        k~ is the estimated number, K the true one.
        """
        pixel = np.repeat(np.arange(self.first.size), np.diff(self.start))
        right = np.bincount(pixel, self.right, self.first.size)
        estimated = np.bincount(self.number, self.mass, n_k)[:n_k]
        return np.asarray(estimated, np.float64), np.asarray(1.0 - right)


def number_type(largest: float) -> np.dtype[Any]:
    """Return uint8 where all electron numbers fit, one being kept for 'none', else uint16."""
    return np.dtype(np.uint8 if largest < np.iinfo(np.uint8).max else np.uint16)


def number_tables(
    minimum: IntegerArray,
    maximum: IntegerArray,
    prior: FloatArray | None,
    pixels: KnownPixels,
    *,
    dtype: np.dtype[Any] | type[np.unsignedinteger[Any]] = np.uint16,
    parts: int = 1,
    detailed: bool = False,
) -> NumberTables:
    """Return the most probable electron number of each code that pixels have shown.

    That it is right has the probability of its share in the sum over all k.

    Args:
        minimum: smallest code of each pixel, of the shape of the pixels.
        maximum: largest code, likewise.
        prior: exposure of each pixel, e-, likewise; NaN: no numbers for the pixel; None: all k are alike.
        pixels: what is known of them.
        dtype: of the numbers; its largest value means none.
        parts: codes in a DN.
        detailed: also the probability that each is right, and the mean.
    """
    n = minimum.size
    first = np.array(minimum.ravel(), np.int64)
    sizes = np.maximum(maximum.ravel().astype(np.int64) - first + 1, 0)
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    number = np.empty(start[-1], np.uint16)
    mass, right = np.empty((2, start[-1] if detailed else 0))
    expected = np.empty(mass.size, np.float32)
    missing = int(np.iinfo(dtype).max)
    weights = np.full(n, NO_PRIOR) if prior is None else np.ascontiguousarray(prior.ravel(), np.float64)
    tables = NumberTables(first, start, number, mass, right, expected)
    electrons_numba.fill_tables(tables, parts, weights, pixels.kernel_inputs(), missing - 1, missing)
    return tables._replace(number=number.astype(dtype, copy=False))


def compare_electron_numbers(
    estimated: NDArray[np.uint16], true: NDArray[np.uint16], n_sizes: int
) -> tuple[IntArray, int]:
    """Compare estimated with true electron numbers, k~ and K, of any shape, where there is an estimate.

    Returns:
        Samples with |k~ - K| = 0, 1, 2, ..., the last one: and more, shape (n_sizes,); sum of k~ - K.
    """
    known = estimated != NO_NUMBER
    off = estimated[known].astype(np.int64) - true[known]
    return np.bincount(np.minimum(np.abs(off), n_sizes - 1), minlength=n_sizes), int(off.sum())


def error_rates(totals: EnsembleTotals, pixels: UsablePixels, true: UsablePixels | None) -> dict[str, Any]:
    """Return how often the electron numbers are wrong, where the true ones are known.

    ``expected_error_rate_from_truth`` is that of data of the true parameters decided with the fitted ones;
    ``least_error_rate`` that of numbers decided with the true ones. Frames that the fit has seen err slightly
    less than new ones. Numbers for the attributes of the group; none where nothing was compared.

    Fitted parameters are of all pixels with a value; true ones of the same pixels, None where they are not
    known or not all there is.
    """
    compared = totals.count("compared")
    if not compared:
        return {}
    sizes = totals.counts("error_sizes")
    frames = compared / totals.count("pixels")
    facts: dict[str, Any] = {
        "error_rate": 1.0 - int(sizes[0]) / compared,
        "error_rate_stderr": math.sqrt(float(totals.variance("error_variance")[0]) / frames),
        "error_sizes": [int(n) for n in sizes],
        "mean_error": totals.count("signed_error") / compared,
        "samples_compared": compared,
    }
    if true is not None:
        error, least = (errors_of_numbers(deciding, true) for deciding in (pixels, true))
        facts |= {
            "expected_error_rate_from_truth": float(error.mean()),
            "error_rate_stderr": math.sqrt(float(np.mean(error * (1.0 - error))) / compared),
            "least_error_rate": float(least.mean()),
        }
    return facts


def errors_of_numbers(deciding: UsablePixels, data: UsablePixels) -> FloatArray:
    """Return how often numbers that n pixels decide are wrong in data of other parameters, shape (n,).

    The number of a code is right with the probability ``P(k; H) [Phi((x + 1/2 - m_k) / s) - Phi((x - 1/2 -
    m_k) / s)]`` of that code and number, ``m_k = mu + k / g``, s the read noise before rounding.
    """
    errors = np.empty(len(deciding))
    for part in np.array_split(np.arange(errors.size), errors.size // _AT_ONCE + 1):
        some = np.isin(np.arange(errors.size), part)
        known, true = (KnownPixels(pixels.of(some), SampleLaw()) for pixels in (deciding, data))
        tables = number_tables(*true.codes(), known.exposure, known)
        pixel = np.repeat(np.arange(part.size), np.diff(tables.start))
        code = np.arange(pixel.size) - tables.start[pixel] + tables.first[pixel]
        h, g, mu, sigma = (column[pixel] for column in data.of(some).maps)
        k = tables.number.astype(np.float64)
        off, sd = code - mu - k / g, np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, LEAST_VARIANCE))
        mass = np.exp(xlogy(k, h) - h - gammaln(k + 1.0)) * (ndtr((off + 0.5) / sd) - ndtr((off - 0.5) / sd))
        errors[part] = 1.0 - np.bincount(pixel, mass, part.size)
    return errors
