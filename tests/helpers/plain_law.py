"""The law of a code, written down: Poisson weights times the normal mass of its cell."""

import numpy as np
from scipy.stats import norm, poisson


def joint_mass(codes, exposure, gain, bias, sigma, n_k=400):
    """Return P(k, x) of whole codes, shape (k, code), by differences of the nearer tail; sigma as fitted."""
    k, analog = np.arange(n_k)[:, None], np.sqrt(sigma**2 - 1 / 12)
    low, high = ((codes + side - bias - k / gain) / analog for side in (-0.5, 0.5))
    inside = np.where(low > 0, norm.sf(low) - norm.sf(high), norm.cdf(high) - norm.cdf(low))
    return np.asarray(poisson.pmf(k, exposure) * inside)
