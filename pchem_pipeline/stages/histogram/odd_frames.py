"""Frames that are empty, copies, or at another level: found from the sums of all rows, and left out of sums.

Empty frames, all pixels at one DN, are left out of the histograms, too: a link that drops frames says nothing
of the pixels.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.histogram.odd_frames import (
    FloatArray,
    IntArray,
    copied_frames,
    far_frames,
    left_out,
    odd_words,
)
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, OpenSums, SummaryAccumulator
from pchem_pipeline.run.frame_source import open_source
from pchem_pipeline.stages.histogram.arrays import COVARIANCES, MAPS, with_block_length

if TYPE_CHECKING:
    from pchem_pipeline.frames.stream import FrameSource
    from pchem_pipeline.run.stage import StageContext
    from pchem_pipeline.store.run_store import RunStore

_FEWEST_PIXELS = 64
#: Probability of an empty frame in the run by chance, below which it is no sample.
_IMPOSSIBLE = 1e-9
_AT_ONCE = 32  # frames


def odd_frames_of(store: RunStore) -> tuple[dict[str, IntArray], IntArray]:
    """Return the odd frames of a run by kind (empty, copied, far), and those that its sums are without."""
    known = store.attributes("summary")
    odd: Mapping[str, Any] = known.get("odd_frames", {})
    kinds = {kind: np.array(odd.get(kind, []), np.int64) for kind in ("empty", "copied", "far")}
    return kinds, np.array(known.get("left_out", []), np.int64)


def leave_out_odd_frames(context: StageContext, mean: FloatArray, variance: FloatArray) -> None:
    """Find odd frames, and leave them out of the sums over frames, and empty ones out of the histograms.

    Args:
        context: of the stage, whose bands are all done.
        mean: of each frame over its pixels, DN, (frame,).
        variance: likewise, DN^2.

    Raises:
        InputError: frames cannot be read again.
        StoreError: the store refuses.
    """
    store, pixels = context.store, math.prod(context.sensor.shape)
    empty = _empty(context, mean, variance)
    others = np.setdiff1d(np.arange(mean.size), empty)
    copied = far = others[:0]
    if pixels >= _FEWEST_PIXELS and others.size:
        copied = others[copied_frames(mean[others], variance[others], lambda at: _digests(store, others[at]))]
        others = np.setdiff1d(others, copied)
        far = others[far_frames(mean[others], variance[others], pixels)]
        far = _whole(store, far, mean.size)
    odd = {"empty": empty, "copied": copied, "far": far}
    out, (_, before) = left_out(odd, mean.size), odd_frames_of(store)
    if empty.size:
        _leave_out_of_histograms(context, empty, mean[empty].astype(np.int64))
        context.note(f"{odd_words({**odd, 'copied': copied[:0], 'far': far[:0]}, mean)}: not counted")
    changed = np.union1d(out, before)
    if changed.size:
        _leave_out_of_sums(context, open_source(context), changed, out)
    numbers = {kind: frames.tolist() for kind, frames in odd.items()}
    store.set_attributes("summary", {"odd_frames": numbers, "left_out": out.tolist()})


def _empty(context: StageContext, mean: FloatArray, variance: FloatArray) -> IntArray:
    """Return the frames whose pixels all have one DN, where chance makes none: by the pixels' histograms."""
    candidates = np.flatnonzero(variance == 0.0)
    if candidates.size in (0, mean.size):
        return candidates[:0]
    levels, kind = np.unique(mean[candidates].astype(np.int64), return_inverse=True)
    log_chance = np.zeros(levels.size)
    for tile in context.tiles():
        counts, origin, under, over = _histograms(context.store, tile.region)
        total = counts.sum(axis=2) + under + over
        for i, dn in enumerate(levels):
            number = np.where(dn < origin, under, over)
            inside = (dn >= origin) & (dn < origin + counts.shape[2])
            number[inside] = counts[inside, dn - origin[inside]]
            # a pixel whose empty frames were left out before has none
            log_chance[i] += float(np.log(np.maximum(number, 0.5) / np.maximum(total, 1)).sum())
    return candidates[(log_chance + math.log(mean.size) < math.log(_IMPOSSIBLE))[kind]]


def _histograms(store: RunStore, region: Any) -> tuple[NDArray[Any], ...]:
    parts = (store.read(f"histogram/{name}", region) for name in ("counts", "origin", "under", "over"))
    return tuple(part.astype(np.int64) for part in parts)


