"""The loops over the pixels of a tile under a grown model: fit, log-likelihood, masses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.goodness_numba import normal_score, pearson
from pchem_pipeline.model.fit.grown_lobes_numba import search_lobes
from pchem_pipeline.model.fit.grown_newton_numba import climb
from pchem_pipeline.model.fit.grown_numba import (
    AMPLITUDE,
    BESIDE,
    CHI2,
    CLEAR_GAP,
    CONVERGED,
    EVALUATIONS,
    FREEDOM,
    GAP,
    LOBE_WEIGHT,
    LOG_LIKELIHOOD,
    MAX_EVALUATIONS,
    MIN_LOG_EXPOSURE,
    TOLERANCE,
    WARM,
    climb_neighbours,
    from_theta,
    make_cells,
    make_lobes,
    to_theta,
)
from pchem_pipeline.model.law.grown_cells_numba import all_masses, evaluate, masses
from pchem_pipeline.model.law.grown_types_numba import (
    LOBE,
    LOG_VARIANCE,
    N_THETA,
    STEP,
    Cells,
    Law,
    Room,
    make_room,
)
from pchem_pipeline.model.law.workspace_numba import Histogram, load

_LEAST_MASS = 1e-300
# what calls for other starts of free lobes: a bad fit (standard normal), or one without resolved peaks, e-
_SUSPICIOUS = 2.3
_UNRESOLVED = 0.45


@kernel
def _goodness(cells: Cells, n: float, room: Room) -> tuple[float, int]:
    """Return chi-square and degrees of freedom of the masses in ``room``; its ratios are overwritten."""
    for i in range(cells.n_bins):
        room.ratio[i] = n * room.mass[i]
    chi2, freedom = pearson(cells.weights, room.ratio, cells.n_bins, n)
    return chi2, freedom


@kernel
def fit_pixel(
    theta: NDArray[np.float64],
    histogram: Histogram,
    cells: Cells,
    law: Law,
    place: tuple[int, int, int],
    amplitudes: NDArray[np.float64],
    gap: float,
    limits: NDArray[np.float64],
    room: Room,
    out: NDArray[np.float64],
) -> tuple[bool, int, int]:
    """Fit one pixel from ``theta``, which is updated; ``room`` holds the answers at the maximum.

    Args:
        theta: start; out: the maximum.
        histogram: of the pixel.
        cells: of the pixel, without free lobes.
        law: grown model.
        place: the pixel's place in the arrays of the law, the code of the first cell, the centre.
        amplitudes: of free lobes, e-.
        gap: nats between the plain fit and its runner-up; the neighbours are tried where it is small.
        limits: bounds and limits, see :mod:`.grown_numba`.
        room: scratch.
        out: out, a row of results.

    Returns:
        Whether it converged, evaluations, degrees of freedom of the goodness of fit.
    """
    bound, most = limits[MIN_LOG_EXPOSURE], int(limits[MAX_EVALUATIONS])
    fine, loglik, used = climb(theta, cells, law, bound, limits[TOLERANCE], most, False, -math.inf, room)
    if not fine:
        return False, used, 0
    out[GAP] = gap
    if gap < limits[CLEAR_GAP] or limits[BESIDE] > 0.0:
        loglik, beside, count = climb_neighbours(theta, loglik, cells, law, limits, False, room)
        if beside > -math.inf:
            out[GAP] = loglik - beside
        used += count
    loglik = evaluate(theta, cells, law, room)
    out[CHI2], freedom = _goodness(cells, histogram.n, room)
    amplitude = 0.0
    if amplitudes.size > 0:
        noise = math.exp(0.5 * theta[LOG_VARIANCE]) / theta[STEP]
        poor = normal_score(out[CHI2], freedom) > _SUSPICIOUS or noise > _UNRESOLVED
        unsure = out[GAP] < limits[CLEAR_GAP]
        amplitude, count = search_lobes(
            theta, loglik, histogram, cells, law, place, amplitudes, unsure, poor, limits, room
        )
        used += count
        space = cells.weights, cells.edges, cells.lobes
        own = make_cells(law, place[0], amplitude, place[1], place[2], cells.n_bins, space)
        loglik = evaluate(theta, own, law, room)
        out[CHI2], freedom = _goodness(own, histogram.n, room)
        freedom = max(freedom - 2, 0) if amplitude > 0.0 else freedom
    out[LOG_LIKELIHOOD] = loglik
    out[AMPLITUDE], out[LOBE_WEIGHT] = amplitude, theta[LOBE]
    return True, used + 1, freedom


@kernel
def fit_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    start: NDArray[np.float64],
    gaps: NDArray[np.float64],
    law: Law,
    amplitudes: NDArray[np.float64],
    limits: NDArray[np.float64],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> None:
    """Fit every row of ``counts`` whose start is finite; pixels do not influence each other.

    Args:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
        start: (H, g, mu, sigma), shape (n, 4).
        gaps: nats between a start and its runner-up, shape (n,).
        law: grown model.
        amplitudes: of free lobes, e-.
        limits: bounds and limits, see :mod:`.grown_numba`.
        parameters: out, (H, g, mu, sigma), shape (n, 4); comes as NaN.
        covariance: out, shape (n, 4, 4); comes as NaN.
        out: out, shape (n, N_OUT); comes as NaN.
        words: out, shape (n, N_WORDS); comes as 0.
    """
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    space = weights, np.empty(n_most + 1), make_lobes(law)
    room, theta = make_room(n_most), np.empty(N_THETA)
    for pixel in range(counts.shape[0]):
        if not math.isfinite(start[pixel].sum()):
            continue
        histogram, middle, occupied = load(counts[pixel], weights, cumulative)
        if occupied < 3:
            continue
        centre = origin[pixel] + middle
        first_code = centre + int(histogram.first)
        cells = make_cells(law, pixel, 0.0, first_code, centre, histogram.n_bins, space)
        to_theta(start[pixel], centre, cells, law, limits[WARM] > 0.0, theta)
        place = pixel, first_code, centre
        fine, words[pixel, EVALUATIONS], words[pixel, FREEDOM] = fit_pixel(
            theta, histogram, cells, law, place, amplitudes, gaps[pixel], limits, room, out[pixel]
        )
        if fine:
            words[pixel, CONVERGED] = from_theta(
                theta,
                centre,
                limits[MIN_LOG_EXPOSURE],
                out[pixel, AMPLITUDE] > 0.0,
                room,
                parameters[pixel],
                covariance[pixel],
            )


@kernel
def score_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    parameters: NDArray[np.float64],
    lobes: NDArray[np.float64],
    law: Law,
    out: NDArray[np.float64],
) -> None:
    """Fill the log-likelihood of every row of ``counts`` whose parameters are finite.

    Args:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        lobes: amplitude (e-) and weight of each pixel's free lobes, shape (n, 2).
        law: grown model.
        out: out, nats, shape (n,); comes as NaN.
    """
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    space = weights, np.empty(n_most + 1), make_lobes(law)
    room, theta = make_room(n_most), np.empty(N_THETA)
    for pixel in range(counts.shape[0]):
        if not math.isfinite(parameters[pixel].sum()):
            continue
        histogram, middle, _ = load(counts[pixel], weights, cumulative)
        centre = origin[pixel] + middle
        first_code = centre + int(histogram.first)
        cells = make_cells(law, pixel, lobes[pixel, 0], first_code, centre, histogram.n_bins, space)
        to_theta(parameters[pixel], centre, cells, law, True, theta)
        theta[LOBE] = lobes[pixel, 1]
        masses(theta, cells, law, room)
        total = 0.0
        for i in range(histogram.n_bins):
            if weights[i] > 0.0:
                total += weights[i] * math.log(max(room.mass[i], _LEAST_MASS))
        out[pixel] = total


@kernel
def mass_tile(
    first: NDArray[np.int64],
    parameters: NDArray[np.float64],
    lobes: NDArray[np.float64],
    law: Law,
    stage: int,
    out: NDArray[np.float64],
) -> None:
    """Fill the mass of successive codes of every pixel whose parameters are finite.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        lobes: amplitude (e-) and weight of each pixel's free lobes, shape (n, 2).
        law: grown model.
        stage: how far the tails go, see ``all_masses``.
        out: out, shape (n, n_codes); comes as NaN.
    """
    n_codes = out.shape[1]
    weights = np.zeros(n_codes)
    space = weights, np.empty(n_codes + 1), make_lobes(law)
    room, theta = make_room(n_codes), np.empty(N_THETA)
    for pixel in range(parameters.shape[0]):
        if not math.isfinite(parameters[pixel].sum()):
            continue
        centre = first[pixel]
        cells = make_cells(law, pixel, lobes[pixel, 0], first[pixel], centre, n_codes, space)
        to_theta(parameters[pixel], centre, cells, law, True, theta)
        theta[LOBE] = lobes[pixel, 1]
        all_masses(theta, cells, law, room, stage)
        for i in range(n_codes):
            out[pixel, i] = room.mass[i]


@kernel
def slope_tile(
    first: NDArray[np.int64],
    parameters: NDArray[np.float64],
    lobes: NDArray[np.float64],
    law: Law,
    stage: int,
    out: NDArray[np.float64],
    slopes: NDArray[np.float64],
) -> None:
    """Fill the mass of successive codes and its slopes in log H, 1/g, mu and log sigma_R^2.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        lobes: amplitude (e-) and weight of each pixel's free lobes, shape (n, 2).
        law: grown model.
        stage: how far the tails go, see ``all_masses``.
        out: out, shape (n, n_codes); comes as NaN.
        slopes: out, shape (n, 4, n_codes); comes as NaN.
    """
    n_codes = out.shape[1]
    space = np.zeros(n_codes), np.empty(n_codes + 1), make_lobes(law)
    room, theta = make_room(n_codes), np.empty(N_THETA)
    for pixel in range(parameters.shape[0]):
        if not math.isfinite(parameters[pixel].sum()):
            continue
        cells = make_cells(law, pixel, lobes[pixel, 0], first[pixel], first[pixel], n_codes, space)
        to_theta(parameters[pixel], first[pixel], cells, law, True, theta)
        theta[LOBE] = lobes[pixel, 1]
        all_masses(theta, cells, law, room, stage)
        for i in range(n_codes):
            out[pixel, i] = room.mass[i]
            for j in range(4):
                slopes[pixel, j, i] = room.slopes[j, i]
