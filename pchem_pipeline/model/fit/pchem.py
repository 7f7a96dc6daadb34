"""PCH-EM on a batch of pixel histograms: maximum likelihood, standard errors, a word on every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc

from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.errors.fisher import sandwich_covariance
from pchem_pipeline.model.fit import fit_tile_numba, pchem_numba, polish_numba
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.start import kernel_counts
from pchem_pipeline.model.fit.start_numba import regression_basis
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law import workspace_numba

__all__ = ["EmTrace", "FitResult", "em_trace", "fit_histograms"]

WARM_UP = 0  # EM steps before the first Newton step: the start is good enough without

# Frames and degrees of freedom below which it matters that merging bins for the chi-square test hides part of
# what the parameters know: it is half a degree of freedom or so.
_FEW_FRAMES, _FEW_GROUPS = 5000, 40


@dataclass(frozen=True)
class FitResult:
    """Estimates of a batch of ``n`` pixels; failed pixels hold NaN and a reason in ``fit_status``.

    Attributes:
        quanta_exposure: H, e-, shape (n,).
        conversion_gain: g, e-/DN, shape (n,).
        bias: mu, DN, shape (n,).
        read_noise_dn: sigma, DN, quantisation included, shape (n,).
        covariance: of (H, g, mu, sigma), the inverse of the observed information (Louis 1982), or the
            sandwich (White 1982), shape (n, 4, 4); NaN in the row and column of a parameter at its bound.
        log_likelihood: ``sum_i c_i log f_X(x_i)``, nats, shape (n,).
        likelihood_gap: nats between the likelihood kept and the runner-up, shape (n,). Runners-up are the
            maxima reached from the neighbours (H -+ 1, mu +- 1/g), the other maxima found, and the best
            single Gaussian (g to infinity). A gap below 30 is exact: the runner-up was polished to its
            maximum. A larger one says that the neighbour was given up when, by the quadratic through it,
            twice its expected rise would have left it more than 30 below; its height is then taken from that
            quadratic. Where the fit is good, 1/g above 5 DN, and the neighbour expected to be more than 80
            below (four gap thresholds if that is more), it is not visited: its height is the one expected.
            Negative only with a reason in ``fit_status``: one Gaussian, or a climb that did not converge,
            stands higher.
        fit_status: bits of :class:`~pchem_pipeline.model.fit.status.FitStatus`, uint16, shape (n,).
        n_iterations: evaluations of the likelihood, all starts and neighbours together, int32, shape (n,).
        goodness_chi2: Pearson chi-square, adjacent DN merged until 5 counts are expected, shape (n,).
        goodness_dof: its degrees of freedom, groups - 5, shape (n,); 0 if there are none. With few frames
            more, up to groups - 1: as far as the groups do not determine the four fitted parameters
            (Chernoff and Lehmann 1954).
        goodness_p: probability of a larger chi-square, shape (n,); NaN without degrees of freedom.
        outlier_share: share of the samples that the tail guard left out of the likelihood, shape (n,).
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
    goodness_dof: NDArray[np.float64]
    goodness_p: NDArray[np.float64]
    outlier_share: NDArray[np.float64]


class EmTrace(NamedTuple):
    """Iterates of plain EM.

    Attributes:
        log_likelihood: nats, shape (iterations + 1,); it never falls.
        parameters: (H, g, mu, sigma), shape (iterations + 1, 4).
    """

    log_likelihood: NDArray[np.float64]
    parameters: NDArray[np.float64]


