"""Loops of :mod:`pchem_pipeline.model.law.pcd`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.arithmetic.normal_numba import normal_mass

_NEGLIGIBLE = 41.0  # nats: exp(-41) is below the resolution of a double


@kernel
def log_term(k: int, y: float, exposure: float, step: float, sigma: float) -> float:
    """Return log(P_k phi(y; k step, sigma^2)) without the constant -H - log(sigma sqrt(2 pi))."""
    e = (y - k * step) / sigma
    return k * math.log(exposure) - math.lgamma(k + 1.0) - 0.5 * e * e


@kernel
def largest_term(y: float, exposure: float, step: float, sigma: float) -> int:
    """Return the k of the largest term; the terms are log-concave in k, so a climb finds it."""
    guess = y / step
    spread = sigma / step
    if spread * spread > exposure:  # wide noise: the Poisson factor decides
        guess = exposure
    k = max(0, int(guess + 0.5))
    best = log_term(k, y, exposure, step, sigma)
    while True:
        up = log_term(k + 1, y, exposure, step, sigma)
        if up <= best:
            break
        k += 1
        best = up
    while k > 0:
        down = log_term(k - 1, y, exposure, step, sigma)
        if down <= best:
            break
        k -= 1
        best = down
    return k


@kernel
def log_density(y: float, exposure: float, step: float, sigma: float) -> float:
    """Return the log density of the PCD at ``y = x - mu`` (DN), with ``step = 1/g`` (DN)."""
    constant: float = -exposure - math.log(sigma) - 0.5 * math.log(2.0 * math.pi)
    if exposure == 0.0:
        return constant - 0.5 * (y / sigma) ** 2
    mode = largest_term(y, exposure, step, sigma)
    top = log_term(mode, y, exposure, step, sigma)
    total = 1.0
    k = mode + 1
    while True:
        term = log_term(k, y, exposure, step, sigma) - top
        if term < -_NEGLIGIBLE:
            break
        total += math.exp(term)
        k += 1
    k = mode - 1
    while k >= 0:
        term = log_term(k, y, exposure, step, sigma) - top
        if term < -_NEGLIGIBLE:
            break
        total += math.exp(term)
        k -= 1
    answer: float = constant + top + math.log(total)
    return answer


@kernel
def log_densities(
    x: NDArray[np.float64],
    exposure: NDArray[np.float64],
    gain: NDArray[np.float64],
    bias: NDArray[np.float64],
    sigma: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill ``out`` with the log density of each element; NaN where a parameter is not valid."""
    for i in range(x.size):
        valid = exposure[i] >= 0.0 and gain[i] > 0.0 and sigma[i] > 0.0 and math.isfinite(x[i] - bias[i])
        if valid and math.isfinite(exposure[i]) and math.isfinite(gain[i]) and math.isfinite(sigma[i]):
            out[i] = log_density(x[i] - bias[i], exposure[i], 1.0 / gain[i], sigma[i])
        else:
            out[i] = math.nan


@kernel
def masses(
    x: NDArray[np.float64],
    exposure: NDArray[np.float64],
    gain: NDArray[np.float64],
    bias: NDArray[np.float64],
    noise: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill ``out`` with the mass of the cell [x - 1/2, x + 1/2]; ``noise`` is analog, in e-."""
    for i in range(x.size):
        lam, step, width = exposure[i], 1.0 / gain[i], noise[i] / gain[i]
        y = x[i] - bias[i]
        first = max(0, int((y - 0.5 - 9.0 * width) / step) - 1)
        last = max(0, int((y + 0.5 + 9.0 * width) / step) + 1)
        total = 0.0
        for k in range(first, last + 1):
            if lam > 0.0:
                weight = math.exp(k * math.log(lam) - lam - math.lgamma(k + 1.0))
            else:
                weight = 1.0 if k == 0 else 0.0
            d = y - k * step
            if width > 0.0:
                total += weight * normal_mass((d - 0.5) / width, (d + 0.5) / width)
            elif -0.5 < d <= 0.5:
                total += weight
        out[i] = total
