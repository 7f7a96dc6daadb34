"""Several exposures of the same pixels fitted jointly: one g, mu and sigma, an H for each exposure.

Multi-sample PCH-EM (Hendrickson and Haefner 2024). Where the read noise blurs the peaks of a single
exposure, the growth of the variance with the mean still tells the gain, and a sample without electrons (a
bias stack) the bias and the read noise; the joint likelihood uses all of that at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc

from pchem_pipeline.model.errors.fisher import cramer_rao
from pchem_pipeline.model.fit import joint_numba, joint_search_numba, polish_numba
from pchem_pipeline.model.fit.joint_guard import guarded, without_extremes
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.start import kernel_counts
from pchem_pipeline.model.fit.start_numba import regression_basis
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.grown_inputs import pack
from pchem_pipeline.model.law.grown_types_numba import N_LOBE_ROWS
from pchem_pipeline.model.law.sample_law import MarginalModel

__all__ = ["JointFit", "fit_joint", "joint_cramer_rao"]

FloatArray = NDArray[np.float64]

WARM_UP = 2  # EM steps before the first Newton step
_GUARD_ROUNDS = 3
_LOOSE = 0.1  # relative standard error of the gain beyond which the samples do not determine it
_COARSE_NOISE, _COARSE_STEP = 0.6, 2.5  # DN, DN per electron: as for one sample


@dataclass(frozen=True)
class JointFit:
    """Estimates of a batch of ``n`` pixels from J samples; failed pixels hold NaN and a reason.

    Attributes:
        quanta_exposure: H_j, e-, shape (n, J); 0 for samples without electrons.
        conversion_gain: g, e-/DN, shape (n,).
        bias: mu, DN, shape (n,).
        read_noise_dn: sigma, DN, quantisation included, shape (n,).
        covariance: of (H_1 ... H_J, g, mu, sigma), the inverse of the observed information (Louis 1982),
            shape (n, J + 3, J + 3); NaN for sigma at its lower bound, zeros for samples without electrons.
        mean: mean of each sample, DN, shape (n, J).
        variance: variance of each sample, DN^2, shape (n, J).
        log_likelihood: of all samples, nats, shape (n,).
        likelihood_gap: nats to the runner-up, shape (n,): the neighbours (all H_j -+ 1, mu +- 1/g), other
            maxima found, and Gaussians of one width, one at the mean of each sample (g to infinity).
        fit_status: bits of :class:`~pchem_pipeline.model.fit.status.FitStatus`, uint16, shape (n,).
            ``NOT_INFORMATIVE``: the standard error of g is above 10 %.
        n_iterations: evaluations of the joint likelihood, int32, shape (n,).
        goodness_chi2, goodness_dof, goodness_p: Pearson chi-square of all samples, its degrees of freedom,
            and the probability of a larger one, shape (n,).
        outlier_share: share of all frames that the tail guard left out, shape (n,).
    """

    quanta_exposure: FloatArray
    conversion_gain: FloatArray
    bias: FloatArray
    read_noise_dn: FloatArray
    covariance: FloatArray
    mean: FloatArray
    variance: FloatArray
    log_likelihood: FloatArray
    likelihood_gap: FloatArray
    fit_status: NDArray[np.uint16]
    n_iterations: NDArray[np.int32]
    goodness_chi2: FloatArray
    goodness_dof: NDArray[np.int32]
    goodness_p: FloatArray
    outlier_share: FloatArray


def fit_joint(
    counts: Sequence[NDArray[np.integer]],
    origins: Sequence[NDArray[np.integer]],
    *,
    dark: Sequence[bool] | None = None,
    settings: FitSettings | None = None,
    adc_limits: tuple[int, int] | None = None,
    outside: NDArray[np.integer] | None = None,
) -> JointFit:
    """Estimate g, mu and sigma of every pixel, and its H in every sample, by maximum likelihood.

    Starts from the samples' characteristic functions and from the line of variance against mean; EM steps
    with the sums of all samples, then damped Newton steps with the observed information; the neighbours (all
    H_j -+ 1, mu +- 1/g) are tried and the likeliest is kept. The answer for a pixel does not depend on the
    others in the batch.

    Args:
        counts: histograms of each sample, shape (n, B_j) each, any unsigned type.
        origins: DN of bin 0 of each sample, shape (n,) each.
        dark: which samples hold no electrons (H = 0 exactly); none by default.
        settings: how to fit; the defaults if None. ``likelihood: auto`` is taken as ``exact``.
        adc_limits: first and last code of the ADC, DN; pixels that reach them are flagged, and the exact
            likelihood counts what lies beyond there.
        outside: frames outside the histogram windows, all samples together, shape (n,); flagged.

    Raises:
        ValueError: if there is no sample, their shapes disagree, or none holds electrons.
    """
    settings = settings or FitSettings()
    dark = [False] * len(counts) if dark is None else list(dark)
    _check(counts, origins, dark)
    if settings.tail_guard == 0:
        found = _climb(counts, origins, dark, settings, adc_limits)
        share = np.zeros(found.words.shape[0])
    else:
        found, share = _climb_guarded(counts, origins, dark, settings, adc_limits)
    return _result(found, share, settings, adc_limits, outside)


class _Found(NamedTuple):
    """What the loops fill."""

    parameters: FloatArray
    covariance: FloatArray
    moments: FloatArray
    out: FloatArray
    words: NDArray[np.int64]


def _climb_guarded(
    counts: Sequence[NDArray[np.integer]],
    origins: Sequence[NDArray[np.integer]],
    dark: list[bool],
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> tuple[_Found, FloatArray]:
    """Fit without the samples that the fit does not expect; return also their share."""
    used: Sequence[NDArray[np.integer]] = without_extremes(counts)
    found = _climb(used, origins, dark, settings, adc_limits)
    share = np.zeros(found.words.shape[0])
    for _ in range(_GUARD_ROUNDS):
        kept, share = guarded(
            counts, origins, found.parameters, settings.tail_guard, settings.tail_guard_share
        )
        changed = np.zeros(share.size, np.bool_)
        for now, before in zip(kept, used, strict=True):
            changed |= (now != before).any(axis=1)
        pixels = np.flatnonzero(changed)
        if pixels.size == 0:
            break
        part = [sample[pixels] for sample in kept]
        again = _climb(part, [origin[pixels] for origin in origins], dark, settings, adc_limits)
        for mine, theirs in zip(found, again, strict=True):
            mine[pixels] = theirs
        used = kept
    return found, share


def _climb(
    counts: Sequence[NDArray[np.integer]],
    origins: Sequence[NDArray[np.integer]],
    dark: list[bool],
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> _Found:
    """Fit all samples as they are."""
    n, size = counts[0].shape[0], len(counts) + 3
    places = np.concatenate([[0], np.cumsum([sample.shape[1] for sample in counts])]).astype(np.int64)
    low, high = adc_limits or (None, None)
    found = _Found(
        np.full((n, size), np.nan),
        np.full((n, size, size), np.nan),
        np.full((n, len(counts), 2), np.nan),
        np.full((n, joint_search_numba.N_OUT), np.nan),
        np.zeros((n, joint_numba.N_WORDS), np.int64),
    )
    joint_numba.fit_joint_tile(
        kernel_counts(np.concatenate(counts, axis=1)),
        places,
        np.ascontiguousarray(np.stack(origins, axis=1), np.int64),
        np.array(dark, np.bool_),
        regression_basis(),
        _limits(settings),
        pack(MarginalModel(clip_low=low, clip_high=high), 1),
        np.empty((N_LOBE_ROWS, 1)),
        *found,
    )
    return found


def _check(
    counts: Sequence[NDArray[np.integer]], origins: Sequence[NDArray[np.integer]], dark: list[bool]
) -> None:
    if not counts or all(dark):
        raise ValueError("no sample holds electrons")
    if len(counts) != len(origins) or len(counts) != len(dark):
        raise ValueError("counts, origins and dark must have one entry for each sample")
    sizes = {sample.shape[0] for sample in counts} | {origin.size for origin in origins}
    if len(sizes) != 1:
        raise ValueError(f"the samples have different numbers of pixels: {sorted(sizes)}")


def _limits(settings: FitSettings) -> FloatArray:
    em = settings.algorithm == "em"
    limits = np.zeros(joint_search_numba.N_LIMITS)
    limits[polish_numba.MIN_LOG_EXPOSURE] = np.log(settings.minimum_quanta_exposure)
    limits[polish_numba.TOLERANCE] = settings.tolerance
    limits[polish_numba.WARM_UP] = WARM_UP
    limits[polish_numba.MAX_EVALUATIONS] = settings.em_max_iterations if em else settings.max_iterations
    limits[polish_numba.ONLY_EM] = em
    limits[joint_search_numba.GAP_THRESHOLD] = settings.gap_threshold
    limits[joint_search_numba.EXACT] = settings.likelihood != "density"
    return limits


def _result(
    found: _Found,
    outlier_share: FloatArray,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
    outside: NDArray[np.integer] | None,
) -> JointFit:
    """Add to the status what the loops do not know, and blank what failed."""
    parameters, covariance, moments, out, words = found
    n_samples = parameters.shape[1] - 3
    chi2, dof = out[:, joint_search_numba.CHI2], words[:, joint_numba.FREEDOM]
    probability = np.asarray(chdtrc(np.where(dof > 0, dof, np.nan), chi2))
    status = words[:, joint_numba.STATUS].copy()
    gain, sigma = parameters[:, n_samples], parameters[:, n_samples + 2]
    with np.errstate(invalid="ignore"):
        loose = np.sqrt(covariance[:, n_samples, n_samples]) > _LOOSE * gain
        coarse = (sigma < _COARSE_NOISE) | (gain > 1.0 / _COARSE_STEP)
        status[probability < settings.goodness_limit] |= FitStatus.POOR_FIT
    status[loose] |= FitStatus.NOT_INFORMATIVE
    if settings.likelihood == "density":
        status[coarse] |= FitStatus.COARSE_STEPS
    if outside is not None:
        status[np.asarray(outside).ravel() > 0] |= FitStatus.OUTSIDE_WINDOW
    if adc_limits is not None:
        low, high = words[:, joint_numba.LOWEST_DN], words[:, joint_numba.HIGHEST_DN]
        seen = (status & FitStatus.NO_DATA) == 0
        status[seen & ((low <= adc_limits[0]) | (high >= adc_limits[1]))] |= FitStatus.ADC_LIMIT
    failed = (status & FAILED) != 0
    parameters[failed] = np.nan
    covariance[failed] = np.nan
    return JointFit(
        quanta_exposure=np.ascontiguousarray(parameters[:, :n_samples]),
        conversion_gain=np.ascontiguousarray(gain),
        bias=np.ascontiguousarray(parameters[:, n_samples + 1]),
        read_noise_dn=np.ascontiguousarray(sigma),
        covariance=covariance,
        mean=np.ascontiguousarray(moments[:, :, 0]),
        variance=np.ascontiguousarray(moments[:, :, 1]),
        log_likelihood=out[:, joint_search_numba.LOG_LIKELIHOOD].copy(),
        likelihood_gap=out[:, joint_search_numba.GAP].copy(),
        fit_status=status.astype(np.uint16),
        n_iterations=words[:, joint_numba.EVALUATIONS].astype(np.int32),
        goodness_chi2=chi2.copy(),
        goodness_dof=dof.astype(np.int32),
        goodness_p=probability,
        outlier_share=outlier_share,
    )


def joint_cramer_rao(
    quanta_exposure: ArrayLike, conversion_gain: float, read_noise_dn: float, n_frames: ArrayLike
) -> FloatArray:
    """Return the smallest covariance of unbiased estimates of (H_1 ... H_J, g, mu, sigma) from J samples.

    The information of independent samples adds up; that of each is the inverse of
    :func:`~pchem_pipeline.model.errors.fisher.cramer_rao`.

    Args:
        quanta_exposure: H_j, e-, shape (J,); 0: a sample without electrons, H not estimated.
        conversion_gain: g, e-/DN.
        read_noise_dn: sigma, DN.
        n_frames: N_j, shape (J,) or one for all.

    Returns:
        Covariance, shape (J + 3, J + 3); zeros in the rows and columns of samples without electrons.
    """
    exposures = np.asarray(quanta_exposure, np.float64)
    frames = np.broadcast_to(np.asarray(n_frames, np.float64), exposures.shape)
    size = exposures.size + 3
    information = np.zeros((size, size))
    for j, (exposure, n) in enumerate(zip(exposures, frames, strict=True)):
        if exposure > 0:
            place = [j, *range(size - 3, size)]
            own = cramer_rao(exposure, conversion_gain, read_noise_dn, 1.0)
            information[np.ix_(place, place)] += n * np.linalg.inv(own)
        else:
            information[size - 2, size - 2] += n / read_noise_dn**2
            information[size - 1, size - 1] += 2.0 * n / read_noise_dn**2
    free = [*np.flatnonzero(exposures > 0), *range(size - 3, size)]
    bound = np.zeros((size, size))
    bound[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    return bound