def fit_histograms(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    under: NDArray[np.integer] | None = None,
    over: NDArray[np.integer] | None = None,
    *,
    settings: FitSettings | None = None,
    adc_limits: tuple[int, int] | None = None,
    start: NDArray[np.float64] | None = None,
) -> FitResult:
    """Estimate (H, g, mu, sigma) of every pixel from its histogram by maximum likelihood.

    The likelihood is that of the PCD at whole DN (Hendrickson et al. 2023, eq. X_density). A start from the
    empirical characteristic function is improved by damped Newton steps with Louis' observed information, by
    EM steps, eqs. (update_eqns) to (gamma_nk), where that does not help (``algorithm: em``: by EM steps
    alone), until the expected rise is below the tolerance. The neighbours (H -+ 1, mu +- 1/g) are tried,
    unless a good fit leaves them no chance, and the likeliest is kept; a pixel whose goodness of fit or read
    noise raises suspicion gets other starts. No pixel raises: what cannot be fitted holds NaN and a reason.
    The answer for a pixel does not depend on the others in the batch.

    Samples that the model does not expect at all are left out (setting ``tail_guard``): a few outliers move
    nothing, and a pixel without any has the very estimates that it would have without the guard.

    Args:
        counts: histograms, shape (n, B), any unsigned type.
        origin: DN of bin 0, shape (n,).
        under: frames below bin 0, shape (n,); such pixels are fitted inside the window and flagged.
        over: frames above the last bin, shape (n,).
        settings: how to fit; the defaults if None.
        adc_limits: first and last code of the ADC, DN; pixels that reach them are flagged.
        start: (H, g, mu, sigma) known to be near the answer, shape (n, 4), NaN where nothing is known. The
            maximum next to it is taken where it fits well, without a look at its neighbours: the bias is not
            tested for ambiguity, and the likelihood gap is that to one Gaussian.

    Returns:
        Estimates, covariances and a status word per pixel.
    """
    settings = settings or FitSettings()
    counts = kernel_counts(counts)
    n = counts.shape[0]
    parameters, covariance = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    out = np.full((n, pchem_numba.N_OUT), np.nan)
    words = np.zeros((n, pchem_numba.N_WORDS), np.int64)
    first = np.ascontiguousarray(origin, np.int64)
    fit_tile_numba.fit_tile(
        counts,
        first,
        regression_basis(),
        _limits(settings),
        np.empty((0, 4)) if start is None else np.ascontiguousarray(start, np.float64),
        parameters,
        covariance,
        out,
        words,
    )
    frames = words[:, pchem_numba.FRAMES].astype(np.float64)
    outliers = np.nan_to_num(out[:, pchem_numba.OUTLYING])
    chi2, dof = out[:, pchem_numba.CHI2], _freedom(words, frames - outliers, parameters, covariance)
    probability = np.asarray(chdtrc(np.where(dof > 0, dof, np.nan), chi2))
    status = _status(words, probability, under, over, settings, adc_limits)
    failed = (status & FAILED) != 0
    parameters[failed] = np.nan
    covariance[failed] = np.nan
    if settings.errors == "sandwich":
        covariance = sandwich_covariance(counts, first, parameters, covariance, settings.tail_guard)
    exposure, gain, bias, sigma = np.ascontiguousarray(parameters.T)
    return FitResult(
        quanta_exposure=exposure,
        conversion_gain=gain,
        bias=bias,
        read_noise_dn=sigma,
        covariance=covariance,
        log_likelihood=out[:, pchem_numba.LOG_LIKELIHOOD].copy(),
        likelihood_gap=out[:, pchem_numba.GAP].copy(),
        fit_status=status.astype(np.uint16),
        n_iterations=words[:, pchem_numba.EVALUATIONS].astype(np.int32),
        goodness_chi2=chi2.copy(),
        goodness_dof=dof,
        goodness_p=probability,
        outlier_share=outliers / np.maximum(frames, 1.0),
    )


