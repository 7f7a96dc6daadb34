"""Stage ``fit``: PCH-EM on the histogram of every pixel, and again with the effects of the run's model."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.errors.rounding import LARGEST_BIAS, biased_by_rounding
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.run.model_versions import ModelVersion, read_added_exposure
from pchem_pipeline.run.progress import parts_told
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.fit.arrays import TileArrays, create_fit_arrays
from pchem_pipeline.stages.fit.code_sums import CodeSums
from pchem_pipeline.stages.fit.fitted_model import pixel_places
from pchem_pipeline.stages.fit.start import drop_fit, kept_fit
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile
from pchem_pipeline.stages.fit.together import judge_sensor
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

_HISTOGRAM = ("counts", "origin", "under", "over")
#: what the summaries of the tiles count
_COUNTED = ("pixels", "poor", "rounded")
_SUSPICIOUS_SHARE = 0.2  # of pixels in poor agreement, from which the samples themselves are in doubt
#: of all that is kept of a pixel of a tile until it is written, twice
_PIXEL_BYTES = 2 * 40 * 8


def run(context: StageContext) -> None:
    """Fit every tile whose histograms are there, all samples of a run together.

    Raises:
        StoreError: the histograms are missing, or the store refuses.
    """
    samples, store, model = context.sensor.samples, context.store, context.model
    create_fit_arrays(context)
    how = TileFit(
        context.config.fit,
        context.sensor.adc_limits,
        model.effects,
        model.settings.set_aside_e,
        [sample.bias for sample in samples],
        context.sensor.shown,
    )
    runs = tuple(target.store for target in sample_targets(context.config, context.base_dir))
    counts = [each.array("histogram/counts") for each in ([RunStore.open(run) for run in runs] or [store])]
    if not context.executor.shares_memory:
        _compile(how, counts[0].dtype)
    pixel_bytes = 2 * sum(each.shape[2] * each.dtype.itemsize for each in counts) + _PIXEL_BYTES
    done = context.run_units(
        context.tiles(),
        functools.partial(_do_tile, samples=runs, how=how, model=model),
        needs="histogram",
        unit_bytes=context.tile_pixels * pixel_bytes,
    )
    if not samples:
        judge_sensor(context)
        if len(done) == context.n_keys:
            drop_fit(store.path)
    pixels, poor, biased = (sum(tile.get(key, 0) for tile in done.values()) for key in _COUNTED)
    if poor > _SUSPICIOUS_SHARE * pixels:
        context.note(
            f"{100 * poor / pixels:.0f} % of the pixels disagree with common g, mu and sigma for all "
            "samples: check that all have the same sensor, gain, offset and temperature"
        )
    if biased:
        share = f"{100 * biased / pixels:.1f} %" if biased >= 0.001 * pixels else "fewer than 0.1 %"
        context.note(
            f"rounding to whole DN biases {share} of the pixels by more than {LARGEST_BIAS:g} "
            "standard errors; set fit.likelihood: auto"
        )


def _compile(how: TileFit, dtype: np.dtype[Any]) -> None:
    """Compile the kernels once, into the cache, before other processes do it all at the same time."""
    histogram: dict[str, NDArray[Any]] = {name: np.zeros((1, 1), np.int32) for name in _HISTOGRAM[1:]}
    histogram["counts"] = np.ones((1, 1, 8), dtype)
    everywhere = [effect.at_place(None) for effect in how.effects]
    fit_tile([histogram] * max(1, len(how.bias)), replace(how, effects=everywhere, adc_limits=None))


def _do_tile(
    tile: Tile, store: RunStore, *, samples: Sequence[Path], how: TileFit, model: ModelVersion
) -> dict[str, Any]:
    """Fit one tile of the store; the summary counts its pixels, and the samples of each code.

    Args:
        tile: of the sensor.
        store: the run.
        samples: paths of the runs of its samples; none of a run of one.
        how: the pixels are fitted.
        model: of the run.
    """
    runs = [RunStore.open(path) for path in samples] or [store]
    histograms = [each.read_arrays("histogram", _HISTOGRAM, tile.region) for each in runs]
    start = added = codes = None
    bins = sum(each["counts"].shape[2] for each in histograms)
    if not samples:
        start, added = kept_fit(store.path, tile.region), read_added_exposure(store, model, tile.region)
        codes = CodeSums(histograms[0]["origin"], bins)
    arrays = TileArrays(tile)
    for part in parts_told(tile.parts(bins)):
        some = [{name: values[part] for name, values in each.items()} for each in histograms]
        found = fit_tile(
            some,
            how,
            None if start is None else start[part],
            None if added is None else added.of(part),
            pixel_places(store, tile.within(part)),
        )
        if codes is not None:
            codes.add(some[0], found["fit"])
        arrays.add(part, found)
    for each in runs:
        if each.has("frames/excluded"):
            arrays.leave_out(each.read("frames/excluded", tile.region) != 0)
    arrays.write(store)
    fit = arrays.values["fit"]
    words = fit["fit_status"]
    summary: dict[str, Any] = {
        "pixels": int(words.size),
        "failed": int(np.count_nonzero(words & np.uint16(int(FAILED & ~FitStatus.EXCLUDED)))),
    }
    if codes is None:
        return {**summary, "poor": int(np.count_nonzero(words & np.uint16(int(FitStatus.POOR_FIT))))}
    summary["codes"] = codes.content()
    if how.settings.likelihood == "density" and not how.effects:
        frames = histograms[0]["counts"].sum(axis=2, dtype=np.float64)
        maps = [fit[name].ravel() for name in PARAMETERS]
        summary["rounded"] = int(np.count_nonzero(biased_by_rounding(maps, frames.ravel())))
    return summary
