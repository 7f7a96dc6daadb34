"""What a run says while it works: progress and one line per stage on stderr, JSON lines in a file."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.store.progress_file import ProgressFile

__all__ = ["Advance", "Reporter", "paced"]

ProgressMode = Literal["auto", "on", "off"]


class Advance(Protocol):
    """Called when units of work are finished."""

    def __call__(self, n: int = 1) -> None:
        """Advance the bar by ``n`` units."""


def paced(label: str, unit: str, done: int, total: int, new: int, seconds: float) -> dict[str, Any]:
    """Return how far a stage is, for machines.

    Args:
        label: the stage, or a part of one.
        unit: what is counted.
        done: units finished.
        total: units of the whole.
        new: units finished in this run.
        seconds: time that those took.

    Returns:
        ``stage``, ``unit``, ``done``, ``total``, ``elapsed`` (s), ``rate`` (units per s), ``remaining`` (s);
        the last two are None before the first unit.
    """
    known = new > 0 and seconds > 0
    return {
        "stage": label,
        "unit": unit,
        "done": done,
        "total": total,
        "elapsed": round(seconds, 3),
        "rate": new / seconds if known else None,
        "remaining": round((total - done) * seconds / new, 3) if known else None,
    }


class Reporter:
    """Progress bars, messages and the JSON log of one command; stdout stays untouched."""

    def __init__(
        self,
        progress: ProgressMode = "auto",
        *,
        quiet: bool = False,
        log: Path | None = None,
        progress_file: ProgressFile | None = None,
    ) -> None:
        self._file = progress_file
        self._disable = {"auto": None, "on": False, "off": True}[progress] if not quiet else True
        self._quiet = quiet
        self._log: TextIO | None = None
        if log is not None:
            try:
                self._log = log.open("a", encoding="utf-8")
            except OSError as error:
                raise ConfigError(f"--log-json {log}: cannot be written ({error.strerror})") from error

    def info(self, message: str, **fields: Any) -> None:
        """Say one line to people (not with --quiet) and to the log."""
        if not self._quiet:
            self._line(message)
        self.event("info", message=message, **fields)

    def warning(self, message: str, **fields: Any) -> None:
        """Say one line of caution, even with --quiet."""
        self._line(f"warning: {message}")
        self.event("warning", message=message, **fields)

    def event(self, kind: str, **fields: Any) -> None:
        """Write one JSON line to the log file, if there is one."""
        if self._log is not None:
            stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
            try:
                self._log.write(json.dumps({"time": stamp, "event": kind, **fields}, default=str) + "\n")
                self._log.flush()
            except OSError as error:  # it is no result
                self._end_log()
                self._line(f"warning: --log-json ends here: {error.strerror or error}")

    @contextmanager
    def progress(
        self, label: str, total: int, unit: str = "tile", done: int = 0, *, hidden: bool = False
    ) -> Iterator[Advance]:
        """Show a bar from ``done`` to ``total``; yields the function that advances it.

        Rate and remaining time are means over this run. A ``hidden`` one shows and tells nothing.
        """
        if hidden:
            yield lambda n=1: None
            return
        from tqdm import tqdm

        with tqdm(
            total=total,
            initial=done,
            desc=label,
            unit=f" {unit}",
            smoothing=0.0,
            disable=self._disable,
            file=sys.stderr,
            leave=False,
        ) as bar:
            count, start, last = done, time.monotonic(), -1.0

            def tell() -> None:
                nonlocal last
                last = time.monotonic()
                pace = paced(label, unit, count, total, count - done, last - start)
                self.event("progress", **pace)
                if self._file is not None:
                    self._file.show(pace)

            def advance(n: int = 1) -> None:
                nonlocal count
                count += n
                bar.update(n)
                if time.monotonic() - last > 1 or count == total:
                    tell()

            tell()
            yield advance

    def close(self) -> None:
        """Close the log file, and take back what others could see."""
        if self._file is not None:
            self._file.remove()
        self._end_log()

    def _end_log(self) -> None:
        log, self._log = self._log, None
        if log is not None:
            with contextlib.suppress(OSError):  # what could not be written is tried once more
                log.close()

    def _line(self, message: str) -> None:
        from tqdm import tqdm

        tqdm.write(message, file=sys.stderr)
