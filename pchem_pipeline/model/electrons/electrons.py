"""Electron numbers of samples under the law of their own pixel, and how often they are wrong.

The most probable k has the largest membership ``P(k; H) P(x | k)`` (Hendrickson et al. 2023, eq.
demarg_K_eqn), with the mass of the whole code x under any law of the samples. Each pixel has a table from
code to number; a sample is looked up in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import Float32Array, FloatArray, IntArray
from pchem_pipeline.model.electrons import electrons_numba
from pchem_pipeline.model.electrons.electrons_numba import NO_PRIOR, CodeTables, PixelLaws, SampleNumbers
from pchem_pipeline.model.law.inputs import kernel_counts, pack, satellites_of
from pchem_pipeline.model.law.mass import code_ranges
from pchem_pipeline.model.law.parameters import Parameters, columns_of, usable_pixels
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Stored where a pixel has no parameters and so no electron number.
NO_NUMBER = 65535
#: Larger electron numbers are cut to this.
LARGEST_NUMBER = NO_NUMBER - 1
#: A pixel's table holds no more codes than this.
_MOST_CODES = 1 << 17


@dataclass(frozen=True)
class KnownPixels:
    """Pixels whose samples are turned into electron numbers.

    Attributes:
        parameters: (H, g, mu, sigma), each of the shape of the pixels; NaN where there are none.
        law: of the samples of the pixels in C order.
        satellites: amplitude (e-) and weight of their free satellites; None: those of the parameters, if any.
    """

    parameters: Parameters
    law: SampleLaw
    satellites: tuple[ArrayLike, ArrayLike] | None = None

    def of(self, pixels: NDArray[np.intp]) -> KnownPixels:
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
        return PixelLaws(columns, satellites_of(self.parameters, self.satellites, n), pack([self.law], n))

    def codes(
        self, counts: NDArray[np.integer[Any]] | None = None, origin: NDArray[np.integer[Any]] | None = None
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


@dataclass(frozen=True)
class Numbers:
    """Electron numbers of samples, each array (frame, y, x).

    Attributes:
        number: the most probable one; the largest value of the type where a pixel has no parameters.
        probability: that it is right; empty where the tables have none.
        expected: E[k | x], e-; empty where it was not asked for.
    """

    number: NDArray[np.unsignedinteger[Any]]
    probability: Float32Array
    expected: Float32Array


@dataclass(frozen=True)
class Outcomes:
    """What the estimated electron numbers should show.

    Attributes:
        estimated: sum over pixels of P(k~ = k), shape (n_k,); divide by the number of pixels for the mass.
        error: P(k~ != K) of each pixel, shape (n,).
    """

    estimated: FloatArray
    error: FloatArray


@dataclass(frozen=True)
class NumberTables:
    """What each code of each pixel says of the electron number.

    Attributes:
        shape: of the pixels.
        first: first code of each pixel, shape (n,).
        start: place of its first code in the tables, shape (n + 1,).
        number: most probable number at each code; the largest value of the type: none.
        mass: P(code); empty where it was not asked for.
        right: P(code, and the number is right); likewise.
        expected: E[k | x], e-; likewise.
    """

    shape: tuple[int, ...]
    first: IntArray
    start: IntArray
    number: NDArray[np.unsignedinteger[Any]]
    mass: FloatArray
    right: FloatArray
    expected: Float32Array

    @property
    def missing(self) -> int:
        """What stands for no number."""
        return int(np.iinfo(self.number.dtype).max)

    @property
    def _tables(self) -> CodeTables:
        return CodeTables(self.first, self.start, self.number, self.mass, self.right, self.expected)

    def convert(
        self, frames: NDArray[np.unsignedinteger[Any]], *, expected: bool = False, lift: int = 0
    ) -> Numbers:
        """Return the electron numbers of samples; none for codes that are not in the table of their pixel.

        Args:
            frames: codes, shape (frame, y, x).
            expected: whether the mean is wanted, too.
            lift: by which the codes were raised.
        """
        n_frames, n = frames.shape[0], self.first.size
        number = np.empty((n_frames, n), self.number.dtype)
        probability = np.empty((n_frames, n) if self.mass.size else (0, 0), np.float32)
        mean = np.empty((n_frames, n) if expected else (0, 0), np.float32)
        lifted = self._tables._replace(first=self.first + lift)
        out = SampleNumbers(number, probability, mean)
        electrons_numba.convert_frames(frames.reshape(n_frames, n), lifted, self.missing, out)
        shape = (n_frames, *self.shape)
        details = (each.reshape(shape) if each.size else each for each in (probability, mean))
        return Numbers(number.reshape(shape), *details)

    def tally(
        self, counts: NDArray[np.integer[Any]], origin: NDArray[np.integer[Any]], n_k: int
    ) -> tuple[IntArray, int]:
        """Return the samples of each electron number k < n_k, and how many have a larger one.

        The histograms have the shape (n, n_bins), the DN of bin 0 the shape (n,).
        """
        out = np.zeros(n_k + 1, np.int64)
        first = np.asarray(origin, np.int64)
        electrons_numba.count_numbers(kernel_counts(counts), first, self._tables, self.missing, out)
        return out[:-1], int(out[-1])

    def outcomes(self, n_k: int) -> Outcomes:
        """Return the probability of each estimated number k < n_k and of an error; of detailed tables."""
        pixel = np.repeat(np.arange(self.first.size), np.diff(self.start))
        right = np.bincount(pixel, self.right, self.first.size)
        estimated = np.bincount(self.number, self.mass, n_k)[:n_k]
        return Outcomes(np.asarray(estimated, np.float64), np.asarray(1.0 - right))


@dataclass(frozen=True)
class ErrorTally:
    """Estimated against true electron numbers.

    Attributes:
        n_samples: samples compared.
        by_size: samples with |k~ - K| = 0, 1, 2, ... (the last entry: and more).
        signed: sum of k~ - K.
    """

    n_samples: int
    by_size: IntArray
    signed: int

    def __add__(self, other: ErrorTally) -> ErrorTally:
        """Return the tally of both sets of samples."""
        n, signed = self.n_samples + other.n_samples, self.signed + other.signed
        return ErrorTally(n, self.by_size + other.by_size, signed)


def number_type(largest: float) -> np.dtype[Any]:
    """Return uint8 where all electron numbers fit, one being kept for 'none', else uint16."""
    return np.dtype(np.uint8 if largest < np.iinfo(np.uint8).max else np.uint16)


def number_tables(
    minimum: NDArray[np.integer[Any]],
    maximum: NDArray[np.integer[Any]],
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
    tables = CodeTables(first, start, number, mass, right, expected)
    electrons_numba.fill_tables(tables, parts, weights, pixels.kernel_inputs(), missing - 1, missing)
    return NumberTables(minimum.shape, first, start, number.astype(dtype, copy=False), mass, right, expected)


def compare_electron_numbers(
    estimated: NDArray[np.uint16], true: NDArray[np.uint16], n_sizes: int = 8
) -> ErrorTally:
    """Compare estimated with true electron numbers of any shape, by sizes of error, where estimated."""
    known = estimated != NO_NUMBER
    off = estimated[known].astype(np.int64) - true[known]
    sizes = np.bincount(np.minimum(np.abs(off), n_sizes - 1), minlength=n_sizes)
    return ErrorTally(off.size, sizes, int(off.sum()))
