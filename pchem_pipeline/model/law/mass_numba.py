"""Loops of :mod:`pchem_pipeline.model.law.mass`."""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE, SMALLEST_MASS
from pchem_pipeline.model.law.cells_numba import Law, cells_of, fill_masses, resolve
from pchem_pipeline.model.law.levels_numba import place_codes, reach_of_law
from pchem_pipeline.model.law.pixel_numba import (
    DERIVATIVES,
    FIRST,
    LOGLIK_ALONE,
    MASS,
    N_BINS,
    N_BLOCK,
    OWN,
    SLOPES,
    Pixel,
    Scratch,
    make_pixel,
    make_scratch,
)

_MOST_EXPOSURE = 1e6  # e-: each electron number costs, and cumulants may ask for 1e13 of them


@kernel
def pixel_scratch(n_bins: int, law: Law) -> tuple[Pixel, Scratch]:
    """Return room for one sample of so many bins."""
    n_peaks = law.peaks.shape[3] * (1 + law.pattern.shape[0])
    n_exposures = max(law.exposures.shape[3], law.added.shape[3])
    pixel = make_pixel(np.zeros(1, np.bool_), n_bins, n_peaks, n_exposures)
    return pixel, make_scratch(1, n_bins, True)


@kernel
def known_theta(parameters: FloatArray, centre: int, weight: float, theta: FloatArray) -> bool:
    """Fill a sample's own theta from (H, g, mu, sigma); False unless known, and H that of a pixel."""
    if not (math.isfinite(parameters.sum()) and parameters[0] < _MOST_EXPOSURE):
        return False
    theta[0] = math.log(max(parameters[0], SMALLEST_MASS))
    theta[1] = 1.0 / parameters[1]
    theta[2] = parameters[2] - centre
    theta[3] = math.log(max(parameters[3] * parameters[3] - QUANTISATION_VARIANCE, LEAST_VARIANCE))
    theta[4] = weight
    return True


@kernel
def find_reach(parameters: FloatArray, satellites: FloatArray, law: Law, out: IntArray) -> None:
    """Fill the first and last code that each pixel shows, DN, shape (n, 2); (0, -1) without parameters."""
    pixel, scratch = pixel_scratch(2, law)
    theta = scratch.small[OWN]
    for p in range(parameters.shape[0]):
        out[p, 0], out[p, 1] = 0, -1
        placed, _ = place_codes(p, 0, 1, 1, law, satellites, pixel)
        if known_theta(parameters[p], placed.centre, satellites[p, 1], theta):
            out[p, 0], out[p, 1] = reach_of_law(parameters[p, 0], p, theta, placed, law)


@kernel
def mass_tile(
    first: IntArray,
    parameters: FloatArray,
    satellites: FloatArray,
    law: Law,
    stage: int,
    out: FloatArray,
    slopes: FloatArray,
) -> None:
    """Fill the mass of successive codes of every pixel whose parameters are finite, and its slopes.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        satellites: amplitude (e-) and weight of each pixel's free satellite peaks, shape (n, 2).
        law: of the samples.
        stage: how far the tails go, see :func:`.cells_numba.fill_masses`.
        out: out, shape (n, n_codes); comes as NaN.
        slopes: out, in log H, 1/g, mu and log sigma_R^2, shape (n, 4, n_codes), comes as NaN; or (0, 4,
            n_codes).
    """
    n_codes = out.shape[1]
    room, scratch = pixel_scratch(n_codes, law)
    theta, what = scratch.small[OWN], DERIVATIVES if slopes.shape[0] > 0 else LOGLIK_ALONE
    room.facts[0, N_BINS], room.facts[0, FIRST] = float(n_codes), 0.0
    for index in range(parameters.shape[0]):
        if not known_theta(parameters[index], first[index], satellites[index, 1], theta):
            continue
        pixel = Pixel(room.bins, room.facts, room.peaks, room.mixtures, first[index], 0.0)
        resolve(law, index, satellites[index, 0], pixel)
        cells = cells_of(pixel, 0)
        fill_masses(theta, cells, stage, what, scratch.numbers, scratch.edges, scratch.cells[0])
        for i in range(n_codes):
            out[index, i] = scratch.cells[0, MASS, i]
        for j in range(N_BLOCK - 1 if slopes.shape[0] > 0 else 0):
            for i in range(n_codes):
                slopes[index, j, i] = scratch.cells[0, SLOPES + j, i]
