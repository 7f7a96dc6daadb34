"""Where a run stands out, over the whole sensor and all frames, before a part of it is compared closely.

Three kinds of sums are looked at. Those of the stage ``histogram`` say whether neighbours and successive
samples resemble each other and whether levels wander; the histograms of all pixels, against the law of their
fit, say whether shapes and tails differ by place; and one more pass over the frames says whether the pixels
of a row, a column or a frame move together in some place. Rows are done in bands, so that the tables of their
pixels and a block of frames take the memory that the run may have, or no more than 1.4 GB.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.compute.memory import resident_bytes
from pchem_pipeline.discrepancy.observe.observe import UNTRUSTWORTHY
from pchem_pipeline.discrepancy.observe.sums import CHANNELS, FrameBlocks, Samples
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, PixelLaws, pixel_laws
from pchem_pipeline.discrepancy.observe.vector import goodness_of
from pchem_pipeline.discrepancy.quick.sums import CellMap, StackSums, sensor_cells, sensor_places
from pchem_pipeline.discrepancy.scan import Suspect
from pchem_pipeline.discrepancy.scan_pairs import pairs_bytes, scan_pairs
from pchem_pipeline.effects.framework.evidence import SCORES, PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.frames.stream import FrameSource
from pchem_pipeline.model.arithmetic.significance import NO_CHANCE, SIGNIFICANCE
from pchem_pipeline.run.model_versions import model_of
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.bands import FRAMES_AT_ONCE
from pchem_pipeline.stages.discrepancy.window import PAIRS, SHAPES, SUMS, Spot, Survey, frame_blocks
from pchem_pipeline.stages.histogram.odd_frames import odd_frames_of
from pchem_pipeline.stages.quick_look import read_sums
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import equal_rows

#: Codes of the tables of a band at most.
_MOST_CODES = 1 << 26
#: Bytes of a band for each sample that is looked at at once.
_SAMPLE_BYTES = 28
#: Such samples at most.
_MOST_AT_ONCE = 1 << 22
#: Samples whose pairs are summed at most: some five minutes.
_MOST_SAMPLES = 1 << 31


def survey(context: StageContext, source: FrameSource, compared: int) -> Survey:
    """Look at every pixel and every frame of a run.

    The frames of a run with no more samples than can be ``compared`` closely are not read here.
    """
    store, shape = context.store, source.shape
    odd, left_out = odd_frames_of(store)
    places = places_of_sums(read_sums(store), shape[1:])
    shares = {} if places is None else {SUMS: 1.0}
    model = model_of(store, "fit")
    records = [store.records.read(stage) for stage in ("histogram", "fit")]
    done = all(record is not None and store.records.has_all(record) for record in records)
    if math.prod(shape) > compared and done and model is not None:
        limit = context.config.compute.max_memory
        memory = None if limit is None else (limit << 20) - resident_bytes()
        here, more = places_of_bands(store, source, plain=not model.effects, memory=memory, left_out=left_out)
        places, shares = (places or {}) | here, shares | more
    spots = {name: Spot(each.region, each.p) for name, each in (places or {}).items()}
    return Survey(spots, shares, tuple(left_out.tolist()), tuple(odd["copied"].tolist()))


def places_of_sums(sums: StackSums | None, shape: tuple[int, int]) -> dict[str, Suspect] | None:
    """Return where the sums of the stage histogram stand out; None where there are none of such a sensor."""
    if sums is None or sums.shape != shape or sums.freedom <= 0:
        return None
    return sensor_places(sensor_cells(sums), SIGNIFICANCE)


def places_of_bands(
    store: RunStore,
    source: FrameSource,
    *,
    plain: bool = True,
    memory: int | None = None,
    left_out: IntArray | tuple[int, ...] = (),
) -> tuple[dict[str, Suspect], dict[str, float]]:
    """Return where histograms and pairs of pixels stand out, and the share of the samples looked at.

    The pixels are ``plain`` if they were fitted without effects, so that their histograms follow the plain
    law. This takes ``memory`` bytes at most, by lower bands; None: what the highest ones take.

    Raises:
        ConfigError: it is not enough for the lowest ones.
    """
    n, ny, nx = source.shape
    rows, at_once = _band_size(store, (ny, nx), memory)
    bands = equal_rows(ny, rows)
    numbers = np.setdiff1d(_spread_frames(n, _MOST_SAMPLES // (ny * nx)), left_out)
    maps = {name: CellMap.empty((ny, nx)) for name in (*(f"score.{s}" for s in SCORES), "goodness")}
    places: dict[str, Suspect] = {}
    for first, last in bands:
        fitted, laws = _laws(store, (first, last))
        shapes = {f"score.{name}": laws.scores[:, 0, j] for j, name in enumerate(SCORES)}
        shapes["goodness"] = goodness_of(laws.moments["goodness"])
        for name, values in shapes.items():
            maps[name].add(np.where(laws.good, values, np.nan).reshape(last - first, nx), first)
        if not laws.good.any():
            continue
        blocks = partial(frame_blocks, source, numbers, (first, last))
        samples = Samples.by_laws(FrameBlocks(numbers.size, blocks), laws, fitted)
        samples = replace(samples, most=at_once)
        del laws
        for each in scan_pairs(samples, significance=SIGNIFICANCE / len(bands), most=1):
            name = f"pairs.{each.mode}.{CHANNELS[each.channel]}"
            mask = np.zeros((ny, nx), np.bool_)
            mask[first:last] = each.region.mask((last - first, nx))
            root = math.sqrt(numbers.size)
            place = replace(
                each,
                region=Region.of_mask(mask),
                log_p=min(0.0, each.log_p + math.log(len(bands))),
                inside=each.inside * root,
                outside=each.outside * root,
            )
            if name not in places or place.p < places[name].p:
                places[name] = place
    shares = {PAIRS: numbers.size / n}
    if plain:
        # maps of shapes rest on fits, whose errors are not quite normal
        places |= sensor_places(maps, NO_CHANCE)
        shares[SHAPES] = 1.0
    return places, shares


def _band_size(store: RunStore, shape: tuple[int, int], memory: int | None) -> tuple[int, int]:
    """Return the rows of a band, and the samples of its frames looked at at once, within a memory, bytes."""
    ny, nx = shape
    counts = store.array("histogram/counts")
    fewest = min(ny, 8)
    rows = max(fewest, min(ny, _MOST_CODES // (nx * counts.shape[2])))
    if memory is None:
        return rows, _MOST_AT_ONCE
    # bytes for each code of a law, and for each pixel
    pixel = counts.shape[2] * counts.dtype.itemsize + 20 * mean_codes(store) + 800 + _SAMPLE_BYTES
    left = 0
    for lower in range(rows, fewest - 1, -1):
        left = memory - pairs_bytes((lower, nx))
        at_once = min(_MOST_AT_ONCE, max(left, 0) // 4 // _SAMPLE_BYTES)
        if lower * nx * pixel <= left - at_once * _SAMPLE_BYTES:
            return lower, at_once
    lacking = math.ceil((fewest * nx * pixel * 4 / 3 - left) / 2**20)
    raise ConfigError(
        f"discrepancy needs {lacking} MiB more for {fewest} rows of the sensor; raise compute.max_memory "
        "(--max-memory)"
    )


def mean_codes(store: RunStore) -> float:
    """Return how many codes the law of a pixel has, on average in the row with the most."""
    span = store.read("histogram/maximum") - store.read("histogram/minimum")
    # the law reaches a little beyond the smallest and the largest sample
    return float(span.mean(axis=1).max()) * 1.2 + 8


def _spread_frames(n: int, most: int) -> IntArray:
    """Return the numbers of all frames, or of blocks spread over the run."""
    if most >= n:
        return np.arange(n, dtype=np.int64)
    starts = np.unique(np.linspace(0, n - FRAMES_AT_ONCE, max(most // FRAMES_AT_ONCE, 1)).astype(np.int64))
    return np.unique((starts[:, None] + np.arange(min(FRAMES_AT_ONCE, n))).ravel())


def _laws(store: RunStore, rows: tuple[int, int]) -> tuple[PixelMaps, PixelLaws]:
    """Return the fit of the pixels of some rows, and their laws with their histograms."""
    part = slice(*rows), slice(None)
    values = [store.read(f"fit/{name}", part).astype(np.float64) for name in PARAMETERS]
    counts, *outside = (store.read(f"histogram/{name}", part) for name in ("counts", "under", "over"))
    usable = (store.read("fit/fit_status", part) & int(UNTRUSTWORTHY)) == 0
    usable &= np.isfinite(values).all(axis=0)
    usable &= counts.sum(axis=2) >= np.maximum(50, 100.0 * sum(outside))
    maps = PixelMaps(values[0], values[1], values[2], values[3], usable)
    origin = store.read("histogram/origin", part).ravel().astype(np.int64)
    beyond = np.stack([each.ravel() for each in outside], axis=1).astype(np.float64)
    seen = PixelHistograms(counts.reshape(-1, counts.shape[2]), origin, beyond)
    laws = pixel_laws(seen, maps.columns, usable.ravel())
    return replace(maps, usable=laws.good.reshape(usable.shape)), laws
