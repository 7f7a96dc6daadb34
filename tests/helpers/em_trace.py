"""Plain EM by the kernels of the fit, step by step."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.climb_numba import Limits, em_step
from pchem_pipeline.model.fit.engine import likelihood
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    DERIVATIVES,
    Pixel,
    Scratch,
    load,
    make_pixel,
    make_scratch,
)

Array = NDArray[np.float64]

LIMITS = Limits(
    -np.inf, 1e-8, 200, 0, True, False, 5.0, 0.5, 0.0, 0.0, 0.0, False, False, False, False, False
)
FREE = np.array([False])


class EmTrace(NamedTuple):
    """Iterates of plain EM: log-likelihoods, and (H, g, mu, sigma)."""

    log_likelihood: Array
    parameters: Array


def one_sample(
    counts: NDArray[np.integer], mask: ArrayLike = 0, n_peaks: int = 0, n_exposures: int = 0
) -> tuple[Pixel, Scratch, int]:
    """Return one histogram as the loops take it, room to work in, and its centre in bins after the first."""
    pixel = make_pixel(FREE, counts.size, n_peaks, n_exposures)
    scratch = make_scratch(1, counts.size, n_peaks > 0)
    whole = np.full(counts.size, mask, np.uint8)
    centre = load(np.asarray(counts, np.uint32), whole, pixel.bins[0], pixel.facts[0])
    return pixel, scratch, int(centre)


@kernel
def evaluated(pixel: Pixel, theta: Array, what: int, evaluate: Any, scratch: Scratch) -> float:
    """Evaluate a likelihood that is called by its address, into the place `AT`."""
    return float(evaluate(pixel, theta, what, scratch, scratch.evaluations[AT]))


def em_trace(counts: NDArray[np.integer], origin: int, start: ArrayLike, n_iterations: int) -> EmTrace:
    """Return the iterates of plain EM on one histogram, eqs. (update_eqns) to (gamma_nk)."""
    pixel, scratch, centre = one_sample(counts)
    middle = float(origin + centre)
    h, g, mu, sigma = np.asarray(start, np.float64)
    theta = np.array([np.log(h), 1 / g, mu - middle, 2 * np.log(sigma), 0.0])
    path, logliks = np.empty((n_iterations + 1, 4)), np.empty(n_iterations + 1)
    for row in range(n_iterations + 1):
        logliks[row] = evaluated(pixel, theta, DERIVATIVES, likelihood(False), scratch)
        path[row] = np.exp(theta[0]), 1 / theta[1], middle + theta[2], np.exp(theta[3] / 2)
        following = np.empty(5)
        if em_step(pixel, theta, scratch.evaluations[AT], LIMITS, following):
            theta = following
    return EmTrace(logliks, path)
