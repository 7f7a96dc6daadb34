"""From camera file to report with one command: wall time, CPU time and peak memory of every stage.

The peer in the same run is reading the same file once with ``readinto``, the floor of any method. Make the
file of the paper's size (9.3 GB) with scripts/simulate_full_size.py. Example:

    python scripts/simulate_full_size.py /data/full
    python scripts/bench/bench_run.py /data/full/frames/frames.raw --workers 2

With ``--sync-pairs 5`` the same run is done five times as it is and five times with ``os.fsync`` replaced by
nothing, by turns, and what it costs to be safe from power cuts is printed instead.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import NamedTuple

from process_tree import Took, run_measured
from running import PCHEM, machine, read_once, stage_records

#: takes the place of ``os.fsync`` in every process of a run; the file SYNCS gets a byte a call
_FSYNC = """
import os
fsync = os.fsync
log = os.open(os.environ["SYNCS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)

def counted(file):
    os.write(log, b".")
    if os.environ["DO_SYNC"] == "1":
        fsync(file)

os.fsync = counted
"""


class Synced(NamedTuple):
    """What a run took that waits for the disk, or does not."""

    wall: float  # s
    cpu: float  # s, of all its processes
    syncs: float  # calls of ``os.fsync``
    written: float  # s, after the command, until all it wrote is on the disk


def run(store: Path, options: argparse.Namespace, environment: Mapping[str, str] | None = None) -> Took:
    """Run the pipeline in a process of its own."""
    command = [PCHEM, "run", str(options.frames), "--store", str(store), "--mode", options.mode]
    command += ["--workers", str(options.workers), "--backend", options.backend]
    command += ["--integration-time", "4.87", "--bit-depth", "14", "--quiet"]
    return run_measured(command, environment=environment, must_succeed=True)


def run_synced(options: argparse.Namespace, sync: bool) -> Synced:
    """Run the pipeline with its syncs, or with none that does anything, from a disk with nothing to write."""
    with tempfile.TemporaryDirectory(prefix="bench-run-") as made:
        folder = Path(made)
        (folder / "sitecustomize.py").write_text(_FSYNC)
        syncs, path = folder / "syncs", os.pathsep.join([made, os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": path, "SYNCS": str(syncs), "DO_SYNC": str(int(sync))}
        os.sync()
        took = run(folder / "bench.zarr", options, environment)
        start = time.perf_counter()
        os.sync()
        return Synced(took.wall, took.cpu, syncs.stat().st_size, time.perf_counter() - start)


def cost_of_syncs(options: argparse.Namespace) -> None:
    """Print what runs with and without syncs take, by turns, and the ratio of each pair."""
    run_synced(options, True)  # compiles, and has the frames in memory
    titles = ("pair", "synced s", "not s", "ratio", "CPU s", "not", "syncs", "left s", "not")
    print(f"{machine()}\n{options.frames.name}: mode {options.mode}, {options.workers} {options.backend}")
    print("".join(f"{title:>9}" for title in titles))
    pairs = []
    for i in range(options.sync_pairs):
        order = (True, False) if i % 2 else (False, True)
        both = {sync: run_synced(options, sync) for sync in order}
        pairs.append((both[True], both[False]))
        show_pair(str(i + 1), both[True], both[False])
    medians = [Synced(*map(median, zip(*runs, strict=True))) for runs in zip(*pairs, strict=True)]
    show_pair("median", *medians)
    ratios = sorted(on.wall / off.wall for on, off in pairs)
    print(f"ratio of a pair: median {median(ratios):.3f}, {ratios[0]:.3f} to {ratios[-1]:.3f}")


def show_pair(name: str, on: Synced, off: Synced) -> None:
    """Print a row: with syncs, without."""
    cells = [name, f"{on.wall:.2f}", f"{off.wall:.2f}", f"{on.wall / off.wall:.3f}", f"{on.cpu:.2f}"]
    cells += [f"{off.cpu:.2f}", f"{on.syncs:.0f}", f"{on.written:.2f}", f"{off.written:.2f}"]
    print("".join(f"{cell:>9}" for cell in cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("frames", type=Path, help="camera file")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--backend", default="threads")
    parser.add_argument("--mode", default="reference", choices=["copy", "reference"])
    parser.add_argument("--store", type=Path, help="keep the store here; default: a temporary folder")
    parser.add_argument(
        "--sync-pairs",
        type=int,
        default=0,
        help="pairs of runs with and without syncs [0: one run, by stages]",
    )
    options = parser.parse_args()
    if options.sync_pairs:
        cost_of_syncs(options)
        return
    size = options.frames.stat().st_size
    with tempfile.TemporaryDirectory(prefix="bench-run-") as folder:
        store = options.store or Path(folder) / "bench.zarr"
        took = run(store, options)
        records = stage_records(store)
    floor = read_once(options.frames)
    print(f"{options.frames.name}: {size / 1e9:.2f} GB, mode {options.mode}, {options.workers} workers")
    print(f"{'stage':<12}{'wall s':>9}{'CPU s':>9}{'GB/s':>9}{'peak MiB so far':>17}")
    for name, record in records.items():
        speed = f"{size / 1e9 / record['seconds']:.2f}" if name in ("ingest", "histogram") else ""
        row = f"{name:<12}{record['seconds']:>9.1f}{record['cpu_seconds']:>9.1f}{speed:>9}"
        print(f"{row}{record['peak_rss_bytes'] / 2**20:>17.0f}")
    wall = took.wall
    print(f"{'pchem run':<12}{wall:>9.1f}{took.cpu:>9.1f}{size / 1e9 / wall:>9.2f}{took.largest:>17.0f}")
    ratio = f"   (the run takes {wall / floor:.1f} x)"
    print(f"{'readinto':<12}{floor:>9.1f}{'':>9}{size / 1e9 / floor:>9.2f}{ratio}")


if __name__ == "__main__":
    main()
