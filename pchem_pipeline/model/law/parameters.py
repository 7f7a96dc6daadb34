"""The four parameters of pixels (H, g, mu, sigma), and which of them define a density."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray


def usable_pixels(
    quanta_exposure: FloatArray, conversion_gain: FloatArray, bias: FloatArray, read_noise_dn: FloatArray
) -> BoolArray:
    """Return which pixels have parameters that define a density (Hendrickson et al. 2023, eq. X_density).

    All four, of any one shape, are finite, H >= 0, g > 0, sigma > 0, and of a size that a pixel can have: H
    up to 1e6 e-, 1e-6..1e3 e-/DN, |mu| up to 1e8 DN, read noise up to 1e3 e-.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # comparisons with NaN are False
        usable = (quanta_exposure >= 0) & (quanta_exposure <= 1e6)
        usable &= (conversion_gain >= 1e-6) & (conversion_gain <= 1e3)
        usable &= (np.abs(bias) <= 1e8) & (read_noise_dn > 0)
        usable &= conversion_gain * read_noise_dn <= 1e3
    return np.asarray(usable)


@dataclass(frozen=True)
class PixelParameters:
    """The four parameters of pixels, NaN where there are none; what else is known of pixels extends it.

    Attributes:
        quanta_exposure: H, e-, any shape; the others have the same, or that of one of several samples.
        conversion_gain: g, e-/DN.
        bias: mu, DN.
        read_noise_dn: sigma with quantisation, DN.
    """

    quanta_exposure: FloatArray
    conversion_gain: FloatArray
    bias: FloatArray
    read_noise_dn: FloatArray

    @property
    def maps(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(H, g, mu, sigma)."""
        return self.quanta_exposure, self.conversion_gain, self.bias, self.read_noise_dn

    @property
    def columns(self) -> FloatArray:
        """(H_1 ... H_J, g, mu, sigma) of the n pixels in C order, shape (n, J + 3)."""
        n = self.bias.size
        exposure, *shared = self.maps
        return np.concatenate([exposure.reshape(n, -1), *(each.reshape(n, 1) for each in shared)], axis=1)

    @property
    def read_noise_e(self) -> FloatArray:
        """Read noise with quantisation, sigma_e- = g sigma, e-."""
        return self.conversion_gain * self.read_noise_dn


Parameters = PixelParameters | Sequence[ArrayLike]


def columns_of(parameters: Parameters) -> FloatArray:
    """Return (H, g, mu, sigma) as an array of shape (n, 4).

    Raises:
        ValueError: there are not four parameters.
    """
    each = parameters.maps if isinstance(parameters, PixelParameters) else parameters
    exposure, gain, bias, noise = (np.asarray(values, np.float64).ravel() for values in each)
    return np.stack(np.broadcast_arrays(exposure, gain, bias, noise), axis=1)


@dataclass(frozen=True)
class UsablePixels(PixelParameters):
    """Parameters of n pixels, each of shape (n,) and with a usable density."""

    def __post_init__(self) -> None:
        if any(column.ndim != 1 or column.shape != self.bias.shape for column in self.maps):
            raise ValueError("the four parameters are one-dimensional and equally long")
        if not usable_pixels(*self.maps).all():
            raise ValueError("some pixels have no usable parameters: select with usable_pixels first")

    def __len__(self) -> int:
        """Return the number of pixels."""
        return int(self.quanta_exposure.size)

    def of(self, pixels: BoolArray | IndexArray) -> UsablePixels:
        """Return some of them."""
        return UsablePixels(*(column[pixels] for column in self.maps))

    @classmethod
    def from_maps(cls, maps: Sequence[NDArray[np.floating]]) -> tuple[UsablePixels, BoolArray]:
        """Return the usable pixels of the maps (H, g, mu, sigma) in C order, and their mask."""
        full = [np.asarray(values, dtype=np.float64) for values in maps]
        mask = usable_pixels(*full)
        chosen = [np.ascontiguousarray(values[mask]) for values in full]
        return cls(*chosen), mask
