"""How much memory the program has and may take, and how many workers that is enough for."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.kernel_cache import TIGHT_MEMORY
from pchem_pipeline.compute.executor import Executor, PoolExecutor

#: the program with its libraries and compiled kernels
BASE_BYTES = 260 << 20
#: the least that a command needs: a run of few pixels, to its report
LEAST_BYTES = 300 << 20
#: a process beside it that draws
SECOND_PROGRAM_BYTES = 400 << 20


@functools.cache
def _libc() -> Any:
    return ctypes.CDLL(None) if sys.platform == "linux" else None


def resident_bytes() -> int:
    """Return the memory of this process, what it does not use given back first; 0 where it is not known."""
    trim = getattr(_libc(), "malloc_trim", None)
    if trim is not None:
        trim(0)
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def keep_to_limit(limit: int | None) -> None:
    """Keep this process, and those that it starts from now on, to a limit, where there is one.

    Freed memory then goes back to the system at once. Otherwise each thread keeps a heap of its own, and
    arrays that were freed stay in it: half as much again as is in use. It costs a twentieth of the CPU time.
    Only the C library of Linux can do it. The limit is ``compute.max_memory``, MiB.

    Raises:
        ConfigError: it is less than the program takes before it does anything; with what it takes.
    """
    if limit is None:
        return
    if limit << 20 < LEAST_BYTES:
        raise ConfigError(
            f"compute.max_memory (--max-memory): {limit} MiB, but the program needs {LEAST_BYTES >> 20} MiB; "
            "raise it"
        )
    os.environ.setdefault(TIGHT_MEMORY, "1")
    mallopt = getattr(_libc(), "mallopt", None)
    # heaps, the size from which memory comes from the system and goes back to it, the free end of a heap
    for name, parameter, value in (
        ("MALLOC_ARENA_MAX", -8, 2),
        ("MALLOC_MMAP_THRESHOLD_", -3, 1 << 20),
        ("MALLOC_TRIM_THRESHOLD_", -1, 1 << 20),
    ):
        os.environ.setdefault(name, str(value))
        if mallopt is not None:
            mallopt(parameter, value)


def affordable(executor: Executor, limit: int, unit_bytes: int, what: str) -> Executor:
    """Return the executor with no more workers than ``limit`` bytes are enough for; not that of a cluster.

    ``unit_bytes`` are what a worker takes for a unit of its work, ``what`` is done, for the message.

    Raises:
        ConfigError: it is not enough for one.
    """
    here, each = resident_bytes() or BASE_BYTES, unit_bytes
    if isinstance(executor, PoolExecutor) and not executor.shares_memory:
        each += BASE_BYTES
    enough = (limit - here) // max(each, 1)
    if enough < 1:
        raise ConfigError(
            f"{what} needs at least {-(-(here + each) >> 20)} MiB, compute.max_memory (--max-memory) allows "
            f"{limit >> 20}: raise it, and run the same command to continue"
        )
    if isinstance(executor, PoolExecutor) and enough < executor.workers:
        return PoolExecutor(enough, processes=not executor.shares_memory)
    return executor
