"""What a run remembers of its stages: fingerprints, records, and a marker for each finished tile."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import LockedError, StoreError, quoted
from pchem_pipeline.store.files import read_record, remove_files, remove_folder, write_record

#: seconds for which a look at the record holds: a worker that hung for less was not overtaken
_LOOK = 1.0


@dataclass
class _Work:
    records: Records
    stage: str
    fingerprint: str
    looked: float = float("-inf")


_WORK: ContextVar[_Work | None] = ContextVar("work", default=None)


@contextlib.contextmanager
def working(records: Records, stage: str, fingerprint: str | None) -> Iterator[None]:
    """Let this thread write only while a stage is done in this form; None: it may always write.

    A worker that hangs, or whose parent was killed, still has its unit. When it wakes up, the run may have
    been done anew with other settings, in whose place it must not put what it was once asked for.
    """
    token = _WORK.set(None if fingerprint is None else _Work(records, stage, fingerprint))
    try:
        yield
    finally:
        _WORK.reset(token)


def check_work(path: Path) -> None:
    """Raise LockedError where the work of this thread on a run was overtaken, so that it writes no more."""
    work = _WORK.get()
    if work is None or time.monotonic() - work.looked < _LOOK:
        return
    record = work.records.known(work.stage)
    if record is None or record.fingerprint != work.fingerprint:
        raise LockedError(f"{path}: a later pchem command has taken over; this one stops writing")
    work.looked = time.monotonic()


@dataclass(frozen=True)
class StageRecord:
    """How a stage was last run.

    Attributes:
        version: of its algorithm.
        fingerprint: digest of all that decides the result.
        content: what the digest was taken of: settings read, upstream fingerprints, input identity.
        keys: how many unit markers the complete stage has.
        finished: True once the stage came to its end; work after the last unit may be missing before.
        started: UTC time, ISO 8601.
        seconds: wall time, summed over the runs that completed it.
        cpu_seconds: CPU time of this process and its children.
        peak_rss_bytes: largest resident set of a process.
        failed: key and reason of each unit that failed.
        notes: one-line remarks that the report repeats.
        versions: of Python and of the libraries.
        model: number of the version of the run's model that the result rests on; None: of none.
        files: names of the files of the run that it wrote, beside arrays, with their digests.
    """

    stage: str
    version: int
    fingerprint: str
    content: dict[str, Any]
    keys: int = 0
    finished: bool = False
    started: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_rss_bytes: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    model: int | None = None
    files: dict[str, str] = field(default_factory=dict)


class Records:
    """The stage records and unit markers below one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, stage: str) -> StageRecord | None:
        """Return the record of a stage, or None if it never started.

        Raises:
            StoreError: it is damaged.
        """
        path = self._folder / "stages" / f"{stage}.json"
        cure = f"run it again: pchem {stage} {quoted(self._folder.parent)} --force"
        content = read_record(path, cure)
        if content is None:
            return None
        try:
            return StageRecord(**{**content, "notes": tuple(content.get("notes", ()))})
        except TypeError as error:
            raise StoreError(f"{path} is damaged ({error}); {cure}") from error

    def known(self, stage: str) -> StageRecord | None:
        """Return the record of a stage, None also where it is damaged and the stage is to be done again."""
        try:
            return self.read(stage)
        except StoreError:
            return None

    def write(self, record: StageRecord) -> None:
        """Store the record of a stage."""
        write_record(self._folder / "stages" / f"{record.stage}.json", asdict(record))

    def forget(self, stage: str) -> None:
        """Drop the record and all markers of a stage."""
        remove_files(self._folder / "stages" / f"{stage}.json")
        self.unmark_all(stage)

    def unmark_all(self, stage: str) -> None:
        """Drop all markers of a stage, which has its record still."""
        remove_folder(self._folder / "done" / stage)

    def mark(self, stage: str, fingerprint: str, key: str, summary: dict[str, Any]) -> None:
        """Say that a unit of a stage is whole in the store.

        Raises:
            ValueError: the key is no name of a file; its marker would never be found again.
        """
        if "/" in key or key.startswith("."):
            raise ValueError(f"stage {stage}: the key {key!r} of a unit is not a file name")
        write_record(self._marker(stage, fingerprint, key), summary)

    def unmark(self, stage: str, fingerprint: str, keys: Iterable[str]) -> None:
        """Say that units have to be done again."""
        gone = sorted(self.done(stage, fingerprint) & set(keys))
        remove_files(*(self._marker(stage, fingerprint, key) for key in gone))

    def done(self, stage: str, fingerprint: str) -> set[str]:
        """Return the keys of the finished units of a stage in its present form."""
        folder = self._marker(stage, fingerprint, "x").parent
        try:
            return {path.name.removesuffix(".json") for path in folder.glob("[!.]*.json")}
        except FileNotFoundError:  # whoever works on the stage removed it meanwhile
            return set()

    def has_all(self, record: StageRecord) -> bool:
        """Return whether all units of a stage are finished that it has as far as its record knows."""
        return len(self.done(record.stage, record.fingerprint)) >= record.keys

    def summaries(self, stage: str, fingerprint: str) -> dict[str, dict[str, Any]]:
        """Return the summary that each finished unit left, in the order of the keys."""
        keys = sorted(self.done(stage, fingerprint))
        return {key: read_record(self._marker(stage, fingerprint, key)) or {} for key in keys}

    def _marker(self, stage: str, fingerprint: str, key: str) -> Path:
        return self._folder / "done" / stage / fingerprint[:16] / f"{key}.json"
