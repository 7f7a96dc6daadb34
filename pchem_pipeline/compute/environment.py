"""The process's surroundings: processors, compiled-kernel cache, inner thread pools, memory."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from platformdirs import user_config_path

from pchem_pipeline.base.kernel_cache import cache_folder, is_writable

_CGROUPS = Path("/sys/fs/cgroup")
_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLOSC_NTHREADS", "NUMBA_NUM_THREADS")


def prepare_environment() -> None:
    """Set what must be set before numpy and numba are imported; the user's own values are kept.

    Inner thread pools are set to one thread, since the tiles are the parallelism. Compiled kernels are
    cached in ``NUMBA_CACHE_DIR``, by default in the user's cache folder, or in a temporary one where the home
    is read-only; there matplotlib, too, which would warn in each run.
    """
    for name in _POOLS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))
    if "MPLCONFIGDIR" not in os.environ and not is_writable(user_config_path("matplotlib")):
        os.environ["MPLCONFIGDIR"] = os.environ["NUMBA_CACHE_DIR"]


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
    """Return how many processors this process may use: affinity, quotas of cgroups, SLURM's allocation."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    most = [count, _slurm("SLURM_CPUS_PER_TASK") or _slurm("SLURM_CPUS_ON_NODE") or count]
    for group in _groups("cpu"):
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
            match _integers(*(group / name for name in names)):
                case [quota, period] if quota > 0 and period > 0:
                    most.append(max(1, quota // period))
    return min(most)


def available_memory() -> int | None:
    """Return the bytes that this process may still take; None if not known.

    The least of the machine's free memory, of what the limits of its cgroups leave, and of what SLURM gave.
    """
    node = _slurm("SLURM_MEM_PER_NODE") or _slurm("SLURM_MEM_PER_CPU", "SLURM_CPUS_ON_NODE")  # MiB
    free = [node << 20] if node else []
    free += [kibibytes << 10 for kibibytes in _named(Path("/proc/meminfo"), "MemAvailable:")]
    for group in _groups("memory"):
        for limit, usage, cache in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.high", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            match _integers(group / limit, group / usage):
                case [most, used]:  # files that were read count as used, until the memory is needed
                    free.append(most - used + sum(_named(group / "memory.stat", cache)))
    return max(0, min(free)) if free else None


def _groups(controller: str) -> Iterator[Path]:
    """Yield the folders of this process's cgroup and of those above it, version 1 and 2."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        lines = ["0::/"]
    for line in lines:
        _, names, path = (*line.split(":", 2), "", "")[:3]
        for top in (_CGROUPS / (controller if names else ""), _CGROUPS / (names or "unified")):
            if not names or controller in names.split(","):
                folder = top / path.lstrip("/")
                yield from (each for each in (folder, *folder.parents) if each.is_relative_to(top))


def _integers(*paths: Path) -> list[int]:
    """Return the numbers that files hold; none where one of them is missing, or sets no limit."""
    try:
        return [int(word) for path in paths for word in path.read_text().split()]
    except (OSError, ValueError):
        return []


def _named(path: Path, name: str) -> list[int]:
    """Return the number behind a name in a file of the kernel; none where it is not there."""
    try:
        words = [line.split() for line in path.read_text().splitlines()]
        return [int(each[1]) for each in words if each[:1] == [name]]
    except (OSError, ValueError, IndexError):
        return []


def _slurm(*names: str) -> int:
    """Return the product of some of SLURM's variables; 0 where it did not set them."""
    try:
        return math.prod(int(os.environ[name]) for name in names)
    except (KeyError, ValueError):
        return 0


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of those packages that are installed."""
    found = {}
    for name in packages:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def peak_rss_bytes() -> int:
    """Return the largest resident set of this process or of one of its finished children."""
    unit = 1 if sys.platform == "darwin" else 1024
    # since the program began; other counts keep that of who started it
    own = [kibibytes << 10 for kibibytes in _named(Path("/proc/self/status"), "VmHWM:")]
    own = own or [unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]
    return max(*own, unit * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
