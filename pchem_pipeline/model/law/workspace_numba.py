"""What the loops of the fit hand to each other: one pixel's histogram, and room to work in."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.simd_numba import LANES

# places in `Workspace.total`, the sums that an evaluation leaves besides score and information
LOGLIK, SUM_K, SUM_KK, SUM_KE, SUM_E, SUM_EE = range(6)
N_TOTAL = 6
N_ROWS = 9
N_SMALL = 10
CAPACITY = 256  # columns of the table of an evaluation; a longer histogram goes through in pieces
MAX_COMPONENTS = 201  # of which a value may be a mixture
_MIN_COLUMNS = 256  # the frequencies of the starting points, a value's components, a table's columns


class Histogram(NamedTuple):
    """One pixel's histogram without its empty ends, values counted from a centre near its mean.

    Attributes:
        weights: counts of successive DN, at least ``n_bins`` long.
        cumulative: ``cumulative[i]`` is the sum of the first i weights.
        n_bins: number of DN in use.
        first: first DN minus the centre.
        n: number of frames.
        mean: mean minus the centre, DN.
        variance: variance, DN^2.
    """

    weights: NDArray[np.float64]
    cumulative: NDArray[np.float64]
    n_bins: int
    first: float
    n: float
    mean: float
    variance: float


class Workspace(NamedTuple):
    """Scratch of an evaluation of the likelihood, and its answers.

    Attributes:
        rows: scratch, shape (N_ROWS, enough).
        table: scratch, a column for each DN.
        total: log-likelihood and the sums over frames of E[k], E[k^2], E[k e], E[e], E[e^2] with
            ``e = x - mu - k/g``; the names above are their places.
        score: gradient of the log-likelihood in theta, shape (4,).
        information: observed information in theta, shape (4, 4).
        small: scratch of a step, shape (N_SMALL, 4).
        held: scratch of a step, the parameters that a bound holds, shape (4,).
    """

    rows: NDArray[np.float64]
    table: NDArray[np.float64]
    total: NDArray[np.float64]
    score: NDArray[np.float64]
    information: NDArray[np.float64]
    small: NDArray[np.float64]
    held: NDArray[np.bool_]


@kernel
def make_rows(n_bins: int) -> NDArray[np.float64]:
    """Return scratch rows for histograms of at most so many bins."""
    return np.empty((N_ROWS, n_bins + _MIN_COLUMNS))


@kernel
def make_workspace(rows: NDArray[np.float64]) -> Workspace:
    """Return a workspace with these rows."""
    table = np.empty((MAX_COMPONENTS + 5, CAPACITY + LANES))
    small, held = np.empty((N_SMALL, 4)), np.empty(4, np.bool_)
    return Workspace(rows, table, np.empty(N_TOTAL), np.empty(4), np.empty((4, 4)), small, held)


@kernel
def share_workspace(space: Workspace) -> Workspace:
    """Return a workspace of the same scratch, which keeps nothing between calls, with its own answers."""
    total, score, information = np.empty(N_TOTAL), np.empty(4), np.empty((4, 4))
    return Workspace(space.rows, space.table, total, score, information, space.small, space.held)


@kernel
def copy(source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    """Copy a vector; a plain loop, since slice assignment compiles slowly."""
    for i in range(source.size):
        target[i] = source[i]


@kernel
def copy_answers(source: Workspace, target: Workspace) -> None:
    """Copy totals, score and information."""
    copy(source.total, target.total)
    copy(source.score, target.score)
    for i in range(4):
        copy(source.information[i], target.information[i])


@kernel
def load(
    counts: NDArray[np.generic], weights: NDArray[np.float64], cumulative: NDArray[np.float64]
) -> tuple[Histogram, int, int]:
    """Copy a histogram without its empty ends and sum it up.

    Returns:
        The histogram, its centre (bins after bin 0) and the number of occupied bins.
    """
    low, high = 0, counts.size
    while low < high and counts[low] == 0:
        low += 1
    while high > low and counts[high - 1] == 0:
        high -= 1
    n_bins = high - low
    cumulative[0] = 0.0
    occupied = 0
    moment = 0.0
    for i in range(n_bins):
        c = float(counts[low + i])
        weights[i] = c
        cumulative[i + 1] = cumulative[i] + c
        moment += c * i
        if c > 0.0:
            occupied += 1
    n = cumulative[n_bins]
    if n == 0.0:
        return Histogram(weights, cumulative, 0, 0.0, 0.0, 0.0, 0.0), 0, 0
    mean = moment / n
    square = 0.0
    for i in range(n_bins):
        square += weights[i] * (i - mean) ** 2
    middle = math.floor(mean)
    histogram = Histogram(weights, cumulative, n_bins, -float(middle), n, mean - middle, square / n)
    return histogram, low + middle, occupied
