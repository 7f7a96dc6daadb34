"""Stage ``ensemble``: the sensor as a whole, predicted from its maps and compared with its data.

Every tile leaves two rows of sums (see :mod:`pchem_pipeline.stages.ensemble.tile`); what is stored in the
group ``ensemble`` is made of their total and of the whole maps.
"""

from __future__ import annotations

import functools
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.variables import FREE_LOBES, PARAMETERS
from pchem_pipeline.frames.stream import FrameStream
from pchem_pipeline.model.electrons.electrons import ErrorTally, compare_electron_numbers, electron_numbers
from pchem_pipeline.model.ensemble.ensemble import DnAxis, electron_pmf, nuced_axis
from pchem_pipeline.model.errors.fisher import covariance_from
from pchem_pipeline.model.histogram.count_numba import count_frames
from pchem_pipeline.model.maps.pixels import PixelParameters
from pchem_pipeline.run.frame_source import open_source
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.bands import tile_bands
from pchem_pipeline.stages.ensemble.result import pixels_of, write_result
from pchem_pipeline.stages.ensemble.tile import ERROR_SIZES, EnsembleAxes, PixelHistograms, ensemble_tile
from pchem_pipeline.stages.fit.fitted_model import deciding_maps, fitted_added_exposure, fitted_effects

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.frames.stream import FrameSource
    from pchem_pipeline.stages.bands import Band
    from pchem_pipeline.store.tiles import Tile

__all__ = ["ensemble_tile", "run"]

#: Frames read at a time, and bytes of histograms of a band.
_BLOCK_FRAMES = 64
_BAND_BYTES = 64 << 20
_SUMS = ("integers", "floats")


@dataclass(frozen=True)
class _Job:
    """What every band is told.

    Attributes:
        store: path of the run.
        axes: axes of the ensemble.
        tiles: number and place of each tile by its key.
        frames: the chosen frames (first, end), or None for all of the histogram.
        source: where frames come from, if any are read.
        truth: first row, first column and first frame of the input in the true electron numbers, or None.
        effects: with which the maps were fitted.
    """

    store: Path
    axes: EnsembleAxes
    tiles: dict[str, tuple[int, Tile]]
    frames: tuple[int, int] | None
    source: FrameSource | None
    truth: tuple[int, int, int] | None
    effects: tuple[Effect, ...]


