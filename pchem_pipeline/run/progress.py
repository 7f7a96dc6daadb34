"""What a run says while it works: progress and one line per stage on stderr, JSON lines in a file.

Other processes read how far it is in a small file of the run.
"""

from __future__ import annotations

import contextlib
import contextvars
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO, TypeVar

from pchem_pipeline.base.errors import ConfigError, StoreError, one_line
from pchem_pipeline.base.kernel_cache import cache_folder, is_writable, listening
from pchem_pipeline.base.wording import typeset
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.lock import is_locked

T = TypeVar("T")
ProgressMode = Literal["auto", "on", "off"]

#: Seconds of silence after which a phase says that it is still at work.
_SILENCE = 20.0


class Advance(Protocol):
    """Called when units of work are finished."""

    def __call__(self, n: float = 1) -> None:
        """Advance the bar by ``n`` units, or a part of one."""


def whole_mebibytes(advance: Advance) -> Callable[[int], None]:
    """Turn bytes into whole MiB of progress."""
    done = shown = 0

    def count(n_bytes: int) -> None:
        nonlocal done, shown
        done += n_bytes
        if (done >> 20) > shown:
            advance((done >> 20) - shown)
            shown = done >> 20

    return count


#: Who hears of the shares of the unit that a thread works on.
_teller: contextvars.ContextVar[Callable[[float], None] | None] = contextvars.ContextVar(
    "teller", default=None
)


@contextmanager
def telling_parts(tell: Callable[[float], None] | None) -> Iterator[None]:
    """Let ``tell`` hear what share of the unit each part makes that is done within, in this thread."""
    token = _teller.set(tell)
    try:
        yield
    finally:
        _teller.reset(token)


def parts_told(parts: Iterable[T]) -> Iterator[T]:
    """Yield the parts of a unit of work, and tell of each that is done: a bar moves within a single tile."""
    every, tell = list(parts), _teller.get()
    for part in every:
        yield part
        if tell is not None:
            tell(1.0 / len(every))


def paced(label: str, unit: str, done: float, total: int, new: float, seconds: float) -> dict[str, Any]:
    """Return how far a stage is, for machines: units done of all, rate and remaining time (s).

    These are None before the first unit; ``new`` units took the given time (s) in this run.
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
        self._lock, self._bar = threading.Lock(), threading.RLock()
        self._told = time.monotonic()
        self._compiled = 0.0
        if log is not None:
            try:
                # a pipe that nobody reads is an error, not a wait
                file = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o666)
                self._log = os.fdopen(file, "a", encoding="utf-8")
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
            line = json.dumps({"time": stamp, "event": kind, **fields}, default=str) + "\n"
            try:
                with self._lock:
                    self._log.write(line)
                    self._log.flush()
            except OSError as error:  # it is no result
                self._end_log()
                self._line(f"warning: --log-json: no further events written: {error.strerror or error}")

    @contextmanager
    def compilation(self, stage: str, limit: int | None = None) -> Iterator[None]:
        """Say when a stage compiles kernels, or waits for another process that does: how many, and how long.

        Warn where compiling takes more memory than the run may take, ``limit`` in MiB.
        """
        seconds: list[float] = []
        most = 490  # MiB of this process while it compiles

        def listener(kernel: str, took: float | None) -> None:
            if took is not None:
                seconds.append(took)
            elif not seconds:
                self.info(f"{stage}: compiling kernels (once after an installation or update)")
                if limit is not None and limit < most:
                    self.warning(
                        f"{stage}: compiling takes up to {most} MiB, more than compute.max_memory "
                        f"(--max-memory) allows ({limit} MiB); later work stays within the limit"
                    )
            self._compiled = sum(seconds)  # no work is done meanwhile
            self.event("compiling", stage=stage, kernel=kernel, seconds=took)

        try:
            with listening(listener):
                yield
        finally:
            self._compiled = 0.0
        if not seconds:
            return
        self.info(
            f"{stage}: {len(seconds)} kernel{'s' * (len(seconds) > 1)} compiled in {sum(seconds):.0f} s"
        )
        if not is_writable(cache_folder()):
            self.warning(
                f"{stage}: {cache_folder()} is not writable, so every command compiles its kernels again; "
                "set NUMBA_CACHE_DIR to another folder"
            )

    @contextmanager
    def phases(self, stage: str) -> Iterator[Callable[[str], None]]:
        """Yield a function that names what a stage does next; one that is silent for long is named again."""
        ended = threading.Event()
        phase, began = "", time.monotonic()

        def show(kind: str, more: str = "") -> None:
            self._told = time.monotonic()
            elapsed = self._told - began
            if not self._quiet:
                self._line(f"{stage}: {phase}{more}")
            self.event(kind, stage=stage, phase=phase, elapsed=round(elapsed, 3))
            if self._file is not None:
                self._file.show({"stage": f"{stage}: {phase}", "elapsed": round(elapsed, 3)})

        def tell(words: str) -> None:
            nonlocal phase, began
            if words != phase:
                phase, began = words, time.monotonic()
                show("phase")

        def watch() -> None:
            while not ended.wait(1.0):
                if phase and time.monotonic() - self._told > _SILENCE:
                    show("still", f", {time.monotonic() - began:.0f} s so far")

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield tell
        finally:
            ended.set()
            watcher.join()

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
            desc=label,
            total=total,
            initial=done,
            unit=f" {unit}",
            smoothing=0.0,
            disable=self._disable,
            file=sys.stderr,
            leave=False,
        ) as bar:
            count: float = done
            start, last, compiled = time.monotonic(), -1.0, self._compiled

            def tell() -> None:
                nonlocal last
                last = self._told = time.monotonic()
                worked = max(last - start - (self._compiled - compiled), 1e-3)
                pace = paced(label, unit, _short(count), total, count - done, worked)
                self.event("progress", **pace)
                if self._file is not None:
                    self._file.show(pace)

            def advance(n: float = 1) -> None:
                nonlocal count
                with self._bar:
                    count += n
                    bar.n = _short(count)
                    bar.update(0)
                    if time.monotonic() - last > 1 or bar.n == total:
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

        self._told = time.monotonic()
        tqdm.write(typeset(message), file=sys.stderr)


def _short(count: float) -> float:
    """Return a count of units for people: whole where it is, else with two digits."""
    rounded = round(count, 2)
    return int(rounded) if rounded == int(rounded) else rounded


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
    """Return the progress of the command that works on a run, or None if none does: its lock decides.

    Numbers and words of other types, and control characters, do not get through.
    """
    place = _place(store)
    try:
        content = json.loads(place.read_bytes())
        if not isinstance(content, dict) or not is_locked(store, place.parent):
            return None
    except (OSError, ValueError, RecursionError):
        return None
    words_of = ("stage", "unit", "time", "host")
    numbers_of = ("done", "total", "elapsed", "rate", "remaining", "pid")
    words = {name: one_line(text) for name in words_of if isinstance(text := content.get(name), str)}
    numbers = {
        name: value
        for name in numbers_of
        if isinstance(value := content.get(name), int | float)
        and not isinstance(value, bool)
        and 0 <= value < 1e15
    }
    return {**words, **numbers}


def _place(store: Path) -> Path:
    return store / ".pchem" / "progress.json"
