"""Which starting point a pixel is given first, and the others that a suspicious pixel gets."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.start_numba import assemble, start_cumulants, start_peak, start_regression
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.workspace_numba import Histogram, Workspace, copy, load, make_rows

#: starts of a suspicious pixel: side lobe, cumulants, scan, and the best with its gain scaled
_SCALES = (2.0, 0.5, 1.5, 0.67, 1.22, 0.82)
N_OTHERS = 3 + len(_SCALES)

_MIN_STEP = 1.2  # DN per electron
_N_SCAN = 25  # steps of the scan over the gain, from a fifth of the sd to 2.5 sd
_SCAN_NOISE = 0.1225  # e-^2


@kernel
def first_start(
    histogram: Histogram, basis: NDArray[np.float64], space: Workspace, theta: NDArray[np.float64]
) -> bool:
    """Fill ``theta`` with the regression's start, or, if that sees no side lobe, the likeliest of three.

    Args:
        histogram: of the pixel.
        basis: from `regression_basis`.
        space: scratch.
        theta: out, the start.

    Returns:
        Whether there is a start.
    """
    usable, clear = start_regression(histogram, basis, space.rows, theta)
    if usable and clear:
        return True
    trial = np.empty(4)
    best = -math.inf
    if usable and theta[1] > _MIN_STEP:
        best = evaluate(histogram, theta, space, 0.0)
    for which in range(2):
        if which == 0:
            found = start_peak(histogram, space.rows, trial)
        else:
            found = start_cumulants(histogram, trial)
        if found and trial[1] > _MIN_STEP:
            loglik = evaluate(histogram, trial, space, 0.0)
            if loglik > best:
                best = loglik
                copy(trial, theta)
    return best > -math.inf


@kernel
def _scan(histogram: Histogram, space: Workspace, theta: NDArray[np.float64]) -> bool:
    """Fill ``theta`` with the likeliest of a row of gains, the read noise taken as 0.35 e-."""
    trial = np.empty(4)
    best = -math.inf
    for place in range(_N_SCAN):
        a = math.sqrt(histogram.variance) * 0.2 * 12.5 ** (place / (_N_SCAN - 1.0))
        exposure = histogram.variance / (a * a) - _SCAN_NOISE
        if exposure > 0.0 and a > _MIN_STEP:
            assemble(histogram, a, exposure, trial)
            trial[3] = math.log(max(_SCAN_NOISE * a * a, 1.0 / 12.0))
            loglik = evaluate(histogram, trial, space, 0.0)
            if loglik > best:
                best = loglik
                copy(trial, theta)
    return best > -math.inf


@kernel
def other_start(
    which: int, histogram: Histogram, best: NDArray[np.float64], space: Workspace, theta: NDArray[np.float64]
) -> bool:
    """Fill ``theta`` with one of the `N_OTHERS` starts kept for suspicious pixels.

    Args:
        which: 0 side lobe, 1 cumulants, 2 scan over the gain, further ones the best with 1/g scaled, the
            mean and the variance of the signal kept.
        histogram: of the pixel.
        best: best maximum so far, theta; its step is 0 where there is none.
        space: scratch.
        theta: out, the start.

    Returns:
        Whether there is a start.
    """
    found: bool
    if which == 0:
        found = start_peak(histogram, space.rows, theta)
        return found
    if which == 1:
        found = start_cumulants(histogram, theta)
        return found
    if which == 2:
        found = _scan(histogram, space, theta)
        return found
    if not best[1] > 0.0:
        return False
    # the read noise in e- is kept, the exposure takes up the rest of the variance
    a = best[1] * _SCALES[which - 3]
    noise2 = min(math.exp(best[3]) / (best[1] * best[1]), 0.25)
    exposure = histogram.variance / (a * a) - noise2
    if exposure < 0.03 or a < _MIN_STEP:
        return False
    assemble(histogram, a, exposure, theta)
    theta[3] = math.log(max(noise2 * a * a, 1.0 / 12.0))
    return True


@kernel
def start_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    basis: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill ``out`` (n, 3, 4), which comes as NaN, with (H, g, mu, sigma) of the three closed-form starts."""
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    rows = make_rows(n_most)
    theta = np.empty(4)
    for pixel in range(counts.shape[0]):
        histogram, centre, occupied = load(counts[pixel], weights, cumulative)
        if occupied < 3:
            continue
        for which in range(3):
            if which == 0:
                found, _ = start_regression(histogram, basis, rows, theta)
            elif which == 1:
                found = start_peak(histogram, rows, theta)
            else:
                found = start_cumulants(histogram, theta)
            if found:
                out[pixel, which, 0] = math.exp(theta[0])
                out[pixel, which, 1] = 1.0 / theta[1]
                out[pixel, which, 2] = float(origin[pixel] + centre) + theta[2]
                out[pixel, which, 3] = math.exp(0.5 * theta[3])