def run(context: StageContext) -> None:
    """Predict the ensemble and compare it with the data.

    Raises:
        ConfigError: the chosen frames do not exist.
        InputError: the camera files vanished or changed.
        StoreError: an upstream stage is missing, or the store refuses.
    """
    tiles = context.tiles()
    frames = _chosen_frames(context)
    truth = _place_in_truth(context) if frames is not None else None
    everything = frames == (0, context.sensor.n_frames)
    source = open_source(context) if frames is not None and (truth or not everything) else None
    if context.sensor.kind == "histograms":
        context.note(
            "the input is histograms: the ensemble is of all samples, every channel counting the same"
        )
    ready = context.tiles_done("fit")
    axes = _axes(context, [tile for tile in tiles if tile.key in ready])
    if axes is None:
        if ready:
            context.note("no pixel has a value, so there is no ensemble; fit_status says why for each")
        context.run_units(tiles, _leave_out, needs="fit")
        return
    _create(context, axes, len(tiles))
    job = _Job(
        context.store.path,
        axes,
        {tile.key: (number, tile) for number, tile in enumerate(tiles)},
        None if everything else frames,
        source,
        truth,
        fitted_effects(context.store),
    )
    bins = context.store.array("histogram/counts").shape[2]
    rows = max(1, _BAND_BYTES // (context.sensor.nx * bins * 4))
    bands = tile_bands(context, "fit", rows, 1 if source is None else source.rows_per_read)
    done = context.run_units(bands, functools.partial(_do_band, job=job), unit_name="band", needs="fit")
    finished = [tile for tile in tiles if tile.key in done]
    if finished:
        numbers = [number for key, (number, _) in job.tiles.items() if key in done]
        write_result(context, axes, finished, numbers, frames, truth)


def _leave_out(tile: Tile) -> dict[str, Any]:
    """Do nothing for a tile, so that it counts as done."""
    return {}


def _chosen_frames(context: StageContext) -> tuple[int, int] | None:
    """Return first and end of the chosen frames, or None where the input has none."""
    sensor, settings = context.sensor, context.config.ensemble
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


def _place_in_truth(context: StageContext) -> tuple[int, int, int] | None:
    """Return row, column and frame of the input's origin in the true electron numbers, where they exist."""
    store, settings = context.store, context.config.input
    if context.config.simulate is None or not store.has("truth/electron_number"):
        return None
    _, ny, nx = store.array("truth/electron_number").shape
    y0, y1, x0, x1 = settings.roi or (0, ny, 0, nx)
    if (min(y1, ny) - y0, min(x1, nx) - x0) != context.sensor.shape:
        return None  # other files than the simulated ones
    return y0, x0, settings.frame_range[0] if settings.frame_range else 0


def _axes(context: StageContext, tiles: list[Tile]) -> EnsembleAxes | None:
    """Choose the axes from the maps of all finished tiles; None where no pixel has a value."""
    store, settings = context.store, context.config.ensemble
    pixels, mask = PixelParameters.from_maps([pixels_of(store, f"fit/{name}", tiles) for name in PARAMETERS])
    if len(pixels) == 0:
        return None
    bins = store.array("histogram/counts").shape[2]
    origin, low, high = (
        pixels_of(store, f"histogram/{name}", tiles)[mask] for name in ("origin", "minimum", "maximum")
    )
    start = int(np.maximum(low, origin).min())
    end = int(np.minimum(high, origin + bins - 1).max()) + 1
    dn = DnAxis(start, end - start)
    nuced = nuced_axis(pixels, dn, width=settings.nuced_bin_width, steps=settings.nuced_bin_steps)
    largest = min(float(pixels.quanta_exposure.max()), 60_000.0)
    mass = electron_pmf(pixels.quanta_exposure, int(largest + 12 * math.sqrt(largest) + 40))
    n_k = int(np.searchsorted(np.cumsum(mass), 1.0 - 1e-7)) + 2
    return EnsembleAxes(dn, nuced, n_k, bool(fitted_effects(store)))


def _create(context: StageContext, axes: EnsembleAxes, n_tiles: int) -> None:
    """Make the rows of sums; start anew where more pixels have moved the axes."""
    store = context.store
    content = asdict(axes)
    if store.attributes("ensemble_tiles").get("axes") != content:
        for key in store.records.done(context.stage, context.fingerprint):
            store.records.unmark(context.stage, context.fingerprint, key)
        store.delete("ensemble_tiles")
    for name in _SUMS:
        if not store.has(f"ensemble_tiles/{name}"):
            length = list(getattr(axes, name).values())[-1].stop
            store.create_array(f"ensemble_tiles/{name}", (n_tiles, length), chunks=(1, length))
    store.set_attributes("ensemble_tiles", {"axes": content})


def _do_band(band: Band, *, job: _Job) -> dict[str, Any]:
    """Sum over each tile of a band."""
    store = open_store(job.store)
    rows = (slice(band.y0, band.y1), slice(None))
    origin = store.read("histogram/origin", rows)
    counts = store.read("histogram/counts", (*rows, slice(None)))
    outside = store.read("histogram/under", rows) + store.read("histogram/over", rows)
    maps = tuple(store.read(f"fit/{name}", rows) for name in PARAMETERS)
    lobes = None
    if job.effects:
        lobes = tuple(store.read(f"fit/{name}", rows) for name in FREE_LOBES)
    added = fitted_added_exposure(store, rows)
    covariance = None
    if store.has("fit/correlation"):
        stderr = np.stack([store.read(f"fit/{name}_stderr", rows) for name in PARAMETERS], axis=-1)
        covariance = covariance_from(stderr, store.read("fit/correlation", (*rows, slice(None))))
    chosen, chosen_outside = counts, outside
    if job.frames is not None:
        chosen, chosen_outside = _count(job, band, origin, counts)
    errors = _compare(job, band, deciding_maps(maps, job.effects, added)) if job.truth is not None else {}
    for key in band.keys:
        number, tile = job.tiles[key]
        part = (slice(tile.y0 - band.y0, tile.y1 - band.y0), slice(tile.x0, tile.x1))
        n = math.prod(tile.shape)
        integers, floats = ensemble_tile(
            tuple(values[part].ravel() for values in maps),
            origin[part].ravel(),
            PixelHistograms(chosen[part].reshape(n, -1), chosen_outside[part].ravel()),
            PixelHistograms(counts[part].reshape(n, -1), outside[part].ravel()),
            job.axes,
            job.effects,
            None if lobes is None else (lobes[0][part].ravel(), lobes[1][part].ravel()),
            None if covariance is None else covariance[part].reshape(n, 4, 4),
            None if added is None else added.of(part).flat(),
        )
        if key in errors:
            integers[job.axes.integers["error_sizes"]] = errors[key].by_size
            integers[job.axes.integers["compared"]] = errors[key].n_samples
            integers[job.axes.integers["signed_error"]] = errors[key].signed
        for name, row in zip(_SUMS, (integers, floats), strict=True):
            store.write(f"ensemble_tiles/{name}", (slice(number, number + 1), slice(None)), row[None])
    return {}


def _stream(job: _Job, band: Band, frames: tuple[int, int]) -> FrameStream:
    """Open the stream of the frames of a band."""
    assert job.source is not None
    return FrameStream(job.source, [(band.y0, band.y1)], _BLOCK_FRAMES, frames=frames)


def _count(
    job: _Job, band: Band, origin: NDArray[Any], like: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Histogram the chosen frames of a band on the bins of the stored histograms."""
    assert job.frames is not None
    counts = np.zeros_like(like)
    under, over = np.zeros((2, *origin.shape), dtype=np.uint32)
    with _stream(job, band, job.frames) as stream:
        for _, (block,) in stream:
            count_frames(block, origin, counts, under, over)
    return counts, under + over


def _compare(job: _Job, band: Band, maps: tuple[NDArray[np.float64], ...]) -> dict[str, ErrorTally]:
    """Compare estimated with true electron numbers of the chosen frames, tile by tile."""
    assert job.truth is not None
    assert job.source is not None
    store, (y0, x0, t0) = open_store(job.store), job.truth
    first, end = job.frames or (0, job.source.shape[0])
    known = min(end, store.array("truth/electron_number").shape[0] - t0)
    found: dict[str, ErrorTally] = {}
    if known <= first:
        return found
    columns = slice(x0, x0 + job.source.shape[2])
    with _stream(job, band, (first, known)) as stream:
        for t, (block,) in stream:
            times = slice(t0 + t, t0 + t + block.shape[0])
            true = store.read("truth/electron_number", (times, slice(y0 + band.y0, y0 + band.y1), columns))
            numbers = electron_numbers(block, *maps)
            for key in band.keys:
                tile = job.tiles[key][1]
                part = (slice(None), slice(tile.y0 - band.y0, tile.y1 - band.y0), slice(tile.x0, tile.x1))
                tally = compare_electron_numbers(numbers[part], true[part], ERROR_SIZES)
                found[key] = found[key] + tally if key in found else tally
    return found
