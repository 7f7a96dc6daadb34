"""Stage ``ensemble``: the sensor as a whole, predicted from its maps and compared with its data.

Every tile leaves two rows of sums (see :mod:`pchem_pipeline.stages.ensemble.tile`); what is stored in the
group ``ensemble`` is made of their total and of the whole maps.
"""

from __future__ import annotations

import functools
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.compose import model_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.frames.stream import FrameSource, FrameStream
from pchem_pipeline.model.electrons.electrons import compare_electron_numbers, error_rates
from pchem_pipeline.model.ensemble.components import COMPONENT_CASES, bias_weight, moment_rows
from pchem_pipeline.model.ensemble.curves import components, curves
from pchem_pipeline.model.ensemble.curves import electron_numbers as electron_numbers_of
from pchem_pipeline.model.ensemble.ensemble import (
    ERROR_PIXELS,
    ERROR_SIZES,
    DnAxis,
    EnsembleAxes,
    EnsembleTotals,
    PixelErrors,
    electron_pmf,
    nuced_axis,
)
from pchem_pipeline.model.ensemble.settings import EnsembleSettings
from pchem_pipeline.model.fit.status import flags_of
from pchem_pipeline.model.histogram.count_numba import count_frames
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.progress import parts_told
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import StageContext, markers
from pchem_pipeline.stages.bands import BAND_BYTES, FRAMES_AT_ONCE, Band, tile_bands
from pchem_pipeline.stages.electrons import read_tables
from pchem_pipeline.stages.ensemble.tile import PixelHistograms, ensemble_tile, occupied
from pchem_pipeline.stages.fit.fitted_model import FittedModel, fitted_effects, fitted_satellites
from pchem_pipeline.stages.histogram.odd_frames import odd_frames_of, uncounted_frames
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile

_SUMS = ("integers", "floats")
_HISTOGRAM = ("origin", "minimum", "maximum")


@dataclass(frozen=True)
class _Job:
    """What the ensemble is of."""

    config: RunConfig
    sensor: SensorInfo
    axes: EnsembleAxes
    tiles: dict[str, tuple[int, Tile]]  # number and place of each by its key
    frames: tuple[int, int] | None  # the chosen ones (first, end); None where there are none to choose from
    source: FrameSource | None  # where frames come from, if any are read
    truth: tuple[int, int, int] | None  # row, column and frame of the input in the true electron numbers
    effects: tuple[Effect, ...]  # with which the maps were fitted
    limits: tuple[int, int] | None  # codes of the ADC, DN, where samples lie at one of them


@dataclass(frozen=True)
class _Fitted:
    """Parameters and histogram ranges (DN) of the pixels with a value, at ``place`` (y, x) of the sensor."""

    pixels: UsablePixels
    place: BoolArray
    origin: NDArray[np.int32]
    low: NDArray[np.int32]
    high: NDArray[np.int32]
    bins: int

    @classmethod
    def read(cls, store: RunStore, tiles: list[Tile]) -> _Fitted:
        """Read them from the run."""
        fit, histogram = store.at(group="fit"), store.at(group="histogram")
        maps = [fit[name] for name in PARAMETERS]
        place = np.zeros(maps[0].shape, np.bool_)
        for tile in tiles:
            place[tile.region] = True
        pixels, known = UsablePixels.from_maps([values[place] for values in maps])
        place[place] = known
        origin, low, high = (histogram[name][place] for name in _HISTOGRAM)
        return cls(pixels, place, origin, low, high, store.array("histogram/counts").shape[2])

    def axes(self, settings: EnsembleSettings) -> EnsembleAxes | None:
        """Choose the axes of the ensemble; None where no pixel has a value."""
        if len(self.pixels) == 0:
            return None
        start = int(np.maximum(self.low, self.origin).min())
        end = int(np.minimum(self.high, self.origin + self.bins - 1).max()) + 1
        dn = DnAxis(start, end - start)
        nuced = nuced_axis(self.pixels, dn, width=settings.nuced_bin_width)
        largest = min(float(self.pixels.quanta_exposure.max()), 60_000.0)
        mass = electron_pmf(self.pixels.quanta_exposure, int(largest + 12 * math.sqrt(largest) + 40))
        n_k = int(np.searchsorted(np.cumsum(mass), 1.0 - 1e-7)) + 2
        return EnsembleAxes(dn, nuced, n_k)


