"""The joint log-likelihood of the samples of one pixel, and the algebra of its arrow of information.

Each sample is evaluated by the loops of the single fit, with the density of the PCD
(:mod:`.estep_numba`) or its cells integrated exactly (:mod:`.grown_cells_numba`). A sample without electrons
is one Gaussian.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.errors.fisher_numba import back_substitute, cholesky
from pchem_pipeline.model.fit.grown_numba import make_cells
from pchem_pipeline.model.fit.joint_types_numba import (
    CENTRE,
    FIRST,
    MEAN,
    N_BINS,
    N_BLOCK,
    N_FRAMES,
    N_SHARED,
    VARIANCE,
    Answers,
    Bench,
    Samples,
    histogram_of,
)
from pchem_pipeline.model.law import grown_cells_numba
from pchem_pipeline.model.law.estep_numba import LOG_2PI, evaluate
from pchem_pipeline.model.law.grown_types_numba import N_THETA
from pchem_pipeline.model.law.workspace_numba import SUM_E, SUM_EE, SUM_K, SUM_KE, SUM_KK, Workspace

NO_ELECTRONS = -60.0  # log H of a sample without electrons, where the cells are integrated
_SMALLEST_SHARE = 1e-10  # of the complete-data information: less is lost in rounding


@kernel
def _gaussian(n: float, mean: float, variance: float, theta: NDArray[np.float64], space: Workspace) -> float:
    """Evaluate a sample without electrons, of so many frames; ``mean`` is counted as ``theta[2]`` is."""
    inverse = math.exp(-theta[3])
    total, score, information = space.total, space.score, space.information
    deviation = mean - theta[2]
    total[SUM_K] = total[SUM_KK] = total[SUM_KE] = 0.0
    total[SUM_E] = n * deviation
    total[SUM_EE] = n * (variance + deviation * deviation)
    for row in range(N_BLOCK):
        score[row] = 0.0
        for column in range(N_BLOCK):
            information[row, column] = 0.0
    score[2] = total[SUM_E] * inverse
    score[3] = 0.5 * (total[SUM_EE] * inverse - n)
    information[2, 2] = n * inverse
    information[2, 3] = information[3, 2] = total[SUM_E] * inverse
    information[3, 3] = 0.5 * total[SUM_EE] * inverse
    loglik: float = -0.5 * (n * (LOG_2PI + theta[3]) + total[SUM_EE] * inverse)
    return loglik


@kernel
def _density(samples: Samples, j: int, own: NDArray[np.float64], bench: Bench, out: Answers) -> float:
    """Evaluate one sample with the density of the PCD."""
    facts, space = samples.facts[j], bench.space
    n = facts[N_FRAMES]
    if samples.dark[j]:
        loglik: float = _gaussian(n, facts[MEAN], facts[VARIANCE], own, space)
    else:
        loglik = evaluate(histogram_of(samples, j), own, space, 0.0)
    total, inverse = space.total, math.exp(-own[3])
    block = out.damping[j]
    for row in range(N_BLOCK):
        out.score[j, row] = space.score[row]
        for column in range(N_BLOCK):
            out.information[j, row, column] = space.information[row, column]
            block[row, column] = 0.0
    # complete-data information, of parameters whose electron numbers are known
    block[0, 0] = 0.0 if samples.dark[j] else n * math.exp(own[0])
    block[1, 1] = total[SUM_KK] * inverse
    block[1, 2] = block[2, 1] = total[SUM_K] * inverse
    block[2, 2] = n * inverse
    block[1, 3] = block[3, 1] = total[SUM_KE] * inverse
    block[2, 3] = block[3, 2] = total[SUM_E] * inverse
    block[3, 3] = 0.5 * total[SUM_EE] * inverse
    out.electrons[j] = total[SUM_K] / n
    for i in range(1, 6):
        out.total[i] += total[i]
    return loglik


@kernel
def _exact(
    samples: Samples, j: int, middle: int, own: NDArray[np.float64], bench: Bench, out: Answers
) -> float:
    """Evaluate one sample with its cells integrated."""
    facts, room = samples.facts[j], bench.room
    centre = middle + int(facts[CENTRE])
    space = samples.weights[j], samples.edges[j], bench.lobes
    cells = make_cells(bench.law, 0, 0.0, centre + int(facts[FIRST]), centre, int(facts[N_BINS]), space)
    theta = np.empty(N_THETA)
    for i in range(N_BLOCK):
        theta[i] = own[i]
    theta[4] = 0.0
    if samples.dark[j]:
        theta[0] = NO_ELECTRONS
    loglik: float = grown_cells_numba.evaluate(theta, cells, bench.law, room)
    for row in range(N_BLOCK):
        out.score[j, row] = room.score[row]
        for column in range(N_BLOCK):
            out.information[j, row, column] = room.information[row, column]
            out.damping[j, row, column] = room.empirical[row, column]
    out.electrons[j] = 0.0
    return loglik


@kernel
def evaluate_joint(
    samples: Samples,
    middle: int,
    theta: NDArray[np.float64],
    exact: bool,
    bench: Bench,
    out: Answers,
) -> float:
    """Evaluate the samples of a pixel.

    Args:
        samples: the histograms.
        middle: centre of the pixel, DN.
        theta: parameters, shape (J + 3,).
        exact: integrate the cells; else take the density at whole DN.
        bench: scratch.
        out: out, the answers; the E-step sums only with the density.

    Returns:
        The log-likelihood, nats.
    """
    n_samples = samples.facts.shape[0]
    own = np.empty(N_BLOCK)
    for i in range(6):
        out.total[i] = 0.0
    loglik = 0.0
    for j in range(n_samples):
        own[0] = theta[j]
        own[1] = theta[n_samples]
        own[2] = theta[n_samples + 1] - samples.facts[j, CENTRE]
        own[3] = theta[n_samples + 2]
        if exact:
            loglik += _exact(samples, j, middle, own, bench, out)
        else:
            loglik += _density(samples, j, own, bench, out)
        if samples.dark[j]:
            out.score[j, 0] = 0.0
            for i in range(N_BLOCK):
                out.information[j, 0, i] = out.information[j, i, 0] = 0.0
                out.damping[j, 0, i] = out.damping[j, i, 0] = 0.0
    return loglik


@kernel
def solve_arrow(
    answers: Answers,
    share: float,
    held: NDArray[np.bool_],
    step: NDArray[np.float64],
    lower: NDArray[np.float64],
) -> float:
    """Solve for the step with the information and a share of the damping matrix, by Schur complements.

    Args:
        answers: of an evaluation.
        share: of the damping matrix.
        held: parameters that stay, shape (J + 3,).
        step: out, shape (J + 3,).
        lower: out, Cholesky factor of the Schur complement of the shared parameters in rows and columns 1 to
            3, shape (4, 4).

    Returns:
        The squared decrement, NaN unless the matrix is positive definite.
    """
    n_samples = answers.score.shape[0]
    schur = np.zeros((N_BLOCK, N_BLOCK))
    right = np.zeros(N_BLOCK)
    squared = 0.0
    for j in range(n_samples):
        information, damping = answers.information[j], answers.damping[j]
        for row in range(1, N_BLOCK):
            right[row] += answers.score[j, row]
            for column in range(1, N_BLOCK):
                schur[row, column] += information[row, column] + share * damping[row, column]
        if held[j]:
            continue
        own = information[0, 0] + share * damping[0, 0]
        if not own > _SMALLEST_SHARE * damping[0, 0]:
            return math.nan
        squared += answers.score[j, 0] * answers.score[j, 0] / own
        for row in range(1, N_BLOCK):
            factor = (information[row, 0] + share * damping[row, 0]) / own
            right[row] -= factor * answers.score[j, 0]
            for column in range(1, N_BLOCK):
                schur[row, column] -= factor * (information[column, 0] + share * damping[column, 0])
    fixed = np.ones(N_BLOCK, np.bool_)
    for i in range(N_SHARED):
        fixed[i + 1] = held[n_samples + i]
        if fixed[i + 1]:
            right[i + 1] = 0.0
    right[0] = 0.0
    if not cholesky(schur, fixed, lower):
        return math.nan
    squared += float(back_substitute(lower, right))
    for i in range(N_SHARED):
        step[n_samples + i] = 0.0 if fixed[i + 1] else right[i + 1]
    for j in range(n_samples):
        information, damping = answers.information[j], answers.damping[j]
        step[j] = 0.0
        if not held[j]:
            value = answers.score[j, 0]
            for row in range(1, N_BLOCK):
                value -= (information[row, 0] + share * damping[row, 0]) * step[n_samples + row - 1]
            step[j] = value / (information[0, 0] + share * damping[0, 0])
    return squared


@kernel
def joint_covariance(
    answers: Answers,
    theta: NDArray[np.float64],
    dark: NDArray[np.bool_],
    held_noise: bool,
    covariance: NDArray[np.float64],
) -> bool:
    """Fill the inverse of the observed information of (H_1 ... H_J, 1/g, mu, v).

    In H itself, ``-d2 L / dH2 = (I + s) / H^2`` with information I and score s in log H: it stays finite
    where the exposure is at its lower bound. Samples without electrons get zeros.

    Args:
        answers: of an evaluation at the maximum.
        theta: there.
        dark: which samples hold no electrons.
        held_noise: the noise is at its lower bound: NaN in its row and column.
        covariance: out, shape (J + 3, J + 3).

    Returns:
        Whether the information is positive definite.
    """
    n_samples = dark.size
    factors = np.zeros((n_samples, N_BLOCK))
    own = np.zeros(n_samples)
    schur = np.zeros((N_BLOCK, N_BLOCK))
    covariance[:, :] = math.nan
    for j in range(n_samples):
        information = answers.information[j]
        for row in range(1, N_BLOCK):
            for column in range(1, N_BLOCK):
                schur[row, column] += information[row, column]
        if dark[j]:
            continue
        exposure = math.exp(theta[j])
        own[j] = (information[0, 0] + answers.score[j, 0]) / (exposure * exposure)
        if not own[j] > 0.0:
            return False
        for row in range(1, N_BLOCK):
            factors[j, row] = information[row, 0] / exposure / own[j]
        for row in range(1, N_BLOCK):
            for column in range(1, N_BLOCK):
                schur[row, column] -= factors[j, row] * factors[j, column] * own[j]
    fixed = np.zeros(N_BLOCK, np.bool_)
    fixed[0], fixed[3] = True, held_noise
    lower = np.zeros((N_BLOCK, N_BLOCK))
    if not cholesky(schur, fixed, lower):
        return False
    shared = np.zeros((N_BLOCK, N_BLOCK))
    for i in range(1, N_BLOCK):
        if not fixed[i]:
            shared[i, i] = 1.0
            back_substitute(lower, shared[i])
    _spread(factors, own, shared, dark, covariance)
    if held_noise:
        covariance[n_samples + 2, :] = math.nan
        covariance[:, n_samples + 2] = math.nan
    return True


@kernel
def _spread(
    factors: NDArray[np.float64],
    own: NDArray[np.float64],
    shared: NDArray[np.float64],
    dark: NDArray[np.bool_],
    covariance: NDArray[np.float64],
) -> None:
    """Fill the covariance of all parameters from that of the shared ones."""
    n_samples = dark.size
    product = np.zeros(N_BLOCK)
    for row in range(N_SHARED):
        for column in range(N_SHARED):
            covariance[n_samples + row, n_samples + column] = shared[row + 1, column + 1]
    for j in range(n_samples):
        for row in range(1, N_BLOCK):
            product[row] = 0.0
            for column in range(1, N_BLOCK):
                product[row] += shared[row, column] * factors[j, column]
            covariance[j, n_samples + row - 1] = covariance[n_samples + row - 1, j] = -product[row]
        for other in range(n_samples):
            value = 0.0
            for row in range(1, N_BLOCK):
                value += product[row] * factors[other, row]
            covariance[j, other] = value
        if not dark[j]:
            covariance[j, j] += 1.0 / own[j]
