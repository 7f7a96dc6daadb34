"""The log-likelihood of histograms by the masses of their codes."""

import numpy as np

from pchem_pipeline.model.law.mass import sample_mass


def log_likelihood(counts, origin, parameters, law, satellites=None):
    """Return ``sum_i c_i log P(x_i)`` of every pixel, nats; NaN without parameters."""
    codes = np.asarray(origin)[:, None] + np.arange(counts.shape[1])
    mass = sample_mass(law, parameters, codes, satellites=satellites)
    return (counts * np.log(np.where(counts > 0, np.maximum(mass, 1e-300), 1.0))).sum(axis=1)
