"""What the charge channel of the evidence says of the exposure: deviations in time, their noise, mixtures.

The expected electron number ``k = E[K | x]`` answers to a change of the exposure by less than the electrons
do: ``d E[k] / dH = Var(k) / H``, for the score of a Poisson law is ``(K - H) / H`` and ``Cov(k, K) =
Var(k)``.

The second Charlier polynomial: a law near Poisson with ``Var K = H + c V`` (c small) has the mass ``P(k; H)
[1 + c V C2(k) / (2 H^2)]``, ``C2 = (k - H)^2 - k``. Its efficient score (Rao 1948) is ``E[C2 | x] / 2``,
with what the four parameters of the PCD can do taken away; the standardised score of N frames then has the
mean ``c V / H^2 sqrt(N I)``, where I is the score's variance.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pchem_pipeline.effects.types import Evidence, FloatArray, IntArray, PixelMaps
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.model.arithmetic.statistics import OF_MEDIAN_DEVIATION
from pchem_pipeline.model.law.pcd import pcd_posterior


class ExposureProfile(NamedTuple):
    """Relative deviation of the exposure of each numbered frame from the mean, (n,), and its shot noise."""

    frames: IntArray
    deviation: FloatArray
    variance: float


def exposure_profile(evidence: Evidence) -> ExposureProfile | None:
    """Return how the exposure common to all pixels went along, or None where time is not known.

    Frame t has ``sum(k - H) / sum(H)`` of mean ``d_t sum(Var k) / sum(H)`` and variance ``sum(Var k) /
    sum(H)^2``, sums over the usable pixels.
    """
    time, good = evidence.time, evidence.maps.usable
    if time is None or time.frames.size < 8 or not good.any():
        return None
    variance = float(np.sum(evidence.charge_std[good] ** 2))
    exposure = float(np.sum(evidence.maps.quanta_exposure[good]))
    if not (variance > 0 and exposure > 0):
        return None
    deviation = np.asarray(time.frame_charge, np.float64) * (exposure / variance)
    return ExposureProfile(time.frames.astype(np.int64), deviation, 1.0 / variance)


class BlockCharge(NamedTuple):
    """Deviations of the block means of the usable pixels' charge, without what is common to all of them."""

    start: FloatArray  # first frame of each block, (b,)
    length: FloatArray  # number of frames of each block, (b,)
    deviation: FloatArray  # e- of exposure (the slope Var(k) / H taken out), (b, n)
    variance: FloatArray  # of a single frame, e-^2 of exposure, (n,)
    y: IntArray  # rows of the pixels, (n,)
    x: IntArray  # columns of the pixels, (n,)


def block_charge(evidence: Evidence) -> BlockCharge | None:
    """Return how each pixel's exposure went along by blocks, or None with fewer than 4 blocks."""
    time = evidence.time
    if time is None or time.block_start.size < 4:
        return None
    good = evidence.maps.usable & (evidence.charge_std > 0) & (evidence.maps.quanta_exposure > 0)
    if not good.any():
        return None
    length = time.block_length.astype(np.float64)
    exposure, variance = evidence.maps.quanta_exposure[good], evidence.charge_std[good] ** 2
    charge = np.asarray(time.block_charge, np.float64)[:, good]
    charge -= np.average(charge, axis=0, weights=length)
    common = charge.sum(axis=1) / variance.sum()
    slope = variance / exposure * against_usual_gain(evidence.maps)[good]
    deviation = (charge - common[:, None] * variance) / slope
    y, x = np.nonzero(good)
    return BlockCharge(time.block_start.astype(np.float64), length, deviation, variance / slope**2, y, x)


