"""The counter of a stack: histograms and summaries of blocks of frames as they come, by bands of rows.

One pass over the camera files, bands of rows that are read one after the other, and frames that are appended
to a finished run differ in how they open the stream of blocks; they are counted by one `StackCounter`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.frames.stream import Block, Rows
from pchem_pipeline.model.histogram.count import HistogramAccumulator, RowHistograms
from pchem_pipeline.model.histogram.odd_frames import MovedFrames
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.spectrum import FrameSpectrum
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, SummaryAccumulator, line_sums
from pchem_pipeline.run.stage import open_store
from pchem_pipeline.stages.histogram.arrays import with_block_length

_ALONG_TIME = ("block_sum", "block_sum_square", "row_sum", "row_sum_square", "column_sum")


class _AlongTime:
    """Gathers the pieces of one array along its first axis, and writes them by whole chunks."""

    def __init__(self, store: Path, name: str, rows: slice, done: int) -> None:
        """Begin after ``done`` frames or blocks; those of the last chunk are written again."""
        self._store, self._name, self._rows = open_store(store), name, rows
        array = self._store.array(name)
        self._length = array.chunks[0]
        self._parts: list[NDArray[Any]] = []
        self._held = done % self._length
        self._written = done - self._held
        if self._held:
            rest = (slice(None),) * (array.ndim - 2)
            self._parts.append(self._store.read(name, (slice(self._written, done), rows, *rest)))

    def add(self, part: NDArray[Any]) -> None:
        """Take the next piece."""
        while part.shape[0]:
            piece = part[: self._length - self._held]
            self._parts.append(piece)
            self._held += piece.shape[0]
            part = part[piece.shape[0] :]
            if self._held == self._length:
                self.flush()

    def flush(self) -> None:
        """Write what is held."""
        if self._held:
            data = np.concatenate(self._parts)
            end = self._written + self._held
            rest = (slice(None),) * (data.ndim - 2)
            self._store.write(self._name, (slice(self._written, end), self._rows, *rest), data)
            self._parts, self._held, self._written = [], 0, end


@dataclass(frozen=True)
class CountJob:
    """What is counted of a stack (frames, rows, columns), into which run, which has the arrays.

    With ``copies`` the frames go into ``frames/dn``, too.
    """

    store: Path
    shape: tuple[int, int, int]
    bins: int
    settings: HistogramSettings
    copies: bool = False


class StackCounter:
    """Counts the blocks of a stack, each band of rows apart, and copies the frames where that is asked."""

    def __init__(self, job: CountJob, bands: Sequence[Rows], workers: int = 1) -> None:
        """Begin with no frames; ``workers`` threads share the bands, whole tiles and whole groups of rows."""
        self._job, self._workers = job, workers
        self._counters = [_BandCounter(job, rows) for rows in bands]

    def resume(self, n_frames: int) -> None:
        """Continue after the ``n_frames`` frames that the run has counted.

        Raises:
            StoreError: an array is missing or damaged.
        """
        call_all([functools.partial(each.resume, n_frames) for each in self._counters], self._workers)

    def count(self, blocks: Iterable[Block], check: Callable[[], None] = lambda: None) -> None:
        """Count all blocks, in the order of time, and write what they give into the run.

        The first block of a stack decides the windows, so let it always have the same number of frames.
        ``check`` is called before each block; it raises where the work shall end.

        Raises:
            InputError: DN of more than 24 bits, or the frames cannot be read.
            StoreError: the store refuses.
        """
        for start, parts in blocks:
            check()
            pairs = list(zip(self._counters, parts, strict=True))
            tasks = [functools.partial(counter.add, part) for counter, part in pairs]
            if self._job.copies:
                tasks += [functools.partial(counter.copy, start, part) for counter, part in pairs]
            call_all(tasks, self._workers)
            del parts, pairs, tasks  # the frames are not held any more while results are written
        call_all([counter.finish for counter in self._counters], self._workers)


class _BandCounter:
    """Histograms and summaries of some rows over the full width, written into a run."""

    def __init__(self, job: CountJob, rows: Rows) -> None:
        y0, y1 = rows
        self._store, self._rows = job.store, slice(y0, y1)
        self._groups = slice(y0 // ROW_GROUP, -(-y1 // ROW_GROUP))
        self._series: dict[str, _AlongTime] = {}
        self._done = dict.fromkeys(_ALONG_TIME, 0)
        self._settings, self._shape = with_block_length(job.settings, open_store(job.store)), job.shape
        shape = (y1 - y0, job.shape[2])
        self._histograms = HistogramAccumulator(shape, job.bins, job.shape[0])
        self._summaries: SummaryAccumulator | None = None
        self._spectrum: FrameSpectrum | None = None
        self._moved: MovedFrames | None = None
        if self._settings.summaries:
            self._summaries = SummaryAccumulator(shape, self._settings.block_length(job.shape[0]))
            if y0 == 0:
                self._spectrum = FrameSpectrum((min(shape[0], ROW_GROUP), shape[1]))
                self._moved = MovedFrames()

    def resume(self, n_frames: int) -> None:
        """Continue after the frames that the run has counted, see `StackCounter.resume`."""
        opened, self._spectrum = open_store(self._store), None  # that of the first frames is there
        region = self._rows, slice(None)
        held = RowHistograms(**opened.at(region, "histogram"))
        self._histograms = HistogramAccumulator.resumed(held, self._shape[0])
        if self._summaries is None:
            return
        length = self._settings.block_length(n_frames)
        self._summaries = SummaryAccumulator.resumed(opened.at(region, "summary"), n_frames, length)
        blocks = n_frames // length
        if self._rows.start == 0:
            known = opened.attributes("summary")
            self._moved = MovedFrames(known.get("moved_frames"), n_frames)
            kept = length - sum(t < length for t in known.get("left_out", []))
            if blocks and kept > 0:
                part = (0, slice(min(self._shape[1], ROW_GROUP)), slice(None))
                total, square = (opened.read(f"summary/block_sum{of}", part) for of in ("", "_square"))
                mean = total / kept
                self._moved.learn(mean, np.sqrt(np.maximum(square / kept - mean**2, 0.0)), kept)
        self._done = {name: blocks if name.startswith("block") else n_frames for name in _ALONG_TIME}

    def add(self, frames: NDArray[Any]) -> None:
        """Take the next frames, (frame, y, x) of these rows; the first time those that decide the windows.

        Raises:
            InputError: DN of more than 24 bits.
        """
        self._histograms.add(frames)
        if self._summaries is not None:
            for sums in self._summaries.add(frames):
                self._add_sums(sums)
            for name, part in line_sums(frames).items():
                self._along(name).add(part)
        if self._spectrum is not None:
            self._spectrum.add(frames[:, :ROW_GROUP])
        if self._moved is not None:
            self._moved.add(frames[:, :ROW_GROUP])

    def copy(self, start: int, frames: NDArray[Any]) -> None:
        """Write frames from ``start`` on, whole chunks, into the store."""
        region = (slice(start, start + len(frames)), self._rows, slice(None))
        open_store(self._store).write("frames/dn", region, frames)

    def finish(self) -> None:
        """Write all that was not written on the way."""
        histograms, summaries = self._histograms, self._summaries
        del self._histograms, self._summaries  # what is done holds no memory
        opened, region = open_store(self._store), (self._rows, slice(None))
        if summaries is not None:
            state = summaries.open_sums()
            rest, covariances = summaries.finish()
            for sums in rest:
                self._add_sums(sums)
            for each in self._series.values():
                each.flush()
            summary = opened.at(region, "summary")
            summary.update(covariances)
            summary.update(state)
        for name, values in vars(histograms.finish()).items():
            # file by file: of each that is written there are copies in memory
            step = opened.file_shape(f"histogram/{name}")[1]
            for x in range(0, values.shape[1], step):
                opened.write(f"histogram/{name}", (self._rows, slice(x, x + step)), values[:, x : x + step])
        if self._spectrum is not None:
            opened.set_attributes("summary", {"spectrum": self._spectrum.line()})
        if self._moved is not None:
            opened.set_attributes("summary", {"moved_frames": self._moved.found})

    def _add_sums(self, sums: dict[str, IntArray]) -> None:
        for name, part in sums.items():
            self._along(name).add(part[None])

    def _along(self, name: str) -> _AlongTime:
        if name not in self._series:
            rows = self._groups if name == "column_sum" else self._rows
            self._series[name] = _AlongTime(self._store, f"summary/{name}", rows, self._done[name])
        return self._series[name]
