"""The lock of a run on an object storage, for all machines: an object that only one of them can put.

Its owner puts it again every minute. A lock whose owner gave no sign of life for ten minutes, or is a process
of this machine that is gone, is taken over. Where two take it over at once, the one that put its lock last
has it, and the other stops before its next marker: what both wrote until then are the same bits.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import LockedError, StoreError
from pchem_pipeline.store.progress_file import process_lives
from pchem_pipeline.store.remote_path import RemotePath

#: seconds between signs of life, and without one until a lock counts as left behind
BEAT, LEFT_BEHIND = 60.0, 600.0

_HELD: dict[str, _Lease] = {}


@contextlib.contextmanager
def leased(place: RemotePath, run: RemotePath) -> Iterator[None]:
    """Hold the lock of a run.

    Args:
        place: the object that is the lock.
        run: the run, for messages.

    Raises:
        LockedError: another process, on any machine, holds it.
        StoreError: the object storage refused.
    """
    lease = _Lease(place, run)
    lease.acquire()
    _HELD[str(run)] = lease
    try:
        yield
    finally:
        del _HELD[str(run)]
        lease.release()


def check_lease(run: RemotePath) -> None:
    """Raise LockedError where this process held the lock of a run, and another has taken it over."""
    lease = _HELD.get(str(run))
    if lease is not None and lease.lost:
        raise LockedError(
            f"{run}: another process has taken over this run, since this one gave no sign of life for "
            f"{LEFT_BEHIND / 60:.0f} minutes; finished tiles are kept"
        )


class _Lease:
    """One holding of the lock.

    Attributes:
        lost: another process has it now.
    """

    def __init__(self, place: RemotePath, run: RemotePath) -> None:
        self.lost = False
        self._place, self._run = place, run
        self._token = secrets.token_hex(8)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="lease", daemon=True)

    def acquire(self) -> None:
        """Put the lock, or take over one that was left behind."""
        for _ in range(3):
            with contextlib.suppress(FileExistsError):
                self._place.create_bytes(self._content())
            held = self._read()
            if held is not None and held.get("token") == self._token:
                self._thread.start()
                return
            if held is not None:
                self._refuse_living(held)
                self._place.unlink(missing_ok=True)
        raise LockedError(f"{self._run} is in use by another pchem process; wait for it")

    def release(self) -> None:
        """Remove the lock, if it is still this one."""
        self._ended.set()
        self._thread.join()
        with contextlib.suppress(StoreError):
            if not self.lost and (self._read() or {}).get("token") == self._token:
                self._place.unlink(missing_ok=True)

    def _content(self) -> bytes:
        about = {
            "token": self._token,
            "host": socket.gethostname(),
            "machine": _machine(),
            "pid": os.getpid(),
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        return (json.dumps(about) + "\n").encode()

    def _read(self) -> dict[str, Any] | None:
        """Return what the lock says, with ``age`` (s); None where there is none."""
        try:
            content = json.loads(self._place.read_bytes())
            held: dict[str, Any] = content if isinstance(content, dict) else {}
            age = time.time() - self._place.modified().timestamp()
        except FileNotFoundError:
            return None
        except ValueError:
            return {"age": 0.0}
        return {**held, "age": max(0.0, age)}

    def _refuse_living(self, held: dict[str, Any]) -> None:
        """Raise LockedError unless the owner of the lock is gone."""
        mine = held.get("machine") == _machine() and isinstance(held.get("pid"), int)
        if held["age"] > LEFT_BEHIND or (mine and not process_lives(held["pid"])):
            return
        raise LockedError(
            f"{self._run} is in use by pchem on {held.get('host', 'another machine')} (process "
            f"{held.get('pid', 'unknown')}, last sign of life {held['age']:.0f} s ago); wait for it, use "
            f"another --store, or, where that process is gone, remove {self._place}"
        )

    def _beat(self) -> None:
        """Put the lock again and again, until it is another's."""
        while not self._ended.wait(BEAT):
            with contextlib.suppress(StoreError):  # the network may come back; the other side is patient
                held = self._read()
                if held is not None and held.get("token") != self._token:
                    self.lost = True
                    return
                self._place.write_bytes(self._content())


def _machine() -> str:
    """Return a name of this machine since it was started, as its processes have numbers of their own."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()} {Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    return socket.gethostname()
