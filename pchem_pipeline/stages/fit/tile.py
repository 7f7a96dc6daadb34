"""The fit of a tile under the model of a run, whether it was given one sample of its pixels or several.

Several share one g, mu and sigma for each pixel, with an H for each exposure: the group ``fit`` holds the
shared parameters with H of the shown sample, as a run of one sample has them; the group ``samples`` what each
exposure has of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray
from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, PARAMETERS, interval_names, variables_of
from pchem_pipeline.effects.framework.compose import AddedExposure, PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.errors.expected_information import correlations
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.guard import Interval
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import AMBIGUOUS, FAILED
from pchem_pipeline.model.law.sample_law import SampleLaw


@dataclass(frozen=True)
class TileFit:
    """How the pixels of a tile are fitted."""

    settings: FitSettings = field(default_factory=FitSettings)
    adc_limits: tuple[int, int] | None = None  # first and last code of the ADC, DN; None: not known
    effects: Sequence[Effect] = ()  # of the run's model; the plain fit is where that under their law starts
    set_aside: Sequence[Interval] = ()  # codes that are left out, e- on the comb of the fit with the PCD
    bias: Sequence[bool] = ()  # of several samples, which hold no electrons; empty for one sample
    shown: int = 0  # the sample whose H is in ``fit``


def fit_tile(
    histograms: Sequence[Arrays],
    how: TileFit,
    start: FloatArray | None = None,
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the arrays of a tile by group and name: of ``fit``, and with several samples of ``samples``.

    The histograms of each sample are ``counts`` (y, x, bin), ``origin``, ``under`` and ``over`` (y, x).
    ``start`` is (H, g, mu, sigma, likelihood gap) of a fit of fewer frames, (y, x, 5), NaN where there is
    none, ``added`` the exposure that the effects add to the pixels, (j, y, x); None: it counts as part of H.
    """
    shape = histograms[0]["counts"].shape[:2]
    counts = [each["counts"].reshape(-1, each["counts"].shape[2]) for each in histograms]
    origins = [each["origin"].ravel() for each in histograms]
    fit = functools.partial(
        fit_histograms,
        counts if how.bias else counts[0],
        origins if how.bias else origins[0],
        under=np.ravel(sum(each["under"].astype(np.int64) + each["over"] for each in histograms)),
        dark=list(how.bias) or None,
        adc_limits=how.adc_limits,
    )
    begin: FitResult | FloatArray | None = None if start is None else start.reshape(-1, start.shape[2])
    law: SampleLaw | list[SampleLaw] | None = None
    if how.effects:  # they compose the law after a fit with the PCD
        # the law is integrated over the cells: a start with all of them would be in vain
        likelihood = "density" if how.settings.likelihood == "density" else "auto"
        simple = how.settings.model_copy(update={"likelihood": likelihood, "intervals": "normal"})
        begin = plain = fit(settings=simple, start=begin)
        law = _laws(plain, how.effects, added, places)
    found = fit(settings=how.settings, start=begin, law=law, excluding=how.set_aside)
    fitted = _fit_arrays(found, how)
    arrays = {"fit": {name: values.reshape(shape + values.shape[1:]) for name, values in fitted.items()}}
    if how.bias:
        of_samples = {
            "quanta_exposure": found.quanta_exposure,
            "quanta_exposure_stderr": _errors(found.covariance)[:, : len(histograms)],
            "mean": found.mean,
            "variance": found.variance,
        }
        arrays["samples"] = {
            **{name: np.ascontiguousarray(each.T).reshape(-1, *shape) for name, each in of_samples.items()},
            "covariance": found.covariance.reshape(shape + found.covariance.shape[1:]),
        }
    return arrays


def _errors(covariance: FloatArray) -> FloatArray:
    """Return the standard errors (pixel, parameter) of a covariance; NaN where a variance is negative."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))


def _laws(
    plain: FitResult, effects: Sequence[Effect], added: AddedExposure | None, places: PixelPlaces | None
) -> SampleLaw | list[SampleLaw]:
    """Return the law that the effects compose after the plain fit, or a list of one for each sample."""
    # not those without a value, or one electron off
    usable = (plain.fit_status & int(FAILED | AMBIGUOUS)) == 0
    shared = [getattr(plain, name) for name in PARAMETERS[1:]]
    laws = [
        sample_law(effects, pixel_maps([np.ascontiguousarray(exposure), *shared], usable), added, places)
        for exposure in np.atleast_2d(plain.quanta_exposure.T)
    ]
    return laws[0] if plain.quanta_exposure.ndim == 1 else laws


def _fit_arrays(result: FitResult, how: TileFit) -> dict[str, NDArray[Any]]:
    """Return the arrays of the group ``fit`` of some pixels, by name, pixels along the first axis."""
    n_samples = result.covariance.shape[1] - 3
    places = [how.shown, *range(n_samples, n_samples + 3)]
    covariance = result.covariance[:, places][:, :, places]
    arrays: dict[str, NDArray[Any]] = {
        f"{name}_stderr": errors for name, errors in zip(PARAMETERS, _errors(covariance).T, strict=True)
    }
    arrays["correlation"] = correlations(covariance)
    arrays["quanta_exposure"] = result.quanta_exposure.reshape(-1, n_samples)[:, how.shown]
    if result.intervals is not None:
        arrays |= {
            path: result.intervals[:, place, side]
            for place, name in zip([*places, n_samples + 3], INTERVALS, strict=True)
            for side, path in enumerate(interval_names(name))
        }
    # only under a model with effects may pixels have free satellites
    known = {*arrays, *(() if how.effects else FREE_SATELLITES)}
    rest = [v.name for v in variables_of("fit") if v.name not in known and hasattr(result, v.name)]
    return arrays | {name: getattr(result, name) for name in rest}
