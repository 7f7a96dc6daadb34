"""What calibrating frames costs, beside numpy's own ``(x - mu) * g`` written with zarr, in the same run.

    python scripts/bench/bench_apply.py --size 512 --frames 2000

Prints seconds, megasamples per second and the largest memory of each, and again for four times the frames:
memory must not grow with them. All read the same TIFF file.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from process_tree import Took, run_measured
from running import PCHEM

_NUMPY = """
import sys, numpy as np, tifffile, zarr
frames, run, out = sys.argv[1:]
group = zarr.open_group(run, mode="r")["fit"]
bias, gain = (group[name][:].astype(np.float32) for name in ("bias", "conversion_gain"))
with tifffile.TiffFile(frames) as file:
    n = len(file.pages)
    stack = file.series[0].asarray(out="memmap")
    array = zarr.create_array(out, shape=(n, *bias.shape), chunks=(64, 64, 256), dtype="float32")
    for t in range(0, n, 64):
        array[t : t + 64] = (stack[t : t + 64] - bias) * gain
"""


def simulate(path: Path, size: int, n: int, exposure: float, seed: int) -> None:
    """Write frames of a sensor of 0.3 e- read noise, a block at a time."""
    import tifffile

    gain = np.random.default_rng(1).uniform(0.08, 0.12, (size, size))
    bias = np.random.default_rng(2).normal(100.0, 4.0, (size, size))
    rng = np.random.default_rng(seed)

    def blocks() -> Iterator[np.ndarray]:
        for _ in range(n):
            electrons = rng.poisson(exposure, (size, size)) + 0.25 * rng.standard_normal((size, size))
            yield np.rint(bias + electrons / gain).astype(np.uint16)

    tifffile.imwrite(path, blocks(), shape=(n, size, size), dtype=np.uint16, bigtiff=True)


def measure(folder: Path, size: int, n: int, workers: int, rounds: int) -> None:
    """Print a row for each way."""
    frames = folder / f"night{n}.tif"
    simulate(frames, size, n, 0.8, 7)
    pchem = [PCHEM, "apply", str(folder / "run.zarr"), str(frames), "--workers", str(workers)]
    pchem += ["--progress", "off", "--output", str(folder / "out.zarr"), "--what"]
    places = [str(frames), str(folder / "run.zarr"), str(folder / "out.zarr")]
    ways = {
        "numpy (x - mu) * g": [sys.executable, "-c", _NUMPY, *places],
        **{what: [*pchem, what] for what in ("electrons", "numbers", "exposure", "all")},
    }
    found: dict[str, list[Took]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, command in ways.items():
            shutil.rmtree(folder / "out.zarr", ignore_errors=True)
            found[name].append(run_measured(command, must_succeed=True))
    base = min(took.wall for took in found["numpy (x - mu) * g"])
    print(f"{n} frames of {size} x {size}, {workers} workers, best of {rounds}")
    for name, each in found.items():
        seconds, memory = min(took.wall for took in each), max(took.largest for took in each)
        rate = n * size * size / seconds / 1e6
        print(
            f"  {name:20} {seconds:7.2f} s  {rate:7.1f} Msamples/s  {seconds / base:5.2f} x  "
            f"{memory:6.0f} MiB"
        )
    frames.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(folder / "dark.tif", given.size, 400, 1.5, 3)
        run = [PCHEM, "run", str(folder / "dark.tif"), "--until", "fit", "--bit-depth", "14", "--quiet"]
        run_measured([*run, "--store", str(folder / "run.zarr")])
        for factor in (1, 4):
            measure(folder, given.size, given.frames * factor, given.workers, given.rounds)


if __name__ == "__main__":
    main()
