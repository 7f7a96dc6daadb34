"""The curves of the ensemble and their agreement with the data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pchem_pipeline.base.arrays import FloatArray, IntegerArray
from pchem_pipeline.model.ensemble.components import component_widths
from pchem_pipeline.model.ensemble.ensemble import MODEL_ERRORS, EnsembleTotals, electron_pmf
from pchem_pipeline.model.ensemble.ensemble_binned import (
    electron_pmf_binned,
    epcd_dependent,
    epcd_independent,
    nuced_dependent,
    nuced_independent,
    within_limits,
)
from pchem_pipeline.model.ensemble.settings import EnsembleSettings
from pchem_pipeline.model.law.parameters import UsablePixels

#: Components are shown up to the electron number whose mass is above this.
_SMALLEST_COMPONENT = 1e-4
_WAYS = ("exact", "dependent", "independent")

Arrays = dict[str, NDArray[Any]]


def curves(
    totals: EnsembleTotals,
    pixels: UsablePixels,
    settings: EnsembleSettings,
    limits: tuple[int, int] | None = None,
) -> tuple[Arrays, dict[str, Any]]:
    """Return the densities, raw and NUCed, and how well they agree with the data.

    As arrays of the group ``ensemble``, and numbers for its attributes. The pixels are all with a value; the
    first and last code, DN, show what is beyond these limits; None: no samples there.
    """
    axes, bins = totals.axes, settings.parameter_bins
    width = axes.nuced.width
    variance, nuced_variance = totals.variance("pcd_variance"), totals.variance("nuced_variance") / width**2
    arrays: Arrays = {
        "dn": axes.dn.dn.astype(np.int32),
        "counts": totals.counts("counts"),
        "counts_all": totals.counts("counts_all"),
        "density": totals.mean("share"),
        "density_all": totals.mean("share_all"),
        "epcd_exact": totals.mean("pcd"),
        "epcd_dependent": within_limits(epcd_dependent, pixels, axes.dn, bins, limits),
        "epcd_independent": within_limits(epcd_independent, pixels, axes.dn, bins, limits),
        "electrons": axes.nuced.electrons,
        "nuced_counts": totals.counts("nuced_counts"),
        "nuced_density": totals.mean("nuced_share") / width,
        "nuced_exact": totals.mean("nuced") / width,
        "nuced_dependent": nuced_dependent(pixels, axes.nuced, bins),
        "nuced_independent": nuced_independent(pixels, axes.nuced, bins),
    }
    errors = [np.sqrt(totals.variance(name)) for name in MODEL_ERRORS]
    if any(each.any() for each in errors):
        arrays["epcd_stderr"], arrays["nuced_stderr"] = errors[0], errors[1] / width
    for prefix, noise in (("", variance), ("nuced_", nuced_variance)):
        exact = arrays[f"{prefix or 'epcd_'}exact"]
        arrays[f"{prefix}residual"] = normalised_residuals(arrays[f"{prefix}density"], exact, noise)
    facts = _agreement(arrays, variance, nuced_variance, totals)
    facts |= {
        "nuced_bin_width": width,
        "samples_beyond_dn": totals.count("outside"),
        "samples_beyond_dn_all_frames": totals.count("outside_all"),
        "samples_beyond_electrons": totals.count("nuced_outside"),
    }
    return arrays, facts


def _agreement(
    arrays: Mapping[str, NDArray[Any]],
    variance: FloatArray,
    nuced_variance: FloatArray,
    totals: EnsembleTotals,
) -> dict[str, Any]:
    """Return RMSEs, their noise floors, chi-square, and the windows they were taken over."""
    found: dict[str, float] = {}
    model_error: dict[str, float] = {}
    fits: dict[str, Any] = {}
    windows = [central_window(arrays[name]) for name in ("counts", "nuced_counts")]
    for prefix, noise, window in zip(("", "nuced_"), (variance, nuced_variance), windows, strict=True):
        curve, data = prefix or "epcd_", arrays[f"{prefix}density"]
        found |= {f"{curve}{way}": rmse(data, arrays[f"{curve}{way}"], window) for way in _WAYS}
        found[f"{prefix}noise_floor"] = noise_floor(noise, window)
        if f"{curve}stderr" in arrays:
            model_error[curve.rstrip("_")] = noise_floor(arrays[f"{curve}stderr"] ** 2, window)
        counts = arrays[f"{prefix}counts"]
        fits[f"{prefix}chi_square"] = chi_square(data, arrays[f"{curve}exact"], noise, counts)
    (n, n_all), all_data = totals.samples, arrays["density_all"]
    found_all = {f"epcd_{way}": rmse(all_data, arrays[f"epcd_{way}"], windows[0]) for way in _WAYS}
    found_all["noise_floor"] = found["noise_floor"] * math.sqrt(n / n_all)
    ends = [[window.start, window.stop - 1] for window in windows]
    return {
        "rmse": found,
        "rmse_all_frames": found_all,
        "model_error": model_error,
        **fits,
        "rmse_window_dn": [int(arrays["dn"][i]) for i in ends[0]],
        "rmse_window_electrons": [float(arrays["electrons"][i]) for i in ends[1]],
    }


def central_window(counts: IntegerArray) -> slice:
    """Return the bins that hold the central 99.9 % of the counts, shape (n,), which are not all zero.

    A few hot pixels stretch the axis over thousands of empty bins; an RMSE over all of them would shrink with
    the length of the axis.
    """
    cumulative = np.cumsum(counts)
    tail = 0.0005 * cumulative[-1]
    first = int(np.searchsorted(cumulative, tail, side="right"))
    last = int(np.searchsorted(cumulative, cumulative[-1] - tail, side="left"))
    return slice(first, max(last, first) + 1)


def rmse(data: FloatArray, model: FloatArray, window: slice = slice(None)) -> float:
    """Return the root mean square difference between two densities, (n,), in their unit."""
    return math.sqrt(float(np.mean((data[window] - model[window]) ** 2)))


def noise_floor(variance: FloatArray, window: slice = slice(None)) -> float:
    """Return the RMSE that counting alone causes, from the variance of the density of each bin, (n,)."""
    return math.sqrt(float(np.mean(variance[window])))


def normalised_residuals(data: FloatArray, model: FloatArray, variance: FloatArray) -> FloatArray:
    """Return ``(data - model) / sqrt(variance)``; NaN where the variance is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0, (data - model) / np.sqrt(variance), np.nan)


