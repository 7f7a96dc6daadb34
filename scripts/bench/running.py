"""What the benchmarks of whole runs share: starting them, reading their records, saying on what machine."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

_SIMULATED, _AT_ONCE = 1000, 100  # frames of `write_stack`
STAGES = ("ingest", "histogram", "fit", "maps", "ensemble", "report")


@dataclass(frozen=True)
class Outcome:
    """What a run took.

    Attributes:
        wall: seconds of the command, start-up included.
        seconds: of each stage.
        cpu: CPU seconds of each stage.
        peak: largest resident memory of each stage's process so far, MiB.
    """

    wall: float
    seconds: dict[str, float]
    cpu: dict[str, float]
    peak: dict[str, float]


def machine() -> str:
    """Return processor, cores, memory and versions in one line."""
    name = platform.processor() or platform.machine()
    facts = Path("/proc/cpuinfo")
    if facts.exists():
        found = re.search(r"model name\s*:\s*(.*)", facts.read_text())
        name = found[1] if found else name
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    libraries = ", ".join(
        f"{each} {version(each)}" for each in ("numpy", "numba", "scipy", "zarr", "dask", "pchem-pipeline")
    )
    load = os.getloadavg()[0]
    return (
        f"{name}, {os.cpu_count()} processors, {memory:.0f} GiB, load {load:.1f}; "
        f"Python {platform.python_version()}, {libraries}"
    )


def evict(path: Path) -> None:
    """Ask the operating system to forget a file, so that it is read from the disk the next time."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
        os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def write_stack(path: Path, frames: int, shape: tuple[int, int]) -> None:
    """Write a raw file of uint16 frames of some rows and columns, with its sidecar.

    The first 1,000 frames are simulated, and repeated from then on, one half of the columns later each time:
    no frame is a copy, but a fit would find it out.
    """
    from pchem_pipeline.simulate.chain import simulate_block
    from pchem_pipeline.simulate.maps import draw_truth
    from pchem_pipeline.simulate.settings import SimulateSettings

    settings = SimulateSettings(shape=(64, 64), n_frames=_SIMULATED, seed=3)
    small, _ = simulate_block(draw_truth(settings), settings, (0, _SIMULATED), electron_frames=0)
    rows, columns = shape
    times = -(-rows // 64), -(-columns // 64)
    with path.open("wb") as stream:
        for start in range(0, frames, _AT_ONCE):
            t = np.arange(start, min(start + _AT_ONCE, frames))
            later = (t + 37 * (t // _SIMULATED)) % _SIMULATED
            some = np.concatenate([small[t % _SIMULATED, :, :32], small[later, :, 32:]], axis=2).astype("<u2")
            stream.write(np.ascontiguousarray(np.tile(some, (1, *times))[:, :rows, :columns]).data)
    path.with_name(f"{path.name}.json").write_text(json.dumps({"shape": shape, "dtype": "uint16"}))


def read_once(path: Path) -> float:
    """Return the seconds that reading a file once with ``readinto`` takes: the floor of any method."""
    buffer = memoryview(bytearray(64 << 20))
    start = time.perf_counter()
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
    return time.perf_counter() - start


_SOME_STAGES = """
import sys
from pathlib import Path
from typing import Any
from pchem_pipeline.compute.environment import prepare_environment
prepare_environment()
from pchem_pipeline.runner.session import Command, run_stages
from pchem_pipeline.run.target import find_run
run_stages(find_run(Path(sys.argv[1])), sys.argv[2:], Command(quiet=True))
"""


def run_pchem(config: Path, stages: Sequence[str] = ()) -> Outcome:
    """Run ``pchem run``, or some stages, in a process of its own; the store is ``<stem>.zarr`` beside it."""
    command = [str(Path(sys.executable).with_name("pchem")), "run", str(config), "--quiet"]
    if stages:
        command = [sys.executable, "-c", _SOME_STAGES, str(config), *stages]
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    folder = config.with_suffix(".zarr") / ".pchem" / "stages"
    records = {}
    for name in STAGES:
        if (folder / f"{name}.json").exists():
            records[name] = json.loads((folder / f"{name}.json").read_text())
    return Outcome(
        wall,
        {name: record["seconds"] for name, record in records.items()},
        {name: record["cpu_seconds"] for name, record in records.items()},
        {name: record["peak_rss_bytes"] / 2**20 for name, record in records.items()},
    )


def save_figure(figure: object, folder: Path, name: str) -> None:
    """Save a figure as PNG and SVG, with the machine below it, and say where."""
    figure.text(0.0, -0.02, machine(), fontsize=6, color="0.4", va="top")  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in ("png", "svg"):
        figure.savefig(folder / f"{name}.{suffix}", dpi=150, bbox_inches="tight")  # type: ignore[attr-defined]
    print(f"figure: {folder / name}.png")
