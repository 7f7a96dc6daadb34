"""Fit of pixels beside codes that are set aside: what the model does not describe there bends nothing.

The likelihood is conditional on the other codes (a truncated sample, Fisher 1931), so the number of samples
in the codes set aside does not matter either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pchem_pipeline.model.fit.goodness_numba import pearson
from pchem_pipeline.model.fit.pchem import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.shared import SharedFit, SharedProblem, fit_shared
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.sample_law import MarginalModel

__all__ = ["Interval", "electrons_of", "fit_beside", "inside"]

FloatArray = NDArray[np.float64]
#: Limits on a pixel's comb, e-; None: no limit.
Interval = tuple[float | None, float | None]

_FEWEST_CODES = 5


def electrons_of(origin: NDArray[np.integer], width: int, gain: FloatArray, bias: FloatArray) -> FloatArray:
    """Return the place ``(x - mu) g`` of every code on its pixel's comb, e-, shape (n, width)."""
    codes = np.asarray(origin, np.int64)[:, None] + np.arange(width)
    return np.asarray((codes - bias[:, None]) * gain[:, None])


def inside(intervals: Sequence[Interval], electrons: FloatArray) -> NDArray[np.bool_]:
    """Tell which places on the comb lie in one of the intervals."""
    found = np.zeros(electrons.shape, np.bool_)
    for low, high in intervals:
        within = np.ones(electrons.shape, np.bool_)
        if low is not None:
            within &= electrons >= low
        if high is not None:
            within &= electrons < high
        found |= within
    return found


def fit_beside(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    plain: FitResult,
    grown: FitResult,
    law: Callable[[FloatArray], MarginalModel],
    intervals: Sequence[Interval],
    settings: FitSettings | None = None,
) -> FitResult:
    """Estimate (H, g, mu, sigma) of every pixel from the codes that are not set aside.

    The answer for a pixel does not depend on the others in the batch.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        plain: plain fit; its comb says which codes are set aside.
        grown: fit to all codes, which this one starts from and whose other entries it keeps.
        law: from (H, g, mu, sigma), shape (n, 4), to the law of these pixels.
        intervals: codes set aside, e-.
        settings: how to fit; the defaults if None.
    """
    settings = settings or FitSettings()
    names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
    start = np.stack([np.asarray(getattr(plain, name), np.float64) for name in names], axis=1)
    fitted = np.isfinite(start).all(axis=1) & ((plain.fit_status & int(FAILED)) == 0)
    place = electrons_of(origin, counts.shape[1], plain.conversion_gain, plain.bias)
    kept = np.isfinite(place) & ~inside(intervals, place)
    fitted &= (np.where(kept, counts, 0) > 0).sum(axis=1) >= _FEWEST_CODES
    rows = np.flatnonzero(fitted)
    if not rows.size:
        return grown
    problem = SharedProblem(
        np.asarray(counts[rows], np.int64),
        np.asarray(origin, np.int64)[rows],
        kept[rows],
        lambda shared, own: law(own),
        np.zeros((0, 2)),
        np.zeros(0),
    )
    fit = fit_shared(
        problem, start[rows], np.zeros(0), max_steps=settings.max_iterations, tolerance=settings.tolerance
    )
    return _merged(grown, problem, fit, rows, settings)


def _merged(
    grown: FitResult, problem: SharedProblem, fit: SharedFit, rows: NDArray[np.intp], settings: FitSettings
) -> FitResult:
    """Put the estimates of some rows into a result."""
    values = {
        name: getattr(grown, name).copy()
        for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "covariance",
                     "log_likelihood", "fit_status", "goodness_chi2", "goodness_dof", "goodness_p")
    }  # fmt: skip
    for index, name in enumerate(("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")):
        values[name][rows] = fit.parameters[:, index]
    h, g, _, sigma = fit.parameters.T
    slopes = np.stack([h, -g, np.ones_like(h), 0.5 * np.exp(fit.theta[:, 3]) / sigma], axis=1)
    values["covariance"][rows] = fit.own_covariance * slopes[:, :, None] * slopes[:, None, :]
    values["log_likelihood"][rows] = fit.log_likelihood
    log_masses = problem.log_masses(fit.theta, fit.shared)
    for row, pixel in enumerate(rows):
        use = problem.kept[row]
        seen = problem.counts[row, use].astype(np.float64)
        chi2, dof = pearson(seen, seen.sum() * np.exp(log_masses[row, use]), seen.size, float(seen.sum()))
        values["goodness_chi2"][pixel], values["goodness_dof"][pixel] = chi2, dof
        probability = float(chdtrc(dof, chi2)) if dof > 0 else np.nan
        values["goodness_p"][pixel] = probability
        word = int(values["fit_status"][pixel]) & ~int(FitStatus.POOR_FIT)
        poor = probability < settings.goodness_limit
        values["fit_status"][pixel] = word | (int(FitStatus.POOR_FIT) if poor else 0)
    return replace(grown, **values)
