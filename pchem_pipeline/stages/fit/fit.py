"""Stage ``fit``: PCH-EM on the histogram of every pixel, and again with the effects of the run's model."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.compose import PixelPlaces
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.errors.rounding import LARGEST_BIAS, biased_by_rounding
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.excluding_codes import Interval
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.run.model_versions import ModelVersion, read_added_exposure
from pchem_pipeline.run.progress import parts_told
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.fit.arrays import create_fit_maps, leave_out_excluded
from pchem_pipeline.stages.fit.code_sums import CodeSums
from pchem_pipeline.stages.fit.fitted_model import pixel_places
from pchem_pipeline.stages.fit.model_fit import fit_arrays, fit_model
from pchem_pipeline.stages.fit.samples import fit_samples
from pchem_pipeline.stages.fit.start import drop_fit, kept_fit
from pchem_pipeline.stages.fit.together import judge_sensor

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

_HISTOGRAM = ("counts", "origin", "under", "over")
#: of all that is kept of a pixel of a tile until it is written, twice
_PIXEL_BYTES = 2 * 40 * 8


def fit_tile(
    histogram: Mapping[str, NDArray[Any]],
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
    effects: Sequence[Effect] = (),
    set_aside: Sequence[Interval] = (),
    start: NDArray[np.float64] | None = None,
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the group ``fit`` of a tile, by name.

    With effects the plain fit is where the one under the extended law starts.

    Args:
        histogram: ``counts`` (y, x, bin), ``origin``, ``under`` and ``over`` (y, x) of the tile.
        settings: of the fit.
        adc_limits: first and last code of the ADC, DN, or None where they are not known.
        effects: of the run's model.
        set_aside: codes that the fit leaves out, e- on the comb of the plain fit.
        start: (H, g, mu, sigma, likelihood gap) of a fit of fewer frames, (y, x, 5), NaN where there is none.
        added: exposure that the effects add to the pixels, (j, y, x); None: it counts as part of H.
        places: of the pixels; None: not known.
    """
    counts = histogram["counts"]
    shape = counts.shape[:2]
    rows = counts.reshape(-1, counts.shape[2])
    origin, under, over = (histogram[name].ravel() for name in ("origin", "under", "over"))
    result = fit_model(
        functools.partial(fit_histograms, rows, origin, under, over, adc_limits=adc_limits),
        settings,
        effects,
        set_aside,
        start=None if start is None else start.reshape(-1, start.shape[2]),
        added=added,
        places=places,
    )
    arrays = fit_arrays(result, effects=bool(effects))
    return {name: array.reshape(shape + array.shape[1:]) for name, array in arrays.items()}


def run(context: StageContext) -> None:
    """Fit every tile whose histograms are there.

    Raises:
        StoreError: the histograms are missing, or the store refuses.
    """
    if context.sensor.samples:
        fit_samples(context)
        return
    create_fit_maps(context)
    if not context.executor.shares_memory:
        _compile(context.store.array("histogram/counts").dtype, context.model.effects)
    task = functools.partial(
        _do_tile,
        store=context.store.path,
        settings=context.config.fit,
        adc_limits=context.adc_limits,
        model=context.model,
    )
    counts = context.store.array("histogram/counts")
    held = context.tile_pixels * (2 * counts.shape[2] * counts.dtype.itemsize + _PIXEL_BYTES)
    done = context.run_units(context.tiles(), task, needs="histogram", unit_bytes=held)
    judge_sensor(context)
    if len(done) == context.n_keys:
        drop_fit(context.store.path)
    biased, pixels = (sum(tile.get(key, 0) for tile in done.values()) for key in ("rounded", "pixels"))
    if biased:
        share = f"{100 * biased / pixels:.1f} %" if biased >= 0.001 * pixels else "fewer than 0.1 %"
        context.note(
            f"rounding to whole DN biases {share} of the pixels by more than {LARGEST_BIAS:g} "
            "standard errors; set fit.likelihood: auto"
        )


def _compile(dtype: np.dtype[Any], effects: Sequence[Effect]) -> None:
    """Compile the kernels once, into the cache, before other processes do it all at the same time."""
    histogram = {name: np.zeros((1, 1), np.int32) for name in ("origin", "under", "over")}
    everywhere = [effect.at_place(None) for effect in effects]
    fit_tile({"counts": np.ones((1, 1, 8), dtype), **histogram}, FitSettings(), None, everywhere)


def _do_tile(
    tile: Tile,
    *,
    store: Path,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
    model: ModelVersion,
) -> dict[str, Any]:
    """Fit one tile of the store; the summary counts its pixels, and the samples of each code."""
    run_store = open_store(store)
    histogram = {name: run_store.read(f"histogram/{name}", tile.region) for name in _HISTOGRAM}
    start = kept_fit(store, tile.region)
    effects, set_aside = model.effects, model.settings.set_aside_e
    added = read_added_exposure(run_store, model, tile.region)
    arrays: dict[str, NDArray[Any]] = {}
    bins = histogram["counts"].shape[2]
    codes = CodeSums(histogram["origin"], bins)
    for part in parts_told(tile.parts(bins)):
        some = {name: values[part] for name, values in histogram.items()}
        found = fit_tile(
            some,
            settings,
            adc_limits,
            effects,
            set_aside,
            None if start is None else start[part],
            None if added is None else added.of(part),
            pixel_places(run_store, tile.within(part)),
        )
        codes.add(some, found)
        for name, values in found.items():
            whole = arrays.setdefault(name, np.empty(tile.shape + values.shape[2:], values.dtype))
            whole[part] = values
    leave_out_excluded(arrays, "fit_status", [run_store], tile.region)
    for name, array in arrays.items():
        run_store.write(f"fit/{name}", tile.region, array)
    words = arrays["fit_status"]
    summary: dict[str, Any] = {
        "pixels": int(words.size),
        "failed": int(np.count_nonzero(words & np.uint16(int(FAILED & ~FitStatus.EXCLUDED)))),
        "codes": codes.content(),
    }
    if settings.likelihood == "density" and not effects:
        counts = histogram["counts"].sum(axis=2, dtype=np.float64)
        biased = biased_by_rounding([arrays[name].ravel() for name in PARAMETERS], counts.ravel())
        summary["rounded"] = int(np.count_nonzero(biased))
    return summary
