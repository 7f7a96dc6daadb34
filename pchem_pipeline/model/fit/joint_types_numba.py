"""What the loops of the joint fit hand to each other: the samples of one pixel, and an evaluation's answers.

A pixel seen at J exposures has ``theta = (log H_1 ... log H_J, 1/g, mu - centre, v)`` with ``v = log
sigma^2`` (density) or ``log sigma_R^2`` (exact cells). No two exposures share a sample, so the information
is an arrow: one block of (log H_j, 1/g, mu, v) for each sample, coupled through the last three alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.grown_types_numba import Law, Room, make_room
from pchem_pipeline.model.law.workspace_numba import Histogram, Workspace, load, make_rows, make_workspace

# columns of `Samples.facts`
N_BINS, FIRST, N_FRAMES, MEAN, VARIANCE, CENTRE, OCCUPIED = range(7)
N_FACTS = 7
#: Shared parameters: 1/g, mu - centre, v; their places after the last exposure, and in a sample's block.
N_SHARED = 3
N_BLOCK = 4


class Samples(NamedTuple):
    """The histograms of one pixel.

    Attributes:
        weights: counts of successive DN, shape (J, enough).
        cumulative: sums of the weights before each DN, shape (J, enough + 1).
        edges: room for the edges of the cells, shape (J, enough + 1).
        facts: bins in use, first DN, frames, mean and variance, all from the sample's centre; that centre
            less the centre of the pixel; occupied bins; shape (J, N_FACTS).
        dark: which samples hold no electrons, shape (J,).
    """

    weights: NDArray[np.float64]
    cumulative: NDArray[np.float64]
    edges: NDArray[np.float64]
    facts: NDArray[np.float64]
    dark: NDArray[np.bool_]


class Answers(NamedTuple):
    """What an evaluation leaves, one block of (log H, 1/g, mu, v) for each sample.

    Attributes:
        score: gradient of the log-likelihood, shape (J, 4).
        information: observed information, shape (J, 4, 4).
        damping: a matrix that is never indefinite and of the same size, shape (J, 4, 4): the complete-data
            information (density) or the sum of the squared scores (exact).
        total: E-step sums over all samples, as in :class:`.workspace_numba.Workspace`.
        electrons: mean electron number of each sample after the E-step, shape (J,).
    """

    score: NDArray[np.float64]
    information: NDArray[np.float64]
    damping: NDArray[np.float64]
    total: NDArray[np.float64]
    electrons: NDArray[np.float64]


class Bench(NamedTuple):
    """Scratch and the law of the joint fit.

    Attributes:
        space: of the density's evaluation.
        room: of the exact one.
        law: the PCD with its limits, cells integrated exactly.
        lobes: room for the one lobe of that law.
    """

    space: Workspace
    room: Room
    law: Law
    lobes: NDArray[np.float64]


@kernel
def make_answers(n_samples: int) -> Answers:
    """Return room for the answers of so many samples."""
    return Answers(
        np.zeros((n_samples, N_BLOCK)),
        np.zeros((n_samples, N_BLOCK, N_BLOCK)),
        np.zeros((n_samples, N_BLOCK, N_BLOCK)),
        np.zeros(6),
        np.zeros(n_samples),
    )


@kernel
def make_samples(n_samples: int, n_bins: int, dark: NDArray[np.bool_]) -> Samples:
    """Return room for the histograms of a pixel."""
    return Samples(
        np.zeros((n_samples, n_bins)),
        np.zeros((n_samples, n_bins + 1)),
        np.zeros((n_samples, n_bins + 1)),
        np.zeros((n_samples, N_FACTS)),
        dark,
    )


@kernel
def make_bench(n_bins: int, law: Law, lobes: NDArray[np.float64]) -> Bench:
    """Return scratch for histograms of at most so many bins."""
    return Bench(make_workspace(make_rows(n_bins)), make_room(n_bins), law, lobes)


@kernel
def load_samples(
    counts: NDArray[np.generic],
    places: NDArray[np.int64],
    origin: NDArray[np.int64],
    samples: Samples,
) -> int:
    """Fill the histograms of a pixel.

    Args:
        counts: histograms one after the other, shape (all bins,).
        places: where each begins in ``counts``, and the end, shape (J + 1,).
        origin: DN of each first bin, shape (J,).
        samples: out.

    Returns:
        The centre of the pixel, DN: that of its first sample.
    """
    middle = 0
    for j in range(origin.size):
        own = counts[places[j] : places[j + 1]]
        histogram, centre, occupied = load(own, samples.weights[j], samples.cumulative[j])
        if j == 0:
            middle = origin[0] + centre
        facts = samples.facts[j]
        facts[N_BINS], facts[FIRST], facts[N_FRAMES] = histogram.n_bins, histogram.first, histogram.n
        facts[MEAN], facts[VARIANCE] = histogram.mean, histogram.variance
        facts[CENTRE], facts[OCCUPIED] = float(origin[j] + centre - middle), occupied
    return middle


@kernel
def histogram_of(samples: Samples, j: int) -> Histogram:
    """Return one sample as the loops of a single fit take it."""
    facts = samples.facts[j]
    return Histogram(
        samples.weights[j],
        samples.cumulative[j],
        int(facts[N_BINS]),
        facts[FIRST],
        facts[N_FRAMES],
        facts[MEAN],
        facts[VARIANCE],
    )


@kernel
def copy_joint(source: Answers, target: Answers) -> None:
    """Copy all answers."""
    for j in range(source.score.shape[0]):
        target.electrons[j] = source.electrons[j]
        for row in range(N_BLOCK):
            target.score[j, row] = source.score[j, row]
            for column in range(N_BLOCK):
                target.information[j, row, column] = source.information[j, row, column]
                target.damping[j, row, column] = source.damping[j, row, column]
    for i in range(source.total.size):
        target.total[i] = source.total[i]
