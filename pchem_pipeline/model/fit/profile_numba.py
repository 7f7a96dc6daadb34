"""Ends of profile-likelihood intervals: a fixed parameter where the best likelihood has fallen by a drop."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.fisher_numba import back_substitute, cholesky, invert
from pchem_pipeline.model.fit.polish_numba import MAX_ELECTRON_NOISE, MIN_ELECTRON_NOISE, MIN_LOG_VARIANCE
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.workspace_numba import (
    Histogram,
    Workspace,
    copy,
    load,
    make_rows,
    make_workspace,
)

#: targets: log H, 1/g, mu, log sigma^2, and log s_e^2 in the place of the last
N_TARGETS = 5
_NOISE_E = 4

_INNER = 40  # Newton steps at a fixed value
_OUTER = 30  # fixed values tried for an end
_ENOUGH = 1e-6  # nats of the inner maximisation
_CLOSE = 1e-4  # of the root of the drop


@kernel
def to_theta(phi: NDArray[np.float64], target: int, theta: NDArray[np.float64]) -> bool:
    """Turn the coordinates of a target into theta; False outside of what the likelihood is defined for."""
    copy(phi, theta)
    if target == _NOISE_E and phi[1] > 0.0:
        theta[3] = phi[3] + 2.0 * math.log(phi[1])
    if not (theta[1] > 1.0 and theta[3] >= MIN_LOG_VARIANCE - 1e-9 and -25.0 < theta[0] < 11.0):
        return False
    noise = math.exp(0.5 * theta[3]) / theta[1]
    inside: bool = MIN_ELECTRON_NOISE <= noise <= MAX_ELECTRON_NOISE
    return inside


@kernel
def to_coordinates(space: Workspace, phi: NDArray[np.float64], target: int) -> None:
    """Turn score and information in theta, in place, into those in the coordinates of a target."""
    if target != _NOISE_E:
        return
    score, information = space.score, space.information
    slope = 2.0 / phi[1]  # of log sigma^2 = log s_e^2 + 2 log a with respect to a
    extra = 2.0 * score[3] / (phi[1] * phi[1])
    score[1] += slope * score[3]
    for j in range(4):
        information[1, j] += slope * information[3, j]
    for j in range(4):
        information[j, 1] += slope * information[j, 3]
    information[1, 1] += extra


@kernel
def maximise_others(
    histogram: Histogram,
    phi: NDArray[np.float64],
    target: int,
    held: NDArray[np.bool_],
    space: Workspace,
) -> float:
    """Climb over the coordinates that are not held, in place; return the log-likelihood, NaN on failure."""
    theta, trial, step = np.empty(4), np.empty(4), np.empty(4)
    matrix, lower = np.empty((4, 4)), np.empty((4, 4))
    if not to_theta(phi, target, theta):
        return math.nan
    loglik: float = evaluate(histogram, theta, space, 0.0)
    for _ in range(_INNER):
        to_coordinates(space, phi, target)
        damping = 0.0
        while True:
            for i in range(4):
                step[i] = 0.0 if held[i] else space.score[i]
                for j in range(4):
                    matrix[i, j] = space.information[i, j]
                matrix[i, i] += damping * abs(matrix[i, i])
            if cholesky(matrix, held, lower):
                break
            damping = 4.0 * damping + 1e-3
            if damping > 1e3:
                return math.nan
        rise: float = 0.5 * back_substitute(lower, step)
        if rise < _ENOUGH and damping == 0.0:
            return loglik + rise
        longest = max(max(abs(step[0]) / 0.5, abs(step[1]) / (0.1 * phi[1])),
                      max(abs(step[2]) / (0.4 * phi[1]), abs(step[3]) / 0.5))  # fmt: skip
        factor = 1.0 if longest <= 1.0 else 1.0 / longest
        higher = -math.inf
        for _attempt in range(12):
            for i in range(4):
                trial[i] = phi[i] + factor * step[i]
            if to_theta(trial, target, theta):
                higher = evaluate(histogram, theta, space, 0.0)
                if higher >= loglik - 1e-9 * abs(loglik) * 1e-3:
                    break
            factor *= 0.4
        if not higher >= loglik - 1e-9 * abs(loglik) * 1e-3:
            return math.nan
        copy(trial, phi)
        loglik = higher
    return math.nan


@kernel
def find_end(
    histogram: Histogram,
    best: NDArray[np.float64],
    top: float,
    target: int,
    root: float,
    direction: NDArray[np.float64],
    held: NDArray[np.bool_],
    space: Workspace,
) -> float:
    """Return the value of the target at which the profile has fallen by ``root^2 / 2``; NaN without one.

    The signed root of twice the drop is nearly linear, so a secant on it ends after a few values.

    Args:
        histogram: of the pixel.
        best: coordinates at the maximum.
        top: log-likelihood there.
        target: the parameter.
        root: drop, as standard normal quantile.
        direction: change of all coordinates per standard error of the target, with the side's sign.
        held: coordinates that stay, the target's place included.
        space: scratch.
    """
    place = min(target, 3)
    phi, good = best.copy(), best.copy()
    inside, below, outside, above = 0.0, 0.0, math.inf, math.inf
    distance = root
    for _ in range(_OUTER):
        for i in range(4):
            phi[i] = good[i] + (distance - inside) * direction[i]
        loglik = maximise_others(histogram, phi, target, held, space)
        drop = math.sqrt(max(0.0, 2.0 * (top - loglik))) if math.isfinite(loglik) else math.inf
        if abs(drop - root) < _CLOSE * root:
            return float(phi[place])
        if drop < root:
            inside, below = distance, drop
            copy(phi, good)
        else:
            outside, above = distance, drop
        if outside == math.inf:
            distance = min(3.0 * distance, distance * root / max(below, 0.1 * root) * 1.02)
            if distance > 60.0 * root:
                return math.nan
        elif above == math.inf:
            distance = 0.5 * (inside + outside)
        else:
            share = (root - below) / (above - below)
            distance = inside + min(0.95, max(0.05, share)) * (outside - inside)
        if outside - inside < 1e-7 * root:
            return math.nan if above == math.inf else float(phi[place])
    return math.nan


@kernel
def profile_tile(
    counts: NDArray[np.generic],
    origin: NDArray[np.int64],
    parameters: NDArray[np.float64],
    root: float,
    out: NDArray[np.float64],
) -> None:
    """Fill the ends of the intervals of every pixel, in theta and log s_e^2.

    Args:
        counts: histograms without outliers, shape (n, B).
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma) at the maximum, shape (n, 4); NaN where there is none.
        root: drop of the log-likelihood, as standard normal quantile.
        out: out, (log H, 1/g, mu, log sigma^2, log s_e^2) by pixel, and the lower and upper end of each,
            shape (n, 5, 2); NaN where the likelihood does not fall far enough.
    """
    n_most = counts.shape[1]
    weights, cumulative = np.empty(n_most), np.empty(n_most + 1)
    space = make_workspace(make_rows(n_most))
    theta, best, direction = np.empty(4), np.empty(4), np.empty(4)
    covariance = np.empty((4, 4))
    nothing, held = np.zeros(4, np.bool_), np.zeros(4, np.bool_)
    for p in range(counts.shape[0]):
        out[p] = math.nan
        if not math.isfinite(parameters[p].sum()):
            continue
        histogram, centre, _ = load(counts[p], weights, cumulative)
        middle = float(origin[p] + centre)
        theta[0], theta[1] = math.log(parameters[p, 0]), 1.0 / parameters[p, 1]
        theta[2], theta[3] = parameters[p, 2] - middle, 2.0 * math.log(parameters[p, 3])
        for target in range(N_TARGETS):
            place = min(target, 3)
            copy(theta, best)
            if target == _NOISE_E:
                best[3] = theta[3] - 2.0 * math.log(theta[1])
            top = maximise_others(histogram, best, target, nothing, space)
            if not math.isfinite(top) or not invert(space.information, nothing, covariance):
                continue
            for i in range(4):
                held[i] = i == place
            for side in range(2):
                sign = 2.0 * side - 1.0
                for i in range(4):
                    direction[i] = sign * covariance[i, place] / math.sqrt(covariance[place, place])
                out[p, target, side] = find_end(histogram, best, top, target, root, direction, held, space)
            if target == 2:
                out[p, target] += middle
