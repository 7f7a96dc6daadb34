"""Run a function on many items, on any backend, and hear of each result as it comes."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor as Pool
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from pchem_pipeline.base.errors import ConfigError, ExitCode, IncompleteRunError
from pchem_pipeline.compute.environment import prepare_environment
from pchem_pipeline.compute.settings import ComputeSettings

T = TypeVar("T")
_SPAWN = multiprocessing.get_context("spawn")  # a forked child deadlocks in zarr's event loop


@dataclass(frozen=True)
class Outcome:
    """What became of one item: a value, or an error with its traceback."""

    value: Any = None
    error: BaseException | None = None
    trace: str = ""


class Stop(Exception):
    """Raised by ``on_result`` to end the work: nothing new starts, what runs is finished."""


OnResult = Callable[[Any, Outcome], None]


class Executor(Protocol):
    """The interface of every backend."""

    workers: int
    #: workers share the memory of this process
    shares_memory: bool
    #: bytes that a worker may take, where somebody watches over that
    memory_limit: int | None = None

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """Call ``function`` on each item and ``on_result(item, outcome)`` here, in any order."""

    def close(self) -> None:
        """Free the workers, where any wait for more work."""
        return


def guarded(function: Callable[[T], Any], item: T) -> Outcome:
    """Call ``function`` and turn what it raises into an outcome: one bad tile stops no run."""
    try:
        return Outcome(value=function(item))
    except MemoryError as error:
        return Outcome(error=IncompleteRunError(out_of_memory(error)), trace=traceback.format_exc())
    except Exception as error:
        return Outcome(error=error, trace=traceback.format_exc())


def out_of_memory(error: MemoryError) -> str:
    """Say in one line that memory was not enough."""
    return (
        f"out of memory{f' ({error})' if str(error) else ''}; use fewer --workers, a smaller --max-memory "
        "or a smaller run.tile, or a machine with more, and run the same command to continue"
    )


def call_all(tasks: Sequence[Callable[[], T]], threads: int) -> list[T]:
    """Call tasks that share the memory, on some threads of this process; return their results in order.

    The first error is raised when all have ended.
    """
    if threads <= 1 or len(tasks) <= 1:
        return [task() for task in tasks]
    with ThreadPoolExecutor(min(threads, len(tasks)), thread_name_prefix="share") as pool:
        futures = [pool.submit(task) for task in tasks]
    return [future.result() for future in futures]


class Beside(Protocol):
    """Takes a task; what it returns gives the task's result, however often it is asked."""

    def __call__(self, task: Callable[[], T], /) -> Callable[[], T]:
        """See above."""
        ...


@contextlib.contextmanager
def beside(threads: int) -> Iterator[Beside]:
    """Have tasks that share the memory done by another thread, one after the other.

    Of a single thread each is done when its result is first asked for. What is not begun at the end, which
    may be an error, is not done.
    """
    if threads <= 1:
        yield functools.cache
        return
    pool = ThreadPoolExecutor(1, thread_name_prefix="beside")
    try:
        yield lambda task: pool.submit(task).result
    finally:
        pool.shutdown(cancel_futures=True)


class SerialExecutor(Executor):
    """One item after the other, in this thread."""

    workers = 1
    shares_memory = True

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """See :class:`Executor`."""
        for item in items:
            on_result(item, guarded(function, item))


def _begin_worker() -> None:
    """Prepare a worker process, which ends with its parent however that ends."""
    prepare_environment()
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
        os._exit(ExitCode.INTERNAL)

    threading.Thread(target=follow, daemon=True).start()


class PoolExecutor(Executor):
    """A pool of threads or of spawned processes, which lives only during :meth:`map`."""

    def __init__(self, workers: int, *, processes: bool) -> None:
        self.workers = workers
        self.shares_memory = not processes
        self._processes = processes

    def _pool(self) -> Pool:
        if self._processes:
            try:
                _SPAWN.Lock()
            except OSError as error:
                raise ConfigError(
                    "no shared memory for worker processes (on Linux: /dev/shm is read-only or full); use "
                    "--backend threads"
                ) from error
            return ProcessPoolExecutor(self.workers, mp_context=_SPAWN, initializer=_begin_worker)
        return ThreadPoolExecutor(self.workers, thread_name_prefix="tile")

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """See :class:`Executor`.

        Raises:
            IncompleteRunError: a worker process died.
        """
        others, wait = set(multiprocessing.active_children()), True
        pool = self._pool()
        try:
            item_of = {pool.submit(guarded, function, item): item for item in items}
            for future in as_completed(item_of):
                on_result(item_of.pop(future), future.result())
        except BrokenProcessPool as error:
            raise IncompleteRunError(
                "a worker process died (killed, or out of memory); finished tiles are kept: run again to "
                "continue, with fewer --workers if out of memory"
            ) from error
        except Exception:
            raise
        except BaseException:  # an interruption, which waits for nothing that was begun
            wait = self._processes
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()
            raise
        finally:
            pool.shutdown(wait, cancel_futures=True)


def make_executor(
    settings: ComputeSettings,
    say: Callable[[str], None] = lambda text: None,
    check: Callable[[], None] = lambda: None,
) -> Executor:
    """Return the executor that the section ``compute`` asks for.

    While workers are waited for, ``say`` gets lines for people, and ``check`` raises to end the wait.

    Raises:
        PchEmError: it cannot be had; the message says why.
    """
    if settings.workers != "auto" and settings.workers < 1:
        raise ConfigError(f"compute.workers: {settings.workers}; give 1 or more, or auto")
    if settings.backend == "serial":
        return SerialExecutor()
    if settings.backend == "distributed":
        from pchem_pipeline.compute.cluster import DistributedExecutor

        return DistributedExecutor(settings, say, check)
    return PoolExecutor(settings.count(), processes=settings.backend == "processes")