def chi_square(
    data: FloatArray, model: FloatArray, variance: FloatArray, counts: IntegerArray
) -> dict[str, float]:
    """Return Pearson's chi-square of an ensemble histogram with the binomial variance of its pixels.

    Over those of the n bins with at least 10 samples. The bins of one pixel are slightly anticorrelated, so
    the sum is not exactly chi-square; with many bins the difference is small. As ``value``, the number of
    bins ``dof``, and ``p``, the probability of a larger one if the model holds; NaN without bins.
    """
    use = (counts >= 10) & (variance > 0)
    value, dof = float(np.sum((data[use] - model[use]) ** 2 / variance[use])), int(use.sum())
    return {"value": value, "dof": dof, "p": float(chdtrc(dof, value)) if dof else math.nan}


def electron_numbers(
    totals: EnsembleTotals, pixels: UsablePixels, settings: EnsembleSettings
) -> tuple[Arrays, dict[str, Any]]:
    """Return the electron numbers, observed and predicted, and how often they should be wrong.

    Arguments and results as of :func:`curves`.
    """
    n_k = totals.axes.n_k
    arrays: Arrays = {
        "k": np.arange(n_k, dtype=np.int32),
        "electron_counts": totals.counts("electron_counts"),
        "electron_mass": totals.mean("electron_share"),
        "electron_pmf": electron_pmf(pixels.quanta_exposure, n_k),
        "electron_pmf_binned": electron_pmf_binned(pixels.quanta_exposure, n_k, settings.parameter_bins),
        "electron_pmf_map": totals.mean("electron_expected"),
    }
    mass = arrays["electron_pmf_map"]
    n_samples = max(int(arrays["electron_counts"].sum()), 1)
    errors = {
        name: rmse(arrays["electron_mass"], arrays[f"electron_{name}"])
        for name in ("pmf", "pmf_binned", "pmf_map")
    }
    return arrays, {
        "expected_error_rate": float(totals.mean("error")[0]),
        "electrons_beyond": totals.count("electrons_beyond"),
        "electron_rmse": errors | {"noise_floor": noise_floor(mass * (1.0 - mass) / n_samples)},
    }


def components(pixels: UsablePixels, mass: FloatArray, weight: FloatArray) -> Arrays:
    """Return means and widths of the components (Appendix B) whose electron numbers have enough mass, (n_k,).

    The pixels are all with a value, weighted as :func:`bias_weight` says.
    """
    shown = max(2, int(np.flatnonzero(mass >= _SMALLEST_COMPONENT)[-1]) + 1)
    return component_widths(pixels, min(shown, mass.size), weight)
