"""The loops over the pixels of a tile under a grown model: fit, log-likelihood, masses."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.goodness_numba import pearson
from pchem_pipeline.model.grown_cells_numba import all_masses, evaluate, masses
from pchem_pipeline.model.grown_newton_numba import climb
from pchem_pipeline.model.grown_numba import (
    AMPLITUDE,
    CHI2,
    CLEAR_GAP,
    CONVERGED,
    EVALUATIONS,
    FREEDOM,
    GAP,
    LOBE_RISE,
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
    seek_lobe,
    to_theta,
)
from pchem_pipeline.model.grown_types_numba import (
    LOBE,
    N_THETA,
    Cells,
    Law,
    Room,
    make_room,
)
from pchem_pipeline.model.workspace_numba import load

_LEAST_MASS = 1e-300


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _search_lobes(
    theta: NDArray[np.float64],
    loglik: float,
    cells: Cells,
    law: Law,
    place: tuple[int, int, int],
    amplitudes: NDArray[np.float64],
    limits: NDArray[np.float64],
    room: Room,
) -> tuple[float, float, int]:
    """Try free lobes of each amplitude; keep the best in ``theta`` where the likelihood rises by enough.

    Returns:
        The amplitude kept, e-, 0 without one; its log-likelihood; evaluations.
    """
    trial, best = np.empty(N_THETA), np.empty(N_THETA)
    kept, highest, used = 0.0, loglik + limits[LOBE_RISE], 0
    pixel, first_code, centre = place
    space = cells.weights, cells.edges, cells.lobes
    for amplitude in amplitudes:
        own = make_cells(law, pixel, amplitude, first_code, centre, cells.n_bins, space)
        for i in range(N_THETA):
            trial[i] = theta[i]
        found, count = seek_lobe(trial, own, law, limits, room)
        used += count
        if found > highest:
            kept, highest = amplitude, found
            for i in range(N_THETA):
                best[i] = trial[i]
    if kept > 0.0:
        for i in range(N_THETA):
            theta[i] = best[i]
        return kept, highest, used
    return 0.0, loglik, used


@nb.njit(nogil=True, cache=True, error_model="numpy")
def fit_pixel(
    theta: NDArray[np.float64],
    cells: Cells,
    law: Law,
    place: tuple[int, int, int],
    amplitudes: NDArray[np.float64],
    gap: float,
    n: float,
    limits: NDArray[np.float64],
    room: Room,
    out: NDArray[np.float64],
) -> tuple[bool, int, int]:
    """Fit one pixel from ``theta``, which is updated; ``room`` holds the answers at the maximum.

    Args:
        theta: start; out: the maximum.
        cells: of the pixel, without free lobes.
        law: grown model.
        place: the pixel's place in the arrays of the law, the code of the first cell, the centre.
        amplitudes: of free lobes, e-.
        gap: nats between the plain fit and its runner-up; the neighbours are tried where it is small.
        n: number of samples.
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
    if gap < limits[CLEAR_GAP]:
        loglik, beside, count = climb_neighbours(theta, loglik, cells, law, limits, room)
        if beside > -math.inf:
            out[GAP] = loglik - beside
        used += count
    amplitude = 0.0
    if amplitudes.size > 0:
        amplitude, loglik, count = _search_lobes(theta, loglik, cells, law, place, amplitudes, limits, room)
        used += count
    own = make_cells(
        law, place[0], amplitude, place[1], place[2], cells.n_bins, (cells.weights, cells.edges, cells.lobes)
    )
    out[LOG_LIKELIHOOD] = evaluate(theta, own, law, room)
    out[AMPLITUDE], out[LOBE_WEIGHT] = amplitude, theta[LOBE]
    for i in range(cells.n_bins):
        room.ratio[i] = n * room.mass[i]
    out[CHI2], freedom = pearson(cells.weights, room.ratio, cells.n_bins, n)
    if amplitude > 0.0:
        freedom = max(freedom - 2, 0)
    return True, used + 1, freedom


@nb.njit(nogil=True, cache=True, error_model="numpy")
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
            theta, cells, law, place, amplitudes, gaps[pixel], histogram.n, limits, room, out[pixel]
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


@nb.njit(nogil=True, cache=True, error_model="numpy")
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


@nb.njit(nogil=True, cache=True, error_model="numpy")
def mass_tile(
    first: NDArray[np.int64],
    parameters: NDArray[np.float64],
    lobes: NDArray[np.float64],
    law: Law,
    out: NDArray[np.float64],
) -> None:
    """Fill the mass of successive codes of every pixel whose parameters are finite.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        lobes: amplitude (e-) and weight of each pixel's free lobes, shape (n, 2).
        law: grown model.
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
        all_masses(theta, cells, law, room)
        for i in range(n_codes):
            out[pixel, i] = room.mass[i]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def slope_tile(
    first: NDArray[np.int64],
    parameters: NDArray[np.float64],
    lobes: NDArray[np.float64],
    law: Law,
    out: NDArray[np.float64],
    slopes: NDArray[np.float64],
) -> None:
    """Fill the mass of successive codes and its slopes in log H, 1/g, mu and log sigma_R^2.

    Args:
        first: first code of each pixel, DN, shape (n,).
        parameters: (H, g, mu, sigma), shape (n, 4).
        lobes: amplitude (e-) and weight of each pixel's free lobes, shape (n, 2).
        law: grown model.
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
        all_masses(theta, cells, law, room)
        for i in range(n_codes):
            out[pixel, i] = room.mass[i]
            for j in range(4):
                slopes[pixel, j, i] = room.slopes[j, i]
