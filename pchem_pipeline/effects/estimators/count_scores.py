"""How much excess variance of the electron numbers a score of the second Charlier polynomial stands for.

A law near Poisson with ``Var K = H + c V`` (c small) has the mass ``P(k; H) [1 + c V C2(k) / (2 H^2)]``, ``C2
= (k - H)^2 - k``. Its efficient score (Rao 1948) is ``E[C2 | x] / 2``, with what the four parameters of the
PCD can do taken away; the standardised score of N frames then has the mean ``c V / H^2 sqrt(N I)``, where I
is the score's variance.
"""

from __future__ import annotations

import functools

import numpy as np

from pchem_pipeline.effects.types import FloatArray, IntArray
from pchem_pipeline.model.law.pcd import pcd_posterior

# the information is smooth in both: nodes of its table, e-
_EXPOSURES = np.geomspace(0.02, 60.0, 25)
_NOISES = np.geomspace(0.08, 1.6, 14)
_POINTS_PER_SIGMA = 4


def charlier_information(exposure: FloatArray, noise: FloatArray) -> FloatArray:
    """Return I, the variance per frame of the efficient score ``E[C2 | x] / 2``, e-^4.

    Args:
        exposure: H, e-, shape (n,).
        noise: sigma_e, e-, shape (n,).

    Returns:
        Bilinear interpolation, in logarithms, of a table; shape (n,).
    """
    table = _table()
    i, u = _place(np.log(_EXPOSURES), np.log(np.maximum(exposure, 1e-9)))
    j, v = _place(np.log(_NOISES), np.log(np.maximum(noise, 1e-9)))
    upper = (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
    information: FloatArray = np.exp((1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * upper)
    return information


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
