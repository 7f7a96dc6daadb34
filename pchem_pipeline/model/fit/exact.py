"""The exact quantised likelihood of one sample: each component integrated over the cell of its code.

The density of the PCD at whole DN stands for the mass of a cell; that biases the estimates once a peak is
narrower than about a DN and a half. :func:`rounding_bias` says by how much, :func:`refine` fits with the
exact masses instead, for all pixels or where it matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.fit import rounding_numba
from pchem_pipeline.model.fit.grown import fit_grown
from pchem_pipeline.model.fit.joint import JointFit, fit_joint
from pchem_pipeline.model.fit.outliers import without_outliers
from pchem_pipeline.model.fit.pchem import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.sample_law import MarginalModel

__all__ = ["LARGEST_BIAS", "biased_by_rounding", "refine", "rounding_bias"]

FloatArray = NDArray[np.float64]

#: Standard errors by which rounding may bias the density's estimates before it is said (or mended).
LARGEST_BIAS = 0.05

# Peaks so wide are safe: the bias falls as sqrt(N) / sigma^4 (rounding differs from a normal law of variance
# 1/12 in the fourth cumulant), and is below 0.03 standard errors here.
_SAFE = 20.0
_COARSE = 3.0  # DN per electron, below which the starts of the density may miss the right maximum
_SAME_GAIN, _SAME_BIAS = 0.02, 0.3  # relative, and e-: maxima that lie no farther apart are one
_FIT_FAILED = FAILED & ~(FitStatus.NO_DATA | FitStatus.TOO_FEW_BINS)
_OF_DATA = FitStatus.ADC_LIMIT | FitStatus.OUTSIDE_WINDOW


def rounding_bias(parameters: Sequence[FloatArray], n_frames: NDArray[np.generic]) -> FloatArray:
    """Return the bias that rounding to whole DN gives to estimates from the density, in standard errors.

    To first order, ``I^-1 E[s]``: the score of the density under the exact masses, through the inverse of its
    information, at the parameters given.

    Args:
        parameters: (H, g, mu, sigma), each of shape (n,).
        n_frames: frames of each pixel, shape (n,).

    Returns:
        Bias of (H, g, mu, sigma) over their standard errors, shape (n, 4): signs as of (H, 1/g, mu, sigma);
        infinite where there is no answer.
    """
    columns = np.ascontiguousarray(np.stack([np.asarray(each, np.float64) for each in parameters], axis=1))
    out = np.full(columns.shape, np.inf)
    rounding_numba.rounding_tile(columns, np.ascontiguousarray(n_frames, np.float64), out)
    return out


def biased_by_rounding(parameters: Sequence[FloatArray], n_frames: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Tell in which pixels rounding biases the density's estimates by more than :data:`LARGEST_BIAS`.

    Args:
        parameters: (H, g, mu, sigma) estimated with the density, each (n,); NaN: not fitted, not counted.
        n_frames: frames of each pixel, shape (n,).
    """
    sigma, frames = np.asarray(parameters[3], np.float64), np.asarray(n_frames, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        suspects = np.flatnonzero(np.isfinite(sigma) & (np.sqrt(frames) > _SAFE * sigma**4))
    biased = np.zeros(sigma.shape, np.bool_)
    found = rounding_bias([np.asarray(each)[suspects] for each in parameters], frames[suspects])
    biased[suspects] = ~(np.abs(found).max(axis=1, initial=0.0) < LARGEST_BIAS)
    return biased


def refine(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    plain: FitResult,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None = None,
) -> FitResult:
    """Fit again with the exact likelihood where the settings ask for it.

    With ``exact`` in all pixels that have data; with ``auto`` where rounding biases the density's estimates
    by more than :data:`LARGEST_BIAS` standard errors or their fit failed; with ``density`` nowhere. Samples
    that the tail guard left out of the plain fit stay out.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        plain: fit of the same pixels with the density.
        settings: of the fit.
        adc_limits: first and last code of the ADC, DN: what lies beyond is counted there.
    """
    if settings.likelihood == "density":
        return plain
    estimates = np.stack([getattr(plain, name) for name in PARAMETERS], axis=1)
    counts = without_outliers(counts, origin, estimates, plain.outlier_share, settings)
    chosen = (plain.fit_status & int(FitStatus.NO_DATA | FitStatus.TOO_FEW_BINS)) == 0
    if settings.likelihood == "auto":
        parameters = [getattr(plain, name) for name in PARAMETERS]
        biased = biased_by_rounding(parameters, counts.sum(axis=1, dtype=np.float64))
        chosen = biased | ((plain.fit_status & int(_FIT_FAILED)) != 0)
    pixels = np.flatnonzero(chosen)
    if pixels.size == 0:
        return plain
    again = _exact(counts[pixels], origin[pixels], _of(plain, pixels), settings, adc_limits)
    return replace(_with(plain, again, pixels), outlier_share=plain.outlier_share)


def _exact(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    plain: FitResult,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> FitResult:
    """Fit all of these pixels with the exact masses; those at few DN per electron also from other starts."""
    low, high = adc_limits or (None, None)
    model = MarginalModel(clip_low=low, clip_high=high)
    grown = fit_grown(counts, origin, plain, model, settings, plain=plain)
    result = FitResult(**{each.name: getattr(grown, each.name) for each in fields(FitResult)})
    with np.errstate(invalid="ignore"):
        coarse = ~(result.conversion_gain < 1.0 / _COARSE)
    pixels = np.flatnonzero(coarse)
    if pixels.size == 0:
        return result
    exact = settings.model_copy(update={"likelihood": "exact", "tail_guard": 0.0})
    other = _single(fit_joint([counts[pixels]], [origin[pixels]], settings=exact, adc_limits=adc_limits))
    other.fit_status[:] |= plain.fit_status[pixels] & np.uint16(int(_OF_DATA))
    return _likelier(result, other, pixels, settings)


def _likelier(
    result: FitResult, other: FitResult, pixels: NDArray[np.intp], settings: FitSettings
) -> FitResult:
    """Keep the likelier of two fits of some pixels; where they lie apart, one limits the gap of the other."""
    mine = _of(result, pixels)
    with np.errstate(invalid="ignore"):
        rise = _height(other) - _height(mine)
        better = rise > 0
        step = np.abs(other.conversion_gain / mine.conversion_gain - 1.0) > _SAME_GAIN
        apart = step | (np.abs(other.bias - mine.bias) * mine.conversion_gain > _SAME_BIAS)
    kept = _with(mine, _of(other, np.flatnonzero(better)), np.flatnonzero(better))
    gap = np.where(apart, np.fmin(kept.likelihood_gap, np.abs(rise)), kept.likelihood_gap)
    kept.likelihood_gap[:] = gap
    kept.fit_status[gap < settings.gap_threshold] |= np.uint16(int(FitStatus.BIAS_AMBIGUOUS))
    return _with(result, kept, pixels)


def _height(result: FitResult) -> FloatArray:
    return np.where((result.fit_status & int(FAILED)) == 0, result.log_likelihood, -np.inf)


def _single(joint: JointFit) -> FitResult:
    """Return a joint fit of one sample as the fit of a single sample."""
    nothing: Any = np.zeros(joint.bias.size)
    values: dict[str, Any] = {each.name: getattr(joint, each.name, nothing) for each in fields(FitResult)}
    return FitResult(**{**values, "quanta_exposure": joint.quanta_exposure[:, 0].copy()})


def _of(result: FitResult, pixels: NDArray[np.intp]) -> FitResult:
    return FitResult(**{each.name: getattr(result, each.name)[pixels] for each in fields(FitResult)})


def _with(result: FitResult, part: FitResult, pixels: NDArray[np.intp]) -> FitResult:
    """Return the result with some of its pixels replaced."""
    arrays = {each.name: getattr(result, each.name).copy() for each in fields(FitResult)}
    for name, array in arrays.items():
        array[pixels] = getattr(part, name)
    return replace(result, **arrays)
