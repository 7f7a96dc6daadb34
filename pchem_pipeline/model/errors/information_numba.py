"""Sums of the scores of single samples: sandwich errors and the calibration of chi-square."""

from __future__ import annotations

import math

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import LEAST_EXPONENT
from pchem_pipeline.model.arithmetic.significance import SMALLEST_EXPECTATION
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.density_scores_numba import N_MEANS, density_scores, posterior
from pchem_pipeline.model.law.pixel_numba import Pixel


@kernel
def fill_squared_scores(pixel: Pixel, theta: FloatArray, at: FloatArray) -> None:
    """Fill the sums of outer products of the samples' scores, the middle of the sandwich, of the density.

    Lower triangles, in the place of the damping matrix of an evaluation.
    """
    n = pixel.facts.shape[0]
    means, score = np.empty(N_MEANS), np.empty(4)
    step, sigma = theta[n + px.STEP], math.exp(0.5 * theta[n + px.LOG_VARIANCE])
    slope = np.empty(4)
    slope[1], slope[2], slope[3] = -1.0 / (step * step), 1.0, 0.5 * sigma
    for j in range(n):
        facts, first, n_bins = pixel.facts[j], pixel.facts[j].first, pixel.facts[j].n_bins
        at[j, px.DAMPING : px.SUMS] = 0.0
        dark = facts.dark
        exposure, bias = math.exp(theta[j]), theta[n + px.BIAS] - facts.centre
        slope[0] = exposure
        for i in range(n_bins):
            c = pixel.bins[j, px.WEIGHT, i]
            if c == 0.0:
                continue
            posterior(first + i, 0.0 if dark else exposure, step, bias, sigma, means)
            density_scores(means, exposure, step, sigma, score)
            for row in range(4):
                for column in range(row + 1):
                    product = score[row] * slope[row] * score[column] * slope[column]
                    at[j, px.DAMPING + row, column] += c * product


@kernel
def grouped_trace(
    first: IntArray,
    last: IntArray,
    frames: FloatArray,
    parameters: FloatArray,
    covariance: FloatArray,
    out: FloatArray,
) -> None:
    """Fill how many of the fitted parameters the groups of the chi-square test determine.

    The trace of the groups' Fisher information times the covariance of the estimates: 4 where grouping
    loses nothing, 0 where the groups say nothing. Groups are those of
    :func:`~pchem_pipeline.model.fit.search_numba.pearson`, from the first occupied DN to the last, (n,).

    The parameters (H, g, mu, sigma), (n, 4), are NaN where there are none, and so is ``out``; the covariance,
    (n, 4, 4), for what a bound holds.
    """
    means, score, held, rest = np.empty(N_MEANS), np.empty(4), np.empty(4), np.empty(4)
    for p in range(first.size):
        out[p] = math.nan
        if not math.isfinite(parameters[p].sum()):
            continue
        exposure, step, bias, sigma = (
            parameters[p, 0],
            1.0 / parameters[p, 1],
            parameters[p, 2],
            parameters[p, 3],
        )
        expected, remaining, trace = 0.0, frames[p], 0.0
        held[:] = 0.0
        rest[:] = 0.0
        for x in range(first[p], last[p] + 1):
            logged = posterior(float(x), exposure, step, bias, sigma, means)
            density_scores(means, exposure, step, sigma, score)
            mass = frames[p] * math.exp(max(logged, LEAST_EXPONENT))
            expected += mass
            for i in range(4):
                held[i] += mass * score[i]
            if expected >= SMALLEST_EXPECTATION and remaining - expected >= SMALLEST_EXPECTATION:
                trace += _form(held, covariance[p]) / expected
                remaining -= expected
                for i in range(4):
                    rest[i] -= held[i]
                    held[i] = 0.0
                expected = 0.0
        # the scores of all groups add up to 0, those outside the window included
        if remaining > 0.0:
            trace += _form(rest, covariance[p]) / remaining
        out[p] = trace


@kernel
def _form(vector: FloatArray, matrix: FloatArray) -> float:
    """Return ``vector' matrix vector`` over the entries of the matrix that are known."""
    found = 0.0
    for i in range(4):
        for j in range(4):
            if math.isfinite(matrix[i, j]):
                found += vector[i] * matrix[i, j] * vector[j]
    return found
