"""A run on a large sensor, from camera file to report: seconds, CPU, memory and files of every stage.

The stack is made of a simulated block of 64 x 64 pixels, repeated in space (and in time beyond 1,000 frames),
written as one raw file or one BigTIFF, and removed again. Memory is counted over all processes, see
`process_tree`.

    python scripts/bench/bench_size.py --rows 2304 --columns 4096 --frames 600 --format tiff  # 11 GB of disk
    python scripts/bench/bench_size.py --rows 1024 --columns 1024 --frames 200
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from process_tree import run_measured
from running import PCHEM, machine, stage_records, write_stack

from pchem_pipeline.compute.environment import prepare_environment
from pchem_pipeline.stages.table import STAGES


def as_tiff(raw: Path, shape: tuple[int, int, int]) -> Path:
    """Write a raw file again as one BigTIFF, and remove it."""
    import tifffile

    frames = np.memmap(raw, "<u2", "r", shape=shape)
    tifffile.imwrite(raw.with_suffix(".tif"), frames, bigtiff=True, photometric="minisblack")
    raw.unlink()
    return raw.with_suffix(".tif")


def files_below(folder: Path) -> int:
    """Return how many files lie below a folder."""
    return sum(path.is_file() for path in folder.rglob("*"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=2304)
    parser.add_argument("--columns", type=int, default=4096)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--format", choices=["raw", "tiff"], default="raw")
    parser.add_argument("--mode", choices=["reference", "copy"], default="reference")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--max-memory", type=int, help="MiB")
    parser.add_argument("--until", default="report", help="last stage")
    parser.add_argument("--folder", type=Path, help="where the stack and the store lie for a while")
    given = parser.parse_args()
    prepare_environment()
    with tempfile.TemporaryDirectory(prefix="bench-size-", dir=given.folder) as name:
        raw, store = Path(name) / "stack.raw", Path(name) / "run.zarr"
        write_stack(raw, given.frames, (given.rows, given.columns))
        if given.format == "tiff":
            raw = as_tiff(raw, (given.frames, given.rows, given.columns))
        command = [PCHEM, "run", str(raw), "--store", str(store)]
        command += ["--mode", given.mode, "--workers", str(given.workers), "--until", given.until, "--quiet"]
        command += ["--bit-depth", "14", "--integration-time", "1"]
        if given.max_memory:
            command += ["--max-memory", str(given.max_memory)]
        print(f"{given.frames} x {given.rows} x {given.columns}, {raw.stat().st_size / 1e9:.2f} GB")
        took = run_measured(command)
        print("stage      seconds    CPU s   peak MiB    files")
        for stage, record in stage_records(store).items():
            folders = [*(store / each for each in STAGES[stage].writes), store / ".pchem/done" / stage]
            print(
                f"{stage:10}{record['seconds']:8.1f} {record['cpu_seconds']:8.1f} "
                f"{record['peak_rss_bytes'] / 2**20:10.0f} {sum(map(files_below, folders)):8d}"
            )
        print(f"all       {took.wall:8.1f} {took.cpu:8.1f} {took.tree:10.0f} {files_below(store):8d}")
        if took.code:
            print(took.words)
    print(machine())


if __name__ == "__main__":
    main()
