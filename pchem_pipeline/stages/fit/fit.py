"""Stage ``fit``: PCH-EM on the histogram of every pixel, and again with the effects of the run's model."""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.variables import PARAMETERS, VARIABLES
from pchem_pipeline.model.checks.shrinkage import Judged, NoisePool, noise_of
from pchem_pipeline.model.errors.expected_information import (
    CORRELATION_PAIRS,
    LARGEST_BIAS,
    biased_by_rounding,
)
from pchem_pipeline.model.fit.status import FAILED, MEANINGS, FitStatus, moves_gain
from pchem_pipeline.run.fingerprint import setting_values
from pchem_pipeline.run.model_versions import ModelVersion, read_added_exposure
from pchem_pipeline.run.progress import parts_told
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.fit.fitted_model import pixel_places
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.remote_path import RemotePath
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile, equal_rows

_HISTOGRAM = ("counts", "origin", "under", "over")
_LARGEST_POOL = 2**19  # pixels: every so many-th of a larger sensor


def run(context: StageContext) -> None:
    """Fit every tile whose histograms are there, all samples of a run together.

    Raises:
        StoreError: the histograms are missing, or the store refuses.
    """
    samples, store, model = context.sensor.samples, context.store, context.model
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
    _create(context, how, counts[0].dtype)
    # of a pixel the histograms, and all that is kept of it until it is written, twice
    pixel_bytes = 2 * (sum(each.shape[2] * each.dtype.itemsize for each in counts) + 40 * 8)
    done = context.run_units(
        context.tiles(),
        functools.partial(_do_tile, samples=runs, how=how, model=model),
        needs="histogram",
        unit_bytes=context.tile_pixels * pixel_bytes,
    )
    if not samples:
        judge_sensor(context)
        if len(done) == context.n_keys:
            _start_file(store.path).unlink(missing_ok=True)
    counted = ("pixels", "poor", "rounded")
    pixels, poor, biased = (sum(tile.get(key, 0) for tile in done.values()) for key in counted)
    if poor > 0.2 * pixels:
        context.note(
            f"{100 * poor / pixels:.0f} % of the pixels disagree with common g, mu and sigma for all "
            "samples: check that all have the same sensor, gain, offset and temperature, and that bias "
            "frames (--bias) have no charge"
        )
    if biased:
        share = f"{100 * biased / pixels:.1f} %" if biased >= 0.001 * pixels else "fewer than 0.1 %"
        context.note(
            f"rounding to whole DN biases {share} of the pixels by more than {LARGEST_BIAS:g} "
            "standard errors; set fit.likelihood: auto"
        )


def _create(context: StageContext, how: TileFit, dtype: np.dtype[Any]) -> None:
    """Make arrays like those of a fit of one pixel, which compiles the kernels before all workers do it."""
    histogram: dict[str, NDArray[Any]] = {name: np.zeros((1, 1), np.int32) for name in _HISTOGRAM[1:]}
    histogram["counts"] = np.ones((1, 1, 8), dtype)
    everywhere = [effect.at_place(None) for effect in how.effects]
    found = fit_tile([histogram] * max(1, len(how.bias)), replace(how, effects=everywhere, adc_limits=None))
    for group, arrays in found.items():
        context.create_like({f"{group}/{name}": values for name, values in arrays.items()})
    context.create(
        "fit/fit_status",
        flag_masks=[int(bit) for bit in MEANINGS],
        flag_meanings=" ".join(str(bit.name).lower() for bit in MEANINGS),
        flag_sentences={str(bit.name).lower(): sentence for bit, sentence in MEANINGS.items()},
    )


def _do_tile(
    tile: Tile, store: RunStore, *, samples: Sequence[Path], how: TileFit, model: ModelVersion
) -> dict[str, Any]:
    """Fit one tile of the store; the summary counts its pixels.

    ``samples`` are the paths of the runs of several samples; empty for a run of one.
    """
    runs = [RunStore.open(path) for path in samples] or [store]
    read = [each.at(tile.region, "histogram") for each in runs]
    histograms = [{name: each[name] for name in _HISTOGRAM} for each in read]
    bins = sum(each["counts"].shape[2] for each in histograms)
    start = None if samples else kept_fit(store.path, tile.region)
    added = None if samples else read_added_exposure(store, model, tile.region)
    arrays: dict[str, NDArray[Any]] = {}
    for part in parts_told(tile.parts(bins)):
        some = [{name: values[part] for name, values in each.items()} for each in histograms]
        found = fit_tile(
            some,
            how,
            None if start is None else start[part],
            None if added is None else added.of(part),
            pixel_places(store, tile.within(part)),
        )
        for group, values_of in found.items():
            for name, values in values_of.items():
                variable = VARIABLES[f"{group}/{name}"]
                y = variable.dims.index("y")
                shape = (*values.shape[:y], *tile.shape, *values.shape[y + 2 :])
                whole = arrays.setdefault(variable.path, np.empty(shape, values.dtype))
                whole[variable.index(part)] = values
    for each in runs:
        if each.has("frames/excluded"):
            excluded = each.read("frames/excluded", tile.region) != 0
            for path, values in arrays.items():
                if values.dtype.kind == "f":
                    values[(slice(None),) * VARIABLES[path].dims.index("y") + (excluded,)] = np.nan
            arrays["fit/fit_status"][excluded] = int(FitStatus.EXCLUDED)
    store.at(tile.region).update(arrays)
    words = arrays["fit/fit_status"]
    summary: dict[str, Any] = {
        "pixels": int(words.size),
        "failed": int(np.count_nonzero(words & np.uint16(int(FAILED & ~FitStatus.EXCLUDED)))),
    }
    if samples:
        return {**summary, "poor": int(np.count_nonzero(words & np.uint16(int(FitStatus.POOR_FIT))))}
    maps = [arrays[f"fit/{name}"] for name in PARAMETERS]
    if how.settings.likelihood == "density" and not how.effects:
        frames = histograms[0]["counts"].sum(axis=2, dtype=np.float64)
        biased = biased_by_rounding([values.ravel() for values in maps], frames.ravel())
        summary["rounded"] = int(np.count_nonzero(biased))
    return summary


