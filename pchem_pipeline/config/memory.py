"""What a configuration lets a command take: workers, and memory of them together and of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pchem_pipeline.compute.environment import available_memory, available_workers
from pchem_pipeline.compute.memory import BASE_BYTES

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig


def worker_count(config: RunConfig) -> int:
    """Return the workers on this machine that a configuration asks for."""
    if config.compute.backend == "serial":
        return 1
    return available_workers() if config.compute.workers == "auto" else config.compute.workers


def allowed_bytes(config: RunConfig, workers: int) -> int:
    """Return the memory that the run may take, in all: the setting, else half of what is free."""
    if config.compute.max_memory is not None:
        return config.compute.max_memory << 20
    bands = BASE_BYTES + workers * (config.histogram.band_memory << 20)
    return max(bands, (available_memory() or 0) // 2)


def band_bytes(config: RunConfig, workers: int, limit: int | None = None) -> int:
    """Return the memory of a worker that counts a band of rows.

    Args:
        config: of the run.
        workers: number of workers.
        limit: bytes that the process of a worker may take, above which it is killed; None: no limit.
    """
    bytes_each = config.histogram.band_memory << 20
    if limit is not None:
        bytes_each = min(bytes_each, max(16 << 20, limit - BASE_BYTES))
    if config.compute.max_memory is None:
        return bytes_each
    return min(bytes_each, max(16 << 20, ((config.compute.max_memory << 20) - BASE_BYTES) // workers))
