"""Frames in the order of time, and the hashes of their files, from one reading of the bytes.

Files in which whole frames lie plainly are read from their offsets into the caller's memory, and hashed
there. Of files that have to be decoded, or of which only a region is wanted, the bytes are hashed a little
ahead of the decoder, which then finds them in the memory of the operating system.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.frames.formats.contiguous import ContiguousReader
from pchem_pipeline.frames.identity import FileHasher, file_size, identity_of_hashes
from pchem_pipeline.frames.reader import FrameReader
from pchem_pipeline.frames.sequence import FrameSequence

__all__ = ["ReadOnce"]

#: bytes of decoded frames that a thread holds before they are cut into bands of rows
_SCRATCH_BYTES = 8 << 20


class ReadOnce:
    """Reads a stack from its first frame to its last, and knows the identity of its files in the end."""

    def __init__(
        self,
        frames: FrameSequence,
        paths: Sequence[Path],
        threads: int = 1,
        advance: Callable[[int], None] | None = None,
    ) -> None:
        """Begin before the first frame.

        Args:
            frames: the stack.
            paths: all files that decide what is read, in reading order; among them those of the stack.
            threads: threads that decode, where there is something to decode.
            advance: told of the number of bytes that were hashed.
        """
        self._frames = frames
        self._threads = threads
        self._hashers = {path: FileHasher(path, advance) for path in paths}
        self._sizes: dict[Path, int] = {}

    @property
    def scratch_bytes(self) -> int:
        """Memory beside the caller's."""
        frame = int(np.prod(self._frames.shape[1:])) * self._frames.dtype.itemsize
        return self._threads * max(_SCRATCH_BYTES, frame)

    def read(self, parts: Sequence[NDArray[Any]], t0: int, t1: int) -> None:
        """Fill the parts with the next frames, t0..t1, end excluded.

        Args:
            parts: C-contiguous, (t1 - t0, rows, columns) each, that cover the frames from top to bottom.
            t0: first frame: the end of the last call.
            t1: end of the frames.

        Raises:
            InputError: a file vanished, changed or cannot be read.
        """
        decode: list[tuple[int, int]] = []
        for reader, first, end, offset in self._frames.pieces(t0, t1):
            hasher = self._hashers[reader.paths[0]]
            if self._is_plain(reader):
                bands = [part[offset : offset + end - first] for part in parts]
                assert isinstance(reader, ContiguousReader)
                reader.scatter(bands, first, end, hasher)
                for band in bands:
                    self._frames.check_bits(reader, band)
            else:
                hasher.read_to(self._size(reader.paths[0]) * end // reader.shape[0])
                decode.append((t0 + offset, t0 + offset + end - first))
            if end == reader.shape[0]:
                hasher.read_to()
        self._decode(parts, t0, decode)

    def identity(self) -> dict[str, Any]:
        """Hash what is left of the files, and return their identity; see `content_identity`.

        Raises:
            InputError: a file vanished or cannot be read.
        """
        return identity_of_hashes({path: hasher.hexdigest() for path, hasher in self._hashers.items()})

    def _is_plain(self, reader: FrameReader) -> bool:
        """Tell whether whole frames lie plainly in the file, one behind the other."""
        if not (isinstance(reader, ContiguousReader) and self._frames.whole_frames):
            return False
        layout = reader.layout
        return layout is not None and layout.in_order

    def _size(self, path: Path) -> int:
        if path not in self._sizes:
            self._sizes[path] = file_size(path)
        return self._sizes[path]

    def _decode(self, parts: Sequence[NDArray[Any]], t0: int, ranges: Sequence[tuple[int, int]]) -> None:
        """Decode ranges of frames, shared among the threads, each frame once."""
        frame = int(np.prod(self._frames.shape[1:])) * self._frames.dtype.itemsize
        step = max(1, _SCRATCH_BYTES // max(frame, 1))
        cuts = [(a, min(a + step, end)) for start, end in ranges for a in range(start, end, step)]

        def decode(cut: tuple[int, int]) -> None:
            a, b = cut
            frames = self._frames.read(a, b)
            row = 0
            for part in parts:
                part[a - t0 : b - t0] = frames[:, row : row + part.shape[1]]
                row += part.shape[1]

        if self._threads == 1:
            for cut in cuts:
                decode(cut)
        elif cuts:
            with ThreadPoolExecutor(self._threads, thread_name_prefix="decode") as pool:
                for done in [pool.submit(decode, cut) for cut in cuts]:
                    done.result()
