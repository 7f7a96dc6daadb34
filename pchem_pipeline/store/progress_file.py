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

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.store.files import write_atomic


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
    """Return what the command that works on a run tells, or None where none does.

    A file that a killed process of this machine left counts as none.
    """
    try:
        content: dict[str, Any] = dict(json.loads(_place(store).read_text(encoding="utf-8")))
        here = content["host"] == socket.gethostname()
        return content if not here or process_lives(int(content["pid"])) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def process_lives(pid: int) -> bool:
    """Tell whether a process of this machine is there."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def _place(store: Path) -> Path:
    return store / ".pchem" / "progress.json"
