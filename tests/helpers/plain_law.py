"""The law of a code, written down: Poisson weights times the normal mass of its cell."""

import numpy as np
from scipy.special import gammaln, ndtr, xlogy
from scipy.stats import norm, poisson


def joint_mass(codes, exposure, gain, bias, sigma, n_k=400):
    """Return P(k, x) of whole codes, shape (k, code), by differences of the nearer tail; sigma as fitted."""
    k, analog = np.arange(n_k)[:, None], np.sqrt(sigma**2 - 1 / 12)
    low, high = ((codes + side - bias - k / gain) / analog for side in (-0.5, 0.5))
    inside = np.where(low > 0, norm.sf(low) - norm.sf(high), norm.cdf(high) - norm.cdf(low))
    return np.asarray(poisson.pmf(k, exposure) * inside)


def pcd_mass(x, quanta_exposure, conversion_gain, bias, analog_read_noise_e):
    """Return the exact probability of the whole number x, the rounding of eq. (PCD_RV_definition) included.

    All arguments broadcast; ``analog_read_noise_e`` is sigma_R >= 0 before quantisation, e-.
    """
    arrays = np.broadcast_arrays(x, quanta_exposure, conversion_gain, bias, analog_read_noise_e)
    flat = [np.ravel(each).astype(np.float64) for each in arrays]
    parts = zip(*(np.array_split(each, flat[0].size // 2**18 + 1) for each in flat), strict=True)
    return np.concatenate([_mass(*(each[:, None] for each in part)) for part in parts]).reshape(
        arrays[0].shape
    )


def _mass(at, h, gain, offset, noise):
    # without noise a number between two cells is half in each
    y, half, s = gain * (at - offset), 0.5 * gain, np.maximum(noise, 1e-200)
    reach = int(np.nanmax(8.5 * s + half, initial=0.0)) + 1
    k = np.round(y) + np.arange(-reach, reach + 1)
    off = np.abs(y - k)  # the tails above are those below
    weight = np.exp(xlogy(k, h) - h - gammaln(np.maximum(k, 0) + 1.0))
    inside = ndtr((half - off) / s) - ndtr((-half - off) / s)
    return (np.where(k < 0, 0.0, weight) * inside).sum(axis=1)
