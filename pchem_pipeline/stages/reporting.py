"""What a run says while it works: progress and one line per stage on stderr, JSON lines in a file."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO

from pchem_pipeline.errors import ConfigError

__all__ = ["Advance", "Reporter"]

ProgressMode = Literal["auto", "on", "off"]


class Advance(Protocol):
    """Called when units of work are finished."""

    def __call__(self, n: int = 1) -> None:
        """Advance the bar by ``n`` units."""


class Reporter:
    """Progress bars, messages and the JSON log of one command; stdout stays untouched."""

    def __init__(
        self, progress: ProgressMode = "auto", *, quiet: bool = False, log: Path | None = None
    ) -> None:
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
            self._log.write(json.dumps({"time": stamp, "event": kind, **fields}, default=str) + "\n")
            self._log.flush()

    @contextmanager
    def progress(self, label: str, total: int, unit: str = "tile", done: int = 0) -> Iterator[Advance]:
        """Show a bar from ``done`` to ``total``; yields the function that advances it."""
        from tqdm import tqdm

        with tqdm(
            total=total,
            initial=done,
            desc=label,
            unit=unit,
            disable=self._disable,
            file=sys.stderr,
            leave=False,
        ) as bar:
            count, last = done, time.monotonic()

            def advance(n: int = 1) -> None:
                nonlocal count, last
                count += n
                bar.update(n)
                now = time.monotonic()
                if now - last > 1 or count == total:
                    last = now
                    self.event("progress", stage=label, done=count, total=total)

            yield advance

    def close(self) -> None:
        """Close the log file."""
        if self._log is not None:
            self._log.close()

    def _line(self, message: str) -> None:
        from tqdm import tqdm

        tqdm.write(message, file=sys.stderr)
