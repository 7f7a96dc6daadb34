"""The fit of several samples of a tile: one g, mu and sigma for each pixel, an H for each exposure.

The group ``fit`` holds the shared parameters with H of the shown sample, as a run of one sample has them; the
group ``samples`` what each exposure has of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.compose import PixelPlaces
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.excluding_codes import Interval
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.stages.fit.model_fit import fit_arrays, fit_model

Histogram = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class SampleFit:
    """How the samples of a tile are fitted.

    Attributes:
        bias: which samples hold no electrons.
        shown: the sample whose H stands in ``fit``.
        settings: of the fit.
        adc_limits: first and last code of the ADC, DN, or None where they are not known.
        effects: of the run's model.
        set_aside: codes that the fit leaves out, e- on the comb of the fit with the PCD.
    """

    bias: Sequence[bool]
    shown: int
    settings: FitSettings
    adc_limits: tuple[int, int] | None = None
    effects: Sequence[Effect] = ()
    set_aside: Sequence[Interval] = ()


def fit_samples_tile(
    histograms: Sequence[Histogram], how: SampleFit, places: PixelPlaces | None = None
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the groups ``fit`` and ``samples`` of a tile, by path.

    Args:
        histograms: ``counts`` (y, x, bin), ``origin``, ``under`` and ``over`` (y, x) of each sample.
        how: they are fitted.
        places: of the pixels; None: not known.
    """
    shape = histograms[0]["counts"].shape[:2]
    fit = functools.partial(
        fit_histograms,
        [each["counts"].reshape(-1, each["counts"].shape[2]) for each in histograms],
        [each["origin"].ravel() for each in histograms],
        under=np.ravel(sum(each["under"].astype(np.int64) + each["over"] for each in histograms)),
        dark=list(how.bias),
        adc_limits=how.adc_limits,
    )
    found = fit_model(fit, how.settings, how.effects, how.set_aside, places=places)
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    own = {
        "quanta_exposure": found.quanta_exposure,
        "quanta_exposure_stderr": errors[:, : len(histograms)],
        "mean": found.mean,
        "variance": found.variance,
    }
    arrays = {
        f"fit/{name}": values.reshape(shape + values.shape[1:])
        for name, values in fit_arrays(found, how.shown, effects=bool(how.effects)).items()
    }
    arrays |= {
        f"samples/{name}": np.ascontiguousarray(values.T).reshape(-1, *shape) for name, values in own.items()
    }
    arrays["samples/covariance"] = found.covariance.reshape(shape + found.covariance.shape[1:])
    return arrays
