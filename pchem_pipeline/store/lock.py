"""The lock of a run: a lock of the kernel on a disk, an object that only one can create on an object storage.

The kernel frees its lock when a process ends, however it ends. An object stays where its owner was killed: it
is taken over only where that was a process of this machine and is gone, since clocks of machines differ.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import secrets
import socket
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pchem_pipeline.base.errors import LockedError, StoreError
from pchem_pipeline.store.files import storage_error
from pchem_pipeline.store.remote_path import RemotePath

#: s: a look by `is_locked` is shorter
_PATIENCE = 0.3
_FILE, _OBJECT = "lock", "lock.json"


@contextlib.contextmanager
def locked(run: Path, private: Path) -> Iterator[None]:
    """Hold the lock of a run, which lies in its folder ``private``.

    Raises:
        LockedError: another process holds it.
        StoreError: the lock cannot be written.
    """
    if isinstance(private, RemotePath):
        lock = private / _OBJECT
        mine = _acquired(run, lock)
        try:
            yield
        finally:
            with contextlib.suppress(StoreError, FileNotFoundError):
                if lock.read_bytes() == mine:
                    lock.unlink(missing_ok=True)
        return
    try:
        private.mkdir(parents=True, exist_ok=True)
        held = FileLock(private / _FILE)
        held.acquire(timeout=_PATIENCE)
    except Timeout as error:
        raise _in_use(run) from error
    except OSError as error:
        raise storage_error(error, private) from error
    try:
        yield
    finally:
        held.release()


def _in_use(run: Path) -> LockedError:
    return LockedError(f"{run} is in use by another pchem process; wait for it or use another --store")


def is_locked(run: Path, private: Path) -> bool:
    """Return whether a living process holds the lock of a run, as far as this machine can know."""
    if isinstance(private, RemotePath):
        try:
            return not _is_left_behind(_owner(run, private / _OBJECT))
        except FileNotFoundError:
            return False
        except LockedError:
            return True
    try:
        with (private / _FILE).open("rb") as file:  # also where this user may not write
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError as error:
        return error.errno in (errno.EWOULDBLOCK, errno.EACCES)
    return False


def _acquired(run: Path, lock: RemotePath) -> bytes:
    """Create the object, in the place of one whose owner is gone; return its content."""
    about = {
        "host": socket.gethostname(),
        "machine": _machine(),
        "pid": os.getpid(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "token": secrets.token_hex(8),
    }
    content = (json.dumps(about) + "\n").encode()
    for _ in range(3):
        with contextlib.suppress(FileExistsError):
            lock.create_bytes(content)
            return content
        with contextlib.suppress(FileNotFoundError):
            held = _owner(run, lock)
            if held == about:  # the answer to the first request was lost
                return content
            if not _is_left_behind(held):
                raise LockedError(
                    f"{run} is in use by pchem on {held.get('host')} (process {held.get('pid')}, since "
                    f"{held.get('time')}); wait for it or use another --store; if this process has ended: "
                    f"{_free(lock)}"
                )
            lock.unlink(missing_ok=True)
    raise _in_use(run)


def _owner(run: Path, lock: RemotePath) -> dict[str, Any]:
    """Return what the object says of its owner; raise LockedError where it is damaged."""
    with contextlib.suppress(ValueError):
        held = json.loads(lock.read_bytes())
        if isinstance(held, dict):
            return held
    raise LockedError(f"{run}: its lock {lock} is damaged; if no pchem command uses this run: {_free(lock)}")


def _free(lock: RemotePath) -> str:
    return f"""python -c "import fsspec; fsspec.open('{lock}').fs.rm('{lock}')\""""


def _is_left_behind(held: dict[str, Any]) -> bool:
    """Return whether the owner was a process of this machine, and is gone."""
    pid = held.get("pid")
    if held.get("machine") != _machine() or not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # somebody else's
        return False
    return False


def _machine() -> str:
    """Return a name of this machine since it was started, as its processes have numbers of their own."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()} {Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    return socket.gethostname()
