"""A camera in plain numpy whose parameters are known: independent of the package's own simulator."""

from dataclasses import dataclass

import numpy as np
from helpers.plain_law import joint_mass

from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.exposure import estimate_exposure


@dataclass(frozen=True)
class KnownCamera:
    """Maps (y, x) of a sensor; analog read noise in e-."""

    gain: np.ndarray
    bias: np.ndarray
    read_noise_e: np.ndarray

    @classmethod
    def drawn(cls, rng, shape, read_noise=(0.15, 0.35), gain=(0.07, 0.12)):
        """Return a camera with pixels that differ."""
        return cls(rng.uniform(*gain, shape), rng.normal(100.0, 4.0, shape), rng.uniform(*read_noise, shape))

    @classmethod
    def taken(cls, seed, shape, exposure, n, **ranges):
        """Return a generator, a camera drawn with it, and true electron numbers and DN of its frames."""
        rng = np.random.default_rng(seed)
        camera = cls.drawn(rng, shape, **ranges)
        return rng, camera, *camera.frames(rng, exposure, n)

    @property
    def sigma(self):
        """Read noise with rounding, DN."""
        return np.sqrt((self.read_noise_e / self.gain) ** 2 + 1 / 12)

    def frames(self, rng, exposure, n, offset=0.0):
        """Return true electron numbers and DN of n frames; the offset is in DN."""
        electrons = rng.poisson(exposure, (n, *self.bias.shape))
        noise = self.read_noise_e * rng.standard_normal(electrons.shape)
        dn = np.rint(self.bias + (electrons + noise) / self.gain + offset)
        return electrons, np.clip(dn, 0, 65535).astype(np.uint16)

    def calibration(self, rng=None, errors=(0.0, 0.0, 0.0), exposure=1.0):
        """Return what a characterisation with these standard errors of (g, mu, sigma) finds."""
        truth = np.stack([self.gain, self.bias, self.sigma])
        wide = np.array(errors)[:, None, None]
        found = truth if rng is None else truth + wide * rng.standard_normal(truth.shape)
        covariance = np.zeros((*self.bias.shape, 3, 3))
        for i, error in enumerate(errors):
            covariance[..., i, i] = error**2
        words = np.zeros(self.bias.shape, np.uint16)
        return Calibration(np.full(self.bias.shape, exposure), *found, covariance, words)

    def least_error(self, exposure):
        """Return the least probability of a wrong electron number of each pixel (Bayes), by plain sums."""
        out = np.empty(self.bias.shape)
        for place in np.ndindex(*out.shape):
            theta = [
                np.broadcast_to(v, out.shape)[place] for v in (exposure, self.gain, self.bias, self.sigma)
            ]
            h, g, mu, sigma = theta
            n_k = int(h + 12 * np.sqrt(h + 1) + 12)
            dn = np.arange(int(mu - 8 * sigma - 3), int(mu + n_k / g + 8 * sigma + 3))
            out[place] = 1.0 - joint_mass(dn, *theta, n_k).max(axis=0).sum()
        return out


def estimated(frames, calibration):
    """Return the exposures that frames of known pixels tell."""
    histograms = histogram_frames(frames)
    return estimate_exposure(histograms.counts, histograms.origin, calibration)


def pink(rng, shape, taps, n):
    """Noise of spectrum 1/f of taps that are read row by row, cut from records eight times as long."""
    width = -(-shape[1] // taps)
    size = 8 * shape[0] * width
    cycles = np.arange(size // 2 + 1)
    amplitude = np.where(cycles >= 8, np.maximum(cycles, 1) ** -0.5, 0.0)
    record = np.fft.irfft(amplitude * np.fft.rfft(rng.standard_normal((n, taps, size))), size)
    samples = (record / record.std())[..., : size // 8].reshape(n, taps, shape[0], width)
    return samples.transpose(0, 2, 1, 3).reshape(n, shape[0], -1)[..., : shape[1]]
