"""PCH-EM on a batch of pixel histograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.settings import FitSettings

__all__ = ["FitResult", "fit_histograms"]


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
    raise NotImplementedError
