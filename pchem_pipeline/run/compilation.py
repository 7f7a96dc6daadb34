"""Kernels that a command will need: compiled by a second process from the start, told of on the terminal."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pchem_pipeline.base.kernel_cache import cache_folder, listening
from pchem_pipeline.compute.environment import available_workers
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.progress import Reporter

__all__ = ["announced", "compiled_ahead", "mark_path"]

_MODULE = "pchem_pipeline.commands.compile_kernels"
#: Sections of the configuration that decide which kernels are needed.
_SECTIONS = ("histogram", "model", "fit", "maps", "ensemble")


@contextlib.contextmanager
def compiled_ahead(config: RunConfig, stages: Sequence[str]) -> Iterator[None]:
    """Compile the kernels of stages in a second process while the first ones run; it ends with the block.

    Nothing is started where the kernels are there, where the work is to be done on one processor, or for no
    stages. Nothing is lost where the process fails: whoever needs a kernel compiles it.
    """
    mark = mark_path(config, stages)
    one = min(available_workers(), 2 if config.compute.workers == "auto" else config.compute.workers) < 2
    if one or not stages or mark.exists():
        yield
        return
    process = _start({"config": config.model_dump(mode="json", by_alias=True), "stages": list(stages)})
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


def _start(request: dict[str, Any]) -> subprocess.Popen[bytes] | None:
    """Start the process, in a session of its own: Ctrl-C is for the command, which ends it."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", _MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
        assert process.stdin is not None
        with process.stdin as stream:
            stream.write(json.dumps(request).encode())
    except OSError:
        return None
    return process


def mark_path(config: RunConfig, stages: Sequence[str]) -> Path:
    """Return the file that says: these stages have their kernels, for this source and configuration."""
    package = Path(__file__).parents[1]
    files = sorted([*package.rglob("*_numba.py"), *(package / "base").glob("kernel*.py")])
    state = hashlib.sha256()
    for file in files:
        state.update(file.read_bytes())
    sections = config.model_dump(mode="json", by_alias=True, include=set(_SECTIONS))
    several = bool(config.input.samples)
    about = (
        sorted(stages),
        sections,
        several,
        platform.machine(),
        sys.version,
        version("numba"),
        version("llvmlite"),
    )
    state.update(json.dumps(about, sort_keys=True).encode())
    return cache_folder() / f"compiled-{state.hexdigest()[:32]}"


@contextlib.contextmanager
def announced(reporter: Reporter, stage: str) -> Iterator[None]:
    """Say when a stage compiles kernels, or waits for the second process, and how long."""
    seconds: list[float] = []

    def listener(kernel: str, took: float | None) -> None:
        if took is not None:
            seconds.append(took)
        elif not seconds:
            reporter.info(f"{stage}: compiling kernels, once after an installation or a change of them")
        reporter.event("compiling", stage=stage, kernel=kernel, seconds=took)

    with listening(listener):
        yield
    if seconds:
        reporter.info(f"{stage}: {len(seconds)} kernels compiled in {sum(seconds):.0f} s")
