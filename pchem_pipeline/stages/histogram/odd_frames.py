"""Odd frames are left out of the sums over frames, empty ones and copies of the histograms, too.

All frames are counted before. A link that drops or repeats frames says nothing of the pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.frames.stream import FrameSource, FrameStream
from pchem_pipeline.model.histogram.odd_frames import KINDS, left_out, odd_words
from pchem_pipeline.model.histogram.spectrum import FrameSpectrum
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, SummaryAccumulator
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.bands import FRAMES_AT_ONCE
from pchem_pipeline.stages.histogram.arrays import MAPS, with_block_length
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile, equal_rows


def odd_frames_of(store: RunStore) -> tuple[dict[str, IntArray], IntArray]:
    """Return the odd frames of a run by kind, and those that its sums are without."""
    known = store.attributes("summary")
    odd = known.get("odd_frames", {})
    kinds = {kind: np.array(odd.get(kind, []), np.int64) for kind in KINDS}
    return kinds, np.array(known.get("left_out", []), np.int64)


def uncounted_frames(odd: Mapping[str, IntArray]) -> IntArray:
    """Return the frames that are in no histogram: empty ones and copies of others."""
    return np.union1d(odd["empty"], odd["copied"])


def leave_out_odd_frames(
    context: StageContext, odd: dict[str, IntArray], mean: FloatArray, variance: FloatArray
) -> None:
    """Leave odd frames (by kind) out once all bands are done; again where that was done in part before.

    ``mean`` (DN) and ``variance`` (DN^2) are those of each frame over its pixels.

    Raises:
        InputError: frames cannot be read again.
        StoreError: the store refuses.
    """
    out, (_, before) = left_out(odd, mean.size), odd_frames_of(context.store)
    gone = uncounted_frames(odd)
    if gone.size:
        _leave_out_of_histograms(context, gone)
        useless = {kind: odd[kind] for kind in ("empty", "copied")}
        context.note(f"{odd_words(useless, mean, variance)}: not counted")
    changed = np.union1d(out, before)
    if changed.size:
        _leave_out_of_sums(context, changed, out)
        _leave_out_of_spectrum(context, out)
    numbers = {kind: frames.tolist() for kind, frames in odd.items()}
    context.store.set_attributes("summary", {"odd_frames": numbers, "left_out": out.tolist()})


def _leave_out_of_histograms(context: StageContext, frames: IntArray) -> None:
    """Take samples of frames out of all histograms, those that are there still: the newest."""
    store, source = context.store, open_source(context)
    newer = dict(zip(frames.tolist(), range(frames.size)[::-1], strict=True))
    for tile in context.tiles():
        held = store.at(tile.region, "histogram")
        before = {name: held[name] for name in ("counts", *MAPS)}
        counts, origin, under, over, low, high = (values.astype(np.int64) for values in before.values())
        last = origin + counts.shape[2] - 1
        surplus = counts.sum(axis=2) + under + over - (context.sensor.n_frames - frames.size)
        for t, dn in _samples(source, tile, newer):
            some = surplus > newer[t]
            inside = some & (dn >= origin) & (dn <= last)
            counts[inside, (dn - origin)[inside]] -= 1
            under -= some & (dn < origin)
            over -= some & (dn > last)
        filled = counts > 0
        low = np.where(under == 0, origin + filled.argmax(axis=2), low)
        high = np.where(over == 0, last - filled[:, :, ::-1].argmax(axis=2), high)
        for (name, old), new in zip(before.items(), (counts, origin, under, over, low, high), strict=True):
            held[name] = new.astype(old.dtype)


def _samples(source: FrameSource, tile: Tile, frames: Iterable[int]) -> Iterator[tuple[int, IntArray]]:
    """Yield the samples of a tile, (y, x), of each of some frames, which are read by blocks."""
    for block, some in groupby(frames, lambda t: t // FRAMES_AT_ONCE):
        t0, t1 = block * FRAMES_AT_ONCE, min((block + 1) * FRAMES_AT_ONCE, source.shape[0])
        held = np.empty((t1 - t0, tile.y1 - tile.y0, source.shape[2]), source.dtype)
        source.read_into(held, t0, t1, tile.y0, tile.y1)
        for t in some:
            yield t, held[t - t0, :, tile.x0 : tile.x1].astype(np.int64)


def _leave_out_of_spectrum(context: StageContext, out: IntArray) -> None:
    source, rows = open_source(context), (0, min(context.sensor.shape[0], ROW_GROUP))
    spectrum = FrameSpectrum((rows[1], source.shape[2]))
    frames, step = (0, min(spectrum.most, source.shape[0])), context.config.histogram.window_frames
    with FrameStream(source, [rows], step, frames=frames) as stream:
        for start, (part,) in stream:
            spectrum.add(part[~np.isin(np.arange(start, start + len(part)), out)])
    context.store.set_attributes("summary", {"spectrum": spectrum.line()})


def _leave_out_of_sums(context: StageContext, changed: IntArray, out: IntArray) -> None:
    """Write block sums and covariances without frames ``out``; blocks of ``changed`` ones are read again."""
    store, source = context.store, open_source(context)
    n_frames, ny, _ = source.shape
    length = with_block_length(context.config.histogram, store).block_length(n_frames)
    kept = ~np.isin(np.arange(n_frames), out)
    step = max(context.tile[0], ROW_GROUP)
    for rows in equal_rows(ny, step):
        band = (slice(*rows), slice(None))
        sums = SummaryAccumulator.resumed(store.at(band, "summary"), n_frames, length)
        sums.finish()
        for block in np.unique(changed // length).tolist():
            frames = block * length, min((block + 1) * length, n_frames)
            with FrameStream(source, [rows], FRAMES_AT_ONCE, frames=frames) as stream:
                done = sums.exchange((piece for _, (piece,) in stream), kept[slice(*frames)])
            for name, values in done.items():
                store.write(f"summary/{name}", (slice(block, block + 1), *band), values[None])
        _, covariances = sums.finish()
        for name, covariance in covariances.items():
            store.write(f"summary/{name}", band, covariance)
