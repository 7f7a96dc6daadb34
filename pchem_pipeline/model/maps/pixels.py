"""The fitted parameters of a set of pixels, as the ensemble functions take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["FloatArray", "PixelParameters", "usable_pixels"]

FloatArray = NDArray[np.float64]


def usable_pixels(
    quanta_exposure: FloatArray, conversion_gain: FloatArray, bias: FloatArray, read_noise_dn: FloatArray
) -> NDArray[np.bool_]:
    """Tell which pixels have parameters that define a density (Hendrickson et al. 2023, eq. X_density).

    Args:
        quanta_exposure: H, e-, any shape; the others have the same shape.
        conversion_gain: g, e-/DN.
        bias: mu, DN.
        read_noise_dn: sigma, DN.

    Returns:
        True where all four are finite, H >= 0, g > 0 and sigma > 0, and where they are of a size that a pixel
        can have: H up to 1e6 e-, 1e-6..1e3 e-/DN, |mu| up to 1e8 DN, read noise up to 1e3 e-.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # comparisons with NaN are False
        usable = (quanta_exposure >= 0) & (quanta_exposure <= 1e6)
        usable &= (conversion_gain >= 1e-6) & (conversion_gain <= 1e3)
        usable &= (np.abs(bias) <= 1e8) & (read_noise_dn > 0)
        usable &= conversion_gain * read_noise_dn <= 1e3
    return np.asarray(usable)


@dataclass(frozen=True)
class PixelParameters:
    """Parameters of n pixels, each with a usable density.

    Attributes:
        quanta_exposure: H, e-, shape (n,).
        conversion_gain: g, e-/DN, shape (n,).
        bias: mu, DN, shape (n,).
        read_noise_dn: sigma with quantisation, DN, shape (n,).
    """

    quanta_exposure: FloatArray
    conversion_gain: FloatArray
    bias: FloatArray
    read_noise_dn: FloatArray

    def __post_init__(self) -> None:
        columns = self.columns()
        if any(column.ndim != 1 or column.shape != columns[0].shape for column in columns):
            raise ValueError("the four parameters are one-dimensional and equally long")
        if not usable_pixels(*columns).all():
            raise ValueError("some pixels have no usable parameters: select them with usable_pixels first")

    def __len__(self) -> int:
        """Return the number of pixels."""
        return int(self.quanta_exposure.size)

    @property
    def read_noise_e(self) -> FloatArray:
        """Read noise with quantisation, sigma_e- = g sigma, e-, shape (n,)."""
        return self.conversion_gain * self.read_noise_dn

    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return (H, g, mu, sigma)."""
        return self.quanta_exposure, self.conversion_gain, self.bias, self.read_noise_dn

    @classmethod
    def from_maps(cls, maps: Sequence[NDArray[np.floating]]) -> tuple[PixelParameters, NDArray[np.bool_]]:
        """Select the usable pixels of four maps.

        Args:
            maps: (H, g, mu, sigma), each of the same shape.

        Returns:
            The parameters of the usable pixels in C order, and the mask of them in the shape of the maps.
        """
        full = [np.asarray(values, dtype=np.float64) for values in maps]
        mask = usable_pixels(*full)
        chosen = [np.ascontiguousarray(values[mask]) for values in full]
        return cls(*chosen), mask
