"""The maps of a joint fit: exposures, their line, and what follows from the shared parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit.joint import JointFit
from pchem_pipeline.model.maps.exposure_series import exposure_line
from pchem_pipeline.model.maps.maps import derived_maps, quality_map

__all__ = ["LINE_MAPS", "SHARED_MAPS", "JointMaps", "joint_maps", "own_variance"]

FloatArray = NDArray[np.float64]

#: Maps of the shared parameters and what follows from them.
SHARED_MAPS = ("conversion_gain", "bias", "read_noise_dn", "read_noise_e", "analog_read_noise_e")

#: Names of slope and offset of the exposures against what they are drawn over.
LINE_MAPS = {
    "integration_time": ("dark_current", "spurious_charge"),
    "light_level": ("charge_per_level", "spurious_charge"),
}


@dataclass(frozen=True)
class JointMaps:
    """Arrays by name: ``joint`` of each sample (n, J) and each pixel (n,), ``maps`` of each pixel (n,)."""

    joint: dict[str, NDArray[Any]]
    maps: dict[str, NDArray[Any]]


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


def joint_maps(fit: JointFit, x: FloatArray | None, against: str, exposed: NDArray[np.bool_]) -> JointMaps:
    """Return all arrays of a joint fit.

    Args:
        fit: of n pixels and J samples.
        x: integration times (s) or light levels of the samples, shape (J,); None: no line.
        against: which of the two; a key of :data:`LINE_MAPS`.
        exposed: which samples hold electrons, shape (J,): the line is through these.
    """
    n_samples = exposed.size
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    joint: dict[str, NDArray[Any]] = {
        "quanta_exposure": fit.quanta_exposure,
        "quanta_exposure_stderr": errors[:, :n_samples],
        "mean": fit.mean,
        "variance": fit.variance,
        "covariance": fit.covariance,
        "log_likelihood": fit.log_likelihood,
        "likelihood_gap": fit.likelihood_gap,
        "fit_status": fit.fit_status,
        "n_iterations": fit.n_iterations,
        "goodness_chi2": fit.goodness_chi2,
        "goodness_dof": fit.goodness_dof,
        "goodness_p": fit.goodness_p,
        "outlier_share": fit.outlier_share,
    }
    maps: dict[str, NDArray[Any]] = {}
    for i, name in enumerate(SHARED_MAPS[:3]):
        maps[name], maps[f"{name}_stderr"] = getattr(fit, name), errors[:, n_samples + i]
    first = int(np.flatnonzero(exposed)[0])
    four = [first, n_samples, n_samples + 1, n_samples + 2]
    covariance = fit.covariance[:, four][:, :, four]
    maps |= derived_maps({name: maps[name] for name in SHARED_MAPS[:3]}, covariance, None)
    maps["quality"] = quality_map(fit.fit_status, fit.conversion_gain)
    if x is not None:
        _add_line(fit, x, against, exposed, joint, maps)
    return JointMaps(joint, maps)


def _add_line(
    fit: JointFit,
    x: FloatArray,
    against: str,
    exposed: NDArray[np.bool_],
    joint: dict[str, NDArray[Any]],
    maps: dict[str, NDArray[Any]],
) -> None:
    """Add slope, offset and residuals of the exposures."""
    use = np.flatnonzero(exposed)
    line = exposure_line(
        fit.quanta_exposure[:, use],
        fit.covariance[:, use][:, :, use],
        own_variance(fit.covariance)[:, use],
        x[use],
    )
    for i, (name, values) in enumerate(zip(LINE_MAPS[against], (line.slope, line.offset), strict=True)):
        maps[name], maps[f"{name}_stderr"] = values, np.sqrt(line.covariance[:, i, i])
    shape = fit.quanta_exposure.shape
    residuals = {"linearity_residual": line.residual, "linearity_residual_stderr": line.residual_stderr}
    for name, part in residuals.items():
        joint[name] = np.full(shape, np.nan)
        joint[name][:, use] = part
    joint["linearity_chi2"], joint["linearity_p"] = line.chi2, line.p
