"""PCH-EM on a batch of pixel histograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scipy.special import chdtrc

from pchem_pipeline.model import pchem_numba, polish_numba
from pchem_pipeline.model.fit_status import FAILED, FitStatus
from pchem_pipeline.model.settings import FitSettings
from pchem_pipeline.model.start_numba import regression_basis

__all__ = ["FitResult", "fit_histograms"]

WARM_UP = 1  # EM steps before the first Newton step


@dataclass(frozen=True)
class FitResult:
    """Estimates of a batch of ``n`` pixels; failed pixels hold NaN and a reason in ``fit_status``.

    Attributes:
        quanta_exposure: H, e-, shape (n,).
        conversion_gain: g, e-/DN, shape (n,).
        bias: mu, DN, shape (n,).
        read_noise_dn: sigma, DN, quantisation included, shape (n,).
        covariance: of (H, g, mu, sigma), shape (n, 4, 4).
        log_likelihood: nats, shape (n,).
        likelihood_gap: nats above the runner-up, shape (n,).
        fit_status: bits of :class:`~pchem_pipeline.model.fit_status.FitStatus`, uint16, shape (n,).
        n_iterations: evaluations of the likelihood, int32, shape (n,).
        goodness_chi2: Pearson chi-square, shape (n,).
        goodness_dof: degrees of freedom, int32, shape (n,).
        goodness_p: probability of a larger chi-square, shape (n,).
    """

    quanta_exposure: NDArray[np.float64]
    conversion_gain: NDArray[np.float64]
    bias: NDArray[np.float64]
    read_noise_dn: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    likelihood_gap: NDArray[np.float64]
    fit_status: NDArray[np.uint16]
    n_iterations: NDArray[np.int32]
    goodness_chi2: NDArray[np.float64]
    goodness_dof: NDArray[np.int32]
    goodness_p: NDArray[np.float64]


def fit_histograms(
    counts: NDArray[np.unsignedinteger],
    origin: NDArray[np.integer],
    under: NDArray[np.integer] | None = None,
    over: NDArray[np.integer] | None = None,
    *,
    settings: FitSettings | None = None,
    adc_limits: tuple[int, int] | None = None,
) -> FitResult:
    """Estimate (H, g, mu, sigma) of every pixel from its histogram."""
    settings = settings or FitSettings()
    counts = np.ascontiguousarray(counts)
    n = counts.shape[0]
    parameters, covariance = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    out, words = np.full((n, pchem_numba.N_OUT), np.nan), np.zeros((n, pchem_numba.N_WORDS), np.int64)
    pchem_numba.fit_tile(
        counts, np.asarray(origin, np.int64), regression_basis(), _limits(settings), parameters, covariance, out, words
    )
    dof = words[:, pchem_numba.FREEDOM]
    probability = chdtrc(np.where(dof > 0, dof, np.nan), out[:, pchem_numba.CHI2])
    status = words[:, pchem_numba.STATUS]
    status[probability < settings.goodness_limit] |= FitStatus.POOR_FIT
    for outside in (under, over):
        if outside is not None:
            status[np.asarray(outside) > 0] |= FitStatus.OUTSIDE_WINDOW
    if adc_limits is not None:
        status[(words[:, pchem_numba.LOWEST_DN] <= adc_limits[0]) | (words[:, pchem_numba.HIGHEST_DN] >= adc_limits[1])] |= FitStatus.ADC_LIMIT
    failed = (status & FAILED) != 0
    parameters[failed] = np.nan
    covariance[failed] = np.nan
    return FitResult(
        quanta_exposure=parameters[:, 0].copy(),
        conversion_gain=parameters[:, 1].copy(),
        bias=parameters[:, 2].copy(),
        read_noise_dn=parameters[:, 3].copy(),
        covariance=covariance,
        log_likelihood=out[:, pchem_numba.LOG_LIKELIHOOD].copy(),
        likelihood_gap=out[:, pchem_numba.GAP].copy(),
        fit_status=status.astype(np.uint16),
        n_iterations=words[:, pchem_numba.EVALUATIONS].astype(np.int32),
        goodness_chi2=out[:, pchem_numba.CHI2].copy(),
        goodness_dof=dof.astype(np.int32),
        goodness_p=probability,
    )


def _limits(settings: FitSettings) -> NDArray[np.float64]:
    em = settings.algorithm == "em"
    limits = np.zeros(pchem_numba.N_LIMITS)
    limits[polish_numba.MIN_LOG_EXPOSURE] = np.log(settings.minimum_quanta_exposure)
    limits[polish_numba.TOLERANCE] = settings.tolerance
    limits[polish_numba.WARM_UP] = WARM_UP
    limits[polish_numba.MAX_EVALUATIONS] = settings.em_max_iterations if em else settings.max_iterations
    limits[pchem_numba.GAP_THRESHOLD] = settings.gap_threshold
    limits[pchem_numba.NOISE_LIMIT] = settings.read_noise_limit
    limits[polish_numba.ONLY_EM] = em
    return limits