def run(context: StageContext) -> None:
    """Predict the ensemble and compare it with the data.

    Raises:
        ConfigError: the chosen frames do not exist.
        InputError: the camera files vanished or changed.
        StoreError: an upstream stage is missing, or the store refuses.
    """
    store, sensor, settings = context.store, context.sensor, context.config.ensemble
    tiles, ready, effects = context.tiles(), context.tiles_done("fit"), fitted_effects(context.store)
    frames = _chosen_frames(sensor, settings)
    truth = None if frames is None else _place_in_truth(store, context.config, sensor.shape)
    everything = frames == (0, sensor.n_frames)
    source = open_source(context) if frames is not None and (truth or not everything) else None
    fitted_tiles = [tile for tile in tiles if tile.key in ready]
    fitted = _Fitted.read(store, fitted_tiles)
    limits = sensor.adc_limits
    if limits is not None and not np.any((fitted.low <= limits[0]) | (fitted.high >= limits[1])):
        limits = None  # no samples lie there
    axes = fitted.axes(settings)
    if sensor.kind == "histograms":
        context.note("input is histograms: the ensemble has all samples, with equal weight per channel")
    if axes is None:
        if ready:
            context.note("no pixel has a value, so there is no ensemble; for the reasons see fit_status")
        context.run_units(tiles, needs="fit")
        return
    _create(context, axes, len(tiles))
    numbered = {tile.key: (number, tile) for number, tile in enumerate(tiles)}
    job = _Job(context.config, sensor, axes, numbered, frames, source, truth, effects, limits)
    rows = max(1, BAND_BYTES // (sensor.nx * fitted.bins * 4))
    bands = tiles if source is None else tile_bands(context, rows, source.rows_per_read)
    task = functools.partial(_do_band, job=job)
    counted = fitted.bins * store.array("histogram/counts").dtype.itemsize
    held = context.tile_pixels * (2 * counted + 40 * 8)  # with the maps of a tile
    if source is not None:
        highest = max(band.y1 - band.y0 for band in bands)
        held += highest * sensor.nx * (counted + 2 * FRAMES_AT_ONCE * source.dtype.itemsize)
    unit_name = "tile" if source is None else "band"
    done = context.run_units(bands, task, unit_name=unit_name, needs="fit", unit_bytes=held)
    finished = [tile for tile in tiles if tile.key in done]
    if finished:
        if finished != fitted_tiles:
            fitted = _Fitted.read(store, finished)
        made = {"tiles": len(finished), "tiles_missing": context.n_keys - len(finished)}
        totals = _totals(store, job, [numbered[tile.key][0] for tile in finished])
        _write_result(store, totals, fitted, job, made)


def _chosen_frames(sensor: SensorInfo, settings: EnsembleSettings) -> tuple[int, int] | None:
    """Return first and end of the chosen frames, or None where the input has none."""
    if sensor.kind != "frames":
        return None
    if settings.frames == "all":
        return 0, sensor.n_frames
    first = settings.first_frame
    if first >= sensor.n_frames:
        raise ConfigError(
            f"ensemble.first_frame: {first}, but the run has frames 0 to {sensor.n_frames - 1}; lower it"
        )
    return first, min(first + settings.frames, sensor.n_frames)


def _place_in_truth(
    store: RunStore, config: RunConfig, shape: tuple[int, int]
) -> tuple[int, int, int] | None:
    """Return row, column and frame of the input's origin in the true electron numbers, where they exist."""
    if config.simulate is None or not store.has("truth/electron_number"):
        return None
    _, ny, nx = store.array("truth/electron_number").shape
    y0, y1, x0, x1 = config.input.roi or (0, ny, 0, nx)
    if (min(y1, ny) - y0, min(x1, nx) - x0) != shape:
        return None  # other files than the simulated ones
    return y0, x0, config.input.frame_range[0] if config.input.frame_range else 0


def _create(context: StageContext, axes: EnsembleAxes, n_tiles: int) -> None:
    """Make the rows of sums; start anew where more pixels have moved the axes."""
    context.begin()
    store, content = context.store, asdict(axes)
    if store.attributes("ensemble_tiles").get("axes") != content:
        done = store.records.done(context.stage, context.fingerprint)
        store.records.unmark(context.stage, context.fingerprint, done)
        store.delete("ensemble_tiles")
    for name in _SUMS:
        if not store.has(f"ensemble_tiles/{name}"):
            length = list(getattr(axes, name).values())[-1].stop
            store.create_array(f"ensemble_tiles/{name}", (n_tiles, length), chunks=(1, length))
    store.set_attributes("ensemble_tiles", {"axes": content})


def _do_band(band: Band | Tile, store: RunStore, *, job: _Job) -> None:
    """Sum over each tile of a band; frames, where they are needed, are read once for all of them."""
    some_frames = job.frames not in (None, (0, job.sensor.n_frames))
    chosen = _count(store, job, band) if some_frames else None
    errors = {} if job.truth is None else _compare(store, job, band)
    for key in markers(band):
        number, tile = job.tiles[key]
        of_tile = None if chosen is None else chosen.of(_in_band(tile, band))
        integers, floats = _sum_tile(store, tile, job, of_tile)
        if key in errors:
            sizes, signed = errors[key]
            integers[job.axes.integers["error_sizes"]] = sizes
            integers[job.axes.integers["compared"]] = sizes.sum()
            integers[job.axes.integers["signed_error"]] = signed
        for name, row in zip(_SUMS, (integers, floats), strict=True):
            store.write(f"ensemble_tiles/{name}", (slice(number, number + 1), slice(None)), row[None])


def _in_band(tile: Tile, band: Band | Tile) -> tuple[slice, slice]:
    return slice(tile.y0 - band.y0, tile.y1 - band.y0), slice(tile.x0, tile.x1)


def _sum_tile(
    store: RunStore, tile: Tile, job: _Job, chosen: PixelHistograms | None
) -> tuple[IntArray, FloatArray]:
    """Return what a tile adds to the ensemble; ``chosen``: histograms of some frames, None: of all."""
    fit, histogram = (store.at(tile.region, group) for group in ("fit", "histogram"))
    maps = [fit[name] for name in PARAMETERS]
    origin, low, high = (histogram[name].astype(np.int64) for name in _HISTOGRAM)
    counted = PixelHistograms(histogram["counts"], origin, histogram["under"] + histogram["over"])
    errors = _errors(fit, tile, job.sensor.shape)
    numbers = np.arange(origin.size).reshape(origin.shape)  # of the pixels, in C order
    rows = []
    for part in parts_told(tile.parts(store.array("histogram/counts").shape[2])):
        everything = counted.of(part).cut(low[part], high[part])
        some = everything if chosen is None else chosen.of(part).cut(low[part], high[part])
        place, of_pixels = tile.within(part), [values[part] for values in maps]
        row = ensemble_tile(
            tuple(values.ravel() for values in of_pixels),
            some,
            everything,
            job.axes,
            FittedModel.read(store, place).law(of_pixels).between(*(job.limits or (None, None))),
            fitted_satellites(store, place) if job.effects else None,
            None if errors is None else errors.of(numbers[part].ravel()),
        )
        rows.append(row)
    integers, floats = (np.sum(each, axis=0) for each in zip(*rows, strict=True))
    return integers, floats


def _errors(fit: Arrays, tile: Tile, shape: tuple[int, int]) -> PixelErrors | None:
    """Return the errors of the pixels of a tile in C order; None where they are not known."""
    if "correlation" not in fit:
        return None
    stderr = [fit[f"{name}_stderr"].ravel() for name in PARAMETERS]
    correlation = fit["correlation"]
    place = (np.arange(tile.y0, tile.y1)[:, None] * shape[1] + np.arange(tile.x0, tile.x1)).ravel()
    share = min(1.0, ERROR_PIXELS / math.prod(shape))
    return PixelErrors(np.stack(stderr, axis=1), correlation.reshape(place.size, -1), place, share)


def _stream(job: _Job, band: Band | Tile, frames: tuple[int, int]) -> FrameStream:
    assert job.source is not None
    return FrameStream(job.source, [(band.y0, band.y1)], FRAMES_AT_ONCE, frames=frames)


def _count(store: RunStore, job: _Job, band: Band | Tile) -> PixelHistograms:
    """Histogram the chosen frames of a band; the same samples lie outside as in the stored histograms."""
    assert job.frames is not None
    like = store.array("histogram/counts")
    histogram = store.at((slice(band.y0, band.y1), slice(None)), "histogram")
    origin, low, high = (histogram[name].astype(np.int64) for name in _HISTOGRAM)
    first, size = occupied(origin, low, high, like.shape[2])
    origin += first
    counts = np.zeros((*origin.shape, size), like.dtype)
    under, over = np.zeros((2, *origin.shape), dtype=np.uint32)
    gone = uncounted_frames(odd_frames_of(store)[0])
    with _stream(job, band, job.frames) as stream:
        for t, (block,) in stream:
            kept = ~np.isin(np.arange(t, t + len(block)), gone)
            counted = block if kept.all() else block[kept]
            count_frames(counted, origin.astype(np.int32), counts, under, over)
    return PixelHistograms(counts, origin, under + over)


def _compare(store: RunStore, job: _Job, band: Band | Tile) -> dict[str, tuple[IntArray, int]]:
    assert job.truth is not None
    assert job.source is not None
    assert job.frames is not None
    y0, x0, t0 = job.truth
    first, end = job.frames
    known = min(end, store.array("truth/electron_number").shape[0] - t0)
    found: dict[str, tuple[IntArray, int]] = {}
    if known <= first:
        return found
    columns = slice(x0, x0 + job.source.shape[2])
    tables = read_tables(store, slice(band.y0, band.y1))
    with _stream(job, band, (first, known)) as stream:
        for t, (block,) in stream:
            times = slice(t0 + t, t0 + t + block.shape[0])
            true = store.read("truth/electron_number", (times, slice(y0 + band.y0, y0 + band.y1), columns))
            numbers = tables.convert(block).number
            for key in markers(band):
                tile = job.tiles[key][1]
                part = (slice(None), *_in_band(tile, band))
                sizes, signed = compare_electron_numbers(numbers[part], true[part], ERROR_SIZES)
                before, signed_before = found.get(key, (0, 0))
                found[key] = before + sizes, signed_before + signed
    return found


def _totals(store: RunStore, job: _Job, rows: list[int]) -> EnsembleTotals:
    samples = (1, 1)
    if job.frames is not None:
        gone, (first, end) = uncounted_frames(odd_frames_of(store)[0]), job.frames
        left_out = int(((gone >= first) & (gone < end)).sum())
        samples = end - first - left_out, job.sensor.n_frames - gone.size
    integers, floats = (
        sum(store.read(f"ensemble_tiles/{name}", (number, slice(None))) for number in rows) for name in _SUMS
    )
    return EnsembleTotals(job.axes, np.asarray(integers), np.asarray(floats), samples)


def _write_result(
    store: RunStore, totals: EnsembleTotals, fitted: _Fitted, job: _Job, facts: dict[str, Any]
) -> None:
    """Write the arrays of the group ``ensemble`` and its numbers (attributes of the group).

    The attributes are the facts (``rmse``, counts, error rates), ``moments`` (rows of Appendix A),
    ``component_cases`` (parameters held constant, a list for each row of ``component_variance``) and
    ``missing`` (part to reason).
    """
    settings, frames, pixels = job.config.ensemble, job.frames, fitted.pixels
    per_pixel: int | NDArray[Any] = totals.samples[0]
    if frames is None:
        per_pixel = store.read("histogram/counts")[fitted.place].sum(axis=1, dtype=np.int64)
    weight = np.ones(len(pixels))
    if store.has("fit/likelihood_gap"):
        gap, words = (store.read(f"fit/{name}")[fitted.place] for name in ("likelihood_gap", "fit_status"))
        with np.errstate(divide="ignore"):  # one whose H, or gain, is more open may be off by any number
            wide = np.minimum(2.0 * pixels.maps[0] ** 2 / per_pixel, 0.5 / gap) > 0.25
        weight = bias_weight(np.where(wide | (words & int(flags_of("conversion_gain")) != 0), 0.0, gap))
    true, simulated = None, job.config.simulate
    if job.truth is not None and simulated is not None and not simulated.effects:
        # of the pixels with a value, if they are all that made the frames
        (y0, x0, _), (ny, nx) = job.truth, job.sensor.shape
        truth = store.at((slice(y0, y0 + ny), slice(x0, x0 + nx)), "truth")
        of_truth, known = UsablePixels.from_maps([truth[name][fitted.place] for name in PARAMETERS])
        true = of_truth if known.all() else None
    missing: dict[str, str] = {}
    if frames is None:
        missing["frames"] = f"input is {job.sensor.kind}: the ensemble has all samples"
    if totals.count("compared") == 0:
        missing["truth"] = (
            "unknown true electron numbers"
            if simulated is None
            else "no true electron numbers stored for these frames"
        )
    arrays, found = curves(totals, pixels, settings, job.limits)
    numbers, electron_facts = electron_numbers_of(totals, pixels, settings)
    arrays |= numbers | components(pixels, numbers["electron_pmf"], weight)
    n, n_all = totals.samples
    found |= electron_facts | error_rates(totals, pixels, true)
    found |= {
        "n_frames": None if frames is None else n,
        "n_frames_all": None if frames is None else n_all,
        "first_frame": None if frames is None else frames[0],
        "n_pixels": totals.count("pixels"),
        "n_pixels_without_value": totals.count("excluded"),
        "pixels_of_open_bias": float(np.sum(1.0 - weight)),
        "moments": moment_rows(
            totals, pixels, per_pixel, weight, extended=bool(job.effects) or job.limits is not None
        ),
        "component_cases": COMPONENT_CASES,
        "missing": missing,
    }
    if job.effects:
        found["model"] = model_words(job.effects)
    for name, values in arrays.items():
        store.write_array(f"ensemble/{name}", values)
    store.set_attributes("ensemble", plain(found | facts))
