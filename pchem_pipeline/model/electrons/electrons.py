"""Electron numbers by largest membership, and the two-point non-uniformity correction.

The estimate ``argmax_k gamma_nk`` (Hendrickson et al. 2023, eq. demarg_K_eqn) is a table of thresholds: k + 1
has the larger membership where x exceeds ``t_k = mu + (k + 1/2)/g + g sigma^2 ln((k + 1)/H)``. The thresholds
increase with k, so no cell is empty, and a DN's electron number is the number of thresholds below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.electrons import electrons_numba
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.maps.pixels import FloatArray, PixelParameters, usable_pixels

__all__ = [
    "LARGEST_NUMBER",
    "NO_NUMBER",
    "CellProbabilities",
    "ErrorTally",
    "cell_probabilities",
    "compare_electron_numbers",
    "electron_counts",
    "electron_numbers",
    "thresholds",
]

#: Stored where a pixel has no parameters and so no electron number.
NO_NUMBER = 65535
#: Larger electron numbers are cut to this.
LARGEST_NUMBER = 65534


@dataclass(frozen=True)
class CellProbabilities:
    """What the estimated electron numbers should show.

    Attributes:
        estimated: sum over pixels of P(k~ = k), shape (n_k,); divide by the number of pixels for the mass.
        error: P(k~ != K) of each pixel, shape (n,).
    """

    estimated: FloatArray
    error: FloatArray


@dataclass(frozen=True)
class ErrorTally:
    """Estimated against true electron numbers.

    Attributes:
        n_samples: samples compared.
        by_size: samples with |k~ - K| = 0, 1, 2, ... (the last entry: and more).
        signed: sum of k~ - K.
    """

    n_samples: int
    by_size: NDArray[np.int64]
    signed: int

    def __add__(self, other: ErrorTally) -> ErrorTally:
        """Return the tally of both sets of samples."""
        return ErrorTally(
            self.n_samples + other.n_samples, self.by_size + other.by_size, self.signed + other.signed
        )


def thresholds(
    quanta_exposure: FloatArray | float,
    conversion_gain: FloatArray | float,
    bias: FloatArray | float,
    read_noise_dn: FloatArray | float,
    n_thresholds: int,
) -> FloatArray:
    """Boundaries between the electron numbers (Hendrickson et al. 2023, eq. demarg_K_eqn).

    Args:
        quanta_exposure: H, e-, any shape; the others broadcast with it.
        conversion_gain: g, e-/DN.
        bias: mu, DN.
        read_noise_dn: sigma, DN.
        n_thresholds: number of boundaries.

    Returns:
        t_k, DN, boundary between k and k + 1, k on the last axis; infinite where H = 0.
    """
    exposure, gain, offset, sigma = (
        np.asarray(v, dtype=np.float64)[..., None]
        for v in (quanta_exposure, conversion_gain, bias, read_noise_dn)
    )
    k = np.arange(n_thresholds)
    with np.errstate(divide="ignore"):
        return np.asarray(offset + (k + 0.5) / gain + gain * sigma**2 * np.log((k + 1) / exposure))


def electron_numbers(
    frames: NDArray[np.unsignedinteger[Any]],
    quanta_exposure: FloatArray,
    conversion_gain: FloatArray,
    bias: FloatArray,
    read_noise_dn: FloatArray,
) -> NDArray[np.uint16]:
    """Estimate the electron number of every sample (Hendrickson et al. 2023, eq. demarg_K_eqn).

    Args:
        frames: DN, shape (n_frames, ny, nx), unsigned integers.
        quanta_exposure: H, e-, shape (ny, nx).
        conversion_gain: g, e-/DN, shape (ny, nx).
        bias: mu, DN, shape (ny, nx).
        read_noise_dn: sigma, DN, shape (ny, nx).

    Returns:
        k~, shape (n_frames, ny, nx); ``NO_NUMBER`` for pixels without usable parameters, at most
        ``LARGEST_NUMBER``.
    """
    maps = (quanta_exposure, conversion_gain, bias, read_noise_dn)
    gain = np.where(usable_pixels(*maps), conversion_gain, np.nan)
    out = np.empty(frames.shape, dtype=np.uint16)
    if frames.size:
        electrons_numba.convert_frames(
            frames, quanta_exposure, gain, bias, read_noise_dn, LARGEST_NUMBER, NO_NUMBER, out
        )
    return out


def electron_counts(
    counts: NDArray[np.integer[Any]],
    origin: NDArray[np.integer[Any]],
    pixels: PixelParameters,
    n_k: int,
) -> tuple[NDArray[np.int64], int]:
    """Histogram of the electron numbers of samples that are given as histograms.

    Args:
        counts: samples per bin, shape (n, n_bins).
        origin: DN of bin 0, shape (n,).
        pixels: the n pixels.
        n_k: number of electron numbers, k = 0 .. n_k - 1.

    Returns:
        Samples with each k, shape (n_k,), and the number of samples with a larger one.
    """
    out = np.zeros(n_k, dtype=np.int64)
    beyond = electrons_numba.tally_electrons(
        kernel_counts(counts), np.asarray(origin, dtype=np.int64), *pixels.columns(), out
    )
    return out, int(beyond)


def cell_probabilities(
    pixels: PixelParameters, n_k: int, estimator: PixelParameters | None = None
) -> CellProbabilities:
    """Probability of each estimated electron number and of an error, summed over the pixels' own cells.

    It takes rounding as it is: ``X`` is an integer, so a cell holds whole DN (Hendrickson et al. 2023, eqs.
    PCD_RV_definition and demarg_K_eqn).

    Args:
        pixels: parameters that the data follow.
        n_k: number of electron numbers in the result.
        estimator: parameters that the thresholds are made of; None: the same.

    Returns:
        The sum over pixels of P(k~ = k), and each pixel's P(k~ != K).
    """
    out = np.zeros(n_k)
    errors = np.empty(len(pixels))
    used = pixels if estimator is None else estimator
    electrons_numba.sum_cell_probabilities(*pixels.columns(), *used.columns(), out, errors)
    return CellProbabilities(out, errors)


def compare_electron_numbers(
    estimated: NDArray[np.uint16], true: NDArray[np.uint16], n_sizes: int = 8
) -> ErrorTally:
    """Compare estimated with true electron numbers; samples without an estimate are left out.

    Args:
        estimated: k~, any shape.
        true: K, same shape.
        n_sizes: number of error sizes told apart.

    Returns:
        The tally.
    """
    sizes = np.zeros(n_sizes, dtype=np.int64)
    compared, signed = electrons_numba.count_errors(estimated, true, NO_NUMBER, sizes)
    return ErrorTally(int(compared), sizes, int(signed))
