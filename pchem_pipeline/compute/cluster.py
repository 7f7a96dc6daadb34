"""Work on a dask.distributed cluster: what can go wrong there is one line, and nothing finished is lost."""

from __future__ import annotations

import functools
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any, TypeVar

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError, require
from pchem_pipeline.compute.environment import prepare_environment, versions_of
from pchem_pipeline.compute.executor import Executor, OnResult, Outcome, guarded, out_of_memory
from pchem_pipeline.compute.settings import ComputeSettings

T = TypeVar("T")

_LOOK = 1.0  # s between looks at the workers


class OtherVersionsError(ConfigError):
    """A worker of the cluster has other versions of the libraries."""


class DistributedExecutor(Executor):
    """A dask.distributed cluster: local, or at an address."""

    shares_memory = False

    def __init__(
        self, settings: ComputeSettings, say: Callable[[str], None], check: Callable[[], None]
    ) -> None:
        """Connect to the cluster, or make it, and wait for its first worker.

        Raises:
            ConfigError: no scheduler answers, or one is to be started that a run does not start.
            IncompleteRunError: no worker came in ``compute.wait_for_workers`` seconds.
            MissingDependencyError: dask.distributed is not installed.
        """
        try:
            require("distributed", "cluster", "compute.backend: distributed")
        except ValueError as error:
            raise ConfigError(f"{error}; correct that file") from error
        import distributed

        if settings.cluster is not None and settings.scheduler is None:
            raise ConfigError(
                "compute.cluster: a run starts no such cluster; start it, and give its address or scheduler "
                "file as compute.scheduler"
            )
        self._cluster: Any = None
        try:
            if settings.scheduler is not None:
                self._client = distributed.Client(**_address(settings.scheduler), timeout="20s")
            else:
                self._cluster = distributed.LocalCluster(
                    n_workers=settings.count(),
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",
                    host="127.0.0.1",
                )
                self._client = distributed.Client(self._cluster)
        except OSError as error:
            raise ConfigError(
                f"compute.scheduler: no scheduler at {settings.scheduler} ({error}); start one with: dask "
                "scheduler"
            ) from error
        self._name = f"the dask scheduler {settings.scheduler or 'of this run'}"
        self._seconds, self._say, self._check = settings.wait_for_workers, say, check
        self._since: float | None = None
        self._said = False
        try:
            while not self._can_work():
                time.sleep(0.1)
        except BaseException:
            self.close()
            raise
        known = self._workers()
        self.workers = max(1, len(known))
        limits = [each["memory_limit"] for each in known if each["memory_limit"]]
        # dask gives a worker no more work above this share of its memory
        self.memory_limit = int(0.8 * min(limits)) if limits else None

    def _workers(self) -> list[dict[str, Any]]:
        return list(self._client.scheduler_info(n_workers=-1)["workers"].values())

    def _can_work(self) -> bool:
        """Return whether a worker can work now; say once that none can, and raise if that is so for long."""
        workers = self._workers()
        if any(each["status"] == "running" for each in workers):
            self._since, self._said = None, False
            return True
        self._check()
        now = time.monotonic()
        self._since = now if self._since is None else self._since
        seconds, waited = self._seconds, now - self._since
        if waited >= seconds:
            raise IncompleteRunError(self._given_up(workers))
        if not self._said and waited >= min(5.0, seconds / 2):
            self._said = True
            why = f": all {len(workers)} are paused, memory nearly full" if workers else ""
            self._say(f"waiting for workers of {self._name}{why}")
        return False

    def _given_up(self, workers: Sequence[dict[str, Any]]) -> str:
        waited = f"for {self._seconds:g} s (compute.wait_for_workers)"
        if workers:
            return (
                f"{self._name}: all {len(workers)} workers were paused {waited}, {_limit(workers[0])} is "
                f"nearly full; {_MORE_MEMORY}, and run the same command to continue"
            )
        return (
            f"{self._name} had no worker {waited}; finished tiles are kept: start workers with dask "
            "worker, or raise this time, and run the same command to continue"
        )

    def _completed(self, futures: Sequence[Any]) -> Iterator[tuple[Any, Outcome]]:
        """Yield futures and what became of them as they end, with an eye on the workers while none does."""
        from distributed import as_completed

        pending, looked = as_completed(futures), time.monotonic()
        while not pending.is_empty():
            for future in pending.next_batch(block=False):
                try:
                    yield future, _outcome(future)
                except TimeoutError:  # the worker that had the result is gone: it is done again
                    pending.add(future)
            if time.monotonic() - looked > _LOOK:
                looked = time.monotonic()
                self._can_work()
            time.sleep(0.01)

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """See :class:`Executor`.

        Raises:
            IncompleteRunError: the scheduler went away, or all workers did and none came back.
            OtherVersionsError: a worker has other versions of the libraries.
        """
        todo, futures = list(items), []
        try:
            task = functools.partial(_alike, library_versions(), function)
            futures = self._client.map(task, todo, pure=False)
            item_of = {future.key: item for future, item in zip(futures, todo, strict=True)}
            for future, outcome in self._completed(futures):
                if isinstance(outcome.error, OtherVersionsError):
                    raise outcome.error
                on_result(item_of[future.key], outcome)
        except (OSError, CancelledError) as error:  # a lost connection, and what it makes of results
            raise IncompleteRunError(
                f"{self._name} stopped; finished tiles are kept: start it again, and run the same command to "
                "continue"
            ) from error
        except BaseException:
            self._client.cancel(futures)
            raise

    def close(self) -> None:
        """Leave the cluster, and end it if this run made it."""
        self._client.close(timeout=5)
        if self._cluster is not None:
            self._cluster.close(timeout=30)