def against_usual_gain(maps: PixelMaps) -> FloatArray:
    """Return the gain of each pixel over the sensor's usual one where it is far from that, else 1, (y, x).

    Where the light of a pixel changes much its fit is led astray: so much of an electron counts as one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log_gain = np.log(maps.conversion_gain)
    apart = log_gain - np.median(log_gain[maps.usable])
    usual = OF_MEDIAN_DEVIATION * float(np.median(np.abs(apart[maps.usable])))
    far = np.abs(apart) > BEYOND_DOUBT * usual
    return np.asarray(np.where(far, np.exp(apart), 1.0))


def block_signal(evidence: Evidence) -> BlockCharge | None:
    """Return the same of the samples themselves, at the sensor's usual gain; None as there.

    Where its fit is led astray so is what is taken for charge; the samples are what they are.
    """
    charge, time = block_charge(evidence), evidence.time
    if charge is None or time is None:
        return None
    at = charge.y, charge.x
    gain, exposure = evidence.maps.conversion_gain[at], evidence.maps.quanta_exposure[at]
    usual = 1.0 / against_usual_gain(evidence.maps)[at]
    signal = (time.block_charge[:, *at] + gain * time.block_readout[:, *at]).astype(np.float64) * usual
    signal -= np.average(signal, axis=0, weights=charge.length)
    signal -= np.median(signal / exposure, axis=1)[:, None] * exposure
    variance = (evidence.charge_std[at] ** 2 + (gain * evidence.readout_std[at]) ** 2) * usual**2
    return charge._replace(deviation=signal, variance=variance)


def exposure_nodes(factors: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return weights and nodes of a mixture of three exposures with the first six moments of ``factors``.

    Gauss's quadrature for the empirical law (Golub and Welsch 1969), from its moments by Lanczos's recursion.
    Factors are exposures relative to H, one for each frame, of mean 1; fewer values have fewer nodes.
    """
    values = np.asarray(factors, np.float64).reshape(-1)
    scale = float(values.std())
    if scale < 1e-9:
        return np.ones(1), np.ones(1)
    z = (values - values.mean()) / scale
    diagonal, off, size = np.zeros(3), np.zeros(2), 3
    before, current = np.zeros(z.size), np.full(z.size, z.size**-0.5)
    for j in range(3):
        step = z * current - (off[j - 1] * before if j else 0.0)
        diagonal[j] = float(current @ step)
        step = step - diagonal[j] * current
        norm = float(np.linalg.norm(step))
        if j == 2 or norm < 1e-6:
            size = j + 1
            break
        off[j], before, current = norm, current, step / norm
    matrix = np.diag(diagonal[:size]) + np.diag(off[: size - 1], 1) + np.diag(off[: size - 1], -1)
    nodes, vectors = np.linalg.eigh(matrix)
    weights = vectors[0] ** 2
    nodes = 1.0 + scale * (nodes - weights @ nodes)
    return weights / weights.sum(), np.maximum(nodes, 0.0)


# the information is smooth in both: nodes of its table, e-
_EXPOSURES = np.geomspace(0.02, 60.0, 25)
_NOISES = np.geomspace(0.08, 1.6, 14)
_POINTS_PER_SIGMA = 4


def charlier_information(exposure: FloatArray, noise: FloatArray) -> FloatArray:
    """Return I, the variance per frame of the efficient score ``E[C2 | x] / 2``, e-^4, shape (n,).

    Bilinear interpolation, in logarithms, of a table over H and sigma_e, e-, (n,) each.
    """
    table = _table()
    i, u = _place(np.log(_EXPOSURES), np.log(np.maximum(exposure, 1e-9)))
    j, v = _place(np.log(_NOISES), np.log(np.maximum(noise, 1e-9)))
    upper = (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
    return np.asarray(np.exp((1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * upper))


def _place(nodes: FloatArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    index = np.clip(np.searchsorted(nodes, values) - 1, 0, nodes.size - 2)
    return index, np.clip((values - nodes[index]) / (nodes[index + 1] - nodes[index]), 0.0, 1.0)


@functools.cache
def _table() -> FloatArray:
    return np.log([[_information(h, s) for s in _NOISES] for h in _EXPOSURES])


def _information(exposure: float, noise: float) -> float:
    """Return I of one pixel: sums over x of the densities of the PCD, eq. PCD of Hendrickson et al. 2023."""
    spread = 6.0 * np.sqrt(exposure)
    first, last = max(0, int(exposure - spread)), int(exposure + spread + 8.0) - 1
    x = np.arange(first - 6.0 * noise, last + 6.0 * noise, noise / _POINTS_PER_SIGMA)
    given = pcd_posterior(x, exposure, 1.0, 0.0, noise)
    density = np.exp(given.log_density)
    root = np.sqrt(density / density.sum())
    # the four parameters: exposure, bias, gain, read noise
    tangent = [given.k - exposure, given.e / noise, given.ke / noise, given.ee / noise**2 - 1.0]
    score = root * 0.5 * (given.kk - (2.0 * exposure + 1.0) * given.k + exposure**2)
    basis = np.linalg.qr(np.stack(tangent, axis=1) * root[:, None])[0]
    left = score - basis @ (basis.T @ score)
    return max(float(left @ left), 1e-30)
