"""What the benchmarks of whole runs share: a stack, the records of a run, the machine."""

from __future__ import annotations

import json
import os
import platform
import re
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

_SIMULATED, _AT_ONCE = 1000, 100  # frames of `write_stack`
PCHEM = str(Path(sys.executable).with_name("pchem"))
STAGES = ("ingest", "histogram", "fit", "maps", "ensemble", "report")


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


def stage_records(store: Path) -> dict[str, dict[str, Any]]:
    """Return what a run has noted of each stage that it did."""
    paths = {name: store / ".pchem" / "stages" / f"{name}.json" for name in STAGES}
    return {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
