"""Ctrl-C and SIGTERM: finish the running tiles, write their markers, and go; or go at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from pchem_pipeline.base.errors import ExitCode, PchEmError


class InterruptedRunError(PchEmError):
    """The user or the system asked the run to stop; what was finished is kept."""

    def __init__(self, number: int) -> None:
        name = signal.Signals(number).name
        super().__init__(
            f"stopped by {name}; finished tiles are kept, run the same command again to continue"
        )
        self.exit_code = ExitCode.SIGTERM if number == signal.SIGTERM else ExitCode.SIGINT


class _Interrupted(BaseException):
    """Ends what the main thread does; no error, so that nobody who guards against errors keeps it."""


class StopRequest:
    """Remembers the signal that asked for a stop."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._at_once = False

    def ask(self, number: int) -> None:
        """Remember a signal; raise where the main thread does what may be left half done."""
        self.signal = number
        if self._at_once:
            self._at_once = False
            raise _Interrupted

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a signal end the block wherever the main thread is, also within a unit of work.

        Raises:
            InterruptedRunError: a signal arrived.
        """
        before = self._at_once
        try:
            self._at_once = True
            self.check()
            yield
        except _Interrupted:
            self.check()
        finally:
            self._at_once = before and self.signal is None

    def check(self) -> None:
        """Raise InterruptedRunError if a signal asked for a stop."""
        if self.signal is not None:
            raise InterruptedRunError(self.signal)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn the first SIGINT or SIGTERM into a request; a second one ends the process at once.

    A signal that the process was started to ignore stays ignored: a shell does that to what a script puts
    into the background, so that Ctrl-C ends the script alone.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def handle(number: int, frame: FrameType | None) -> None:
        if request.signal is not None:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        request.ask(number)

    handled = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != signal.SIG_IGN]
    old = {number: signal.signal(number, handle) for number in handled}
    try:
        yield request
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
