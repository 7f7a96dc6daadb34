"""Map of the quanta exposure of frames whose pixels are known, by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.use import exposure_numba
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.exposure_numba import LEAST_EXPOSURE


@dataclass(frozen=True)
class ExposureMaps:
    """Exposure of pixels with its standard errors, e-, shape (y, x); NaN for pixels without a calibration.

    Attributes:
        exposure: H of largest likelihood; 0 where no electron is likelier than any.
        counting: standard error from the samples: numbers of electrons and read noise.
        calibration: standard error from those of g, mu and sigma; no number of frames makes it smaller.
    """

    exposure: FloatArray
    counting: FloatArray
    calibration: FloatArray

    @property
    def stderr(self) -> FloatArray:
        """Standard error of both together."""
        return np.asarray(np.hypot(self.counting, self.calibration))


@dataclass(frozen=True)
class ExposurePool:
    """What the exposures of the pixels have in common in some frames: a prior of their electron numbers.

    The exposure of a pixel estimated from a few frames is near the samples it is made of, and as a prior it
    takes these for certain. Given the other pixels, an exposure has a gamma law: the mean of all, drawn
    towards the pixel's own by as much as its other frames say (empirical Bayes).

    Attributes:
        mean: of the exposures, e-.
        variance: between pixels, e-^2.
        noise: mean variance of a sample at a given electron number, e-^2.
        n_frames: N.
    """

    mean: float
    variance: float
    noise: float
    n_frames: int

    @classmethod
    def of(cls, signal: FloatArray, noise: FloatArray, n_frames: int) -> ExposurePool:
        """Return the pool of some pixels; hot ones do not widen it.

        Args:
            signal: unbiased estimate of H, e-, NaN where there is none.
            noise: variance of a sample at a given electron number, e-^2, same shape.
            n_frames: N.
        """
        known = np.isfinite(signal) & np.isfinite(noise)
        if not known.any():
            return cls(LEAST_EXPOSURE, 0.0, 0.0, n_frames)
        some = np.minimum(signal[known], np.quantile(signal[known], 0.99))
        mean, within = max(float(some.mean()), LEAST_EXPOSURE), float(noise[known].mean())
        return cls(mean, max(float(some.var()) - (mean + within) / n_frames, 0.0), within, n_frames)

    def priors(self, signal: FloatArray, noise: FloatArray) -> FloatArray:
        """Return equally probable exposures of each pixel, e-, shape (y, x, j); one where they are near.

        Args:
            signal: unbiased estimate of H from these frames, shape (y, x); NaN where there is none.
            noise: as of :meth:`of`.
        """
        others = self.variance * (self.n_frames - 1)
        own = others / (others + self.mean + noise)
        mean = np.maximum(self.mean + own * (signal - self.mean), LEAST_EXPOSURE)[..., None]
        left = self.variance * (self.mean + self.noise) / (others + self.mean + self.noise)
        if left < 0.05 * self.mean:  # small beside the variance of the electron number
            return mean
        scale = ((1.0 - own) * self.variance)[..., None] / mean
        found = gammaincinv(mean / scale, np.arange(0.1, 1.0, 0.2)) * scale
        return np.asarray(np.maximum(found, LEAST_EXPOSURE))


def mean_signal(
    counts: NDArray[np.unsignedinteger[Any]],
    origin: NDArray[np.integer[Any]],
    calibration: Calibration,
    parts: int = 1,
) -> FloatArray:
    """Return H from the mean of the samples, e-, shape (y, x): unbiased, and below 0 by chance."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = counts @ np.arange(counts.shape[-1]) / counts.sum(axis=-1)
    electrons = calibration.conversion_gain * ((origin + mean) / parts - calibration.bias)
    law = calibration.law
    added = (law.added_exposure * law.added_weights).sum(axis=1)
    found = electrons - np.broadcast_to(added, electrons.size).reshape(electrons.shape)
    return np.where(calibration.usable, found / (law.exposure_factors @ law.exposure_weights), np.nan)


def estimate_exposure(
    counts: NDArray[np.unsignedinteger[Any]],
    origin: NDArray[np.integer[Any]],
    calibration: Calibration,
    parts: int = 1,
) -> ExposureMaps:
    """Return the exposure of largest likelihood, with g, mu and sigma held at their estimates.

    ``sum_i c_i log sum_k P(k; H) P(x_i | k)``, the cells of the codes integrated exactly; effects of the
    model are in the law. It uses what a sample says of its electron number, where the mean of rounded or of
    corrected frames adds the read noise to that of the numbers.

    Args:
        counts: histograms, shape (y, x, code).
        origin: code of bin 0, shape (y, x).
        calibration: of these pixels.
        parts: codes in a DN.
    """
    n = origin.size
    out = np.full((n, 3), np.nan)
    given = np.zeros((n, 2, 4)) if calibration.rivals is None else calibration.rivals
    rivals = np.ascontiguousarray(given.reshape(n, 2, 4))
    columns = calibration.columns
    exposure_numba.estimate_exposures(
        kernel_counts(counts.reshape(n, -1)),
        np.ascontiguousarray(origin.ravel(), np.int64),
        parts,
        columns,
        np.ascontiguousarray(calibration.covariance.reshape(n, 3, 3)),
        rivals,
        calibration.own_satellites,
        pack([calibration.law], n),
        out,
    )
    return ExposureMaps(*(out[:, i].reshape(origin.shape) for i in range(3)))
