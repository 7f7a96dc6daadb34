"""The line through the exposures of a pixel over time or light: charge rate, spurious charge, linearity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from pchem_pipeline.base.arrays import FloatArray

_REWEIGHTINGS = 2
_MOST_RESCALED = 100.0  # no variance is trusted to change by more


def exposure_line(
    quanta_exposure: FloatArray, covariance: FloatArray, own_variance: FloatArray, x: ArrayLike
) -> tuple[FloatArray, FloatArray, dict[str, FloatArray]]:
    """Fit a line, ``H_j = slope x_j + offset``, to the exposures of n pixels by generalised least squares.

    The exposures of a pixel share g, mu and sigma, so their errors are correlated. The variance of each
    alone grows with H; it is taken at the line, since small estimates would else claim too much weight.

    Args:
        quanta_exposure: H_j, e-, shape (n, J).
        covariance: of H_1 ... H_J, e-^2, shape (n, J, J).
        own_variance: the variance of H_j at known g, mu and sigma, e-^2, shape (n, J).
        x: integration times (s) or light levels of the samples, shape (J,), not all equal.

    Returns:
        Slope, e- per unit of x, and offset, e-, shape (n, 2); their covariance, (n, 2, 2); by name
        ``linearity_residual``, H_j minus the line, with ``linearity_residual_stderr``, e-, (n, J), and
        ``linearity_chi2`` with ``linearity_p``, (n,). The standard error is 0, and p NaN, where the line
        leaves no freedom; all are NaN where a pixel has no exposures.

    Raises:
        ValueError: if there are fewer than two different x.
    """
    places = np.asarray(x, np.float64)
    if np.unique(places).size < 2:
        raise ValueError("a line needs two different integration times or light levels")
    n, n_samples = quanta_exposure.shape
    design = np.stack([places, np.ones(n_samples)], axis=1)
    line, spread = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    residual, sd, chi2 = np.full((n, n_samples), np.nan), np.full((n, n_samples), np.nan), np.full(n, np.nan)
    good = np.flatnonzero(np.isfinite(quanta_exposure).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    exposure, own = quanta_exposure[good], covariance[good]
    fitted = exposure
    for _ in range(1 + _REWEIGHTINGS):
        errors = own.copy()
        change = (_rescaling(exposure, fitted) - 1.0) * own_variance[good]
        errors[:, np.arange(n_samples), np.arange(n_samples)] += change
        inverse = np.linalg.inv(errors)
        weighted = np.einsum("jp,njk->npk", design, inverse)
        bend = np.linalg.inv(weighted @ design)
        solution = np.einsum("npq,nqk,nk->np", bend, weighted, exposure)
        fitted = solution @ design.T
    rest = exposure - fitted
    line[good], spread[good], residual[good] = solution, bend, rest
    rest_square = np.diagonal(errors, axis1=1, axis2=2) - np.einsum("jp,npq,jq->nj", design, bend, design)
    sd[good] = np.sqrt(np.maximum(rest_square, 0.0)) if n_samples > 2 else 0.0
    chi2[good] = np.einsum("nj,njk,nk->n", rest, inverse, rest)
    dof = n_samples - 2
    p = np.asarray(chdtrc(dof, chi2)) if dof > 0 else np.full(n, np.nan)
    left = {"linearity_residual": residual, "linearity_residual_stderr": sd}
    return line, spread, left | {"linearity_chi2": chi2, "linearity_p": p}


def _rescaling(exposure: FloatArray, fitted: FloatArray) -> FloatArray:
    """Return the factor from the variance at the estimates to that at the line."""
    least = np.maximum(1e-6, 1e-3 * exposure.max(axis=1, keepdims=True))
    ratio = np.maximum(fitted, least) / np.maximum(exposure, least)
    return np.asarray(np.clip(ratio, 1.0 / _MOST_RESCALED, _MOST_RESCALED))


def line_map_names(against: str, rate: str) -> tuple[str, ...]:
    """Return the names of slope and offset of the exposures against integration_time, light_level or none.

    The slope over time is the ``rate``: ``charge_rate``, in the dark ``dark_current``.
    """
    if against == "none":
        return ()
    return (rate, "spurious_charge") if against == "integration_time" else ("charge_per_level", "dark_signal")


def own_variance(covariance: FloatArray) -> FloatArray:
    """Return the variance of each H_j at known g, mu and sigma, e-^2, (n, J); NaN without a covariance.

    That is of (H_1 ... H_J, g, mu, sigma), shape (n, J + 3, J + 3); sigma at its bound is NaN.
    """
    n, size = covariance.shape[:2]
    j = size - 3
    shared, across = covariance[:, j:, j:].copy(), covariance[:, :j, j:].copy()
    bound = np.isnan(shared[:, 2, 2]) & np.isfinite(shared[:, 0, 0])
    shared[bound, 2], shared[bound, :, 2], across[bound, :, 2] = 0.0, 0.0, 0.0
    shared[bound, 2, 2] = 1.0
    own = np.full((n, j), np.nan)
    good = np.flatnonzero(np.isfinite(shared).all(axis=(1, 2)))
    # the parameters have scales of their own: the matrix of correlations is inverted
    scale = np.sqrt(np.diagonal(shared[good], axis1=1, axis2=2))
    correlation = shared[good] / (scale[:, :, None] * scale[:, None, :])
    weights = across[good] / scale[:, None, :]
    explained = np.einsum("nja,nab,njb->nj", weights, np.linalg.inv(correlation), weights)
    diagonal = np.diagonal(covariance[good, :j, :j], axis1=1, axis2=2)
    own[good] = np.maximum(diagonal - explained, 0.0)
    return own


def line_maps(
    exposure: FloatArray, covariance: FloatArray, x: FloatArray, names: Sequence[str]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the line through the exposures of each pixel, and what is left of them.

    Slope and offset with standard errors, (n,), by their names of :func:`line_map_names`; and the residuals
    (n, J) with theirs, chi-square and its probability (n,). The covariance is that of (H_1 ... H_J, g, mu,
    sigma); x, times (s) or light levels of the samples, is NaN for those without electrons.
    """
    use = np.flatnonzero(np.isfinite(x))
    own = own_variance(covariance)[:, use]
    line, spread, left = exposure_line(exposure[:, use], covariance[:, use][:, :, use], own, x[use])
    maps: dict[str, FloatArray] = {}
    for i, (name, values) in enumerate(zip(names, line.T, strict=True)):
        maps |= {name: values, f"{name}_stderr": np.sqrt(spread[:, i, i])}
    for name in ("linearity_residual", "linearity_residual_stderr"):
        part, left[name] = left[name], np.full(exposure.shape, np.nan)
        left[name][:, use] = part
    return maps, left
