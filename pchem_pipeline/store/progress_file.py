"""How far a running command is, in a small file of the run that other processes may read."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import StoreError, one_line
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.lock import is_locked

_WORDS = ("stage", "unit", "time", "host")
_NUMBERS = ("done", "total", "elapsed", "rate", "remaining", "pid")
_MOST = 1e15  # of what can be counted here


class ProgressFile:
    """The file ``.pchem/progress.json`` of a run; it is there while a command works on the run.

    A disk that cannot take it stops nothing: progress is not a result.
    """

    def __init__(self, store: Path) -> None:
        self._path = _place(store)
        self._shown = False

    def show(self, pace: Mapping[str, Any]) -> None:
        """Write how far the work is."""
        content = {
            **pace,
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "pid": os.getpid(),
            "host": socket.gethostname(),
        }
        with contextlib.suppress(StoreError):
            write_atomic(self._path, (json.dumps(content) + "\n").encode(), sync=False)
            self._shown = True

    def remove(self) -> None:
        """Remove the file, if this process wrote it and no other has begun since."""
        if self._shown:
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                if json.loads(self._path.read_text(encoding="utf-8"))["pid"] == os.getpid():
                    self._path.unlink()


def read_progress(store: Path) -> dict[str, Any] | None:
    """Return what the command that works on a run tells, or None where none does: its lock decides.

    Numbers and words of other types, and control characters, do not get through.
    """
    place = _place(store)
    try:
        content = json.loads(place.read_bytes())
        if not isinstance(content, dict) or not is_locked(store, place.parent):
            return None
    except (OSError, ValueError, RecursionError):
        return None
    words = {name: one_line(text) for name in _WORDS if isinstance(text := content.get(name), str)}
    numbers = {name: value for name in _NUMBERS if _is_number(value := content.get(name))}
    return {**words, **numbers}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < _MOST


def _place(store: Path) -> Path:
    return store / ".pchem" / "progress.json"
