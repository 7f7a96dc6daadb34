"""Several files as one stack: concatenation, frame range, region of interest, bit shift."""

from __future__ import annotations

import copy
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import shared_facts
from pchem_pipeline.frames.identity import SCRATCH_BYTES
from pchem_pipeline.frames.inspect import InputReport
from pchem_pipeline.frames.reader import FrameReader, check_window, described, sound
from pchem_pipeline.frames.settings import Area, InputSettings


class FrameSequence(FrameReader):
    """All frames of a list of readers of equal frame shape and type, as the settings want them.

    Attributes:
        report: what was found in the files and what was done about it.
        excluded: pixels (y, x) whose samples are replaced by one that is the same in all frames; None: none.
        insensitive: pixels (y, x) outside of the light-sensitive area.
        overscan_pixels: those of them that show the bias, (y, x).
        exclusions: why pixels are excluded.
        stated_integration_time: s, as the files say, whatever the settings say; None if they do not agree.
    """

    format_name = "sequence"
    excluded: BoolArray | None = None
    exclusions: tuple[str, ...] = ()

    def __init__(
        self, readers: Sequence[FrameReader], settings: InputSettings, report: InputReport, least: int = 2
    ) -> None:
        """Join the readers; see `pchem_pipeline.frames.open.open_frames`, which makes them.

        Raises:
            InputError: too few frames, a region of interest or frame range outside of the stack, or
                files that contradict each other on bit depth, bit shift, integration time or camera.
        """
        self.report = report
        self._readers = tuple(readers)
        self.paths = tuple(path for reader in readers for path in reader.paths)
        self._ends = np.cumsum([reader.shape[0] for reader in readers]).tolist()
        total = self._ends[-1] if self._ends else 0
        if total < least:
            shape = f" of {readers[0].shape[1]} x {readers[0].shape[2]} pixels" if readers else ""
            raise InputError(
                f"{_where(self.paths)}: {total} frame{'s' * (total != 1)}{shape} in total; at least {least} "
                "needed, some thousands for useful estimates; add frames to input.files (axes of a stack: "
                "frame, row, column)"
            )
        self._first, end = _frame_range(settings, total, least)
        rows, columns = readers[0].shape[1:]
        self._y0, y1, self._x0, self._x1 = _region(settings, rows, columns)
        self.shape = (end - self._first, y1 - self._y0, self._x1 - self._x0)
        self.dtype = readers[0].dtype
        self.rows_per_read = max(reader.rows_per_read for reader in readers)
        self.byte_order, self.order_by_habit = readers[0].byte_order, readers[0].order_by_habit
        self.seen_limits: tuple[int | None, int | None] = (None, None)
        self._set_areas(settings)
        self.unwritten = any(reader.unwritten for reader in readers)
        self._set_facts(readers, settings, end)

    def _set_areas(self, settings: InputSettings) -> None:
        """Set overscan and other insensitive pixels of the region; none where no other pixel is in it."""
        stated = {(reader.active, reader.overscan) for reader in self._readers}
        if len(stated) > 1:
            raise InputError(
                f"{_where(self.paths)}: the files have different light-sensitive areas or overscan (TRIMSEC, "
                f"DATASEC, BIASSEC: {len(stated)} of them); make one run of each"
            )
        ((active, overscan),) = stated
        rows, columns = self.whole_shape
        outside = ~_image_of([active or (0, rows, 0, columns)], self.whole_shape)
        areas = [overscan] if settings.overscan is None and overscan else settings.overscan
        for area in areas or ():
            if area[1] > rows or area[3] > columns:
                raise InputError(
                    f"input.overscan {list(area)} exceeds the frames of {rows} rows and {columns} columns; "
                    "correct it"
                )
        dark = outside if areas is None else _image_of(areas, self.whole_shape)
        self.insensitive, dark = (self.within_region(each) for each in (outside | dark, dark))
        if self.insensitive.all():  # overscan alone is what is wanted
            self.insensitive, dark = np.zeros((2, *self.shape[1:]), np.bool_)
        self.overscan_pixels = dark

    def _set_facts(self, readers: Sequence[FrameReader], settings: InputSettings, end: int) -> None:
        """Take bit shift, bit depth, integration time and times from the settings, else from the files."""
        shift = settings.bit_shift
        self.bit_shift = _agreed(readers, "bit_shift") or 0 if shift is None else shift
        size = 8 * self.dtype.itemsize
        if self.bit_shift >= size:
            raise InputError(
                f"{_where(self.paths)}: input.bit_shift {self.bit_shift} removes all bits of {self.dtype} "
                "samples; correct it"
            )
        depth = settings.bit_depth
        if depth is None:
            depth = size - self.bit_shift if self.bit_shift else _agreed(readers, "bit_depth")
        self.bit_depth = depth
        if depth is not None and depth > size - self.bit_shift:
            raise InputError(
                f"{_where(self.paths)}: a bit depth of {depth} does not fit {self.dtype} samples shifted by "
                f"{self.bit_shift}; correct input.bit_depth or input.bit_shift"
            )
        times = {reader.integration_time for reader in readers}
        self.stated_integration_time = times.pop() if len(times) == 1 else None
        time = settings.integration_time
        self.integration_time = _agreed(readers, "integration_time") if time is None else time
        self.time_words = _time_words(readers[0], self.integration_time)
        stamps = [reader.timestamps for reader in readers if reader.timestamps is not None]
        if len(stamps) == len(readers):
            self.timestamps = np.concatenate(stamps)[self._first : end]
        _check_same_camera(readers)
        self.camera, moved = shared_facts([reader.camera for reader in readers])
        dates = [(each.camera.taken, each.paths[0].name) for each in readers if each.camera.taken is not None]
        self.last_taken = max(dates, default=(None,))[0]
        self.moved = [*filter(None, [moved, _pause(sorted(dates))])]
        self.report.notes += self.moved

    @classmethod
    def open(cls, path: Path, settings: InputSettings) -> Self:
        """Not for single files: use `pchem_pipeline.frames.open.open_frames`."""
        raise NotImplementedError("use open_frames")

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        """See `FrameReader.read_into`; rows count from the top of the region of interest.

        Raises:
            InputError: also where dropped bits are not zero, or a value does not fit the bit depth.
        """
        y0, y1 = check_window(self, buffer, t0, t1, y0, y1)
        for reader, part in self._parts(buffer, t0, t1, (y0, y1)):
            self.check_bits(reader, part, y0)

    def exclude(self, causes: Mapping[str, BoolArray]) -> None:
        """Exclude pixels (y, x) by cause: their samples become the median of the others in the first frame.

        Raises:
            InputError: no pixel is left.
        """
        self.exclusions = tuple(cause for cause, pixels in causes.items() if pixels.any())
        if not self.exclusions:
            return
        pixels = np.logical_or.reduce([causes[cause] for cause in self.exclusions])
        if pixels.all():
            raise InputError(f"{_where(self.paths)}: every pixel is excluded; correct input.mask (--mask)")
        self.excluded, self._places = pixels, np.nonzero(pixels)
        others = self.stored(0, 1, 0, self.shape[1])[0][~pixels]
        self._filler = np.quantile(others, 0.5, method="lower")

    def with_overscan(self) -> Self:
        """Return these frames with the samples of the overscan as they are."""
        found = copy.copy(self)
        if self.excluded is not None:
            found.excluded = self.excluded & ~self.overscan_pixels
            found._places = np.nonzero(found.excluded)
        return found

    def stored(self, t0: int, t1: int, y0: int, y1: int) -> NDArray[Any]:
        """Return frames t0..t1 and rows y0..y1 (frame, y, x) as they are in the files."""
        buffer = np.empty((t1 - t0, y1 - y0, self.shape[2]), self.dtype)
        list(self._parts(buffer, t0, t1, (y0, y1)))
        return buffer

    def _parts(
        self, buffer: NDArray[Any], t0: int, t1: int, rows: tuple[int, int]
    ) -> Iterator[tuple[FrameReader, NDArray[Any]]]:
        """Fill a buffer, and yield each file with the part that is from it."""
        rows = (rows[0] + self._y0, rows[1] + self._y0)
        for reader, first, end, offset in self.pieces(t0, t1):
            part = buffer[offset : offset + end - first]
            with sound(reader.paths[0], reader.format_name):
                self._read_part(reader, part, first, end, rows)
            yield reader, part

    @property
    def formats(self) -> str:
        """Names of the formats of the files, and of the library that reads each."""
        return ", ".join(dict.fromkeys(described(type(reader)) for reader in self._readers))

    @property
    def whole_shape(self) -> tuple[int, int]:
        """Rows and columns of the files, whatever the region of interest."""
        _, rows, columns = self._readers[0].shape
        return rows, columns

    def top_rows(self, n_frames: int, n_rows: int) -> NDArray[Any]:
        """Return the first rows of the first frames as they are in the files, whatever the region."""
        rows = min(n_rows, self.whole_shape[0])
        return np.concatenate([reader.read(a, b, 0, rows) for reader, a, b, _ in self.pieces(0, n_frames)])

    def within_region(self, image: BoolArray) -> BoolArray:
        """Return the part of an image of whole frames that is in the region of interest."""
        return image[self._y0 : self._y0 + self.shape[1], self._x0 : self._x1]

    @property
    def corner(self) -> tuple[int, int]:
        """First row and column of the region of interest in the files."""
        return self._y0, self._x0

    @property
    def whole_frames(self) -> bool:
        """All rows and columns of the files are wanted."""
        return (self._y0, self._x0, *self.shape[1:]) == (0, 0, *self.whole_shape)

    def pieces(self, t0: int, t1: int) -> Iterator[tuple[FrameReader, int, int, int]]:
        """Yield for each file of frames t0..t1: reader, first frame and end in it, frames before it."""
        t, end = t0 + self._first, t1 + self._first
        while t < end:
            number = bisect_right(self._ends, t)
            reader = self._readers[number]
            start = self._ends[number] - reader.shape[0]
            stop = min(end, self._ends[number])
            yield reader, t - start, stop - start, t - self._first - t0
            t = stop

    def _read_part(
        self, reader: FrameReader, part: NDArray[Any], t0: int, t1: int, rows: tuple[int, int]
    ) -> None:
        """Read from one file, through a bounded scratch buffer if only some columns are wanted."""
        columns = self.whole_shape[1]
        if (self._x0, self._x1) == (0, columns):
            reader.read_into(part, t0, t1, *rows)
            return
        height = rows[1] - rows[0]
        step = max(1, SCRATCH_BYTES // max(1, height * columns * self.dtype.itemsize))
        scratch = np.empty((min(step, t1 - t0), height, columns), self.dtype)
        for t in range(t0, t1, step):
            stop = min(t + step, t1)
            reader.read_into(scratch[: stop - t], t, stop, *rows)
            part[t - t0 : stop - t0] = scratch[: stop - t, :, self._x0 : self._x1]

    def check_bits(self, reader: FrameReader, part: NDArray[Any], y0: int) -> None:
        """Replace excluded samples in part of a file (frame, y, x), from row ``y0`` on; undo the bit shift.

        Raises:
            InputError: a bit would be lost, or a value does not fit the bit depth.
        """
        if self.excluded is not None:
            ys, xs = self._places
            a, b = np.searchsorted(ys, [y0, y0 + part.shape[1]])
            part[:, ys[a:b] - y0, xs[a:b]] = self._filler
        size = 8 * self.dtype.itemsize
        depth = size - self.bit_shift if self.bit_depth is None else self.bit_depth
        if part.size == 0 or (self.bit_shift == 0 and depth == size):
            return
        used = int(np.bitwise_or.reduce(part, axis=None))
        name = reader.paths[0]
        if used & ((1 << self.bit_shift) - 1):
            raise InputError(
                f"{name}: the lowest {self.bit_shift} bits are not all zero; correct input.bit_shift"
            )
        if self.bit_shift:
            np.right_shift(part, self.bit_shift, out=part)
        if used >> self.bit_shift >> depth:
            text = f"{name}: values exceed the bit depth of {depth}"
            unused = (used & -used).bit_length() - 1
            if self.bit_shift < unused and not used >> unused >> depth:
                raise InputError(
                    f"{text}, and their lowest {unused} bits are all zero (left-justified samples?); set "
                    f"input.bit_shift: {unused} (--bit-shift)"
                )
            raise InputError(f"{text}; correct input.bit_depth, input.bit_shift or input.byte_order")


def _image_of(areas: Sequence[Area], shape: tuple[int, int]) -> BoolArray:
    """Return the pixels of areas, (y, x)."""
    found = np.zeros(shape, np.bool_)
    for y0, y1, x0, x1 in areas:
        found[y0:y1, x0:x1] = True
    return found


def _time_words(first: FrameReader, taken: float | None) -> str:
    """Return a remark on the integration time that the first file states; empty where it states none."""
    if not first.time_words:
        return ""
    if taken is None:
        words = "unknown integration time; set input.integration_time (--integration-time SECONDS)"
    else:
        words = f"integration time {taken:g} s"
    return f"{words}: {first.paths[0].name} states {first.time_words}"


def _where(paths: Sequence[Path]) -> str:
    if not paths:
        return "input.files"
    return str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"


def _pause(dates: Sequence[tuple[float, str]]) -> str:
    """Return a remark on the longest pause between files, if above an hour and ten usual ones; else empty."""
    steps = np.diff([taken for taken, _ in dates])
    if not steps.size or steps.max() <= max(3600.0, 10.0 * np.median(steps)):
        return ""
    last = int(steps.argmax())
    return (
        f"a pause of {steps[last] / 3600.0:.3g} h between {dates[last][1]} and {dates[last + 1][1]}: offset, "
        "dark current and light may have changed"
    )


def _check_same_camera(readers: Sequence[FrameReader]) -> None:
    """Refuse files of different cameras or settings: their frames are no samples of one distribution."""
    for name in dict.fromkeys(name for reader in readers for name in reader.camera.setup):
        values = [reader.camera.setup.get(name) for reader in readers]
        if len({*values} - {None}) > 1:
            shown = _first_of_each(readers, values, f"{name} = ")
            raise InputError(
                f"the files were taken with different settings: {shown}; give those of one setting at a time"
            )
    serials = [reader.camera.serial or None for reader in readers]
    distinct = {*serials} - {None}
    # a number that differs in each of many files counts files
    if len(distinct) > 1 and not 2 < len(readers) == len(distinct):
        shown = _first_of_each(readers, serials, "serial number ")
        raise InputError(f"the files are from different cameras: {shown}; give those of one at a time")


def _agreed(readers: Sequence[FrameReader], name: str) -> Any:
    """Return a fact that all files state alike; None if a file does not state it."""
    values = [getattr(reader, name) for reader in readers]
    distinct = {*values}
    if len(distinct) > 1 and None not in distinct:
        shown = _first_of_each(readers, values)
        raise InputError(
            f"the files state different {name}: {shown}; set input.{name}, or make one run of each"
        )
    return distinct.pop() if len(distinct) == 1 else None


def _first_of_each(readers: Sequence[FrameReader], values: Sequence[Any], what: str = "") -> str:
    """Return the first values that differ, each with its files, of many the first and their number."""
    seen: dict[Any, list[str]] = {}
    paths = [reader.paths[0] for reader in readers]
    repeated = len({path.name for path in paths}) < len(paths)
    for path, value in zip(paths, values, strict=True):
        if value is not None:
            seen.setdefault(value, []).append(f"{path.parent.name}/{path.name}" if repeated else path.name)
    return ", ".join(
        f"{what}{value} in {' and '.join(files if len(files) < 5 else (files[0], f'{len(files) - 1} more'))}"
        for value, files in [*seen.items()][:4]
    )


def _frame_range(settings: InputSettings, total: int, least: int) -> tuple[int, int]:
    first, end = settings.frame_range or (0, None)
    end = total if end is None else end
    if end > total or end - first < least:
        raise InputError(
            f"input.frame_range [{first}, {end}] does not select at least {least} of the {total} frames; "
            "correct it (--frames)"
        )
    return first, end


def _region(settings: InputSettings, rows: int, columns: int) -> tuple[int, int, int, int]:
    if settings.roi is None:
        return 0, rows, 0, columns
    y0, y1, x0, x1 = settings.roi
    if y1 > rows or x1 > columns:
        raise InputError(
            f"input.roi {list(settings.roi)} exceeds the frames of {rows} rows and {columns} columns (--roi "
            f"{y0}:{y1},{x0}:{x1}; all pixels: 0:{rows},0:{columns}); correct it"
        )
    return y0, y1, x0, x1
