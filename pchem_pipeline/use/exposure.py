"""Map of the quanta exposure of frames whose pixels are known, by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from pchem_pipeline.base.arrays import CodeArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.normal_numba import REACH
from pchem_pipeline.model.fit import engine, profile_numba
from pchem_pipeline.model.fit.climb_numba import LEAST_NOISE_DN, LEAST_NOISE_E, Limits
from pchem_pipeline.model.fit.tile_numba import Histograms
from pchem_pipeline.model.law.cells_numba import Law
from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.use.calibration import Calibration

LEAST_EXPOSURE = 1e-6  # e-; less is none
_LEAST_START = 1e-3  # e-
_LEAST_WEIGHT = 1e-6  # of a rival: less moves no standard error
_DEPTH, _FARTHEST = 12.0, 1e4  # nats down to which a likelihood is summed, and e- up to which
_NODES = 16  # of that sum: a likelihood is an exponential times a smooth function
_LIMITS = Limits(
    *(float(np.log(LEAST_EXPOSURE)), 1e-14, 200, 0, False, True, 0.0, 0.0, 0.0, 0.0, 0.0),
    *(False, False, False, False, False),
)


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

        ``signal``: unbiased estimate of H, e-, NaN where there is none; ``noise``: variance of a sample at a
        given electron number, e-^2, same shape; ``n_frames``: N.
        """
        known = np.isfinite(signal) & np.isfinite(noise)
        if not known.any():
            return cls(LEAST_EXPOSURE, 0.0, 0.0, n_frames)
        some = np.minimum(signal[known], np.quantile(signal[known], 0.99))
        mean, within = max(float(some.mean()), LEAST_EXPOSURE), float(noise[known].mean())
        return cls(mean, max(float(some.var()) - (mean + within) / n_frames, 0.0), within, n_frames)

    def priors(self, signal: FloatArray, noise: FloatArray) -> FloatArray:
        """Return equally probable exposures of each pixel, e-, shape (y, x, j); one where they are near.

        ``signal`` and ``noise`` as of :meth:`of`, from these frames, shape (y, x).
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
    counts: CodeArray, origin: IntegerArray, calibration: Calibration, parts: int = 1
) -> FloatArray:
    """Return H from the mean of the samples, e-, shape (y, x): unbiased, and below 0 by chance."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = counts @ np.arange(counts.shape[-1]) / counts.sum(axis=-1)
    electrons = calibration.conversion_gain * ((origin + mean) / parts - calibration.bias)
    law = calibration.law
    added = (law.added_exposure * law.added_weights).sum(axis=1)
    found = electrons - np.broadcast_to(added, electrons.size).reshape(electrons.shape)
    return np.where(calibration.usable, found / (law.exposure_factors @ law.exposure_weights), np.nan)