def _leave_out_of_histograms(context: StageContext, frames: IntArray, levels: IntArray) -> None:
    """Take samples of empty frames out of all histograms; again, it takes out those that are there still."""
    store = context.store
    for tile in context.tiles():
        counts, origin, under, over = _histograms(store, tile.region)
        low, high = (store.read(f"histogram/{name}", tile.region) for name in ("minimum", "maximum"))
        there = counts.sum(axis=2) + under + over - (context.sensor.n_frames - frames.size)
        for number, dn in enumerate(levels[::-1].tolist()):
            some = there > number
            inside = some & (dn >= origin) & (dn < origin + counts.shape[2])
            counts[inside, dn - origin[inside]] -= 1
            under -= some & (dn < origin)
            over -= some & (dn >= origin + counts.shape[2])
        filled = counts > 0
        low = np.where(under == 0, origin + filled.argmax(axis=2), low)
        high = np.where(over == 0, origin + counts.shape[2] - 1 - filled[:, :, ::-1].argmax(axis=2), high)
        for name, values in zip(("counts", *MAPS), (counts, origin, under, over, low, high), strict=True):
            array = store.array(f"histogram/{name}")
            store.write(f"histogram/{name}", tile.region, values.astype(array.dtype))


def _digests(store: RunStore, frames: IntArray) -> list[bytes]:
    """Return digests of the sums, and sums of squares, along the rows of some frames, increasing."""
    found = []
    for part in _by_chunks(store, frames):
        first, end = int(part[0]), int(part[-1]) + 1
        names = ("summary/row_sum", "summary/row_sum_square")
        rows = [store.read(name, (slice(first, end), slice(None))) for name in names]
        found += [hashlib.sha256(b"".join(each[t - first].tobytes() for each in rows)).digest() for t in part]
    return found


def _by_chunks(store: RunStore, frames: IntArray) -> list[IntArray]:
    """Return frames by the chunks of row sums that they are in."""
    if not frames.size:
        return []
    step = store.array("summary/row_sum").chunks[0]
    return np.split(frames, np.flatnonzero(np.diff(frames // step)) + 1)


def _whole(store: RunStore, frames: IntArray, n_frames: int) -> IntArray:
    """Return those of far frames that are so in most rows: the track of a particle moves the mean, too."""
    kept: list[int] = []
    for part in _by_chunks(store, frames):
        step = store.array("summary/row_sum").chunks[0]
        first = int(part[0]) // step * step
        rows = store.read("summary/row_sum", (slice(first, min(first + step, n_frames)), slice(None)))
        apart = rows[part - first] - np.median(rows, axis=0)
        kept += part[np.median(apart, axis=1) / np.mean(apart, axis=1) > 0.5].tolist()
    return np.array(kept, np.int64)


def _leave_out_of_sums(context: StageContext, source: FrameSource, changed: IntArray, out: IntArray) -> None:
    """Write block sums and covariances without odd frames, from their blocks' frames and what all gave.

    Args:
        context: of the stage.
        source: the frames.
        changed: frames whose blocks are done again.
        out: frames that are left out.
    """
    store, (n_frames, ny, _) = context.store, source.shape
    length = with_block_length(context.config.histogram, store).block_length(n_frames)
    kept = ~np.isin(np.arange(n_frames), out)
    rows = max(context.tile[0], ROW_GROUP)
    for y0 in range(0, ny, rows):
        band = (slice(None), slice(y0, min(y0 + rows, ny)), slice(None))
        state = OpenSums(*(store.read(f"summary/open_{name}", band) for name in ("sums", "covariances")))
        sums = SummaryAccumulator.resumed(state, n_frames, length)
        sums.finish()
        for block in np.unique(changed // length).tolist():
            first, end = block * length, min((block + 1) * length, n_frames)
            pieces = _pieces(source, (first, end), (y0, min(y0 + rows, ny)))
            for name, values in vars(sums.exchange(pieces, kept[first:end])).items():
                store.write(f"summary/{name}", (slice(block, block + 1), *band[1:]), values[None])
        _, covariances = sums.finish()
        for name in COVARIANCES:
            store.write(f"summary/{name}", band[1:], getattr(covariances, name))


def _pieces(
    source: FrameSource, frames: tuple[int, int], rows: tuple[int, int]
) -> Iterator[NDArray[np.unsignedinteger[Any]]]:
    for first in range(*frames, _AT_ONCE):
        end = min(first + _AT_ONCE, frames[1])
        block = np.empty((end - first, rows[1] - rows[0], source.shape[2]), source.dtype)
        source.read_into(block, first, end, *rows)
        yield block
