"""Histograms of simulated pixels for the tests of the fit."""

from typing import NamedTuple

import numpy as np
from helpers.plain_law import pcd_mass
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.law.parameters import UsablePixels


class Drawn(NamedTuple):
    """Histograms and the true (H, g, mu, sigma)."""

    counts: NDArray[np.uint32]
    origin: NDArray[np.int64]
    truth: NDArray[np.float64]


def draw(
    rng: np.random.Generator,
    exposure: ArrayLike,
    step: ArrayLike,
    electron_noise: ArrayLike,
    bias: ArrayLike = 100.3,
    n_frames: int = 17_750,
) -> Drawn:
    """Draw histograms from the exact quantised mass; ``step = 1/g`` in DN, total noise in e-."""
    h, a, s, mu = np.atleast_1d(
        *np.broadcast_arrays(*[np.asarray(v, float) for v in (exposure, step, electron_noise, bias)])
    )
    analog = np.sqrt(s**2 - 1 / (12 * a**2))
    origin = np.floor(mu - 9 * s * a).astype(np.int64)
    width = np.ceil((h + 11 * np.sqrt(h) + 12 + 18 * s) * a)
    x = origin[:, None] + np.arange(int(width.max()) + 1)
    mass = pcd_mass(x, h[:, None], 1 / a[:, None], mu[:, None], analog[:, None])
    counts = rng.multinomial(n_frames, mass / mass.sum(axis=1, keepdims=True))
    return Drawn(counts.astype(np.uint32), origin, np.stack([h, 1 / a, mu, s * a], axis=1))


def samples(counts: ArrayLike, origin: int) -> NDArray[np.float64]:
    """Return the raw sample of a histogram, sorted."""
    values = np.asarray(counts)
    return np.repeat(origin + np.arange(values.size), values).astype(float)


def codes(rng, shape, exposure, step, noise_e, bias=100.3):
    """Return whole DN of samples by plain numpy: ``bias + step (electrons + noise)`` rounded; noise in e-."""
    electrons = rng.poisson(exposure, shape) + noise_e * rng.standard_normal(shape)
    return np.rint(bias + step * electrons).astype(np.int64)


def histograms(dn):
    """Return the histograms (pixel, bin) of whole DN (pixel, frame), and the DN of bin 0, one for all."""
    low, width = dn.min(), int(np.ptp(dn)) + 1
    counts = np.stack([np.bincount(row - low, minlength=width) for row in dn])
    return counts.astype(np.uint32), np.full(len(dn), low)


def unlike_pixels(n, seed=2):
    """Return pixels whose parameters all vary and depend on one another."""
    z = np.random.default_rng(seed).standard_normal((4, n))
    exposure, gain = 2.0 * np.exp(0.4 * z[1] + 0.2 * z[0]), 0.1 * np.exp(0.1 * z[0])
    bias, sigma = 100.0 + 4.0 * z[2] + 2.0 * z[0], 3.0 * np.exp(0.1 * z[3] - 0.1 * z[1])
    return UsablePixels(exposure, gain, bias, sigma)
