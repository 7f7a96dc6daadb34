"""What a characterisation says of some pixels, as those need it who use the sensor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.fit.status import FAILED
from pchem_pipeline.model.law.parameters import PixelParameters, usable_pixels
from pchem_pipeline.model.law.pcd import nearest_pcd
from pchem_pipeline.model.law.sample_law import SampleLaw

if TYPE_CHECKING:
    from pchem_pipeline.model.electrons.electrons import KnownPixels

#: Read noise, e-, above which the peaks of neighbouring electron numbers overlap so far that the most
#: probable number is often wrong, and the expectation says more.
PEAKS_OVERLAP_E = 0.4


@dataclass(frozen=True)
class Calibration(PixelParameters):
    """Parameters of pixels with the covariance of their estimates, and the law of their samples.

    Attributes:
        quanta_exposure: H of the characterisation, e-, shape (y, x), as the other maps; NaN without a fit.
        covariance: of the estimates of (g, mu, sigma), shape (y, x, 3, 3).
        fit_status: word of each pixel.
        law: of the samples of all pixels in C order.
        satellites: amplitude (e-) and weight of what free satellites the fit found, shape (y * x, 2).
        rivals: probability that the bias is an electron lower or higher, and (g, mu, sigma) if so, shape
            (y, x, 2, 4); None: the covariance is all that is known.
    """

    covariance: FloatArray
    fit_status: NDArray[np.uint16]
    law: SampleLaw = field(default_factory=SampleLaw)
    satellites: FloatArray | None = None
    rivals: FloatArray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ny, nx = self.bias.shape
        return ny, nx

    @cached_property
    def usable(self) -> BoolArray:
        """Pixels whose parameters define a calibration, shape (y, x)."""
        known = usable_pixels(
            np.nan_to_num(self.quanta_exposure), self.conversion_gain, self.bias, self.read_noise_dn
        )
        return np.asarray(known & ((self.fit_status & np.uint16(int(FAILED))) == 0))

    def without_noise(self, variance: float) -> Calibration:
        """Return that of samples without a noise, of this variance (DN^2), that the read noise includes."""
        if variance == 0.0:
            return self

        def less(sigma: FloatArray) -> FloatArray:
            return np.sqrt(np.maximum(sigma**2 - variance, QUANTISATION_VARIANCE))

        scale = np.ones((*self.shape, 3))
        scale[..., 2] = self.read_noise_dn / less(self.read_noise_dn)
        rivals = None if self.rivals is None else self.rivals.copy()
        if rivals is not None:
            rivals[..., 3] = less(rivals[..., 3])
        return replace(
            self,
            read_noise_dn=less(self.read_noise_dn),
            covariance=self.covariance * scale[..., None] * scale[..., None, :],
            rivals=rivals,
        )

    @property
    def columns(self) -> FloatArray:
        """(H, g, mu, sigma) of the usable pixels, NaN elsewhere, shape (n, 4)."""
        table = super().columns
        table[:, 0] = np.where(table[:, 0] > 0.0, table[:, 0], 1.0)  # held fixed nowhere: any will do
        table[~self.usable.ravel()] = np.nan
        return table

    @property
    def own_satellites(self) -> FloatArray:
        """Amplitude and weight of free satellites, 0 without any, shape (n, 2)."""
        if self.satellites is None:
            return np.zeros((self.bias.size, 2))
        return np.nan_to_num(self.satellites)

    @property
    def known(self) -> KnownPixels:
        """The pixels as electron numbers are made of."""
        from pchem_pipeline.model.electrons.electrons import KnownPixels  # loads compiled loops

        amplitude, weight = self.own_satellites.T
        return KnownPixels(list(self.columns.T), self.law, (amplitude, weight))

    @property
    def right_bias(self) -> FloatArray:
        """Probability that the bias is right within half an electron, shape (y, x)."""
        return np.ones(self.shape) if self.rivals is None else 1.0 - self.rivals[..., 0].sum(axis=-1)

    @property
    def whole_covariance(self) -> FloatArray:
        """Mean square deviations of (g, mu, sigma), a bias that is an electron off included."""
        if self.rivals is None:
            return self.covariance
        weight = self.rivals[..., 0]
        own = np.stack([self.conversion_gain, self.bias, self.read_noise_dn], axis=-1)
        off = self.rivals[..., 1:] - own[..., None, :]
        return np.asarray(self.covariance + np.einsum("yxs,yxsi,yxsj->yxij", weight, off, off))

    @property
    def noise_variance_dn2(self) -> FloatArray:
        """Variance of a sample at a given electron number (at k = H), DN^2: all effects included."""
        sigma = nearest_pcd(list(self.columns.T), self.law)[3]
        amplitude, weight = self.own_satellites.T
        pattern = np.array(self.law.free_satellite_pattern).reshape(-1, 2)
        mean, square = pattern.T[0] @ pattern[:, 1], pattern.T[0] ** 2 @ pattern[:, 1]
        own = (weight * square - (weight * mean) ** 2) * (amplitude / self.columns[:, 1]) ** 2
        return np.asarray((sigma**2 + own).reshape(self.shape))


def covariance_of(stderr: FloatArray, correlation: FloatArray) -> FloatArray:
    """Return the covariance of (g, mu, sigma), (y, x, 3, 3), from what the fit stores.

    Standard errors of (H, g, mu, sigma), (4, y, x), and correlations of (H, g), (H, mu), (H, sigma), (g, mu),
    (g, sigma), (mu, sigma), (y, x, 6).
    """
    matrix = np.zeros((*stderr.shape[1:], 3, 3))
    for place, (i, j) in {3: (0, 1), 4: (0, 2), 5: (1, 2)}.items():
        matrix[..., i, j] = matrix[..., j, i] = correlation[..., place] * stderr[1 + i] * stderr[1 + j]
    for i in range(3):
        matrix[..., i, i] = stderr[1 + i] ** 2
    return matrix
