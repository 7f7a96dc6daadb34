"""What the loops of the fit hand to each other: the histograms of one pixel, room to work in, an evaluation.

A pixel seen at J exposures has ``theta = (log H_1 ... log H_J, 1/g, mu - centre, v, q)`` with ``v = log
sigma^2`` where the density at whole DN is taken and ``log sigma_R^2``, the analog part, where cells are
integrated; q is the weight of free satellite peaks. No two exposures share a sample, so the information is an
arrow: one block of (log H_j, 1/g, mu, v, q) for each sample, coupled through the last four alone.

An evaluation is one array of shape (J, N_ROWS, N_BLOCK): see the names of its rows below.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.simd_numba import SIMD_WIDTH

#: Shared parameters 1/g, mu - centre, v, q: their number, and their places after the last exposure.
N_SHARED = 4
STEP, BIAS, LOG_VARIANCE, SATELLITE = range(N_SHARED)
#: A sample's own parameters: log H, and the shared ones.
N_BLOCK = N_SHARED + 1

# rows of an evaluation: gradient of the log-likelihood; observed information; a matrix of the same size that
# is never indefinite (complete-data information of the density, sum of the squared scores of the cells); and
# with the density the sums over frames of E[k], E[k^2], E[k e], E[e], E[e^2], e = x - mu - k/g
SCORE, INFORMATION, DAMPING, SUMS = 0, 1, 1 + N_BLOCK, 1 + 2 * N_BLOCK
N_ROWS = 2 + 2 * N_BLOCK
SUM_K, SUM_KK, SUM_KE, SUM_E, SUM_EE = range(5)

# what is asked of an evaluation: log-likelihood alone; its derivatives and sums, too; and the counts expected
LOGLIK_ALONE, DERIVATIVES, EXPECTATIONS = range(3)

# rows of `Pixel.bins`
WEIGHT, CUMULATIVE, EXPECTED, EDGE, KEPT = range(5)
N_BIN_ROWS = 5

#: What is known of a sample's histogram, and of its cells under the law.
FACTS = np.dtype(
    [
        ("dark", "?"),  # it holds no electrons
        ("n_bins", "i8"),  # DN in use
        ("first", "f8"),  # first DN less the centre
        ("n_frames", "f8"),
        ("mean", "f8"),  # less the centre, DN
        ("variance", "f8"),  # DN^2
        ("centre", "f8"),  # DN near the mean that the others are counted from, less that of the pixel
        ("occupied", "i8"),  # DN with samples
        ("conditional", "?"),  # codes are set aside
        ("bottom", "i8"),  # last edge at minus infinity, -1 without one
        ("top", "i8"),  # first edge at infinity, n_bins + 1 without one
        ("margin", "f8"),  # largest distance of a finite edge from its place half a DN below its code, DN
        ("n_peaks", "i8"),  # levels of the noise
    ],
    align=True,
)
#: The numbers of a law, see :class:`~pchem_pipeline.model.law.sample_law.SampleLaw`.
LAW = np.dtype(
    [
        ("count_law", "i8"),
        ("dispersion", "f8"),
        ("curvature", "f8"),
        ("per_electron", "f8"),  # variance, e-^2
        ("per_electron2", "f8"),
        ("clip_low", "f8"),
        ("clip_high", "f8"),
        ("outlier_share", "f8"),
        ("outlier_mass", "f8"),  # in each code
        ("edge_first", "i8"),
        ("level_scale", "f8"),
        ("level_shift", "f8"),  # e-
        ("extra_e2", "f8"),
        ("extra_dn2", "f8"),
    ],
    align=True,
)

# rows of `Pixel.peaks`: levels of the noise beside the comb's own
SHARE, SHARE_SLOPE, SHIFT_E, SHIFT_DN, SHIFT_SIGMA, WIDTH = range(6)
N_PEAK_ROWS = 6
# rows of `Pixel.mixtures`
EXPOSURE_WEIGHT, EXPOSURE_FACTOR, ADDED_WEIGHT, ADDED_EXPOSURE = range(4)
N_MIXTURE_ROWS = 4

# codes of a mask: counted; left out by the tail guard; set aside, the likelihood being given the others
COUNTED, LEFT_OUT, SET_ASIDE = range(3)

# rows of `Scratch.small`: of an evaluation and a climb, vectors, then matrices of N_BLOCK rows; of the
# search: room for parameters, and starts with their heights
OWN, TRIAL, STEPS, RIGHT, SCHUR, LOWER = 0, 1, 2, 3, 4, 4 + N_BLOCK
HERE, OTHER, KEPT_STARTS = 4 + 2 * N_BLOCK, 5 + 2 * N_BLOCK, 6 + 2 * N_BLOCK
N_KEPT = 6
HEIGHTS = KEPT_STARTS + N_KEPT
N_SMALL = HEIGHTS + 2  # of a single sample, the heights are more than a row
# rows of `Scratch.flags`: parameters that stay in a step, and all the time
HELD, FIXED = range(2)
KNOWN = 0.0  # in place of the longest step
# places in `Scratch.evaluations`: of the last climb, of its trials, at the best maximum
AT, AHEAD, AT_BEST = range(3)
N_DENSITY_ROWS = 10
MAX_COMPONENTS = 201  # of which a value may be a mixture
N_NEGATIVE, _NO_FACTORIAL = 128, 1e5  # numbers below 0 of which a factorial is asked, and its logarithm
SCANNED = 768  # last columns of `Scratch.rows`, where no evaluation comes: frequencies of a scan
_MIN_COLUMNS = 384 + SCANNED  # a value's components
# rows of `Scratch.cells` of a sample: mass, its inverse, counts over mass, slopes in theta
MASS, PER_MASS, RATIO, SLOPES = range(4)
N_CELL_ROWS = 3 + N_BLOCK
# rows of `Scratch.edges`: tail, density and z times the density; columns in which they are kept
TAIL, DENSITY, Z_DENSITY = range(3)
EDGES_KEPT = 8192


class Pixel(NamedTuple):
    """The histograms of one pixel and what the law says of this pixel.

    Attributes:
        bins: by sample: counts, their sums before each DN, the counts expected (out of an evaluation), lower
            edges of the cells, 1 for codes that are not set aside; shape (J, N_BIN_ROWS, bins + 1 +
            SIMD_WIDTH).
        facts: of each sample, see `FACTS`, shape (J,).
        laws: of each sample, see `LAW`, shape (J,).
        peaks: satellite peaks of each sample, shape (J, N_PEAK_ROWS, enough); weight 0 where there are fewer.
        mixtures: of exposures, shape (J, N_MIXTURE_ROWS, enough); weight 0 where there are fewer.
        centre: DN that all is counted from.
        longest_step: 1/g beyond which there is one Gaussian, DN; `KNOWN`: 1/g and sigma are not sought.
    """

    bins: FloatArray
    facts: NDArray[np.void]
    laws: NDArray[np.void]
    peaks: FloatArray
    mixtures: FloatArray
    centre: int
    longest_step: float


class Sample(NamedTuple):
    """One of the samples of a pixel, see `Pixel`."""

    bins: FloatArray
    facts: Any
    law: Any
    peaks: FloatArray
    mixtures: FloatArray


class Scratch(NamedTuple):
    """Room to work in, and the evaluations of a pixel.

    Attributes:
        rows: of the density and of the starts, shape (N_DENSITY_ROWS, enough).
        coefficients: of the density, a row for each component that bins are next to.
        log_factorials: of -N_NEGATIVE, ... -1, where they are very large, 0, 1, ..., shape (1, enough).
        numbers: electron numbers in use with P(k) and its two derivatives, shape (enough, 4).
        cells: of each sample, shape (J, N_CELL_ROWS, bins + 1 + SIMD_WIDTH).
        edges: of all components of a sample, one after another, as far as there is room; and then of one,
            shape (3, EDGES_KEPT + bins + 1 + 2 SIMD_WIDTH).
        small: vectors and matrices, shape (N_SMALL, J + N_SHARED).
        flags: parameters that stay, shape (2, J + N_SHARED).
        evaluations: shape (3, J, N_ROWS, N_BLOCK).
        used: how many evaluations a pixel has taken, shape (1,).
    """

    rows: FloatArray
    coefficients: FloatArray
    log_factorials: FloatArray
    numbers: FloatArray
    cells: FloatArray
    edges: FloatArray
    small: FloatArray
    flags: BoolArray
    evaluations: FloatArray
    used: IntArray


@kernel
def _log_factorials(n: int) -> FloatArray:
    """Return log k! of -N_NEGATIVE <= k < n."""
    found = np.empty((1, N_NEGATIVE + n))
    for place in range(N_NEGATIVE + n):
        k = place - N_NEGATIVE
        found[0, place] = math.lgamma(k + 1.0) if k >= 0 else _NO_FACTORIAL
    return found


@kernel
def make_scratch(n_samples: int, n_bins: int, cells: bool) -> Scratch:
    """Return room for so many samples of at most so many bins; ``cells``: also to integrate them."""
    width = n_bins + 1 + SIMD_WIDTH if cells else 0
    return Scratch(
        np.empty((N_DENSITY_ROWS, 2 * n_bins + _MIN_COLUMNS)),
        np.empty((2 * n_bins + 2, MAX_COMPONENTS + SIMD_WIDTH)),
        _log_factorials(2 * n_bins + 512),
        np.empty((n_bins + 512 if cells else 0, 4)),
        np.zeros((n_samples, N_CELL_ROWS, width)),
        np.zeros((3, EDGES_KEPT + width + SIMD_WIDTH if cells else 0)),
        np.zeros((N_SMALL, n_samples + N_SHARED)),
        np.zeros((2, n_samples + N_SHARED), np.bool_),
        np.zeros((3, n_samples, N_ROWS, N_BLOCK)),
        np.zeros(1, np.int64),
    )


@kernel
def make_pixel(dark: BoolArray, n_bins: int, n_peaks: int, n_exposures: int) -> Pixel:
    """Return room for histograms, levels of the noise and a mixture of exposures, of so many at most."""
    n = dark.size
    facts = np.zeros(n, FACTS)
    for j in range(n):
        facts[j].dark = dark[j]
    return Pixel(
        np.zeros((n, N_BIN_ROWS, n_bins + 1 + SIMD_WIDTH)),
        facts,
        np.zeros(n, LAW),
        np.zeros((n, N_PEAK_ROWS, n_peaks)),
        np.zeros((n, N_MIXTURE_ROWS, n_exposures)),
        0,
        0.0,
    )


@kernel(borrows=True)
def copy(source: FloatArray, target: FloatArray) -> None:
    """Copy a vector; a plain loop, since slice assignment compiles slowly."""
    for i in range(source.size):
        target[i] = source[i]


@kernel(borrows=True)
def copy_evaluation(source: FloatArray, target: FloatArray) -> None:
    """Copy an evaluation."""
    for j in range(source.shape[0]):
        for row in range(N_ROWS):
            for column in range(N_BLOCK):
                target[j, row, column] = source[j, row, column]


@kernel(borrows=True)
def load(counts: NDArray[np.generic], mask: NDArray[np.uint8], bins: FloatArray, facts: Any) -> int:
    """Fill the histogram of one sample without its empty ends, and its facts but for the centre; return that.

    The mask is that of :data:`COUNTED`; the centre is counted in bins after bin 0.
    """
    low, high = 0, counts.size
    worst = np.uint8(COUNTED)
    for i in range(counts.size):
        worst = max(worst, mask[i])
    aside, plain = worst == SET_ASIDE, worst == COUNTED
    weights, cumulative, kept = bins[WEIGHT], bins[CUMULATIVE], bins[KEPT]
    if not aside:  # given the other codes, empty ones tell, too
        while low < high and (counts[low] == 0 or (not plain and mask[low] != COUNTED)):
            low += 1
        while high > low and (counts[high - 1] == 0 or (not plain and mask[high - 1] != COUNTED)):
            high -= 1
    n_bins = high - low
    cumulative[0] = 0.0
    occupied = 0
    moment = 0.0
    for i in range(n_bins):
        c = float(counts[low + i])
        kept[i] = 1.0
        if not plain and mask[low + i] != COUNTED:
            c = 0.0
            kept[i] = 0.0 if mask[low + i] == SET_ASIDE else 1.0
        weights[i] = c
        cumulative[i + 1] = cumulative[i] + c
        moment += c * i
        if c > 0.0:
            occupied += 1
    for i in range(n_bins, n_bins + SIMD_WIDTH):
        weights[i] = kept[i] = 0.0
    n = cumulative[n_bins]
    facts.n_bins, facts.n_frames, facts.occupied, facts.conditional = n_bins, n, occupied, aside
    if n == 0.0:
        facts.n_bins, facts.first, facts.mean, facts.variance = 0, 0.0, 0.0, 0.0
        return 0
    mean = moment / n
    square = 0.0
    for i in range(n_bins):
        square += weights[i] * (i - mean) ** 2
    middle = math.floor(mean)
    facts.first, facts.mean, facts.variance = -float(middle), mean - middle, square / n
    return int(low + middle)


@kernel(views=True)
def sample_of(pixel: Pixel, j: int) -> Sample:
    """Return one sample."""
    return Sample(pixel.bins[j], pixel.facts[j], pixel.laws[j], pixel.peaks[j], pixel.mixtures[j])
