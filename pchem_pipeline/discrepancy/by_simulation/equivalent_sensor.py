"""A sensor to simulate whose fit comes out like the measured one.

Fitted parameters scatter more than the true ones: by their errors. A simulation that took them for the truth
would, fitted again, scatter by those errors twice, and every statistic that looks at how pixels differ would
deviate without any effect, the more the worse a pixel's peaks are resolved. So the maps are drawn together
first, to the scatter that is left when the errors are taken off.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.evidence import PixelMaps

__all__ = ["likely_truth"]

FloatArray = NDArray[np.float64]

_FEWEST = 100  # pixels from which a covariance is worth something
_FAR = 4.0  # robust standard deviations: pixels beyond do not tell how the others scatter
_MAD = 1.4826
# scatter beyond the errors in any direction, in units of the errors' variance, below which it is chance
_CHANCE = 0.05


def likely_truth(maps: PixelMaps, covariance: FloatArray) -> PixelMaps:
    """Return maps that scatter as the true parameters do, given fitted ones.

    In ``(log H, log g, mu, log sigma)``, where errors are nearly Gaussian, the covariance over the pixels is
    ``C = T + mean(E_i)`` with the truth's T and the errors' E_i. Each pixel is moved by the map of optimal
    transport from N(m, T + E_i) to N(m, T), which is linear and moves no pixel further than needed (Dowson
    and Landau 1982). Where the errors are small against the scatter, nothing changes.

    Args:
        maps: fitted.
        covariance: of (H, g, mu, sigma), shape (y, x, 4, 4); a pixel without a finite one stays.

    Returns:
        Maps with the same usable pixels.
    """
    values = np.stack(
        [np.log(maps.quanta_exposure), np.log(maps.conversion_gain), maps.bias, np.log(maps.read_noise_dn)],
        axis=-1,
    )
    slope = np.stack(
        [
            1.0 / maps.quanta_exposure,
            1.0 / maps.conversion_gain,
            np.ones(maps.bias.shape),
            1.0 / maps.read_noise_dn,
        ],
        axis=-1,
    )
    error = covariance * slope[..., :, None] * slope[..., None, :]
    known = maps.usable & np.isfinite(error).all(axis=(-2, -1)) & np.isfinite(values).all(axis=-1)
    if known.sum() < _FEWEST:
        return maps
    x, e = values[known], error[known]
    centre = np.median(x, axis=0)
    off = x - centre
    usual = (np.abs(off) < _FAR * _MAD * np.median(np.abs(off), axis=0)).all(axis=1)
    typical = e[usual].mean(axis=0)
    truth = _scatter_beyond(np.cov(off[usual], rowvar=False), typical)
    moved = np.einsum("nij,nj->ni", _transport(truth, e), off)
    x = np.where(usual[:, None], centre + moved, x)
    found = values.copy()
    found[known] = x
    return PixelMaps(
        np.exp(found[..., 0]), np.exp(found[..., 1]), found[..., 2], np.exp(found[..., 3]), maps.usable
    )


def _scatter_beyond(scatter: FloatArray, error: FloatArray) -> FloatArray:
    """Return what is left of a covariance when that of the errors is taken off, at least nothing."""
    root = np.linalg.cholesky(error)
    white = np.linalg.solve(root, np.linalg.solve(root, scatter).T)
    sizes, axes = np.linalg.eigh((white + white.T) / 2.0)
    left = np.where(sizes > 1.0 + _CHANCE, sizes - 1.0, 0.0)
    factor = root @ axes
    return np.asarray((factor * left) @ factor.T)


def _transport(truth: FloatArray, error: FloatArray) -> FloatArray:
    """Return the optimal transport from N(0, T + E_i) to N(0, T) for each E_i, shape (n, 4, 4)."""
    scale = np.sqrt(np.diagonal(error, axis1=1, axis2=2).mean(axis=0))
    truth, error = truth / np.outer(scale, scale), error / np.outer(scale, scale)
    root = _power(truth, 0.5)
    middle = _power(root @ (truth + error) @ root, -0.5)
    return np.asarray(root @ middle @ root * scale[:, None] / scale[None, :])


def _power(matrix: FloatArray, exponent: float) -> FloatArray:
    """Return a power of symmetric matrices without negative eigenvalues; directions without size stay so."""
    sizes, axes = np.linalg.eigh(matrix)
    least = 1e-12 * sizes[..., -1:]
    powers = np.where(sizes > least, np.maximum(sizes, np.maximum(least, 1e-300)) ** exponent, 0.0)
    return np.asarray((axes * powers[..., None, :]) @ np.swapaxes(axes, -1, -2))
