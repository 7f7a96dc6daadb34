"""The loop over climbs with some parameters fixed: of profiles, and of the exposures of known pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.algebra_numba import invert_arrow
from pchem_pipeline.model.fit.climb_numba import CONVERGED, Goal, Limits, keep_inside
from pchem_pipeline.model.fit.tile_numba import Histograms, load_pixel, make_room
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Law, resolve
from pchem_pipeline.model.law.pixel_numba import Pixel, copy, make_scratch


@kernel
def climb_tile(
    given: Histograms,
    chosen: IntArray,
    law: Law,
    limits: Limits,
    evaluate: Any,
    climb: Any,
    amplitudes: FloatArray,
    fixed: BoolArray,
    tied: BoolArray,
    theta: FloatArray,
    loglik: FloatArray,
    covariance: FloatArray,
    curvature: FloatArray,
) -> None:
    """Climb to the maximum near each of m starts, with some parameters fixed.

    Args:
        given: histograms; codes left out by the tail guard do not count. Samples beyond the exposures of
            theta have the last of these.
        chosen: pixel of each start, shape (m,).
        law: of the samples.
        limits: bounds and limits.
        evaluate: the likelihood.
        climb: the climb on it.
        amplitudes: of the pixels' free satellites, e-, shape (m,); 0: none.
        fixed: parameters that stay, shape (m, J + N_SHARED).
        tied: where 1/g moves sigma with it, so that ``sigma g`` stays, shape (m,).
        theta: starts, mu in DN; out: the maxima; shape (m, J + N_SHARED).
        loglik: out, shape (m,); -inf where there is no maximum, or where what is fixed is not allowed.
        covariance: out, of (H_1 ... H_J, 1/g, mu, v, q), 0 for what stays and NaN where the maximum is not
            regular, shape (m, J + N_SHARED, J + N_SHARED).
        curvature: out, minus the second derivatives of the log-likelihood in H_1 and in (H_1, 1/g, mu, v, q),
            shape (m, N_BLOCK).
    """
    size = theta.shape[1]
    n, room = size - px.N_SHARED, make_room(given, law)
    scratch = make_scratch(n, room.bins.shape[2] - 1, limits.cells)
    here, start = scratch.small[px.HERE], scratch.small[px.OTHER]
    for row in range(chosen.size):
        pixel = load_pixel(given, chosen[row], room)
        if fixed[row, n + px.STEP] and fixed[row, n + px.LOG_VARIANCE]:
            pixel = Pixel(
                pixel.bins, pixel.facts, pixel.laws, pixel.peaks, pixel.mixtures, pixel.centre, px.KNOWN
            )
        if limits.cells:
            resolve(law, chosen[row], amplitudes[row], pixel)
        copy(theta[row], here)
        here[n + px.BIAS] -= pixel.centre
        copy(here, start)
        for i in range(size):
            scratch.flags[px.FIXED, i] = fixed[row, i]
        keep_inside(here, limits)
        allowed = here[n + px.STEP] > 0.0
        for i in range(size):
            allowed = allowed and (here[i] == start[i] or not fixed[row, i])
        loglik[row], regular = -math.inf, False
        if allowed:
            goal = Goal(np.bool_(False), -math.inf, -math.inf, math.inf, tied[row])
            outcome, height = climb(pixel, evaluate, limits, goal, here, here, scratch)
            for i in range(size):
                allowed = allowed and (here[i] == start[i] or tied[row] or not fixed[row, i])
            if allowed and outcome == CONVERGED:
                loglik[row] = height
                at, held = scratch.evaluations[px.AT], scratch.flags[px.HELD]
                regular = invert_arrow(at, here, held, covariance[row])
                for i in range(px.N_BLOCK):
                    curvature[row, i] = at[0, px.INFORMATION + i, 0] * math.exp(-here[0])
                curvature[row, 0] += at[0, px.SCORE, 0] * math.exp(-here[0])
                curvature[row, 0] *= math.exp(-here[0])
        copy(here, theta[row])
        theta[row, n + px.BIAS] += pixel.centre
        if not regular:
            for i in range(size):
                for j in range(size):
                    covariance[row, i, j] = math.nan
