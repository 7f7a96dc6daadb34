"""Kernels that a stage compiles: announced on the terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from pchem_pipeline.base.kernel_cache import cache_folder, is_writable, listening
from pchem_pipeline.run.progress import Reporter

#: of this process while it compiles kernels
_COMPILING_BYTES = 490 << 20


@contextlib.contextmanager
def announced(reporter: Reporter, stage: str, limit: int | None = None) -> Iterator[None]:
    """Say when a stage compiles kernels, or waits for another process that does: how many, and how long.

    Args:
        reporter: prints it.
        stage: its name.
        limit: memory that the run may take, MiB: where compiling takes more, that is a warning.
    """
    seconds: list[float] = []

    def listener(kernel: str, took: float | None) -> None:
        if took is not None:
            seconds.append(took)
        elif not seconds:
            reporter.info(f"{stage}: compiling kernels (once after an installation or update)")
            if limit is not None and limit << 20 < _COMPILING_BYTES:
                reporter.warning(
                    f"{stage}: compiling takes up to {_COMPILING_BYTES >> 20} MiB, more than "
                    f"compute.max_memory (--max-memory) allows ({limit} MiB); later work stays within the "
                    "limit"
                )
        reporter.compiling(sum(seconds))
        reporter.event("compiling", stage=stage, kernel=kernel, seconds=took)

    try:
        with listening(listener):
            yield
    finally:
        reporter.compiling(0.0)
    if not seconds:
        return
    reporter.info(
        f"{stage}: {len(seconds)} kernel{'s' * (len(seconds) > 1)} compiled in {sum(seconds):.0f} s"
    )
    if not is_writable(cache_folder()):
        reporter.warning(
            f"{stage}: {cache_folder()} is not writable, so every command compiles its kernels again; set "
            "NUMBA_CACHE_DIR to another folder"
        )
