"""Loop of :mod:`pchem_pipeline.model.errors.rounding`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.normal_numba import REACH, add_mass
from pchem_pipeline.model.errors.algebra_numba import invert_arrow, solve_arrow
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    DERIVATIVES,
    HELD,
    HERE,
    N_SHARED,
    SATELLITE,
    SCORE,
    STEPS,
    load,
    make_pixel,
    make_scratch,
)

_NO_FRAMES = 1e-9  # expected with a number of electrons that hardly occurs


@kernel(inline=True)
def _shift(parameters: NDArray[np.float64], n: float, evaluate: Any, shift: NDArray[np.float64]) -> bool:
    """Fill the bias of (log H, 1/g, mu, log sigma^2) in standard errors.

    To first order it is ``I^-1 s``, with score s and information I of the density at the truth, on the counts
    that the exact masses expect.

    Args:
        parameters: (H, g, mu, sigma).
        n: frames.
        evaluate: the density.
        shift: out, shape (4,).

    Returns:
        Whether there is an answer: not where sigma is rounding alone.
    """
    exposure, a, bias, sigma = parameters[0], 1.0 / parameters[1], parameters[2], parameters[3]
    analog2 = sigma * sigma - QUANTISATION_VARIANCE
    if not (analog2 > 0.0 and exposure > 0.0 and math.isfinite(a + bias + n)):
        return False
    first = math.floor(-REACH * sigma) - 1
    n_bins = int((exposure + REACH * math.sqrt(exposure) + 8.0) * a + REACH * sigma) + 2 - first
    offset = bias - math.floor(bias)
    pixel = make_pixel(np.zeros(1, np.bool_), n_bins, 0, 0)
    scratch = make_scratch(1, n_bins, np.bool_(False))
    weights = np.zeros(n_bins)
    electrons, holding = 0.0, n
    while electrons < exposure or holding > _NO_FRAMES:
        holding = n * math.exp(electrons * math.log(exposure) - exposure - math.lgamma(electrons + 1.0))
        if holding > _NO_FRAMES:
            add_mass(weights, float(first), holding, offset + electrons * a, math.sqrt(analog2))
        electrons += 1.0
    centre = first + load(weights, np.zeros(n_bins, np.uint8), pixel.bins[0], pixel.facts[0])
    theta, at, held = scratch.small[HERE], scratch.evaluations[AT], scratch.flags[HELD]
    theta[0], theta[1], theta[2], theta[3] = math.log(exposure), a, offset - centre, 2.0 * math.log(sigma)
    evaluate(pixel, theta, DERIVATIVES, scratch, at)
    held[1 + SATELLITE] = True
    step = scratch.small[STEPS]
    covariance = np.empty((1 + N_SHARED, 1 + N_SHARED))
    if not solve_arrow(at, 0.0, scratch, step) >= 0.0:
        return False
    at[0, SCORE] = 0.0
    if not invert_arrow(at, theta, held, covariance):
        return False
    for i in range(4):
        shift[i] = step[i] / math.sqrt(covariance[i, i])
    shift[0] *= exposure
    return True


@kernel
def rounding_tile(
    parameters: NDArray[np.float64], n: NDArray[np.float64], evaluate: Any, out: NDArray[np.float64]
) -> None:
    """Fill the bias of every pixel with finite parameters.

    Args:
        parameters: (H, g, mu, sigma), shape (n, 4).
        n: frames, shape (n,).
        evaluate: the density.
        out: out, shape (n, 4); comes as infinity, which stays where there is no answer.
    """
    shift = np.empty(4)
    for pixel in range(parameters.shape[0]):
        if _shift(parameters[pixel], n[pixel], evaluate, shift):
            for i in range(4):
                out[pixel, i] = shift[i]
