"""Work in fresh Python processes, for functions that must not share an interpreter (drawing does).

Unlike the processes of :mod:`multiprocessing` they never import the main module of the program, so a user's
script needs no ``if __name__ == "__main__"`` for them. Function and item travel as pickles.

Not loky, which does not import the main module either: there a worker that dies takes the items of all
others with it, and after a kill -9 of the program its workers live on for ever. Here a death is an error of
its item, and a process ends when its input does.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from pchem_pipeline.base.errors import IncompleteRunError
from pchem_pipeline.compute.executor import OnResult, Outcome, guarded

T = TypeVar("T")
_MODULE = "pchem_pipeline.compute.fresh_processes"


class FreshProcessExecutor:
    """Processes that live during :meth:`map`; see :class:`~pchem_pipeline.compute.executor.Executor`."""

    shares_memory = False
    memory_limit: int | None = None

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """Call ``function`` on each item, first ones first; a process that dies is an error of its item."""
        todo: queue.SimpleQueue[T] = queue.SimpleQueue()
        n_items = 0
        for item in items:
            todo.put(item)
            n_items += 1
        done: queue.SimpleQueue[tuple[T, Outcome]] = queue.SimpleQueue()
        stopped = threading.Event()
        threads = [
            threading.Thread(target=_feed, args=(function, todo, done, stopped), daemon=True)
            for _ in range(min(self.workers, n_items))
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in range(n_items):
                on_result(*done.get())
        finally:
            stopped.set()
            for thread in threads:
                thread.join()

    def close(self) -> None:
        """Nothing to free: the processes live only during :meth:`map`."""


def _feed(
    function: Callable[[T], Any],
    todo: queue.SimpleQueue[T],
    done: queue.SimpleQueue[tuple[T, Outcome]],
    stopped: threading.Event,
) -> None:
    """Give items to one process, one after the other; a new one where it died."""
    process: subprocess.Popen[bytes] | None = None
    while not stopped.is_set():
        try:
            item = todo.get_nowait()
        except queue.Empty:
            break
        try:
            if process is None:
                process = _start()
            outcome = _ask(process, function, item)
        except (OSError, EOFError):
            outcome = Outcome(error=IncompleteRunError("a worker process died (killed, or out of memory)"))
            _end(process)
            process = None
        except Exception as error:  # what cannot be pickled
            outcome = Outcome(error=error)
        done.put((item, outcome))
    _end(process)


def _start() -> subprocess.Popen[bytes]:
    """Start a process with this one's import path, in a session of its own: Ctrl-C is not for it."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.Popen(
        [sys.executable, "-m", _MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )


def _ask(process: subprocess.Popen[bytes], function: Callable[[T], Any], item: T) -> Outcome:
    assert process.stdin is not None
    assert process.stdout is not None
    request = pickle.dumps((function, item), protocol=pickle.HIGHEST_PROTOCOL)
    process.stdin.write(request)
    process.stdin.flush()
    outcome: Outcome = pickle.load(process.stdout)
    return outcome


def _end(process: subprocess.Popen[bytes] | None) -> None:
    """End a process: it stops when its input does."""
    if process is not None:
        with contextlib.suppress(OSError):
            process.__exit__(None, None, None)


def serve() -> None:
    """Answer requests from standard input until it ends; what functions print goes to standard error."""
    from pchem_pipeline.compute.environment import prepare_environment

    prepare_environment()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            function, item = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        except Exception as error:  # a function or a class that this process cannot import
            outcome = Outcome(error=RuntimeError(f"{type(error).__name__}: {error}"))
        else:
            outcome = guarded(function, item)
        try:
            answers.write(_pickled(outcome))
            answers.flush()
        except BrokenPipeError:  # the one who asked is gone, and the rest of the answer with it
            os._exit(0)


def _pickled(outcome: Outcome) -> bytes:
    """Return the pickle of an outcome; of its words where an error cannot be pickled and read again."""
    try:
        text = pickle.dumps(outcome, protocol=pickle.HIGHEST_PROTOCOL)
        if outcome.error is not None:
            pickle.loads(text)
    except Exception:
        words = RuntimeError(f"{type(outcome.error).__name__}: {outcome.error}")
        text = pickle.dumps(Outcome(error=words, trace=outcome.trace))
    return text


if __name__ == "__main__":
    serve()
