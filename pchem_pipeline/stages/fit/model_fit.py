"""Fit pixels under the model of a run, whether it was given one sample of them or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, PARAMETERS, interval_names, variables_of
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.errors.fisher import correlations
from pchem_pipeline.model.fit.excluding_codes import Interval
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import AMBIGUOUS, FAILED
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Pixels of which effects are told nothing: no value, or one electron off.
_UNUSABLE = FAILED | AMBIGUOUS


def fit_model(
    fit: Callable[..., FitResult],
    settings: FitSettings,
    effects: Sequence[Effect] = (),
    set_aside: Sequence[Interval] = (),
    *,
    start: NDArray[np.float64] | None = None,
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> FitResult:
    """Fit with the PCD or, where the model has effects, with the law that they compose after such a fit.

    Args:
        fit: :func:`fit_histograms` of the pixels, one sample or several, which takes the other arguments.
        settings: of the fit.
        effects: of the run's model.
        set_aside: codes that the fit leaves out, e- on the comb of the fit with the PCD.
        start: of a fit of fewer frames; see :func:`fit_histograms`.
        added: exposure that the effects add to the pixels, (j, n); None: it counts as part of H.
        places: of the pixels; None: not known.
    """
    if not effects:
        return fit(settings=settings, start=start, excluding=set_aside)
    # the law is integrated over the cells: a start with all of them would be in vain
    likelihood = "density" if settings.likelihood == "density" else "auto"
    simple = settings.model_copy(update={"likelihood": likelihood, "intervals": "normal"})
    plain = fit(settings=simple, start=start)
    return fit(settings=settings, start=plain, law=_laws(plain, effects, added, places), excluding=set_aside)


def _laws(
    plain: FitResult,
    effects: Sequence[Effect],
    added: AddedExposure | None,
    places: PixelPlaces | None,
) -> SampleLaw | list[SampleLaw]:
    """Return the law that the effects compose after the plain fit, or a list of one for each sample."""
    usable = (plain.fit_status & int(_UNUSABLE)) == 0
    shared = [getattr(plain, name) for name in PARAMETERS[1:]]
    if plain.quanta_exposure.ndim == 1:
        return sample_law(effects, pixel_maps([plain.quanta_exposure, *shared], usable), added, places)
    return [
        sample_law(effects, pixel_maps([np.ascontiguousarray(exposure), *shared], usable), added, places)
        for exposure in plain.quanta_exposure.T
    ]


def fit_arrays(result: FitResult, shown: int = 0, *, effects: bool = False) -> dict[str, NDArray[Any]]:
    """Return the arrays of the group ``fit`` of some pixels, by name, pixels along the first axis.

    Args:
        result: of the pixels.
        shown: the sample whose H it is, where there are several.
        effects: whether the model has effects, with which pixels may have free satellites.
    """
    n_samples = result.covariance.shape[1] - 3
    places = [shown, *range(n_samples, n_samples + 3)]
    covariance = result.covariance[:, places][:, :, places]
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    arrays: dict[str, NDArray[Any]] = {
        f"{name}_stderr": errors[:, index] for index, name in enumerate(PARAMETERS)
    }
    arrays["correlation"] = correlations(covariance)
    arrays["quanta_exposure"] = result.quanta_exposure.reshape(-1, n_samples)[:, shown]
    if result.intervals is not None:
        arrays |= {
            path: result.intervals[:, place, side]
            for place, name in zip([*places, n_samples + 3], INTERVALS, strict=True)
            for side, path in enumerate(interval_names(name))
        }
    known = {*arrays, *(() if effects else FREE_SATELLITES)}
    arrays |= {
        v.name: getattr(result, v.name)
        for v in variables_of("fit")
        if v.name not in known and hasattr(result, v.name)
    }
    return arrays
