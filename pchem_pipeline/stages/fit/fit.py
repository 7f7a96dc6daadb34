"""Stage ``fit``: PCH-EM on the histogram of every pixel, and again with the effects of the run's model."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.fit.arrays import TileArrays, create_fit_arrays
from pchem_pipeline.stages.fit.code_sums import CodeSums
from pchem_pipeline.stages.fit.fitted_model import pixel_places
from pchem_pipeline.stages.fit.model_fit import fit_arrays, fit_model
from pchem_pipeline.stages.fit.samples import SampleFit, fit_samples_tile
from pchem_pipeline.stages.fit.start import drop_fit, kept_fit
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


@dataclass(frozen=True)
class _Job:
    """How tiles are fitted.

    Attributes:
        samples: paths of the runs of its samples; none of a run of one.
        how: several samples are fitted.
        model: of the run.
    """

    samples: tuple[Path, ...]
    how: SampleFit
    model: ModelVersion

    def tile(
        self,
        histograms: Sequence[Mapping[str, NDArray[Any]]],
        start: NDArray[np.float64] | None = None,
        added: AddedExposure | None = None,
        places: PixelPlaces | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays of some pixels by path; the arguments are those of the two tile functions."""
        how = self.how
        if self.samples:
            return fit_samples_tile(histograms, how, places)
        options = (how.settings, how.adc_limits, how.effects, how.set_aside, start, added, places)
        return {f"fit/{name}": values for name, values in fit_tile(histograms[0], *options).items()}


def run(context: StageContext) -> None:
    """Fit every tile whose histograms are there, all samples of a run together.

    Raises:
        StoreError: the histograms are missing, or the store refuses.
    """
    samples, store, model = context.sensor.samples, context.store, context.model
    create_fit_arrays(context)
    how = SampleFit(
        [sample.bias for sample in samples],
        context.sensor.shown,
        context.config.fit,
        context.adc_limits,
        model.effects,
        model.settings.set_aside_e,
    )
    runs = tuple(target.store for target in sample_targets(context.config, context.base_dir))
    job = _Job(runs, how, model)
    counts = [each.array("histogram/counts") for each in ([RunStore.open(run) for run in runs] or [store])]
    if not context.executor.shares_memory:
        _compile(job, counts[0].dtype)
    pixel_bytes = 2 * sum(each.shape[2] * each.dtype.itemsize for each in counts) + _PIXEL_BYTES
    done = context.run_units(
        context.tiles(),
        functools.partial(_do_tile, job=job),
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


def _compile(job: _Job, dtype: np.dtype[Any]) -> None:
    """Compile the kernels once, into the cache, before other processes do it all at the same time."""
    histogram: dict[str, NDArray[Any]] = {name: np.zeros((1, 1), np.int32) for name in _HISTOGRAM[1:]}
    histogram["counts"] = np.ones((1, 1, 8), dtype)
    everywhere = [effect.at_place(None) for effect in job.how.effects]
    how = replace(job.how, effects=everywhere, adc_limits=None)
    replace(job, how=how).tile([histogram] * max(1, len(job.samples)))


def _do_tile(tile: Tile, store: RunStore, *, job: _Job) -> dict[str, Any]:
    """Fit one tile of the store; the summary counts its pixels, and the samples of each code."""
    runs = [RunStore.open(path) for path in job.samples] or [store]
    histograms = [each.read_arrays("histogram", _HISTOGRAM, tile.region) for each in runs]
    start = added = codes = None
    bins = sum(each["counts"].shape[2] for each in histograms)
    if not job.samples:
        start, added = kept_fit(store.path, tile.region), read_added_exposure(store, job.model, tile.region)
        codes = CodeSums(histograms[0]["origin"], bins)
    arrays = TileArrays(tile)
    for part in parts_told(tile.parts(bins)):
        some = [{name: values[part] for name, values in each.items()} for each in histograms]
        found = job.tile(
            some,
            None if start is None else start[part],
            None if added is None else added.of(part),
            pixel_places(store, tile.within(part)),
        )
        if codes is not None:
            codes.add(some[0], {name: found[f"fit/{name}"] for name in PARAMETERS})
        arrays.add(part, found)
    for each in runs:
        if each.has("frames/excluded"):
            arrays.leave_out(each.read("frames/excluded", tile.region) != 0)
    arrays.write(store)
    words = arrays.values["fit/fit_status"]
    summary: dict[str, Any] = {
        "pixels": int(words.size),
        "failed": int(np.count_nonzero(words & np.uint16(int(FAILED & ~FitStatus.EXCLUDED)))),
    }
    if codes is None:
        return {**summary, "poor": int(np.count_nonzero(words & np.uint16(int(FitStatus.POOR_FIT))))}
    summary["codes"] = codes.content()
    if job.how.settings.likelihood == "density" and not job.how.effects:
        frames = histograms[0]["counts"].sum(axis=2, dtype=np.float64)
        maps = [arrays.values[f"fit/{name}"].ravel() for name in PARAMETERS]
        summary["rounded"] = int(np.count_nonzero(biased_by_rounding(maps, frames.ravel())))
    return summary