def _freedom(
    words: NDArray[np.int64],
    frames: NDArray[np.float64],
    parameters: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the degrees of freedom of chi-square, those that merged bins leave to it included.

    The estimates know every DN, the test only the groups: of the four parameters it loses as many as the
    groups determine (Chernoff and Lehmann 1954). Many frames leave few DN merged, and that is all four.
    """
    freedom = words[:, pchem_numba.FREEDOM].astype(np.float64)
    few = np.flatnonzero((freedom > 0) & (freedom < _FEW_GROUPS) & (frames < _FEW_FRAMES))
    if few.size:
        known = np.empty(few.size)
        ends = (words[few, pchem_numba.LOWEST_DN], words[few, pchem_numba.HIGHEST_DN])
        information_numba.grouped_trace(*ends, frames[few], parameters[few], covariance[few], known)
        freedom[few] += 4.0 - np.clip(np.nan_to_num(known, nan=4.0), 0.0, 4.0)
    return freedom


def _status(
    words: NDArray[np.int64],
    probability: NDArray[np.float64],
    under: NDArray[np.integer] | None,
    over: NDArray[np.integer] | None,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> NDArray[np.int64]:
    """Add to the status words what the loop over the pixels does not know."""
    status = words[:, pchem_numba.STATUS].copy()
    status[probability < settings.goodness_limit] |= FitStatus.POOR_FIT
    for outside in (under, over):
        if outside is not None:
            status[np.asarray(outside).ravel() > 0] |= FitStatus.OUTSIDE_WINDOW
    if adc_limits is not None:
        low, high = words[:, pchem_numba.LOWEST_DN], words[:, pchem_numba.HIGHEST_DN]
        seen = (status & FitStatus.NO_DATA) == 0
        status[seen & ((low <= adc_limits[0]) | (high >= adc_limits[1]))] |= FitStatus.ADC_LIMIT
    return status


def _limits(settings: FitSettings) -> NDArray[np.float64]:
    """Pack the settings for the loops."""
    em = settings.algorithm == "em"
    limits = np.zeros(pchem_numba.N_LIMITS)
    limits[polish_numba.MIN_LOG_EXPOSURE] = np.log(settings.minimum_quanta_exposure)
    limits[polish_numba.TOLERANCE] = settings.tolerance
    limits[polish_numba.WARM_UP] = WARM_UP
    limits[polish_numba.MAX_EVALUATIONS] = settings.em_max_iterations if em else settings.max_iterations
    limits[polish_numba.ONLY_EM] = em
    limits[pchem_numba.GAP_THRESHOLD] = settings.gap_threshold
    limits[pchem_numba.NOISE_LIMIT] = settings.read_noise_limit
    limits[pchem_numba.FLOOR] = settings.tail_guard
    limits[pchem_numba.MOST_OUTLIERS] = settings.tail_guard_share
    return limits


def em_trace(counts: NDArray[np.integer], origin: int, start: ArrayLike, n_iterations: int) -> EmTrace:
    """Return the iterates of plain EM on one histogram.

    Hendrickson et al. 2023, eqs. (update_eqns) to (gamma_nk).

    Args:
        counts: histogram of one pixel with at least 3 occupied bins, shape (B,).
        origin: DN of bin 0.
        start: (H, g, mu, sigma); sigma at least 1/sqrt(12) DN.
        n_iterations: EM steps to take.

    Returns:
        Log-likelihood and parameters at the start and after every step.
    """
    counts = kernel_counts(counts)
    weights, cumulative = np.empty(counts.size), np.empty(counts.size + 1)
    histogram, centre, _ = workspace_numba.load(counts, weights, cumulative)
    exposure, gain, bias, sigma = (float(value) for value in np.asarray(start, np.float64))
    middle = float(origin + centre)
    theta = np.array([np.log(exposure), 1.0 / gain, bias - middle, 2.0 * np.log(sigma)])
    path, logliks = np.empty((n_iterations + 1, 4)), np.empty(n_iterations + 1)
    polish_numba.em_path(histogram, theta, -np.inf, path, logliks)
    natural = np.stack(
        [np.exp(path[:, 0]), 1.0 / path[:, 1], middle + path[:, 2], np.exp(0.5 * path[:, 3])], axis=1
    )
    return EmTrace(logliks, natural)
