"""One look at all files, and one message on all that is wrong with them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.identity import file_size, hash_file, sample_hash
from pchem_pipeline.frames.reader import FrameReader, said_once, shared_notes, sound
from pchem_pipeline.frames.registry import detect_format, reader_class
from pchem_pipeline.frames.resolve import resolve_files
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.stamps import stamp_notes


@dataclass
class FileReport:
    """A file, and why it cannot be used; empty if it can."""

    path: Path
    problem: str = ""


@dataclass
class InputReport:
    """What was found in the input files.

    Attributes:
        files: one entry per file, in reading order.
        notes: remarks that stop nothing, such as gaps in the numbers of the files.
    """

    files: list[FileReport]
    notes: list[str] = field(default_factory=list)

    @property
    def bad(self) -> list[FileReport]:
        """The files that cannot be used."""
        return [file for file in self.files if file.problem]

    @property
    def good(self) -> list[FileReport]:
        """The files that can be used."""
        return [file for file in self.files if not file.problem]

    def message(self, done: str = "skipped (input.on_bad_file: skip)") -> str:
        """Return one line: all bad files, what was done about them, and notes; empty if all is well."""
        lines = []
        if bad := self.bad:
            several = f"{len(bad)} of {len(self.files)} input files cannot be used: "
            listed = "; ".join(said_once((str(file.path), file.problem or "") for file in bad))
            lines += [(several if len(self.files) > 1 else "") + listed, done]
        return "; ".join(filter(None, lines + self.notes))

    def raise_if_refused(self, on_bad_file: Literal["error", "skip"]) -> None:
        """Raise InputError if there are bad files that are not to be skipped, or no good ones are left."""
        if self.bad and (on_bad_file == "error" or not self.good):
            cure = "; repair or remove them, or set input.on_bad_file: skip" if self.good else ""
            raise InputError(self.message("") + cure)


def survey(
    settings: InputSettings, base_dir: Path, *, check_duplicates: bool = True
) -> tuple[list[FrameReader], InputReport]:
    """Open all files; return the readers of the good ones, in order, and the report on all."""
    report = InputReport([FileReport(path) for path in resolve_files(settings, base_dir)])
    opened = [(entry, reader) for entry in report.files if (reader := _open(entry, settings)) is not None]
    mark_repeated_paths(report.files)
    _mark_odd(opened)
    if check_duplicates:
        _mark_duplicates(report.good)
    readers = [reader for entry, reader in opened if not entry.problem]
    report.notes += shared_notes(readers)
    report.notes += stamp_notes(readers, settings.frame_range)
    report.notes += _gaps([entry.path for entry in report.files])
    return readers, report


def _open(entry: FileReport, settings: InputSettings) -> FrameReader | None:
    try:
        name = settings.format if settings.format != "auto" else detect_format(entry.path)
        with sound(entry.path, name):  # a reader of another package may raise anything
            reader = reader_class(name).open(entry.path, settings)
            entry.problem = "has no frames; omit it" if 0 in reader.shape else ""
    except InputError as error:
        entry.problem = str(error).removeprefix(f"{entry.path}: ")
        return None
    return reader


def mark_repeated_paths(files: list[FileReport]) -> None:
    """Mark files that are the same as an earlier one, by whatever name."""
    seen: set[Path] = set()
    for entry in files:
        real = entry.path.resolve()
        if real in seen:
            entry.problem = entry.problem or "is listed twice in input.files"
        seen.add(real)


def _mark_odd(opened: list[tuple[FileReport, FrameReader]]) -> None:
    """Mark files whose frames differ in shape or type from those of most files."""
    kinds = [
        (entry, f"{reader.shape[1]} x {reader.shape[2]} {reader.dtype}")
        for entry, reader in opened
        if not entry.problem
    ]
    most = Counter(kind for _, kind in kinds).most_common(1)
    for entry, kind in kinds:
        if kind != most[0][0]:
            entry.problem = f"has {kind} frames, the others {most[0][0]}"


def _mark_duplicates(files: list[FileReport]) -> None:
    """Mark files with the content of an earlier one: by size, then by samples, then by all bytes."""
    groups = [files]
    for key in (file_size, sample_hash, hash_file):
        alike: defaultdict[object, list[FileReport]] = defaultdict(list)
        for number, group in enumerate(groups):
            for entry in group:
                alike[number, key(entry.path)].append(entry)
        groups = [group for group in alike.values() if len(group) > 1]
    for first, *others in groups:
        for entry in others:
            entry.problem = f"has the same content as {first.path.name}"


_LAST_NUMBER = re.compile(r"(\d+)(?=\D*$)")
#: hours, minutes and seconds, as the end of a name's last number or with signs between them
_CLOCK = re.compile(r"([01]\d|2[0-3])([-_.:h]?)([0-5]\d)([-_.:m]?)([0-5]\d)(\d{0,9})(?=\D*$)")


def _gaps(paths: list[Path]) -> list[str]:
    """Say how many numbers are missing in the names of a sequence of files, unless the numbers are a clock.

    The steps of a clock vary, or are equal only if minutes have 60 seconds.
    """
    groups: defaultdict[tuple[Path, str], list[Path]] = defaultdict(list)
    for path in paths:
        if _LAST_NUMBER.search(path.name):
            groups[path.parent, _LAST_NUMBER.sub("#", path.name)].append(path)
    notes = []
    for (_, pattern), files in groups.items():
        missing = _missing([int(_LAST_NUMBER.findall(path.name)[0]) for path in files])
        clocks = [_CLOCK.search(path.name) for path in files]
        if all(clocks) and missing:
            times = [3600 * int(c[1]) + 60 * int(c[3]) + int(c[5]) for c in clocks if c and not c[6]]
            if len(times) < len(files) or any(c[2] or c[4] for c in clocks if c) or _missing(times) < missing:
                continue
        if missing:
            are = "is" if missing == 1 else "are"
            notes.append(
                f"{missing} of the numbered files {pattern} {are} missing between the first and the last"
            )
    return notes


def _missing(numbers: list[int]) -> int:
    """Return how many are missing in numbers of equal steps; 0 where their steps are not equal."""
    steps = Counter(b - a for a, b in pairwise(sorted(set(numbers))))
    usual = min(steps, default=0)
    if (
        len(numbers) < 3
        or usual == 0
        or any(step % usual for step in steps)
        or 2 * steps[usual] < steps.total()
    ):
        return 0
    return sum((step // usual - 1) * count for step, count in steps.items())
