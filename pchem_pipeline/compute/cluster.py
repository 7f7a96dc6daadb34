"""Work on a dask.distributed cluster: what can go wrong there is one line, and nothing finished is lost."""

from __future__ import annotations

import functools
import platform
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from pchem_pipeline.compute.environment import prepare_environment
from pchem_pipeline.compute.executor import OnResult, Outcome, Stop, guarded
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.errors import ConfigError, IncompleteRunError, MissingDependencyError

__all__ = ["DistributedExecutor", "OtherVersionsError", "library_versions"]

T = TypeVar("T")

#: libraries that decide the bits of a result, or that must understand each other
_LIBRARIES = ("pchem-pipeline", "numpy", "scipy", "numba", "zarr", "distributed")


class OtherVersionsError(ConfigError):
    """A worker of the cluster has other versions of the libraries."""


class DistributedExecutor:
    """A dask.distributed cluster: local, at an address, or made by a class from the settings."""

    shares_memory = False

    def __init__(self, settings: ComputeSettings, workers: int) -> None:
        try:
            import distributed
        except ImportError as error:
            raise MissingDependencyError(
                'compute.backend: distributed needs another library: pip install "pchem-pipeline[cluster]"'
            ) from error
        self._cluster: Any = None
        try:
            if settings.scheduler is not None:
                self._client = distributed.Client(**_address(settings.scheduler), timeout="20s")
            elif settings.cluster is not None:
                self._cluster = _cluster_class(settings.cluster.cls)(**settings.cluster.kwargs)
                self._cluster.scale(settings.cluster.scale)
                self._client = distributed.Client(self._cluster)
            else:
                self._cluster = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
                )
                self._client = distributed.Client(self._cluster)
        except OSError as error:
            raise ConfigError(
                f"compute.scheduler: no scheduler answers at {settings.scheduler} ({error}); "
                "start one with: dask scheduler"
            ) from error
        self._name = settings.scheduler or "of this run"
        self.workers = max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def map(self, function: Callable[[T], Any], items: Iterable[T], on_result: OnResult) -> None:
        """See :class:`Executor`.

        Raises:
            IncompleteRunError: the scheduler went away.
            OtherVersionsError: a worker has other versions of the libraries.
        """
        from distributed import as_completed

        todo = list(items)
        try:
            task = functools.partial(_alike, library_versions(), function)
            futures = self._client.map(task, todo, pure=False)
            item_of = {future.key: item for future, item in zip(futures, todo, strict=True)}
            for future in as_completed(futures):
                outcome = _outcome(future)
                if isinstance(outcome.error, OtherVersionsError):
                    raise outcome.error
                on_result(item_of[future.key], outcome)
        except (Stop, OtherVersionsError):
            self._client.cancel(futures)
            raise
        except (OSError, CancelledError) as error:  # a lost connection, and what it makes of results
            raise self._scheduler_is_gone() from error

    def _scheduler_is_gone(self) -> IncompleteRunError:
        return IncompleteRunError(
            f"the dask scheduler {self._name} went away; finished tiles are kept: start it again, and run "
            "the same command to go on"
        )

    def close(self) -> None:
        """Leave the cluster, and end it if this run made it."""
        self._client.close(timeout=5)
        if self._cluster is not None:
            self._cluster.close(timeout=30)


def _address(scheduler: str) -> dict[str, str]:
    """Return how to name a scheduler: by address, or by its file (for which dask would wait for ever)."""
    if "://" in scheduler:
        return {"address": scheduler}
    if not Path(scheduler).exists():
        raise FileNotFoundError("no such scheduler file")
    return {"scheduler_file": scheduler}


def _cluster_class(name: str) -> Any:
    import importlib

    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"compute.cluster.class: cannot import {name} ({error})") from error


def library_versions() -> dict[str, str]:
    """Return the versions that must be the same on all machines."""
    found = {"Python": ".".join(platform.python_version_tuple()[:2])}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _alike(expected: dict[str, str], function: Callable[[Any], Any], item: Any) -> Outcome:
    """Do an item on a worker, if its versions are those of who asks: others would give other bits."""
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
    """Return what became of an item, also where its workers died."""
    if future.cancelled():
        raise CancelledError
    error = future.exception()
    if error is None:
        outcome: Outcome = future.result()
        return outcome
    if type(error).__name__ == "KilledWorker":
        text = (
            "all workers that tried it died (killed, or out of memory); give workers more memory, run again"
        )
        return Outcome(error=IncompleteRunError(text), trace=str(error))
    return Outcome(error=error, trace=str(error))
