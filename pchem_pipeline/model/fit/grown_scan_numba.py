"""Starts for pixels whose codes end at a limit: a scan of the grown likelihood at a known step.

Mean and variance of a cut histogram say little, so the starts of the plain fit fail. Its peaks are where
they were: the step comes from their comb. What is left, exposure and bias, is scanned around the median.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.grown_newton_numba import sensible
from pchem_pipeline.model.fit.grown_numba import make_cells, make_lobes
from pchem_pipeline.model.law.grown_cells_numba import near_masses
from pchem_pipeline.model.law.grown_types_numba import (
    BIAS,
    LOBE,
    LOG_EXPOSURE,
    LOG_VARIANCE,
    N_THETA,
    STEP,
    Cells,
    Law,
    Room,
    make_room,
)
from pchem_pipeline.model.law.workspace_numba import Histogram, load

_EXPOSURES = (0.3, 0.5, 0.8, 1.2, 1.8, 2.5, 3.3, 4.2, 5.3, 6.8, 9.0)
_NOISE_E = 0.28
_STEPS = 4  # biases per electron
_AROUND = 6  # steps from the exposure to the median, at most
_LEAST_MASS = 1e-9  # of a sample that must not decide between starts


@kernel
def _median(histogram: Histogram) -> float:
    """Return the median, counted from the centre."""
    place = 0
    while histogram.cumulative[place + 1] < 0.5 * histogram.n:
        place += 1
    return histogram.first + place


@kernel
def _scan(
    a: float,
    histogram: Histogram,
    cells: Cells,
    law: Law,
    room: Room,
    best: float,
    theta: NDArray[np.float64],
) -> float:
    """Fill ``theta`` with the likeliest start of a step if it beats ``best``; return the larger of both."""
    trial = np.zeros(N_THETA)
    median = _median(histogram)
    trial[STEP] = a
    trial[LOG_VARIANCE] = 2.0 * math.log(_NOISE_E * a)
    if not sensible(trial):
        return best
    for exposure in _EXPOSURES:
        trial[LOG_EXPOSURE] = math.log(exposure)
        for place in range(-_AROUND, _AROUND + 1):
            trial[BIAS] = median - a * (exposure + place / _STEPS)
            near_masses(trial, cells, law, room)
            loglik = 0.0
            for i in range(cells.n_bins):
                if cells.weights[i] > 0.0:
                    loglik += cells.weights[i] * math.log(max(room.mass[i], _LEAST_MASS))
            if loglik > best:
                best = loglik
                for i in range(N_THETA):
                    theta[i] = trial[i]
    return best


@kernel
def scan_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    gains: NDArray[np.float64],
    law: Law,
    out: NDArray[np.float64],
) -> None:
    """Fill the likeliest start of every row of ``counts``.

    Args:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
        gains: g to try, e-/DN, shape (n, m); NaN: none.
        law: grown model.
        out: out, (H, g, mu, sigma), shape (n, 4); comes as NaN.
    """
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    space = weights, np.empty(n_most + 1), make_lobes(law)
    room, theta = make_room(n_most), np.empty(N_THETA)
    theta[LOBE] = 0.0
    for pixel in range(counts.shape[0]):
        histogram, middle, occupied = load(counts[pixel], weights, cumulative)
        if occupied < 3:
            continue
        centre = origin[pixel] + middle
        first_code = centre + int(histogram.first)
        cells = make_cells(law, pixel, 0.0, first_code, centre, histogram.n_bins, space)
        best = -math.inf
        for gain in gains[pixel]:
            if gain > 0.0:
                best = _scan(1.0 / gain, histogram, cells, law, room, best, theta)
        if best > -math.inf:
            out[pixel, 0] = math.exp(theta[LOG_EXPOSURE])
            out[pixel, 1] = 1.0 / theta[STEP]
            out[pixel, 2] = centre + theta[BIAS]
            out[pixel, 3] = math.sqrt(math.exp(theta[LOG_VARIANCE]) + 1.0 / 12.0)
