"""The process's surroundings: processors, compiled-kernel cache, inner thread pools, memory."""

from __future__ import annotations

import importlib.util
import os
import resource
import sys
import tempfile
from pathlib import Path

__all__ = ["available_workers", "peak_rss_bytes", "prepare_environment"]

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLOSC_NTHREADS", "NUMBA_NUM_THREADS")


def prepare_environment() -> None:
    """Set what must be set before numpy and numba are imported; the user's own values are kept.

    Inner thread pools are set to one thread, since the tiles are the parallelism. Compiled kernels are
    cached in the user's cache folder, or in a temporary one where the home is read-only.
    """
    for name in _POOLS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("MPLBACKEND", "Agg")
    if "NUMBA_CACHE_DIR" not in os.environ:
        os.environ["NUMBA_CACHE_DIR"] = str(_cache_folder())


def _cache_folder() -> Path:
    from platformdirs import user_cache_path

    # one folder per copy of the package: two versions side by side must not share kernels
    spec = importlib.util.find_spec("pchem_pipeline")
    origin = str(Path(spec.origin or "").parent) if spec else ""
    tag = f"{sys.version_info[0]}{sys.version_info[1]}-{abs(_stable_hash(origin)):08x}"
    folder = user_cache_path("pchem_pipeline") / "kernels" / tag
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        folder = Path(tempfile.gettempdir()) / f"pchem_pipeline-{os.getuid()}" / tag
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder


def _stable_hash(text: str) -> int:
    import zlib

    return zlib.crc32(text.encode())


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


def peak_rss_bytes() -> int:
    """Return the largest resident set of this process or of one of its finished children."""
    sizes = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return max(sizes) * (1 if sys.platform == "darwin" else 1024)
