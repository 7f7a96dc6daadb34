"""Profiles of the likelihood: ends of intervals, where it has fallen by a drop, and a walk along the bias."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.algebra_numba import invert_arrow, to_natural
from pchem_pipeline.model.fit.climb_numba import CONVERGED, Goal, Limits, min_log_variance
from pchem_pipeline.model.fit.search_numba import Tools, climb_on
from pchem_pipeline.model.fit.tile_numba import Histograms, load_pixel, make_room, theta_of
from pchem_pipeline.model.law.cells_numba import Law, resolve
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    BIAS,
    DARK,
    FIXED,
    HELD,
    HERE,
    KEPT_STARTS,
    LOG_VARIANCE,
    N_SHARED,
    OTHER,
    SATELLITE,
    STEP,
    Pixel,
    copy,
    make_scratch,
)

FloatArray = NDArray[np.float64]

_OUTER = 30  # fixed values tried for an end
_CLOSE = 1e-4  # of the root of the drop
_FARTHEST = 60.0  # roots from the maximum


class Maxima(NamedTuple):
    """Fitted pixels.

    Attributes:
        parameters: (H_1 ... H_J, g, mu, sigma) at the maximum, shape (n, J + 3); NaN where there is none.
        satellites: amplitude (e-) and weight of the pixels' free satellites, shape (n, 2).
    """

    parameters: FloatArray
    satellites: FloatArray


@kernel(inline=True)
def _set(
    good: FloatArray, direction: FloatArray, distance: float, tied: bool, rounding: float, theta: FloatArray
) -> None:
    """Fill ``theta``: ``good`` and so many directions; tied: log (sigma g)^2 stands in the place of v."""
    noise, step = theta.size - N_SHARED + LOG_VARIANCE, theta.size - N_SHARED + STEP
    for i in range(theta.size):
        theta[i] = good[i] + distance * direction[i]
    if tied:
        own = math.log((math.exp(good[noise]) + rounding) / good[step] ** 2) + distance * direction[noise]
        theta[noise] = math.log(max(math.exp(own) * theta[step] ** 2 - rounding, 1e-12))


@kernel(inline=True)
def _of_profile(tied: bool) -> Goal:
    """Return the goal of a climb with a parameter fixed; tied: the read noise in e-."""
    return Goal(np.bool_(False), -math.inf, -math.inf, math.inf, tied)


@kernel
def _end(
    pixel: Pixel,
    tools: Tools,
    best: FloatArray,
    top: float,
    place: int,
    tied: bool,
    root: float,
    direction: FloatArray,
) -> bool:
    """Find where the profile of a parameter has fallen by ``root^2 / 2``; in the row `HERE` of the scratch.

    The signed root of twice the drop is nearly linear, so a secant on it ends after a few values.

    Args:
        pixel: its samples.
        tools: likelihood and climb; its scratch holds the parameters that stay.
        best: theta at the maximum.
        top: log-likelihood there.
        place: of the parameter in theta.
        tied: it is the read noise in e- instead.
        root: drop, as standard normal quantile.
        direction: change of all coordinates per standard error of the parameter, with the side's sign.

    Returns:
        Whether there is such an end.
    """
    limits, scratch = tools.limits, tools.scratch
    theta, good = scratch.small[HERE], scratch.small[OTHER]
    goal = _of_profile(tied)
    rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
    n = theta.size - N_SHARED
    copy(best, good)
    inside, below, outside, above = 0.0, 0.0, math.inf, math.inf
    distance = root
    for _ in range(_OUTER):
        _set(good, direction, distance - inside, tied, rounding, theta)
        wanted = theta[place]
        drop = math.inf
        low = min_log_variance(theta[n + STEP], limits.cells) if place == n + LOG_VARIANCE else limits.bound
        if theta[n + STEP] > 0.0 and (place == n + STEP or place == n + 1 or wanted >= low):
            outcome, loglik, _ = climb_on(pixel, tools, goal, theta, theta)
            if outcome == CONVERGED and (tied or theta[place] == wanted):
                drop = math.sqrt(max(0.0, 2.0 * (top - loglik)))
        if abs(drop - root) < _CLOSE * root:
            return True
        if drop < root:
            inside, below = distance, drop
            copy(theta, good)
        else:
            outside, above = distance, drop
        if outside == math.inf:
            distance = min(3.0 * distance, distance * root / max(below, 0.1 * root) * 1.02)
            if distance > _FARTHEST * root:
                return False
        elif above == math.inf:
            distance = 0.5 * (inside + outside)
        else:
            share = (root - below) / (above - below)
            distance = inside + min(0.95, max(0.05, share)) * (outside - inside)
        if outside - inside < 1e-7 * root:
            return above < math.inf
    return False


@kernel(inline=True)
def _tools(given: Histograms, law: Law, limits: Limits, evaluate: Any, climb: Any) -> tuple[Pixel, Tools]:
    """Return room for a pixel, and what climbs on its likelihood."""
    room = make_room(given, law)
    scratch = make_scratch(given.dark.size, room.bins.shape[2] - 1, limits.cells)
    return room, Tools(limits, evaluate, climb, np.empty((0, 0)), scratch)


@kernel
def _at_maximum(
    given: Histograms, law: Law, index: int, room: Pixel, tools: Tools, fits: Maxima, covariance: FloatArray
) -> tuple[Pixel, bool, float]:
    """Climb to the maximum near the fit of a pixel; fill `KEPT_STARTS` of the scratch and the covariance.

    Returns:
        The pixel, whether there is a regular maximum, and its log-likelihood.
    """
    pixel, best = load_pixel(given, index, room), tools.scratch.small[KEPT_STARTS]
    if not theta_of(fits.parameters[index], pixel, tools.limits, best):
        return pixel, False, -math.inf
    if tools.limits.cells:
        resolve(law, index, fits.satellites[index, 0], pixel)
    weight = fits.satellites[index, 1]
    n, fixed = pixel.facts.shape[0], tools.scratch.flags[FIXED]
    rounding = QUANTISATION_VARIANCE if tools.limits.cells else 0.0
    best[n + LOG_VARIANCE] = math.log(max(math.exp(best[n + LOG_VARIANCE]) - rounding, 1e-12))
    best[n + SATELLITE] = weight
    for i in range(best.size):
        fixed[i] = i < n and pixel.facts[min(i, n - 1), DARK] > 0.0
    fixed[n + SATELLITE] = not weight > 0.0
    outcome, top, _ = climb_on(pixel, tools, _of_profile(np.bool_(False)), best, best)
    at, held = tools.scratch.evaluations[AT], tools.scratch.flags[HELD]
    return pixel, outcome == CONVERGED and invert_arrow(at, best, held, covariance), top


@kernel(inline=True)
def _direction(
    target: int, best: FloatArray, covariance: FloatArray, rounding: float, direction: FloatArray
) -> None:
    """Fill the change of all coordinates per standard error of a parameter; the last is ``sigma g``."""
    size = best.size
    n = size - N_SHARED
    tied, place = target == n + 3, min(target, n + LOG_VARIANCE)
    slope = 1.0 / (1.0 + rounding * math.exp(-best[n + LOG_VARIANCE]))
    for i in range(size):
        direction[i] = covariance[i, place]
        if tied:
            direction[i] = slope * direction[i] - 2.0 / best[n + STEP] * covariance[i, n + STEP]
    if tied:
        direction[place] = slope * direction[place] - 2.0 / best[n + STEP] * direction[n + STEP]
    sd = math.sqrt(direction[place])
    for i in range(size):
        direction[i] /= sd
        if i < n:
            direction[i] *= math.exp(-best[i])  # of log H


@kernel(inline=True)
def _value_at(end: FloatArray, target: int, centre: int, rounding: float) -> float:
    """Return a parameter at an end of its interval, in its own unit; 1/g for the gain."""
    n = end.size - N_SHARED
    place = min(target, n + LOG_VARIANCE)
    value: float = end[place]
    if place < n:
        value = math.exp(value)
    elif place == n + BIAS:
        value += centre
    elif place == n + LOG_VARIANCE:
        value = math.sqrt(math.exp(value) + rounding)
        value = value / end[n + STEP] if target == n + 3 else value
    return value


@kernel
def profile_tile(
    given: Histograms,
    law: Law,
    limits: Limits,
    evaluate: Any,
    climb: Any,
    fits: Maxima,
    root: float,
    out: FloatArray,
) -> None:
    """Fill the ends of the intervals of every pixel.

    Args:
        given: histograms; codes left out by the tail guard do not count.
        law: of the samples.
        limits: bounds and limits.
        evaluate: the likelihood.
        climb: the climb on it.
        fits: of the pixels.
        root: drop of the log-likelihood, as standard normal quantile.
        out: out, lower and upper ends of (H_1 ... H_J, g, mu, sigma, sigma g), shape (n, J + 4, 2); comes as
            NaN, which stays where the likelihood does not fall far enough.
    """
    n = given.dark.size
    size = n + N_SHARED
    room, tools = _tools(given, law, limits, evaluate, climb)
    scratch = tools.scratch
    best, direction, covariance = scratch.small[KEPT_STARTS], np.empty(size), np.empty((size, size))
    rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
    for index in range(given.counts.shape[0]):
        pixel, found, top = _at_maximum(given, law, index, room, tools, fits, covariance)
        held = scratch.flags[HELD].copy()
        for target in range(size if found else 0):
            tied, place = target == n + 3, min(target, n + LOG_VARIANCE)
            if held[place]:
                continue
            _direction(target, best, covariance, rounding, direction)
            scratch.flags[FIXED, place] = True
            for side in range(2):
                for i in range(size):
                    direction[i] = -direction[i]
                if not _end(pixel, tools, best, top, place, tied, root, direction):
                    continue
                value = _value_at(scratch.small[HERE], target, pixel.centre, rounding)
                if place == n + STEP:
                    out[index, target, 1 - side] = 1.0 / value  # a larger step is a smaller gain
                else:
                    out[index, target, side] = value
            scratch.flags[FIXED, place] = False


@kernel
def walk_tile(
    given: Histograms,
    law: Law,
    limits: Limits,
    evaluate: Any,
    climb: Any,
    fits: Maxima,
    spacing: float,
    reach: FloatArray,
    deepest: float,
    found: FloatArray,
    covariances: FloatArray,
    heights: FloatArray,
) -> None:
    """Walk along the profile of the bias: fill the best other parameters at biases on both sides.

    Args:
        given: histograms; codes left out by the tail guard do not count.
        law: of the samples.
        limits: bounds and limits.
        evaluate: the likelihood.
        climb: the climb on it.
        fits: of the pixels.
        spacing: of the biases, standard errors.
        reach: distance that is walked in any case, e-, shape (n,).
        deepest: fall of the log-likelihood at which the walk ends beyond there, nats.
        found: out, parameters, those of the maximum in the middle, shape (n, 2 m + 1, J + 3).
        covariances: out, of all but the bias at each, NaN for what stays, shape (n, 2 m + 1, J + 3, J + 3).
        heights: out, log-likelihood above that of the maximum, shape (n, 2 m + 1); comes as -inf.
    """
    n = given.dark.size
    size, most = n + N_SHARED, heights.shape[1] // 2
    room, tools = _tools(given, law, limits, evaluate, climb)
    scratch = tools.scratch
    best, direction, covariance = scratch.small[KEPT_STARTS], np.empty(size), np.empty((size, size))
    theta, absolute, fixed = scratch.small[HERE], np.empty(size), scratch.flags[FIXED]
    rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
    goal = _of_profile(np.bool_(False))
    for index in range(given.counts.shape[0]):
        pixel, regular, top = _at_maximum(given, law, index, room, tools, fits, covariance)
        if not regular:
            continue
        _direction(n + BIAS, best, covariance, rounding, direction)
        fixed[n + BIAS] = True
        for side in range(-1, 2):
            copy(best, theta)
            for i in range(1 if side == 0 else most):
                for j in range(size):
                    theta[j] += side * spacing * direction[j]
                outcome, loglik, _ = climb_on(pixel, tools, goal, theta, theta)
                full, place = np.empty((size, size)), most + side * (i + 1)
                if outcome != CONVERGED or not invert_arrow(
                    scratch.evaluations[AT], theta, scratch.flags[HELD], full
                ):
                    break
                copy(theta, absolute)
                absolute[n + BIAS] += pixel.centre
                to_natural(
                    absolute, fixed[:n], scratch.flags[HELD], rounding, full,
                    found[index, place], covariances[index, place],
                )  # fmt: skip
                heights[index, place] = loglik - top
                walked = abs(theta[n + BIAS] - best[n + BIAS]) / best[n + STEP]
                if walked > reach[index] and loglik < top - deepest:
                    break
        fixed[n + BIAS] = False
