"""What several exposures of the same pixels tell together: the line of H over time or light."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.maps.exposure_series import exposure_line

#: Slope and offset of the exposures over the light level.
LEVEL_MAPS = ("charge_per_level", "dark_signal")


def line_map_names(against: str, rate: str) -> tuple[str, ...]:
    """Return the names of slope and offset of the exposures against what they are drawn over.

    Args:
        against: integration_time, light_level or none.
        rate: name of the slope over time: ``charge_rate``, in the dark ``dark_current``.
    """
    if against == "none":
        return ()
    return (rate, "spurious_charge") if against == "integration_time" else LEVEL_MAPS


def own_variance(covariance: FloatArray) -> FloatArray:
    """Return the variance of each H_j at known g, mu and sigma, e-^2.

    Args:
        covariance: of (H_1 ... H_J, g, mu, sigma), shape (n, J + 3, J + 3); sigma at its bound is NaN.

    Returns:
        Shape (n, J); NaN where a pixel has no covariance.
    """
    n, size = covariance.shape[:2]
    j = size - 3
    shared, across = covariance[:, j:, j:].copy(), covariance[:, :j, j:].copy()
    bound = np.isnan(shared[:, 2, 2]) & np.isfinite(shared[:, 0, 0])
    shared[bound, 2], shared[bound, :, 2], across[bound, :, 2] = 0.0, 0.0, 0.0
    shared[bound, 2, 2] = 1.0
    own = np.full((n, j), np.nan)
    good = np.flatnonzero(np.isfinite(shared).all(axis=(1, 2)))
    if good.size:
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
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return the line through the exposures of each pixel, and what is left of them.

    Args:
        exposure: H of n pixels in J samples, e-, shape (n, J).
        covariance: of (H_1 ... H_J, g, mu, sigma), shape (n, J + 3, J + 3).
        x: integration times (s) or light levels of the samples, NaN for those without electrons, shape (J,).
        names: of slope and offset, as of :func:`line_map_names`.

    Returns:
        Slope and offset with standard errors, (n,), by name; and the residuals (n, J) with theirs, chi-square
        and its probability (n,).
    """
    use = np.flatnonzero(np.isfinite(x))
    own = own_variance(covariance)[:, use]
    line = exposure_line(exposure[:, use], covariance[:, use][:, :, use], own, x[use])
    maps: dict[str, NDArray[Any]] = {}
    for i, (name, values) in enumerate(zip(names, (line.slope, line.offset), strict=True)):
        maps[name], maps[f"{name}_stderr"] = values, np.sqrt(line.covariance[:, i, i])
    left: dict[str, NDArray[Any]] = {"linearity_chi2": line.chi2, "linearity_p": line.p}
    residuals = {"linearity_residual": line.residual, "linearity_residual_stderr": line.residual_stderr}
    for name, part in residuals.items():
        left[name] = np.full(exposure.shape, np.nan)
        left[name][:, use] = part
    return maps, left
