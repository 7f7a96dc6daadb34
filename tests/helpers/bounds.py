"""Cramer-Rao bounds of (H_1 ... H_J, g, mu, sigma) from J samples, of the expected information of each."""

import numpy as np

from pchem_pipeline.model.errors.expected_information import expected_information, shared_information


def cramer_rao(exposures, gain, sigma, frames):
    """Return the smallest covariance, (J + 3, J + 3); zeros for samples without electrons."""
    exposures = np.atleast_1d(np.asarray(exposures, np.float64))
    n = exposures.size
    information = np.zeros((n + 3, n + 3))
    for j, (exposure, number) in enumerate(zip(exposures, np.broadcast_to(frames, n), strict=True)):
        if exposure > 0:
            place = np.ix_([j, n, n + 1, n + 2], [j, n, n + 1, n + 2])
            information[place] += number * expected_information(exposure, gain * sigma)
        else:
            information[n:, n:] += number * shared_information(0.0, gain * sigma)
    free = np.ix_(*2 * [[*np.flatnonzero(exposures > 0), n, n + 1, n + 2]])
    bound = np.zeros_like(information)
    bound[free] = np.linalg.inv(information[free])
    scale = np.concatenate([np.ones(n), [gain, 1.0 / gain, sigma]])
    return bound * np.outer(scale, scale)
