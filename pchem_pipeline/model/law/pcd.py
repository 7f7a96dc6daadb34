"""The photon counting distribution (PCD): density, thresholds, and the one nearest to an extended law.

A pixel reads ``X = round((K + R)/g + mu)`` with ``K`` Poisson of mean ``H`` and ``R`` normal of
standard deviation ``sigma_R`` (Hendrickson et al. 2023, eq. PCD_RV_definition). The PCD is the density that
treats the rounding as additive noise, ``sigma^2 = sigma_R^2/g^2 + 1/12`` (eq. X_density).

All arguments broadcast. Units: H and sigma_R in e-, g in e-/DN, mu, sigma and x in DN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.law.parameters import Parameters, columns_of
from pchem_pipeline.model.law.sample_law import SampleLaw


class PosteriorMeans(NamedTuple):
    """Means given a value x, with the residual ``e = x - mu - k/g``, and the density at it.

    Attributes:
        k, kk: E[k], E[k^2].
        e, ke, ee: E[e], E[k e], E[e^2], DN and DN^2.
        log_density: log f_X(x), nats of 1/DN.
    """

    k: FloatArray
    kk: FloatArray
    e: FloatArray
    ke: FloatArray
    ee: FloatArray
    log_density: FloatArray


def pcd_posterior(
    x: ArrayLike,
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    bias: ArrayLike,
    read_noise_dn: ArrayLike,
) -> PosteriorMeans:
    """Return the log density of the PCD, and what a value says of its electron number and its noise.

    Exact to rounding everywhere, also deep in the tails. Arguments as in :func:`log_pcd`; all answers are NaN
    where a parameter is NaN or not valid.
    """
    from pchem_pipeline.model.law.density_scores_numba import N_MEANS, fill_posterior  # a compiled loop

    arrays = np.broadcast_arrays(
        *[np.asarray(a, np.float64) for a in (x, quanta_exposure, conversion_gain, bias, read_noise_dn)]
    )
    values, *parameters = (a.ravel() for a in arrays)
    out = np.empty((N_MEANS + 1, values.size))
    fill_posterior(values, np.stack(parameters), out)
    return PosteriorMeans(*out.reshape(N_MEANS + 1, *arrays[0].shape))


def log_pcd(
    x: ArrayLike,
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    bias: ArrayLike,
    read_noise_dn: ArrayLike,
) -> FloatArray:
    """Return the log density of the PCD, eq. (X_density), with as many components as matter.

    Args:
        x: values, DN, any shape.
        quanta_exposure: H >= 0, e-.
        conversion_gain: g > 0, e-/DN.
        bias: mu, DN.
        read_noise_dn: sigma > 0, quantisation included, DN.

    Returns:
        log f_X(x), nats of 1/DN, of the broadcast shape; NaN where a parameter is NaN or not valid.
    """
    return pcd_posterior(x, quanta_exposure, conversion_gain, bias, read_noise_dn).log_density


def pcd(
    x: ArrayLike,
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    bias: ArrayLike,
    read_noise_dn: ArrayLike,
) -> FloatArray:
    """Return the density of the PCD, eq. (X_density), in 1/DN; arguments as in :func:`log_pcd`.

    Example:
        >>> float(round(pcd(0.0, 1.8, 1.0, 0.0, 0.33)[()], 4))
        0.2035
    """
    return np.asarray(np.exp(log_pcd(x, quanta_exposure, conversion_gain, bias, read_noise_dn)))


def thresholds(
    quanta_exposure: FloatArray | float,
    conversion_gain: FloatArray | float,
    bias: FloatArray | float,
    read_noise_dn: FloatArray | float,
    n_thresholds: int,
) -> FloatArray:
    """Return where the largest membership goes from k to k + 1 (Hendrickson et al. 2023, eq. demarg_K_eqn).

    ``t_k = mu + (k + 1/2)/g + g sigma^2 ln((k + 1)/H)``, DN, of the density, with k on the last axis, k <
    ``n_thresholds``; infinite where H = 0. Parameters as of :func:`log_pcd`.
    """
    exposure, gain, offset, sigma = (
        np.asarray(v, dtype=np.float64)[..., None]
        for v in (quanta_exposure, conversion_gain, bias, read_noise_dn)
    )
    k = np.arange(n_thresholds)
    with np.errstate(divide="ignore"):
        return np.asarray(offset + (k + 0.5) / gain + gain * sigma**2 * np.log((k + 1) / exposure))


def nearest_pcd(parameters: Parameters, model: SampleLaw) -> tuple[FloatArray, ...]:
    """Return (H, g, mu, sigma) of the PCD whose peaks lie and widen as the extended law's do near k = H.

    Unlike the fitted read noise it has the whole width of the peaks, that of the named effects included. Free
    satellites are levels beside the peaks, not part of their width. Each of the four is of shape (n,).
    """
    exposure, gain, bias, sigma = columns_of(parameters).T
    exposure = exposure + (model.added_weights * model.added_exposure).sum(axis=1)
    step, analog = 1.0 / gain, np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, 0.0))
    weights = model.satellite_weights
    shift = (
        step[:, None] * model.satellite_shift_e
        + model.satellite_shift_dn
        + model.satellite_shift_sigma * analog[:, None]
    )
    centre = (weights * shift).sum(axis=1)
    own = (weights * ((model.satellite_width * analog[:, None]) ** 2 + shift**2)).sum(axis=1) - centre**2
    charge = model.extra_variance_e2 + model.variance_per_electron * exposure
    charge = charge + model.variance_per_electron2 * exposure**2
    variance = own + step**2 * charge + model.extra_variance_dn2 + QUANTISATION_VARIANCE
    level = model.level_scale * exposure * (1.0 + 0.5 * model.curvature * (exposure - 1.0))
    slope = step * model.level_scale * (1.0 + model.curvature * (exposure - 0.5))
    middle = bias + step * (level + model.level_shift_e) + centre
    return exposure, 1.0 / slope, middle - slope * exposure, np.sqrt(variance)
