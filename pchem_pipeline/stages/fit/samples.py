"""The stage ``fit`` of a run of several samples: one g, mu and sigma for each pixel, an H for each exposure.

The group ``fit`` holds the shared parameters with H of the shown sample, as a run of one sample has them; the
group ``samples`` what each exposure has of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.compose import PixelPlaces
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.excluding_codes import Interval
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.run.progress import parts_told
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.fit.arrays import create_fit_maps, first_is_sample, leave_out_excluded
from pchem_pipeline.stages.fit.fitted_model import pixel_places
from pchem_pipeline.stages.fit.model_fit import fit_arrays, fit_model
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

_HISTOGRAM = ("counts", "origin", "under", "over")
_OF_SAMPLES = ("quanta_exposure", "quanta_exposure_stderr", "mean", "variance")
_SUSPICIOUS_SHARE = 0.2  # of pixels in poor agreement, from which the samples themselves are in doubt

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


def fit_samples(context: StageContext) -> None:
    """Fit every tile, all samples together.

    Raises:
        StoreError: histograms of a sample are missing, or the store refuses.
    """
    samples, tile, shape = context.sensor.samples, context.tile, context.sensor.shape
    create_fit_maps(context)
    for name in _OF_SAMPLES:
        context.create(f"samples/{name}", (len(samples), *shape), chunks=(len(samples), *tile))
    rest = (len(samples) + 3,) * 2
    context.create("samples/covariance", (*shape, *rest), chunks=(*tile, *rest))
    how = SampleFit(
        [sample.bias for sample in samples],
        context.sensor.shown,
        context.config.fit,
        context.adc_limits,
        context.model.effects,
        context.model.settings.set_aside_e,
    )
    if not context.executor.shares_memory:
        _compile(how)
    stores = [target.store for target in sample_targets(context.config, context.base_dir)]
    task = functools.partial(_do_tile, store=context.store.path, stores=stores, how=how)
    done = context.run_units(context.tiles(), task, needs="histogram")
    pixels, poor = (sum(tile.get(key, 0) for tile in done.values()) for key in ("pixels", "poor"))
    if poor > _SUSPICIOUS_SHARE * pixels:
        context.note(
            f"{100 * poor / pixels:.0f} % of the pixels disagree with common g, mu and sigma for all "
            "samples: check that all have the same sensor, gain, offset and temperature"
        )


def _compile(how: SampleFit) -> None:
    """Compile the kernels once, into the cache, before other processes do it all at the same time."""
    histogram = {name: np.zeros((1, 1), np.int32) for name in _HISTOGRAM[1:]}
    histogram["counts"] = np.ones((1, 1, 8), np.uint32)
    everywhere = [effect.at_place(None) for effect in how.effects]
    fit_samples_tile([histogram] * len(how.bias), replace(how, effects=everywhere))


def _do_tile(tile: Tile, *, store: Path, stores: Sequence[Path], how: SampleFit) -> dict[str, Any]:
    """Fit one tile; the summary counts its pixels."""
    runs = [RunStore.open(path) for path in stores]
    histograms = [
        {name: sample.read(f"histogram/{name}", tile.region) for name in _HISTOGRAM} for sample in runs
    ]
    target = open_store(store)
    arrays: dict[str, NDArray[Any]] = {}
    for part in parts_told(tile.parts(sum(each["counts"].shape[2] for each in histograms))):
        some = [{name: values[part] for name, values in each.items()} for each in histograms]
        found = fit_samples_tile(some, how, pixel_places(target, tile.within(part)))
        for name, values in found.items():
            lead = values.shape[:1] if first_is_sample(name) else ()
            rest = values.shape[len(lead) + 2 :]
            whole = arrays.setdefault(name, np.empty((*lead, *tile.shape, *rest), values.dtype))
            whole[(slice(None), *part) if lead else part] = values
    leave_out_excluded(arrays, "fit/fit_status", runs, tile.region)
    for name, values in arrays.items():
        target.write(name, (slice(None), *tile.region) if first_is_sample(name) else tile.region, values)
    words = arrays["fit/fit_status"]
    bits = {"failed": int(FAILED & ~FitStatus.EXCLUDED), "poor": int(FitStatus.POOR_FIT)}
    counts = {name: int(np.count_nonzero(words & np.uint16(bit))) for name, bit in bits.items()}
    return {"pixels": int(words.size), **counts}
