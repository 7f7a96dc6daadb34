"""The loop of the joint fit over the pixels of a tile."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.joint_climb_numba import floor_of
from pchem_pipeline.model.fit.joint_likelihood_numba import joint_covariance
from pchem_pipeline.model.fit.joint_search_numba import EXACT, FIT_NOT_CONVERGED, fit_joint_pixel
from pchem_pipeline.model.fit.joint_types_numba import (
    CENTRE,
    FIRST,
    MEAN,
    N_BINS,
    N_FRAMES,
    OCCUPIED,
    VARIANCE,
    Answers,
    Samples,
    load_samples,
    make_answers,
    make_bench,
    make_samples,
)
from pchem_pipeline.model.fit.polish_numba import MAX_STEP, MIN_LOG_EXPOSURE
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.grown_types_numba import Law

# columns of `words`
STATUS, EVALUATIONS, FREEDOM, LOWEST_DN, HIGHEST_DN = range(5)
N_WORDS = 5

NO_DATA, TOO_FEW_BINS = int(FitStatus.NO_DATA), int(FitStatus.TOO_FEW_BINS)
EXPOSURE_AT_BOUND = int(FitStatus.EXPOSURE_AT_BOUND)

_ROUNDING = 1.0 / 12.0


@kernel
def _write(
    samples: Samples,
    middle: int,
    theta: NDArray[np.float64],
    answers: Answers,
    bound: float,
    exact: bool,
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> int:
    """Fill (H_1 ... H_J, g, mu, sigma) and their covariance; return further bits of the status."""
    n_samples = samples.dark.size
    n = n_samples
    slope = np.empty(theta.size)
    variance = math.exp(theta[n + 2])
    at_bound = True
    for j in range(n):
        parameters[j], slope[j] = (0.0, 0.0) if samples.dark[j] else (math.exp(theta[j]), 1.0)
        at_bound = at_bound and (samples.dark[j] or theta[j] <= bound + 1e-9)
    parameters[n] = 1.0 / theta[n]
    parameters[n + 1] = middle + theta[n + 1]
    parameters[n + 2] = math.sqrt(variance + _ROUNDING) if exact else math.sqrt(variance)
    slope[n] = -parameters[n] * parameters[n]
    slope[n + 1] = 1.0
    slope[n + 2] = 0.5 * variance / parameters[n + 2]
    held_noise = theta[n + 2] <= floor_of(theta[n], exact) + 1e-9
    regular = joint_covariance(answers, theta, samples.dark, held_noise, covariance)
    for row in range(theta.size):
        for column in range(theta.size):
            covariance[row, column] *= slope[row] * slope[column]
    status = 0 if regular else FIT_NOT_CONVERGED
    return status | EXPOSURE_AT_BOUND if at_bound else status


@kernel
def _describe(
    samples: Samples, middle: int, moments: NDArray[np.float64], words: NDArray[np.int64]
) -> tuple[float, int, float]:
    """Fill moments and extreme codes; return frames of the smallest sample, occupied bins, widest range."""
    least, occupied, span = math.inf, 0, 0.0
    lowest, highest = 2**62, -(2**62)
    for j in range(samples.dark.size):
        facts = samples.facts[j]
        least = min(least, facts[N_FRAMES])
        if facts[N_FRAMES] > 0.0:
            moments[j, 0] = middle + facts[CENTRE] + facts[MEAN]
            moments[j, 1] = facts[VARIANCE]
            first = middle + int(facts[CENTRE] + facts[FIRST])
            lowest, highest = min(lowest, first), max(highest, first + int(facts[N_BINS]) - 1)
            span = max(span, facts[N_BINS])
            if not samples.dark[j]:
                occupied = max(occupied, int(facts[OCCUPIED]))
    words[LOWEST_DN], words[HIGHEST_DN] = lowest, highest
    return least, occupied, span


@kernel
def fit_joint_tile(
    counts: NDArray[np.generic],
    places: NDArray[np.int64],
    origin: NDArray[np.int64],
    dark: NDArray[np.bool_],
    basis: NDArray[np.float64],
    limits: NDArray[np.float64],
    law: Law,
    lobes: NDArray[np.float64],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
    moments: NDArray[np.float64],
    out: NDArray[np.float64],
    words: NDArray[np.int64],
) -> None:
    """Fit every row of ``counts``; pixels do not influence each other.

    Args:
        counts: histograms of the samples of each pixel, one after the other, shape (n, all bins).
        places: where each sample begins among the bins, and the end, shape (J + 1,).
        origin: DN of the first bin of each sample, shape (n, J).
        dark: which samples hold no electrons, shape (J,).
        basis: of the regression on the characteristic function.
        limits: bounds and limits, shape (N_LIMITS,).
        law: the PCD with its limits, for the exact likelihood.
        lobes: room for its one lobe.
        parameters: out, (H_1 ... H_J, g, mu, sigma), shape (n, J + 3); comes as NaN.
        covariance: out, shape (n, J + 3, J + 3); comes as NaN.
        moments: out, mean (DN) and variance (DN^2) of each sample, shape (n, J, 2); comes as NaN.
        out: out, shape (n, N_OUT); comes as NaN.
        words: out, shape (n, N_WORDS); comes as 0.
    """
    n_samples = dark.size
    most = 0
    for j in range(n_samples):
        most = max(most, places[j + 1] - places[j])
    samples = make_samples(n_samples, most, dark)
    bench, answers = make_bench(most, law, lobes), make_answers(n_samples)
    theta = np.empty(n_samples + 3)
    own_limits = limits.copy()
    for pixel in range(counts.shape[0]):
        middle = load_samples(counts[pixel], places, origin[pixel], samples)
        least, occupied, span = _describe(samples, middle, moments[pixel], words[pixel])
        if least == 0.0 or occupied < 3:
            words[pixel, STATUS] = NO_DATA if least == 0.0 else TOO_FEW_BINS
            continue
        own_limits[MAX_STEP] = 4.0 * span + 10.0
        status, words[pixel, EVALUATIONS], words[pixel, FREEDOM] = fit_joint_pixel(
            samples, middle, basis, own_limits, bench, answers, theta, out[pixel]
        )
        if theta[n_samples] > 0.0:
            status |= _write(
                samples,
                middle,
                theta,
                answers,
                limits[MIN_LOG_EXPOSURE],
                limits[EXACT] > 0.0,
                parameters[pixel],
                covariance[pixel],
            )
        words[pixel, STATUS] = status
