"""The loop over the pixels of a tile: the fit of each, and again where the tail guard has something to do."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.fisher_numba import to_natural
from pchem_pipeline.model.fit.goodness_numba import normal_score
from pchem_pipeline.model.fit.outliers_numba import core_ends, cut, inner_ends, leave_out, total
from pchem_pipeline.model.fit.pchem_numba import (
    CHI2,
    EVALUATIONS,
    EXPOSURE_AT_BOUND,
    FIT_NOT_CONVERGED,
    FLOOR,
    FRAMES,
    FREEDOM,
    GAIN_NOT_IDENTIFIED,
    HIGHEST_DN,
    LOWEST_DN,
    MOST_OUTLIERS,
    NO_DATA,
    OUTLYING,
    STATUS,
    TOO_FEW_BINS,
    fit_pixel,
)
from pchem_pipeline.model.fit.polish_numba import MAX_STEP, min_log_variance
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.workspace_numba import (
    Histogram,
    Workspace,
    copy,
    load,
    make_rows,
    make_workspace,
    share_workspace,
)

_MOST_PASSES = 8  # of the tail guard
_MISFIT = 5.0  # standard normal: a goodness of fit that outliers may be to blame for


class Room(NamedTuple):
    """What the fit of a row works with.

    Attributes:
        basis: of the regression on the ECF.
        limits: bounds and limits; ``MAX_STEP`` is set for each row.
        weights, cumulative: a histogram without its empty ends, and its sums.
        space: scratch.
        at_best: score and information at the maximum; shares the scratch.
        near: (H, g, mu, sigma) known to be near the answer, NaN where nothing is known.
        theta: parameters at the maximum; their step is 0 where there is none.
    """

    basis: NDArray[np.float64]
    limits: NDArray[np.float64]
    weights: NDArray[np.float64]
    cumulative: NDArray[np.float64]
    space: Workspace
    at_best: Workspace
    near: NDArray[np.float64]
    theta: NDArray[np.float64]


@kernel
def _fit_row(
    row: NDArray[np.generic],
    origin: int,
    room: Room,
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> int:
    """Fit one row of counts; return its status word."""
    histogram, centre, occupied = load(row, room.weights, room.cumulative)
    status: int = _fit_loaded(histogram, centre, occupied, origin, room, parameters, covariance, out, words)
    return status


@kernel
def _fit_loaded(
    histogram: Histogram,
    centre: int,
    occupied: int,
    origin: int,
    room: Room,
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> int:
    """Fit a histogram that lies in the room; return its status word."""
    room.theta[1] = 0.0
    for i in range(out.size):
        out[i] = math.nan
    if occupied < 3:
        return NO_DATA if occupied == 0 else TOO_FEW_BINS
    near, middle = np.zeros(4), float(origin + centre)
    if math.isfinite(room.near[0] + room.near[1] + room.near[2] + room.near[3]):
        near[0], near[1] = math.log(room.near[0]), 1.0 / room.near[1]
        near[2], near[3] = room.near[2] - middle, 2.0 * math.log(room.near[3])
    room.limits[MAX_STEP] = 4.0 * histogram.n_bins + 10.0
    status: int
    status, used, words[FREEDOM] = fit_pixel(
        histogram, room.basis, room.limits, room.space, near, room.theta, room.at_best, out
    )
    words[EVALUATIONS] += used
    theta = room.theta
    if theta[1] > 0.0:
        held = np.zeros(4, np.bool_)
        held[0] = status & EXPOSURE_AT_BOUND != 0
        held[3] = theta[3] <= min_log_variance(theta[1]) + 1e-9
        if not to_natural(theta, middle, room.at_best.information, held, parameters, covariance):
            status |= FIT_NOT_CONVERGED
    return status


@kernel
def _unexpected(
    row: NDArray[np.generic],
    origin: int,
    frames: float,
    room: Room,
    parameters: NDArray[np.float64],
    kept: NDArray[np.generic],
) -> bool:
    """Leave out of ``kept`` the samples that the parameters do not expect; tell whether it changed."""
    histogram, centre, _ = load(row, room.weights, room.cumulative)
    theta = room.theta
    theta[0], theta[1] = math.log(parameters[0]), 1.0 / parameters[1]
    theta[2], theta[3] = parameters[2] - float(origin + centre), 2.0 * math.log(parameters[3])
    evaluate(histogram, theta, room.at_best, frames)
    first = centre + int(histogram.first)
    changed: bool = leave_out(row, room.at_best.rows[0], first, histogram.n_bins, room.limits[FLOOR], kept)
    return changed


@kernel
def _suspicious(
    limits: NDArray[np.float64],
    theta: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> bool:
    """Tell whether a fit of all samples may have been led by outliers: by single samples or as a whole."""
    if not (limits[FLOOR] > 0.0 and theta[1] > 0.0):
        return False
    misfit: float = normal_score(out[CHI2], words[FREEDOM])
    return bool(out[OUTLYING] > 0.0 or misfit > _MISFIT)


@kernel
def _fit_guarded(
    row: NDArray[np.generic],
    kept: NDArray[np.generic],
    origin: int,
    room: Room,
    far: bool,
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> int:
    """Fit a row that may hold outliers; return its status word.

    A good fit of all samples says itself which it does not expect. Otherwise both ends of the histogram are
    left out first, as much of them as may be outliers; where that says nothing, the samples that a gap cuts
    off. What these parameters expect then comes back, until the samples left out stay the same. Where that
    fails, or where they are too many to be a few outliers, it is the fit of all samples.
    """
    status: int
    histogram, centre, _ = load(row, room.weights, room.cumulative)
    n, start = histogram.n, centre + int(histogram.first)
    inner, core = inner_ends(histogram, room.limits[MOST_OUTLIERS]), core_ends(histogram)
    good = not far and normal_score(out[CHI2], words[FREEDOM]) <= _MISFIT
    for attempt in range(0 if good else 1, 3 if far else 2):
        if attempt == 0:
            cut(row, 0, row.size, kept)
            _unexpected(row, origin, n, room, parameters, kept)
        else:
            first, end = inner if attempt == 1 else core
            cut(row, start + first, start + end, kept)
        for _ in range(_MOST_PASSES):
            left_out = n - total(kept)
            if left_out > room.limits[MOST_OUTLIERS] * n:
                break
            status = _fit_row(kept, origin, room, parameters, covariance, out, words)
            if room.theta[1] == 0.0 or status & (FIT_NOT_CONVERGED | GAIN_NOT_IDENTIFIED) != 0:
                break
            if not _unexpected(row, origin, n - left_out, room, parameters, kept):
                out[OUTLYING] = left_out
                return status
    status = _fit_row(row, origin, room, parameters, covariance, out, words)
    out[OUTLYING] = 0.0
    if far and _suspicious(room.limits, room.theta, out, words):
        status |= GAIN_NOT_IDENTIFIED  # only far samples speak for a gain, and it does not explain them
    return status


@kernel
def fit_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    start: NDArray[np.float64],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> None:
    """Fit every row of ``counts``; pixels do not influence each other.

    Args:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
        basis: of the regression on the ECF.
        limits: bounds and limits, shape (N_LIMITS,).
        start: (H, g, mu, sigma) near the answer, shape (n, 4), NaN where not known; or shape (0, 4).
        parameters: out, (H, g, mu, sigma), shape (n, 4); comes as NaN.
        covariance: out, shape (n, 4, 4); comes as NaN.
        out: out, shape (n, N_OUT); comes as NaN.
        words: out, shape (n, N_WORDS); comes as 0.
    """
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    space = make_workspace(make_rows(n_most))
    near, theta = np.full(4, math.nan), np.empty(4)
    room = Room(basis, limits.copy(), weights, cumulative, space, share_workspace(space), near, theta)
    kept = np.empty(n_most, counts.dtype)
    for pixel in range(counts.shape[0]):
        row = counts[pixel]
        if start.shape[0] > 0:
            copy(start[pixel], near)
        histogram, centre, occupied = load(row, weights, cumulative)
        dn = origin[pixel] + centre + int(histogram.first)
        words[pixel, FRAMES] = int(histogram.n)
        words[pixel, LOWEST_DN], words[pixel, HIGHEST_DN] = dn, dn + histogram.n_bins - 1
        far = False
        if limits[FLOOR] > 0.0:
            first, end = core_ends(histogram)
            far = first > 0 or end < histogram.n_bins
        status = 0
        if not far:
            status = _fit_loaded(
                histogram, centre, occupied, origin[pixel], room,
                parameters[pixel], covariance[pixel], out[pixel], words[pixel],
            )  # fmt: skip
        if far or _suspicious(limits, theta, out[pixel], words[pixel]):
            status = _fit_guarded(
                row, kept, origin[pixel], room, far,
                parameters[pixel], covariance[pixel], out[pixel], words[pixel],
            )  # fmt: skip
        else:
            out[pixel, OUTLYING] = 0.0
        words[pixel, STATUS] = status