@dataclass(frozen=True)
class _Known:
    """Histograms of pixels of which g, mu and sigma are known, and the climb to their exposures."""

    given: Histograms  # a sample for each part of a DN in which codes lie: all have one exposure
    law: Law
    satellites: FloatArray  # amplitude (e-) and weight of free satellites, shape (n, 2)

    @classmethod
    def of(cls, counts: CodeArray, origin: IntegerArray, calibration: Calibration, parts: int) -> _Known:
        """Return codes sorted by how far they lie above a whole DN, as if mu were lower by that in each."""
        n, width = counts.shape
        whole, aside = np.divmod(origin.astype(np.int64) + parts // 2, parts)
        found = np.zeros((n, (-(-width // parts) + 1) * parts), counts.dtype)
        for i in range(parts):
            found[aside == i, i : i + width] = counts[aside == i]
        by_part = found.reshape(n, -1, parts).transpose(0, 2, 1).reshape(n, -1)
        given = Histograms(
            kernel_counts(by_part),
            np.arange(parts + 1) * (by_part.shape[1] // parts),
            np.repeat(whole[:, None], parts, axis=1),
            np.zeros(parts, np.bool_),
            np.zeros(by_part.shape, np.uint8),
        )
        laws = [calibration.law.with_noise([1.0], shift_dn=(parts // 2 - i) / parts) for i in range(parts)]
        return cls(given, pack(laws, n), calibration.own_satellites)

    def climb(
        self, pixels: IntArray, exposure: FloatArray, own: FloatArray, *, stay: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Climb from exposures (m,), e-, of ``pixels`` to the likeliest; ``stay``: evaluate there.

        With ``own`` (g, mu, sigma), (m, 3). Returns the exposure, e-, 0 where no electron is likelier than
        any; log-likelihood, nats; minus its second derivatives in H and in (H, g, mu, sigma), (m, 4).
        """
        gain, bias, sigma = own.T
        least = np.maximum(LEAST_NOISE_DN, LEAST_NOISE_E / gain)
        variance = np.maximum(sigma**2 - QUANTISATION_VARIANCE, least**2 * (1.0 + 1e-12))
        amplitude, weight = self.satellites[pixels].T
        log_exposure = np.log(np.maximum(exposure, LEAST_EXPOSURE))
        theta = np.column_stack([log_exposure, 1.0 / gain, bias, np.log(variance), weight])
        fixed = np.ones(theta.shape, np.bool_)
        fixed[:, 0] = stay
        loglik, curvature = np.empty(pixels.size), np.full(theta.shape, np.nan)
        profile_numba.climb_tile(
            *(self.given, pixels, self.law, _LIMITS, engine.likelihood(cells=True), engine.climb()),
            *(np.ascontiguousarray(amplitude), fixed, np.zeros(pixels.size, np.bool_), theta, loglik),
            *(np.empty((*theta.shape, theta.shape[1])), curvature),
        )
        found = np.where(theta[:, 0] > _LIMITS.bound + 1e-9, np.exp(theta[:, 0]), 0.0)
        found[loglik == -np.inf] = np.nan
        slopes = np.stack([np.ones_like(gain), -(gain**-2), np.ones_like(gain), 2.0 * sigma / variance])
        return found, loglik, curvature[:, :4] * slopes.T

    def at_border(self, pixels: IntArray, height: FloatArray, own: FloatArray) -> FloatArray:
        """Return one over the mean square of H over the likelihoods of which the maximum is at 0.

        The curvature there says nothing: they fall as an exponential does, or as half a normal law. Of
        ``pixels``, with log-likelihood ``height`` at 0, (m,), and ``own`` (g, mu, sigma), (m, 3).
        """
        reach = _DEPTH / self.given.counts[pixels].sum(axis=1)  # by one a sample and electron at most
        near = np.arange(pixels.size)
        while near.size:
            fallen = height[near] - self.climb(pixels[near], reach[near], own[near], stay=True)[1]
            near = near[(fallen < _DEPTH) & (reach[near] < _FARTHEST)]
            reach[near] *= 2.0
        mass = square = np.zeros(pixels.size)
        for place, weight in zip(*np.polynomial.legendre.leggauss(_NODES), strict=True):
            exposure = 0.5 * (1.0 + place) * reach
            part = weight * np.exp(np.minimum(self.climb(pixels, exposure, own, stay=True)[1] - height, 0.0))
            mass, square = mass + part, square + part * exposure**2
        return mass / square


def estimate_exposure(
    counts: CodeArray, origin: IntegerArray, calibration: Calibration, parts: int = 1
) -> ExposureMaps:
    """Return the exposure of largest likelihood, with g, mu and sigma held at their estimates.

    ``sum_i c_i log sum_k P(k; H) P(x_i | k)``, the cells of the codes integrated exactly; effects of the
    model are in the law. It uses what a sample says of its electron number, where the mean of rounded or of
    corrected frames adds the read noise to that of the numbers. NaN where all samples lie below those of no
    electron. Histograms (y, x, code) begin at ``origin``, (y, x), with ``parts`` codes in a DN.
    """
    n, occupied = origin.size, counts.reshape(origin.size, -1) > 0
    highest = (origin.ravel() + occupied.shape[1] - 1 - occupied[:, ::-1].argmax(axis=1)) / parts
    _, _, bias, sigma = calibration.columns.T
    known = _Known.of(counts.reshape(n, -1), origin.ravel(), calibration, parts)
    pixels = np.flatnonzero(occupied.any(axis=1) & np.isfinite(calibration.columns).all(axis=1))
    own = calibration.columns[pixels, 1:]
    start = np.maximum(mean_signal(counts, origin, calibration, parts).ravel()[pixels], _LEAST_START)
    exposure, height, bend = known.climb(pixels, start, own)
    # codes so far below the level of no electron no exposure explains, unless the law has wider noise
    least = -0.5 * REACH**2 * counts.reshape(n, -1)[pixels].sum(axis=1)
    possible = (highest > bias - REACH * sigma)[pixels] | (height > least)
    pixels, own, exposure, height, bend = (a[possible] for a in (pixels, own, exposure, height, bend))
    curvature, border = bend[:, 0], np.flatnonzero(exposure == 0.0)
    curvature[border] = known.at_border(pixels[border], height[border], own[border])
    with np.errstate(invalid="ignore"):
        counting = curvature**-0.5
    # errors of g, mu and sigma, by the implicit function theorem
    slopes = bend[:, 1:] / curvature[:, None]
    covariance = calibration.covariance.reshape(n, 3, 3)[pixels]
    variance = np.einsum("ni,nij,nj->n", slopes, covariance, slopes)
    variance = np.where(np.isnan(variance), variance, np.maximum(variance, 0.0))
    rivals = np.zeros((n, 2, 4)) if calibration.rivals is None else calibration.rivals.reshape(n, 2, 4)
    for rival in rivals[pixels].swapaxes(0, 1):
        some = np.flatnonzero(rival[:, 0] > _LEAST_WEIGHT)
        there = known.climb(pixels[some], exposure[some], rival[some, 1:])[0]
        variance[some] += rival[some, 0] * (there - exposure[some]) ** 2
    out = np.full((3, n), np.nan)
    out[:, pixels] = exposure, counting, np.sqrt(variance)
    return ExposureMaps(*out.reshape(3, *origin.shape))
