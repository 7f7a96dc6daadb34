"""Laws of the electron number with their derivatives in the exposure, and tails of the normal law."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

# laws of the electron number
POISSON, NEGATIVE_BINOMIAL, BOREL = 0, 1, 2

# the table of the normal law: steps per unit of z, and where a tail ends for all that double can hold
STEPS = 128
FARTHEST = 38.0


@kernel(borrows=True)
def _log_rising(dispersion: float, k: float) -> float:
    """Return ``sum_{j<k} log(1 + j a)``; a sum of logarithms where those of gamma functions would cancel."""
    total = 0.0
    if dispersion > 1e-3:
        size = 1.0 / dispersion
        total = math.lgamma(k + size) - math.lgamma(size) + k * math.log(dispersion)
    else:
        for j in range(1, int(k)):
            total += math.log1p(j * dispersion)
    return total


@kernel(borrows=True)
def _one_law(law: int, dispersion: float, k: float, exposure: float) -> tuple[float, float, float]:
    """Return log P(k) at mean ``exposure`` and its first two derivatives in log exposure."""
    log_factorial = math.lgamma(k + 1.0)
    if law == NEGATIVE_BINOMIAL and dispersion > 0.0:
        excess = dispersion * exposure
        size = 1.0 / dispersion
        log_mass = _log_rising(dispersion, k) - (k + size) * math.log1p(excess)
        log_mass += k * math.log(exposure) - log_factorial
        first = (k - exposure) / (1.0 + excess)
        second = -exposure * (1.0 + dispersion * k) / ((1.0 + excess) * (1.0 + excess))
        return log_mass, first, second
    if law == BOREL and dispersion > 0.0:
        primary = exposure * (1.0 - dispersion)
        whole = primary + k * dispersion
        share = primary / whole
        log_mass = math.log(primary) + (k - 1.0) * math.log(whole) - whole - log_factorial
        first = 1.0 + (k - 1.0) * share - primary
        second = (k - 1.0) * share * (1.0 - share) - primary
        return log_mass, first, second
    return k * math.log(exposure) - exposure - log_factorial, k - exposure, -exposure


@kernel(borrows=True)
def electron_number(
    law: int,
    dispersion: float,
    k: int,
    exposure: float,
    mixtures: NDArray[np.float64],
) -> tuple[float, float, float]:
    """Return P(k) of a mixture of exposures and its first two derivatives in log exposure.

    Args:
        law: one of the names at the top of this module.
        dispersion: its parameter, see :class:`~pchem_pipeline.model.law.sample_law.SampleLaw`.
        k: number of electrons.
        exposure: H, e-.
        mixtures: weights of the exposures and these in units of H; weights of the exposures beside it and
            these in e-; shape (4, m), weight 0 where there are fewer.
    """
    mass = slope = bend = 0.0
    for b in range(mixtures.shape[1]):
        if mixtures[0, b] == 0.0:
            continue
        own = exposure * mixtures[1, b]
        for j in range(mixtures.shape[1]):
            if mixtures[2, j] == 0.0:
                continue
            whole = own + mixtures[3, j]
            log_mass, first, second = _one_law(law, dispersion, float(k), whole)
            # from the logarithm of the whole exposure to that of H: d log whole = share d log H
            share = own / whole
            second = (second * share + first * (1.0 - share)) * share
            first *= share
            part = mixtures[0, b] * mixtures[2, j] * math.exp(log_mass)
            mass += part
            slope += part * first
            bend += part * (second + first * first)
    return mass, slope, bend


@kernel(borrows=True)
def fill_normal_table(table: NDArray[np.float64]) -> None:
    """Fill the upper tail and the density of the normal law at z = 0, 1/STEPS, ..., shape (n, 2)."""
    for j in range(table.shape[0]):
        z = j / STEPS
        table[j, 0] = 0.5 * math.erfc(z / math.sqrt(2.0))
        table[j, 1] = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


@kernel(inline=True)
def normal_tail(z: float, table: NDArray[np.float64]) -> tuple[float, float]:
    """Return the nearer tail of the normal law, negative above the middle, and the density at z.

    The difference of two such tails is the mass between two values on one side of the middle without
    cancellation; where they lie on either side, it is the mass less one. Taylor series around the nearest
    node: the mass is good to 1e-15 of itself within 8 standard deviations, and to 1e-7 at the far end.
    """
    distance = abs(z)
    if not distance < FARTHEST:
        return 0.0, 0.0
    node = int(distance * STEPS + 0.5)
    z0 = node / STEPS
    d = distance - z0
    h2 = z0 * z0 - 1.0
    h3 = z0 * h2 - 2.0 * z0
    h4 = z0 * h3 - 3.0 * h2
    h5 = z0 * h4 - 4.0 * h3
    series = d * (1.0 - d * (z0 / 2.0 - d * (h2 / 6.0 - d * (h3 / 24.0 - d * (h4 / 120.0 - d * h5 / 720.0)))))
    tail = table[node, 0] - table[node, 1] * series
    y = -d * (z0 + 0.5 * d)
    extended = 1.0 + y * (1.0 + y * (1.0 / 2.0 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y / 120.0))))
    return (tail if z <= 0.0 else -tail), table[node, 1] * extended
