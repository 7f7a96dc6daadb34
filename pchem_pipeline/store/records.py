"""What a run remembers of its stages: fingerprints, records, and a marker for each finished tile."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pchem_pipeline.store.files import (
    canonical_json,
    read_json,
    remove_file,
    remove_folder,
    sync_folder,
    write_json,
)
from pchem_pipeline.store.remote_path import RemotePath


def fingerprint_of(content: dict[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of ``content``."""
    return hashlib.sha256(canonical_json(content)).hexdigest()


@dataclass(frozen=True)
class StageRecord:
    """How a stage was last run.

    Attributes:
        stage: its name.
        version: version of its algorithm.
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
        versions: versions of Python and of the libraries.
        model: number of the version of the run's model that the result rests on; None: of none.
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


class Records:
    """The stage records and unit markers below one folder."""

    def __init__(self, folder: Path, sync: Callable[[Path], None]) -> None:
        """Take the folder, and what waits until a file, and the arrays written before it, are on the disk."""
        self._folder = folder
        self._sync = sync

    def read(self, stage: str) -> StageRecord | None:
        """Return the record of a stage, or None if it never started."""
        content = read_json(self._folder / "stages" / f"{stage}.json")
        if content is None:
            return None
        return StageRecord(**{**content, "notes": tuple(content.get("notes", ()))})

    def write(self, record: StageRecord) -> None:
        """Store the record of a stage."""
        write_json(self._folder / "stages" / f"{record.stage}.json", asdict(record), sync=self._sync)

    def forget(self, stage: str) -> None:
        """Drop the record and all markers of a stage."""
        remove_file(self._folder / "stages" / f"{stage}.json")
        self.unmark_all(stage)

    def unmark_all(self, stage: str) -> None:
        """Drop all markers of a stage, which has its record still."""
        remove_folder(self._folder / "done" / stage)
        self._forgotten(self._folder / "done")

    def mark(self, stage: str, fingerprint: str, key: str, summary: dict[str, Any]) -> None:
        """Say that a unit of a stage is whole in the store.

        Raises:
            ValueError: the key is no name of a file; its marker would never be found again.
        """
        if "/" in key or key.startswith("."):
            raise ValueError(f"stage {stage}: the key {key!r} of a unit is no name of a file")
        write_json(self._marker(stage, fingerprint, key), summary, sync=self._sync)

    def unmark(self, stage: str, fingerprint: str, keys: Iterable[str]) -> None:
        """Say that units have to be done again."""
        marked = self.done(stage, fingerprint) & set(keys)
        for key in sorted(marked):
            remove_file(self._marker(stage, fingerprint, key))
        if marked:
            self._forgotten(self._marker(stage, fingerprint, "x").parent)

    def _forgotten(self, folder: Path) -> None:
        """Wait until markers are gone from the disk, before what they stood for is written anew."""
        if not isinstance(folder, RemotePath):
            sync_folder(folder)

    def done(self, stage: str, fingerprint: str) -> set[str]:
        """Return the keys of the finished units of a stage in its present form."""
        folder = self._marker(stage, fingerprint, "x").parent
        try:
            return {path.name.removesuffix(".json") for path in folder.glob("[!.]*.json")}
        except FileNotFoundError:  # whoever works on the stage removed it meanwhile
            return set()

    def summaries(self, stage: str, fingerprint: str) -> dict[str, dict[str, Any]]:
        """Return the summary that each finished unit left, in the order of the keys."""
        keys = sorted(self.done(stage, fingerprint))
        return {key: read_json(self._marker(stage, fingerprint, key)) or {} for key in keys}

    def _marker(self, stage: str, fingerprint: str, key: str) -> Path:
        return self._folder / "done" / stage / fingerprint[:16] / f"{key}.json"
