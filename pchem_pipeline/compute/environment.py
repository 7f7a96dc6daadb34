"""The process's surroundings: processors, compiled-kernel cache, inner thread pools, memory."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from pchem_pipeline.base.kernel_cache import cache_folder

#: Unix alone has it.
_RESOURCE: Any = importlib.import_module("resource") if importlib.util.find_spec("resource") else None

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLOSC_NTHREADS", "NUMBA_NUM_THREADS")


def prepare_environment() -> None:
    """Set what must be set before numpy and numba are imported; the user's own values are kept.

    Inner thread pools are set to one thread, since the tiles are the parallelism. Compiled kernels are
    cached in ``NUMBA_CACHE_DIR``, by default in the user's cache folder, or in a temporary one where the home
    is read-only.
    """
    for name in _POOLS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))


class Dispensable:
    """A text stream that is not needed: where it cannot be written, it goes on as ``/dev/null``."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        """Return what the stream itself has."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or lose it."""
        try:
            return int(self._stream.write(text))
        except OSError:
            self._give_up()
            return len(text)

    def flush(self) -> None:
        """Hand on what was written, or lose it."""
        try:
            self._stream.flush()
        except OSError:
            self._give_up()

    def _give_up(self) -> None:
        # what is still in its buffer must go somewhere, too
        os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def keep_standard_streams() -> None:
    """Open those of the standard streams that are closed, and let standard error fail without harm.

    Otherwise the next file that is opened becomes standard error, and gets what is meant for it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    stream: Any = Dispensable(sys.stderr or os.fdopen(2, "w"))
    sys.stderr = stream


def available_workers() -> int:
    """Return how many processors this process may use: affinity and cgroup quota."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        if quota != "max":
            count = min(count, max(1, int(quota) // int(period)))
    except (OSError, ValueError):
        pass
    return count


def available_memory() -> int | None:
    """Return the bytes that this process may still take: free memory and cgroup limit; None if not known."""
    free: list[int] = []
    try:
        facts = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        free.append(int(facts["MemAvailable"].split()[0]) << 10)
    except (OSError, KeyError, ValueError):
        pass
    try:
        group = Path("/sys/fs/cgroup")
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            free.append(int(limit) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass
    return max(0, min(free)) if free else None


def cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def peak_rss_bytes() -> int:
    """Return the largest resident set of this process or of one of its finished children; 0 if not known."""
    if _RESOURCE is None:
        return 0
    own = _peak_of_this_program()
    if own is None:
        own = _unit() * _RESOURCE.getrusage(_RESOURCE.RUSAGE_SELF).ru_maxrss
    return int(max(own, _unit() * _RESOURCE.getrusage(_RESOURCE.RUSAGE_CHILDREN).ru_maxrss))


def _unit() -> int:
    return 1 if sys.platform == "darwin" else 1024


def _peak_of_this_program() -> int | None:
    """Return the largest resident set since the program began; other counts keep that of who started it."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration, ValueError):
        return None