_MORE_MEMORY = (
    "give each more memory (fewer workers on a machine, dask worker --memory-limit) or smaller pieces "
    "(--max-memory)"
)


def _limit(worker: dict[str, Any]) -> str:
    """Return the words for the memory that a worker may take."""
    limit = worker.get("memory_limit")
    return f"their memory of {limit / 2**20:.0f} MiB" if limit else "their memory"


def _address(scheduler: str) -> dict[str, str]:
    """Return how to name a scheduler: by address, or by its file (for which dask would wait for ever)."""
    if "://" in scheduler:
        return {"address": scheduler}
    if not Path(scheduler).exists():
        raise FileNotFoundError("no such scheduler file")
    return {"scheduler_file": scheduler}


def library_versions() -> dict[str, str]:
    """Return the versions that must be the same on all machines: they decide the bits of a result."""
    python = ".".join(platform.python_version_tuple()[:2])
    names = ("pchem-pipeline", "numpy", "scipy", "numba", "zarr", "distributed")
    return {"Python": python, **dict.fromkeys(names, "none"), **versions_of(*names)}


def _alike(expected: dict[str, str], function: Callable[[Any], Any], item: Any) -> Outcome:
    """Call a function on an item in a worker of the caller's versions: others would give other bits."""
    if text := _differences(tuple(expected.items())):
        return Outcome(error=OtherVersionsError(text))
    return guarded(function, item)


@functools.cache
def _differences(expected: tuple[tuple[str, str], ...]) -> str:
    """Prepare this worker, once; return in one line what it has other versions of, or nothing."""
    prepare_environment()
    here = library_versions()
    wrong = [(name, wanted) for name, wanted in expected if here.get(name) != wanted]
    other = [f"{name} {here.get(name)} instead of {wanted}" for name, wanted in wrong]
    if not other:
        return ""
    return f"a worker on {platform.node()} has {', '.join(other)}; install the same versions on all machines"


def _outcome(future: Any) -> Outcome:
    """Return what became of an item, also where its workers died; raise TimeoutError if it is not known."""
    if future.cancelled():
        raise CancelledError
    error = future.exception(timeout=_LOOK)
    if error is None:
        outcome: Outcome = future.result(timeout=_LOOK)
        return outcome
    trace = str(error)
    if type(error).__name__ == "KilledWorker":
        error = IncompleteRunError(_killed(error))
    elif isinstance(error, MemoryError):
        error = IncompleteRunError(out_of_memory(error))
    return Outcome(error=error, trace=trace)


def _killed(error: Any) -> str:
    """Say in one line that workers died at an item; the scheduler does not know of what."""
    last, times = error.last_worker, error.allowed_failures + 1
    return (
        f"{times} worker{'s' * (times > 1)} died on it, the last at {last.address}: killed, or above "
        f"{_limit({'memory_limit': last.memory_limit})}; {_MORE_MEMORY}, and run the same command to continue"
    )
