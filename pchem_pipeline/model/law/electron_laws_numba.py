"""Laws of the electron number with their derivatives in the exposure."""

from __future__ import annotations

import math

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.limits import NEGLIGIBLE

# laws of the electron number
POISSON, NEGATIVE_BINOMIAL, BOREL, TRAPPED, LOST = 0, 1, 2, 3, 4

_MOST_LOST, _SURELY_LOST = 400, 0.99


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
def _trapped(chance: float, k: float, exposure: float) -> tuple[float, float, float]:
    """Return P(k) over that of Poisson electrons, and its first two derivatives in log exposure."""
    some, none = -math.expm1(-exposure), exposure * math.exp(-exposure)
    given, left = k / exposure, exposure / (k + 1.0)
    taken = 1.0 if k > 0.0 else 0.0
    factor = 1.0 + chance * (some * (given - 1.0) + left - taken)
    rise = chance * (none * (given - 1.0) - some * given + left)
    bend = chance * (none * (1.0 - exposure) * (given - 1.0) + (some - 2.0 * none) * given + left)
    return factor, rise, bend


@kernel(borrows=True)
def _lost(chance: float, k: float, exposure: float) -> tuple[float, float, float]:
    """Return log P(k) where each electron is lost with a chance for every other one, and its derivatives."""
    log_exposure, largest = math.log(exposure), 0.0
    mass = slope = bend = 0.0
    outer = -exposure - math.lgamma(k + 1.0)
    for gone in range(_MOST_LOST):
        n = k + gone
        each = min(chance * (n - 1.0), _SURELY_LOST) if n > 1.0 else 0.0
        if gone > 0 and each == 0.0:
            continue
        log_term = outer + n * log_exposure - math.lgamma(gone + 1.0) + k * math.log1p(-each)
        if gone > 0:
            log_term += gone * math.log(each)
        if gone == 0:
            largest = log_term
        term = math.exp(log_term - largest)
        mass += term
        slope += term * (n - exposure)
        bend += term * ((n - exposure) * (n - exposure) - exposure)
        if n > exposure and term < NEGLIGIBLE * mass:
            break
    first = slope / mass
    return largest + math.log(mass), first, bend / mass - first * first


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
    poisson = k * math.log(exposure) - exposure - log_factorial
    if law == TRAPPED and dispersion > 0.0:
        factor, rise, bend = _trapped(dispersion, k, exposure)
        share = rise / factor
        return poisson + math.log(factor), k - exposure + share, bend / factor - share * share - exposure
    if law == LOST and dispersion > 0.0:
        log_mass, first, second = _lost(dispersion, k, exposure)
        return log_mass, first, second
    return poisson, k - exposure, -exposure


@kernel(borrows=True)
def electron_number(
    law: int, dispersion: float, k: int, exposure: float, mixtures: FloatArray
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
