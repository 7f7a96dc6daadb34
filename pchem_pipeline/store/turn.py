"""Whose turn it is to write into a run: work that was overtaken must not write any more.

A worker that hangs, or whose parent was killed, still has its unit. Meanwhile the run may go on without it,
end, and be done anew with other settings; when the worker wakes up, it would put what it was once asked for
in place of that. So whoever hands out work to other processes takes a turn first, a number in the store, and
the work writes as long as that number stands there.
"""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from pchem_pipeline.base.errors import LockedError
from pchem_pipeline.store.files import write_atomic

#: seconds for which a look at the store holds: a worker that hung for less was not overtaken
_LOOK = 1.0


@dataclass
class _Turn:
    file: Path
    number: str
    looked: float = float("-inf")


_PRESENT: ContextVar[_Turn | None] = ContextVar("turn", default=None)


def take_turn(file: Path) -> str:
    """Begin a turn, which ends all earlier ones, and return its number.

    Raises:
        StoreError: the file cannot be written.
    """
    number = secrets.token_hex(8)
    write_atomic(file, number.encode())
    return number


@contextlib.contextmanager
def in_turn(file: Path, number: str | None) -> Iterator[None]:
    """Let this thread write only while a turn lasts; None: it may always write."""
    token = _PRESENT.set(None if number is None else _Turn(file, number))
    try:
        yield
    finally:
        _PRESENT.reset(token)


def check_turn() -> None:
    """Refuse to write where the turn of this thread has ended.

    Raises:
        LockedError: it has.
    """
    turn = _PRESENT.get()
    if turn is None or time.monotonic() - turn.looked < _LOOK:
        return
    try:
        there = turn.file.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        there = "none"
    if there != turn.number:
        raise LockedError(
            f"{turn.file.parent.parent}: work was taken over by a later pchem command; it writes no more"
        )
    turn.looked = time.monotonic()
