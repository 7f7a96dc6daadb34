"""From camera file to report with one command: wall time, CPU time and peak memory of every stage.

The peer in the same run is reading the same file once with ``readinto``, the floor of any method. Make the
file of the paper's size (9.3 GB) with scripts/simulate_full_size.py. Example:

    python scripts/simulate_full_size.py /data/full
    python scripts/bench/bench_run.py /data/full/frames/frames.raw --workers 2
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STAGES = ("ingest", "histogram", "fit", "maps", "ensemble", "report")


def read_once(path: Path) -> float:
    """Return the seconds that reading a file once takes."""
    buffer = memoryview(bytearray(64 << 20))
    start = time.perf_counter()
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
    return time.perf_counter() - start


def run(frames: Path, store: Path, options: argparse.Namespace) -> tuple[float, float, float]:
    """Run the pipeline in a process of its own; return wall seconds, CPU seconds and peak MiB."""
    command = [str(Path(sys.executable).with_name("pchem")), "run", str(frames), "--store", str(store)]
    command += ["--mode", options.mode, "--workers", str(options.workers), "--backend", options.backend]
    command += ["--integration-time", "4.87", "--bit-depth", "14", "--quiet"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cpu, after.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("frames", type=Path, help="camera file")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--backend", default="threads")
    parser.add_argument("--mode", default="reference", choices=["copy", "reference"])
    parser.add_argument("--store", type=Path, help="keep the store here; default: a temporary folder")
    options = parser.parse_args()
    size = options.frames.stat().st_size
    with tempfile.TemporaryDirectory(prefix="bench-run-") as folder:
        store = options.store or Path(folder) / "bench.zarr"
        wall, cpu, peak = run(options.frames, store, options)
        records = [json.loads((store / ".pchem" / "stages" / f"{name}.json").read_text()) for name in STAGES]
    floor = read_once(options.frames)
    print(f"{options.frames.name}: {size / 1e9:.2f} GB, mode {options.mode}, {options.workers} workers")
    print(f"{'stage':<12}{'wall s':>9}{'CPU s':>9}{'GB/s':>9}{'peak MiB so far':>17}")
    for record in records:
        reads = record["stage"] in ("ingest", "histogram")
        speed = f"{size / 1e9 / record['seconds']:.2f}" if reads else ""
        peak_mib = record["peak_rss_bytes"] / 2**20
        print(
            f"{record['stage']:<12}{record['seconds']:>9.1f}{record['cpu_seconds']:>9.1f}{speed:>9}{peak_mib:>17.0f}"
        )
    print(f"{'pchem run':<12}{wall:>9.1f}{cpu:>9.1f}{size / 1e9 / wall:>9.2f}{peak:>17.0f}")
    ratio = f"   (the run takes {wall / floor:.1f} x)"
    print(f"{'readinto':<12}{floor:>9.1f}{'':>9}{size / 1e9 / floor:>9.2f}{ratio}")


if __name__ == "__main__":
    main()
