"""What the loops of the grown likelihood hand to each other: the law, a pixel's cells, room to work in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

# places in theta: log H, 1/g (DN per electron), mu - centre (DN), log sigma_R^2 (DN^2), weight of free lobes
N_THETA = 5
LOG_EXPOSURE, STEP, BIAS, LOG_VARIANCE, LOBE = range(N_THETA)

# rows of the resolved lobes of a pixel
WEIGHT, WEIGHT_SLOPE, SHIFT_E, SHIFT_DN, SHIFT_SIGMA, WIDTH = range(6)
N_LOBE_ROWS = 6


class Law(NamedTuple):
    """A :class:`~pchem_pipeline.model.law.sample_law.MarginalModel` as the loops take it: see there.

    Arrays with a row per pixel have 1 or n rows; ``outlier_mass`` is that of the outliers in each code,
    ``pattern`` that of the free lobes, ``table`` that of the normal law.
    """

    law: int
    dispersion: float
    exposure_weights: NDArray[np.float64]
    exposure_factors: NDArray[np.float64]
    added_exposure: NDArray[np.float64]
    added_weights: NDArray[np.float64]
    level_scale: NDArray[np.float64]
    level_shift_e: NDArray[np.float64]
    curvature: float
    variance_per_electron: float
    variance_per_electron2: float
    extra_variance_e2: NDArray[np.float64]
    extra_variance_dn2: NDArray[np.float64]
    lobe_weights: NDArray[np.float64]
    lobe_shift_e: NDArray[np.float64]
    lobe_shift_dn: NDArray[np.float64]
    lobe_shift_sigma: NDArray[np.float64]
    lobe_width: NDArray[np.float64]
    edge_first: int
    edge_shift: NDArray[np.float64]
    clip_low: int
    clip_high: int
    outlier_share: float
    outlier_mass: float
    pattern: NDArray[np.float64]
    table: NDArray[np.float64]


class Cells(NamedTuple):
    """One pixel: its counts, the edges of its cells, and what the law says of it alone.

    Attributes:
        weights: counts, shape (at least n_bins,).
        edges: lower edges of the cells and the upper edge of the last one, less the centre; infinite where
            everything beyond is counted in the cell.
        n_bins: cells in use.
        bottom: last edge at minus infinity, -1 without one.
        top: first edge at infinity, n_bins + 1 without one.
        margin: largest distance of a finite edge from its place ``i`` after ``first``, DN.
        first: place of the first edge, less the centre, without any shift.
        lobes: resolved lobes, shape (N_LOBE_ROWS, at least n_lobes).
        n_lobes: lobes in use.
        added_exposure, added_weights: exposures beside H, e-, and their weights, shape (j,).
        level_scale, level_shift: of the comb, and e-.
        extra_e2, extra_dn2: variance, e-^2 and DN^2.
    """

    weights: NDArray[np.float64]
    edges: NDArray[np.float64]
    n_bins: int
    bottom: int
    top: int
    margin: float
    first: float
    lobes: NDArray[np.float64]
    n_lobes: int
    added_exposure: NDArray[np.float64]
    added_weights: NDArray[np.float64]
    level_scale: float
    level_shift: float
    extra_e2: float
    extra_dn2: float


class Room(NamedTuple):
    """Scratch of an evaluation, and its answers.

    Attributes:
        numbers: electron numbers in use with P(k) and its two derivatives, shape (enough, 4).
        mass: mass of each cell, shape (enough,).
        slopes: derivative of the mass of each cell in theta, shape (N_THETA, enough).
        ratio: counts over mass of each cell, shape (enough,).
        at_edges: tail, density, and z times the density at each edge, shape (3, enough).
        score: gradient of the log-likelihood, shape (N_THETA,).
        empirical: sum of the squares of the samples' scores, shape (N_THETA, N_THETA).
        information: observed information, shape (N_THETA, N_THETA).
    """

    numbers: NDArray[np.float64]
    mass: NDArray[np.float64]
    slopes: NDArray[np.float64]
    ratio: NDArray[np.float64]
    at_edges: NDArray[np.float64]
    score: NDArray[np.float64]
    empirical: NDArray[np.float64]
    information: NDArray[np.float64]


class Component(NamedTuple):
    """One electron number in one lobe: mean, variance and sd, their derivatives in theta, and its reach.

    Attributes:
        mean, variance, sd: DN, DN^2, DN.
        mean_step, mean_log: derivative of the mean in the step and in log sigma_R^2.
        variance_step, variance_log: those of the variance.
        low, high: first and last edge within reach.
    """

    mean: float
    variance: float
    sd: float
    mean_step: float
    mean_log: float
    variance_step: float
    variance_log: float
    low: int
    high: int


@kernel
def make_room(n_bins: int) -> Room:
    """Return scratch for histograms of at most so many bins."""
    return Room(
        np.empty((n_bins + 512, 4)),
        np.empty(n_bins),
        np.empty((N_THETA, n_bins)),
        np.empty(n_bins),
        np.empty((3, n_bins + 1)),
        np.empty(N_THETA),
        np.empty((N_THETA, N_THETA)),
        np.empty((N_THETA, N_THETA)),
    )
