"""Kernels that a command will need: compiled by a second process from the start, told of on the terminal."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pchem_pipeline.base.kernel_cache import cache_folder, listening
from pchem_pipeline.compute.environment import available_workers
from pchem_pipeline.compute.memory import BASE_BYTES, SECOND_PROGRAM_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.store.files import write_atomic

_PAUSE = 5.0  # seconds between lines
#: of this process while it compiles kernels
_COMPILING_BYTES = 490 << 20
#: Kernels of a stage and seconds that they take, before anything is known of this machine.
_GUESS = {
    "ingest": (7, 6.0),
    "fit": (8, 40.0),
    "ensemble": (3, 8.0),
    "report": (1, 2.0),
    "discrepancy": (9, 35.0),
}

_MODULE = "pchem_pipeline.commands.compile_kernels"
#: Sections of the configuration that decide which kernels are needed.
_SECTIONS = ("histogram", "model", "fit", "maps", "ensemble")


@contextlib.contextmanager
def compiled_ahead(config: RunConfig, stages: Sequence[str]) -> Iterator[None]:
    """Compile the kernels of stages in a second process while the first ones run; it ends with the block.

    Nothing is started where the kernels are there, where the work is to be done on one processor or in little
    memory, or for no stages. Nothing is lost where the process fails: whoever needs a kernel compiles it.
    """
    mark = mark_path(config, stages)
    one = min(available_workers(), 2 if config.compute.workers == "auto" else config.compute.workers) < 2
    limit = config.compute.max_memory
    small = limit is not None and limit << 20 < BASE_BYTES + SECOND_PROGRAM_BYTES
    if one or small or not stages or mark.exists():
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
def announced(reporter: Reporter, stage: str, limit: int | None = None) -> Iterator[None]:
    """Say when a stage compiles kernels, or waits for the second process: how many, how long, what is left.

    What is left is what the stage took the last time that it compiled on this machine.

    Args:
        reporter: is told.
        stage: its name.
        limit: memory that the run may take, MiB: where compiling takes more, that is a warning.
    """
    seconds: list[float] = []
    number, total = known_compilation(stage)
    last = time.monotonic()

    def listener(kernel: str, took: float | None) -> None:
        nonlocal last
        if took is not None:
            seconds.append(took)
            if time.monotonic() - last > _PAUSE:
                last = time.monotonic()
                reporter.info(f"{stage}: {_so_far(seconds, number, total)}")
        elif not seconds:
            about = f" (about {total:.0f} s)" if total else ""
            reporter.info(
                f"{stage}: compiling kernels{about}, once after an installation or a change of them"
            )
            if limit is not None and limit << 20 < _COMPILING_BYTES:
                reporter.warning(
                    f"{stage}: compiling takes up to {_COMPILING_BYTES >> 20} MiB, more than "
                    f"compute.max_memory (--max-memory) allows ({limit}); what comes after it keeps to that"
                )
        share = min(sum(seconds) / total, 1.0) if total else None
        reporter.compiling(sum(seconds), _left(seconds, number, total))
        reporter.event("compiling", stage=stage, kernel=kernel, seconds=took, share=share)

    try:
        with listening(listener):
            yield
    finally:
        reporter.compiling(0.0, 0.0)
    if seconds:
        reporter.info(f"{stage}: {_so_far(seconds, 0, 0.0)}")
        _remember(stage, len(seconds), sum(seconds))


def _so_far(seconds: Sequence[float], number: int, total: float) -> str:
    """Return how many kernels are compiled, and what is left."""
    of = f" of about {number}" if len(seconds) < number else ""
    left = _left(seconds, number, total)
    words = f", about {left:.0f} s left" if left > 1 else ""
    done = f"{len(seconds)}{of} kernels" if of or len(seconds) > 1 else "one kernel"
    return f"{done} compiled in {sum(seconds):.0f} s{words}"


def _left(seconds: Sequence[float], number: int, total: float) -> float:
    """Return the seconds that are left of what compiling took the last time; none where all were compiled."""
    return max(total - sum(seconds), 0.0) if len(seconds) < max(number, 1) else 0.0


def known_compilation(stage: str) -> tuple[int, float]:
    """Return how many kernels a stage compiles and in how many seconds: as the last time, or a guess."""
    try:
        number, seconds = json.loads(_memory(stage).read_text())
    except (OSError, ValueError, TypeError):
        return _GUESS.get(stage, (0, 0.0))
    return int(number), float(seconds)


def _remember(stage: str, number: int, seconds: float) -> None:
    """Keep what compiling took, unless more was compiled another time: then a part was there this time."""
    if number >= known_compilation(stage)[0] or not _memory(stage).exists():
        with contextlib.suppress(OSError):
            write_atomic(_memory(stage), json.dumps([number, round(seconds, 1)]).encode())


def _memory(stage: str) -> Path:
    return cache_folder() / f"compiling-{stage}.json"


def compilation_lines(config: RunConfig, todo: Sequence[str], ahead: Sequence[str]) -> list[str]:
    """Return what compiling will add to the time of stages, where their kernels may be missing; else nothing.

    Args:
        config: of the run.
        todo: the stages that are to be done.
        ahead: of all stages of the run those that are compiled ahead.
    """
    if not todo or not ahead or mark_path(config, ahead).exists():
        return []
    seconds = sum(known_compilation(stage)[1] for stage in todo)
    if not seconds:
        return []
    return [
        f"plan: up to {seconds:.0f} s more where kernels are still to be compiled, once after an installation"
    ]