# -- what all pixels of the sensor together say about the fit of each ------------------------------


def judge_sensor(context: StageContext) -> int:
    """Set ``WEAKLY_IDENTIFIED`` or ``BIAS_UNSURE`` where a pixel is clear by chance; return the number.

    The latter where a bias that is an electron off leaves the gain as it is. The words depend on the sensor
    as a whole, not on its tiles, and may be given again and again.

    Raises:
        StoreError: the store refuses.
    """
    store, shape = context.store, context.sensor.shape
    bands = [(slice(*rows), slice(0, shape[1])) for rows in equal_rows(shape[0], context.tile[0])]
    every = -(-shape[0] * shape[1] // _LARGEST_POOL)
    chosen = []
    for band in bands:
        some = _judged(store, band).of(slice(-band[0].start * shape[1] % every, None, every))
        chosen.append(Judged.join([some]))  # a copy: a view would keep the whole band
    pool = NoisePool.of(Judged.join(chosen))
    weakly, unsure = (np.uint16(int(bit)) for bit in (FitStatus.WEAKLY_IDENTIFIED, FitStatus.BIAS_UNSURE))
    found = 0
    for band in bands:
        words = store.read("fit/fit_status", band)
        new = words & ~(weakly | unsure)
        if pool is not None:
            pixels = _judged(store, band)
            weak, ambiguous = pool.reasons(pixels, context.config.fit)
            exposure = store.read("fit/quanta_exposure", band).ravel()
            of_gain = bool(context.sensor.samples) | moves_gain(exposure, pixels.noise)
            weak |= ambiguous & of_gain
            new[weak.reshape(words.shape)] |= weakly
            new[(ambiguous & ~of_gain).reshape(words.shape)] |= unsure
            found += int(np.count_nonzero(weak | ambiguous))
        if not np.array_equal(new, words):
            store.write("fit/fit_status", band, new)
    return found


def _judged(store: RunStore, band: tuple[slice, slice]) -> Judged:
    """Return the pixels of a band, in order; NaN where they are not fitted."""
    names = ("conversion_gain", "read_noise_dn")
    fit = store.at(band, "fit")
    pair = CORRELATION_PAIRS.index(tuple(map(PARAMETERS.index, names)))
    gain, sigma = (fit[name].ravel() for name in names)
    of_gain, of_sigma = (fit[f"{name}_stderr"].ravel() for name in names)
    together = store.read("fit/correlation", (*band, slice(pair, pair + 1))).ravel()
    return Judged(*noise_of(gain, sigma, of_gain, of_sigma, together), fit["likelihood_gap"].ravel())


# -- the answer of an earlier fit, from which that of more frames starts ---------------------------
#
# It lies among the private files of the run, is kept when frames are appended and forgotten once it has been
# used. It is no part of the fingerprint: the maximum does not depend on where the climb to it starts.


def _start_file(store: Path) -> Path:
    return store / ".pchem" / "fit_start.npy"


def keep_fit(context: StageContext) -> None:
    """Keep the pixels that were fitted well, unless the fit had other settings or another model.

    The file holds (H, g, mu, sigma, likelihood gap), float64, (y, x, 5); NaN for pixels without a start.
    """
    store, record = context.store, context.store.records.read("fit")
    if (
        record is None
        or not record.finished
        or record.content["settings"] != setting_values(STAGES["fit"], context)
        or record.content["input"]["model"] != context.model.digest
    ):
        _start_file(store.path).unlink(missing_ok=True)
        return
    start = np.stack([store.read(f"fit/{name}") for name in (*PARAMETERS, "likelihood_gap")], axis=-1)
    start[store.read("fit/fit_status") != 0] = np.nan
    buffer = io.BytesIO()
    np.save(buffer, start)
    write_atomic(_start_file(store.path), buffer.getvalue())


def kept_fit(store: Path, region: tuple[slice, slice]) -> FloatArray | None:
    """Return what `keep_fit` kept of a tile, or None."""
    place = _start_file(store)
    if not place.exists():
        return None
    if isinstance(place, RemotePath):
        return np.array(np.load(io.BytesIO(place.read_bytes()), allow_pickle=False)[region])
    return np.array(np.load(place, mmap_mode="r", allow_pickle=False)[region])
