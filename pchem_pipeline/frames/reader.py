"""What every reader of a camera format offers.

A reader is one file: a class derived from `FrameReader`, with its name, its suffixes and its magic bytes.
Readers from elsewhere come through the entry point group ``pchem_pipeline.readers``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.errors import InputError, PchEmError, error_words, unreadable
from pchem_pipeline.frames.camera import CameraFacts, Duration
from pchem_pipeline.frames.settings import Area, InputSettings


class FrameReader(ABC):
    """Frames of one file (or of many, see `open_frames`), read by blocks of frames and bands of rows.

    Reading is safe from several threads at once, and a reader can be pickled into another process: it
    holds where things are in the file, and opens the file when it reads.

    Attributes:
        format_name: name of the format, as in ``input.format``.
        suffixes: file suffixes, lower case, with the dot.
        magic: first bytes that tell the format.
        library: that reads it; empty for one of another package.
        paths: the files behind the reader, in the order of their frames.
        shape: (number of frames, rows, columns).
        dtype: native unsigned type of the samples that `read_into` delivers.
        bit_depth: bits of the ADC; like all that follows to ``frame_stamps``, where the file says so.
        bit_shift: bits by which the samples are left-justified.
        integration_time: s.
        time_words: what the file states of it, and in what unit.
        camera: its name, serial number, temperature and time.
        active: first row, end of the rows, first column and end of the columns of the light-sensitive area.
        overscan: likewise of pixels without electrons; None: all outside of ``active``.
        timestamps: start of each frame, s since 1970-01-01 UTC, (frames,).
        frame_stamps: number that the camera gave to each frame, (frames,).
        notes: remarks for the user on what was left out or assumed, without the file's name.
        byte_order: of the bytes of a sample, little or big, where ``input.byte_order`` decides it.
        unwritten: samples of the file were never written, and are read as a fill value.
        rows_per_read: rows that are decoded together, so that they come at no more cost than one.
        order_by_habit: whether the format has arrays that do not say which axis is time.
    """

    format_name: ClassVar[str] = ""
    suffixes: ClassVar[tuple[str, ...]] = ()
    magic: ClassVar[tuple[bytes, ...]] = ()
    library: ClassVar[str] = ""

    paths: tuple[Path, ...]
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    bit_depth: int | None = None
    bit_shift: int = 0
    integration_time: float | None = None
    time_words: str = ""
    camera: CameraFacts = CameraFacts()
    active: Area | None = None
    overscan: Area | None = None
    timestamps: FloatArray | None = None
    frame_stamps: IntArray | None = None
    notes: tuple[str, ...] = ()
    byte_order: str | None = None
    unwritten: bool = False
    rows_per_read: int = 1
    order_by_habit: bool = False

    @classmethod
    @abstractmethod
    def open(cls, path: Path, settings: InputSettings) -> Self:
        """Open one file; raise InputError with one line (what, the cure) if that cannot be."""

    @classmethod
    def recognises(cls, path: Path, head: bytes) -> bool:
        """Tell from the first bytes (at most 64; none for a folder) whether this reader is for the file."""
        return head.startswith(cls.magic)

    @abstractmethod
    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """Fill ``buffer`` with frames t0..t1 and rows y0..y1 (ends excluded; None: to the last), all columns.

        The buffer is C-contiguous, of shape (t1 - t0, y1 - y0, columns) and of ``self.dtype``.

        Raises:
            InputError: the file vanished, changed or cannot be decoded.
        """

    def read(self, t0: int = 0, t1: int | None = None, y0: int = 0, y1: int | None = None) -> NDArray[Any]:
        """Return frames t0..t1 and rows y0..y1 as a new array (frame, y, x)."""
        t1 = self.shape[0] if t1 is None else t1
        y1 = self.shape[1] if y1 is None else y1
        buffer = np.empty((t1 - t0, y1 - y0, self.shape[2]), self.dtype)
        with sound(self.paths[0], self.format_name):
            self.read_into(buffer, t0, t1, y0, y1)
        return buffer

    def take_facts(
        self, camera: CameraFacts, duration: Duration | None = None, bit_depth: int | None = None
    ) -> None:
        """Take what the file says beside its frames."""
        self.camera, self.bit_depth = camera, bit_depth
        self.integration_time, self.time_words = duration or (None, "")

    def cards(self) -> tuple[Any, ...]:
        """Return the cards of a FITS file that are not of its samples or their place; else none."""
        return ()


def described(reader: type[FrameReader]) -> str:
    """Return the name of the format that a reader is for, with the library that it reads it with."""
    return reader.format_name + (f" ({reader.library})" if reader.library else "")


def check_window(
    reader: FrameReader, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int | None
) -> tuple[int, int]:
    """Check the arguments of `FrameReader.read_into`; return (y0, y1) with y1 filled in.

    Raises:
        ValueError: a programming mistake: window outside of the stack, or a buffer that does not fit.
    """
    n, ny, nx = reader.shape
    y1 = ny if y1 is None else y1
    if not (0 <= t0 <= t1 <= n and 0 <= y0 <= y1 <= ny):
        raise ValueError(f"window frames {t0}..{t1}, rows {y0}..{y1} is outside the stack {reader.shape}")
    if (
        buffer.shape != (t1 - t0, y1 - y0, nx)
        or buffer.dtype != reader.dtype
        or not buffer.flags.c_contiguous
    ):
        raise ValueError(
            f"buffer {buffer.shape} {buffer.dtype} does not fit {(t1 - t0, y1 - y0, nx)} {reader.dtype}, C "
            "order"
        )
    return y0, y1


def shared_notes(readers: Sequence[FrameReader]) -> list[str]:
    """Return the remarks on all files; one that many share stands once."""
    notes = ((reader.paths[0].name, note) for reader in readers for note in dict.fromkeys(reader.notes))
    return said_once((name, note.removeprefix(f"{name}: ")) for name, note in notes)


def said_once(said: Iterable[tuple[str, str]]) -> list[str]:
    """Return what is said of files, all alike once, with the name of the first."""
    names: dict[str, list[str]] = {}
    for name, words in said:
        names.setdefault(words, []).append(name)
    return [
        f"{first}{f' and {len(others)} more' if others else ''}: {words}"
        for words, (first, *others) in names.items()
    ]


def unwritten_notes(missing: int, wanted: int, what: str = "chunks") -> tuple[str, ...]:
    """Return a remark on parts of a file that were never written; empty where all were.

    Raises:
        InputError: none was written.
    """
    if missing >= wanted > 0:
        raise InputError(f"none of its {wanted} {what} was written; copy it again or omit it")
    were = "was" if missing == 1 else "were"
    words = f"{missing} of {wanted} {what} {were} not written; read as the fill value"
    return (words,) if missing > 0 else ()


@contextmanager
def sound(path: Path, name: str, magic: tuple[bytes, ...] = ()) -> Iterator[None]:
    """Turn what a library says of a damaged file of a format, its first bytes its magic, into one line.

    Raises:
        InputError: with the path before what a reader says, and in place of all but our other errors and a
            lack of memory.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except (PchEmError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, FileNotFoundError | PermissionError) and error.strerror:
            raise unreadable(path, error) from error
        words = f"not a valid {name} file, or truncated ({error_words(error)}); copy it again"
        if magic and path.is_file() and not np.fromfile(path, "u1", 64).tobytes().startswith(magic):
            words = f"does not begin as {name} files do; correct its name, or copy it again"
        raise InputError(f"{path}: {words}") from error


def changed(what: str) -> InputError:
    """Return the error for a file that is no longer as it was when it was opened."""
    return InputError(f"{what} while it was being read; restore the file and start again")
