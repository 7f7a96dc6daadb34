"""How well the samples of one pixel agree with a joint fit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.fit.goodness_numba import FITTED_PARAMETERS, pearson
from pchem_pipeline.model.fit.grown_numba import make_cells
from pchem_pipeline.model.fit.joint_likelihood_numba import NO_ELECTRONS
from pchem_pipeline.model.fit.joint_types_numba import (
    CENTRE,
    FIRST,
    N_BINS,
    N_BLOCK,
    N_FRAMES,
    Bench,
    Samples,
    histogram_of,
)
from pchem_pipeline.model.law import grown_cells_numba
from pchem_pipeline.model.law.estep_numba import evaluate
from pchem_pipeline.model.law.grown_types_numba import N_THETA


@kernel
def _expect(
    samples: Samples, j: int, middle: int, theta: NDArray[np.float64], exact: bool, bench: Bench
) -> NDArray[np.float64]:
    """Return the counts expected of the DN of one sample."""
    n_samples = samples.dark.size
    facts = samples.facts[j]
    n, n_bins = facts[N_FRAMES], int(facts[N_BINS])
    ratio: NDArray[np.float64] = bench.room.ratio
    row: NDArray[np.float64] = bench.space.rows[0]
    own = np.zeros(N_THETA)
    own[0] = theta[j]
    own[1] = theta[n_samples]
    own[2] = theta[n_samples + 1] - facts[CENTRE]
    own[3] = theta[n_samples + 2]
    if exact:
        if samples.dark[j]:
            own[0] = NO_ELECTRONS
        centre = middle + int(facts[CENTRE])
        space = samples.weights[j], samples.edges[j], bench.lobes
        cells = make_cells(bench.law, 0, 0.0, centre + int(facts[FIRST]), centre, n_bins, space)
        grown_cells_numba.masses(own, cells, bench.law, bench.room)
        for i in range(n_bins):
            ratio[i] = n * bench.room.mass[i]
        return ratio
    if not samples.dark[j]:
        evaluate(histogram_of(samples, j), own[:N_BLOCK], bench.space, n)
        return row
    sd = math.exp(0.5 * own[3])
    for i in range(n_bins):
        z = (facts[FIRST] + i - own[2]) / sd
        row[i] = n * math.exp(-0.5 * z * z) / (sd * math.sqrt(2.0 * math.pi))
    return row


@kernel
def joint_goodness(
    samples: Samples, middle: int, theta: NDArray[np.float64], exact: bool, bench: Bench
) -> tuple[float, int]:
    """Return Pearson's chi-square of all samples together and its degrees of freedom."""
    chi2, freedom = 0.0, -3
    for j in range(samples.dark.size):
        expected = _expect(samples, j, middle, theta, exact, bench)
        own, degrees = pearson(
            samples.weights[j], expected, int(samples.facts[j, N_BINS]), samples.facts[j, N_FRAMES]
        )
        if degrees > 0:
            chi2 += own
            freedom += degrees + FITTED_PARAMETERS
            if not samples.dark[j]:
                freedom -= 1
    if freedom <= 0:
        return math.nan, 0
    return chi2, freedom


@kernel
def joint_side_lobe(samples: Samples, theta: NDArray[np.float64]) -> float:
    """Return the height of the side lobe at theta in units of its noise, of the largest sample."""
    n_samples = samples.dark.size
    most = 0.0
    for j in range(n_samples):
        if not samples.dark[j]:
            most = max(most, samples.facts[j, N_FRAMES])
    noise2 = math.exp(theta[n_samples + 2]) / theta[n_samples] ** 2
    return math.sqrt(most) * math.exp(-2.0 * math.pi**2 * noise2)
