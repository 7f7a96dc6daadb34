"""A stack of frames in the order of time, by blocks; the next one is read while one is used.

A `HashedFrameStream` takes the hashes of the files from the same reading: frames that lie plainly in a file
are taken from the bytes that are hashed. Of files that have to be decoded, or of which only a region is
wanted, the bytes are hashed a little ahead of the decoder, which then finds them in the memory of the
operating system.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, unstore
from pchem_pipeline.frames.identity import SCRATCH_BYTES, FileHasher, identity_of_hashes
from pchem_pipeline.frames.reader import FrameReader, changed, sound
from pchem_pipeline.frames.sequence import FrameSequence

#: first row of a band, and its end
Rows = tuple[int, int]

#: first frame of a block, and the frames (frame, y, x) of each band
Block = tuple[int, list[NDArray[Any]]]


class FrameSource(Protocol):
    """Frames that can be read by blocks of frames and bands of rows, from any thread or process."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the samples."""

    @property
    def rows_per_read(self) -> int:
        """Rows that are decoded together, and so come at no more cost than one."""

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """Fill ``buffer`` (frame, y, x) with frames t0..t1 and rows y0..y1, ends excluded."""


class FrameStream:
    """The frames of a stack by blocks: to be opened with ``with``, and iterated once."""

    def __init__(
        self,
        source: FrameSource,
        bands: Sequence[Rows],
        step: int,
        *,
        frames: tuple[int, int] | None = None,
        threads: int = 1,
    ) -> None:
        """Take the memory, two blocks; nothing is read yet.

        Bands of rows, and ``frames`` from the first to the end (None: all), are wanted; blocks end at
        multiples of ``step`` frames. Threads share the reading of a block (coded files cost time to decode).
        """
        self.bands = bands
        self._source, self._threads = source, threads
        n_frames, _, columns = source.shape
        first, end = frames or (0, n_frames)
        cuts = [first, *range((first // step + 1) * step, end, step), end]
        self._ranges = [*itertools.pairwise(cuts)] if first < end else []
        longest = min(step, end - first)
        self._buffers = [
            [np.empty((longest, y1 - y0, columns), source.dtype) for y0, y1 in bands] for _ in range(2)
        ]
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="read")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *unused: object) -> None:
        self._reader.shutdown()

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks; each is overwritten after the next one was asked for."""
        requests = map(self._request, self._ranges, itertools.cycle(self._buffers))
        pending = next(requests, None)
        while pending is not None:
            t0, parts, reading = pending
            reading.result()
            pending = next(requests, None)
            yield t0, parts
            del parts
        self._buffers = []

    def _request(
        self, frames: tuple[int, int], buffers: Sequence[NDArray[Any]]
    ) -> tuple[int, list[NDArray[Any]], Future[None]]:
        t0, t1 = frames
        parts = [band[: t1 - t0] for band in buffers]
        return t0, parts, self._reader.submit(self._fill, parts, t0, t1)

    def _fill(self, parts: Sequence[NDArray[Any]], t0: int, t1: int) -> None:
        """Read frames t0..t1 into the parts, one for each band."""
        cuts = np.linspace(0, t1 - t0, self._threads + 1).astype(int).tolist()
        call_all(
            [
                functools.partial(self._source.read_into, part[a:b], t0 + a, t0 + b, *rows)
                for a, b in itertools.pairwise(cuts)
                if a < b
                for rows, part in zip(self.bands, parts, strict=True)
            ],
            self._threads,
        )


class HashedFrameStream(FrameStream):
    """The frames of camera files, all rows, from one reading of the bytes that also hashes them."""

    def __init__(
        self,
        stack: FrameSequence,
        bands: Sequence[Rows],
        step: int,
        *,
        files: Sequence[Path],
        first: int = 0,
        threads: int = 1,
        advance: Callable[[int], None] | None = None,
    ) -> None:
        """Take the memory; nothing is read yet.

        The bands cover all rows, from top to bottom. All files that decide what is read are hashed, in
        reading order; frames begin with ``first``, the first one of a file. For bytes that are hashed,
        ``advance`` is called with their number.
        """
        super().__init__(stack, bands, step, frames=(first, stack.shape[0]), threads=threads)
        self._stack = stack
        self._hashers = {path: FileHasher(path, advance) for path in files}

    def identity(self) -> dict[str, Any]:
        """Hash what is left of the files, and return their identity; see `content_identity`.

        Raises:
            InputError: a file vanished or cannot be read.
        """
        return identity_of_hashes({path: hasher.hexdigest() for path, hasher in self._hashers.items()})

    def _fill(self, parts: Sequence[NDArray[Any]], t0: int, t1: int) -> None:
        """Read the next frames, each once, and hash the bytes of their files up to there."""
        decode: list[tuple[int, int]] = []
        for reader, first, end, offset in self._stack.pieces(t0, t1):
            hasher, n_frames = self._hashers[reader.paths[0]], reader.shape[0]
            if self._is_plain(reader):
                with sound(hasher.path, reader.format_name):
                    self._take(reader, hasher, (first, end), [part[offset:] for part in parts])
            else:
                hasher.read_to(hasher.size * end // n_frames)
                decode.append((t0 + offset, t0 + offset + end - first))
            if end == n_frames:
                hasher.read_to()
        self._decode(parts, t0, decode)

    def _is_plain(self, reader: FrameReader) -> bool:
        """Return whether whole frames lie plainly in the file, one behind the other."""
        if not (isinstance(reader, ContiguousReader) and self._stack.whole_frames):
            return False
        layout = reader.layout
        return layout is not None and bool((np.diff(layout.offsets) >= layout.frame_bytes).all())

    def _take(
        self, reader: Any, hasher: FileHasher, frames: tuple[int, int], parts: Sequence[NDArray[Any]]
    ) -> None:
        """Take frames that lie plainly in a file from the bytes that are hashed."""
        layout, (first, end) = reader.layout, frames
        step = max(1, SCRATCH_BYTES // max(layout.frame_bytes, 1))
        for a in range(first, end, step):
            offsets = layout.offsets[a : min(a + step, end)]
            hasher.read_to(int(offsets[0]))
            wanted = int(offsets[-1] - offsets[0]) + layout.frame_bytes
            data = hasher.take(wanted)
            if len(data) < wanted:
                raise changed("the file was truncated")
            for t, start in enumerate((offsets - offsets[0]).tolist(), a - first):
                frame = layout.frame(data, start)
                for part, (y0, y1) in zip(parts, self.bands, strict=True):
                    part[t] = frame[y0:y1]
        for part, (y0, _) in zip(parts, self.bands, strict=True):
            read = part[: end - first]
            unstore(read, layout.stored, layout.offset)
            reader.put_right(read, first, y0)
            self._stack.check_bits(reader, read, y0)

    def _decode(self, parts: Sequence[NDArray[Any]], t0: int, ranges: Sequence[tuple[int, int]]) -> None:
        """Decode ranges of frames, shared among the threads, each frame once."""
        frame = int(np.prod(self._stack.shape[1:])) * self._stack.dtype.itemsize
        step = max(1, SCRATCH_BYTES // max(frame, 1))
        cuts = [(a, min(a + step, end)) for start, end in ranges for a in range(start, end, step)]

        def decode(a: int, b: int) -> None:
            frames = self._stack.read(a, b)
            for part, (y0, y1) in zip(parts, self.bands, strict=True):
                part[a - t0 : b - t0] = frames[:, y0:y1]

        call_all([functools.partial(decode, a, b) for a, b in cuts], self._threads)
