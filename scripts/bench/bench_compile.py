"""What compiling the kernels costs: the first run after an installation, against the same run afterwards.

Each command runs twice, from an empty cache and from the one that this filled; the waiting is the difference.
``--old`` does the same with another checkout of the project in the same environment, turn by turn. CPU
seconds are those of all processes of the command; what else the machine does hardly changes them.

Example:
    python scripts/bench/bench_compile.py --old ../before
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from process_tree import run_measured
from running import machine

RUN = """run: {{store: {name}.zarr}}
input: {{files: [{name}/*.tif], integration_time: {exposure}, bit_depth: 14}}
"""
CAMERA = """run: {{store: {name}-truth.zarr}}
simulate:
  shape: [{side}, {side}]
  n_frames: {frames}
  seed: {seed}
  output: {name}
  integration_time: {exposure}
  parameters: {{quanta_exposure: {{kind: constant, value: {exposure}}}}}
"""


@dataclass(frozen=True)
class Cost:
    """What one command took: seconds by the wall, CPU seconds, and files in the cache afterwards."""

    wall: float
    cpu: float
    files: int


def pchem(checkout: Path, cache: Path, folder: Path, arguments: list[str]) -> Cost:
    """Run a command of a checkout with a cache of kernels of its own."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "pchem_pipeline", *arguments, "--quiet"]
    took = run_measured(command, folder, environment, must_succeed=True)
    return Cost(took.wall, took.cpu, len(list(cache.rglob("*.nbc"))))


def prepare(checkout: Path, folder: Path, options: argparse.Namespace) -> None:
    """Simulate two exposures of one camera, and fit both where that is needed; the cache is thrown away."""
    cache = folder / "preparing"
    for name, exposure in (("frames", 2.0), ("brighter", 5.0)):
        text = CAMERA.format(
            name=name, exposure=exposure, side=options.side, frames=options.frames, seed=options.seed
        )
        (folder / f"{name}.yaml").write_text(text)
        pchem(checkout, cache, folder, ["simulate", f"{name}.yaml"])
        (folder / f"{name}-run.yaml").write_text(RUN.format(name=name, exposure=exposure))
        if set(options.commands) != {"run"}:
            pchem(checkout, cache, folder, ["run", f"{name}-run.yaml"])


COMMANDS = {
    "run": (["run", "frames-run.yaml"], "frames.zarr", False),
    "discrepancy": (["discrepancy", "frames-run.yaml"], "frames.zarr", True),
    "joint": (["joint", "frames.zarr", "brighter.zarr"], "joint.zarr", False),
}


def measure(checkout: Path, base: Path, command: str, cache: Path) -> Cost:
    """Run one command on a copy of the prepared folder."""
    arguments, store, keeps_run = COMMANDS[command]
    with tempfile.TemporaryDirectory(prefix="bench-compile-") as place:
        folder = Path(place) / "data"
        shutil.copytree(base, folder, ignore=shutil.ignore_patterns("preparing"))
        if not keeps_run and (folder / store).exists():
            shutil.rmtree(folder / store)
        return pchem(checkout, cache, folder, arguments)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commands", nargs="*", default=list(COMMANDS), help="run, discrepancy, joint")
    parser.add_argument("--side", type=int, default=64, help="pixels on a side")
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--old", type=Path, help="another checkout, measured in turns with this one")
    options = parser.parse_args()
    checkouts = {"now": Path(__file__).resolve().parents[2]}
    if options.old is not None:
        checkouts = {"old": options.old.resolve(), **checkouts}
    print(machine())
    print(f"{options.side} x {options.side} pixels, {options.frames} frames")
    head = ("", "cold s", "warm s", "waiting s", "cold CPU s", "warm CPU s", "compiling CPU s", "kernels")
    print(f"{head[0]:<18}" + "".join(f"{word:>16}" for word in head[1:]))
    with tempfile.TemporaryDirectory(prefix="bench-compile-") as place:
        for label, checkout in checkouts.items():
            (Path(place) / label).mkdir()
            prepare(checkout, Path(place) / label, options)
        for command in options.commands:
            for label, checkout in checkouts.items():
                base, cache = Path(place) / label, Path(place) / f"cache-{label}-{command}"
                cold = measure(checkout, base, command, cache)
                warm = measure(checkout, base, command, cache)
                pairs = (cold.wall, warm.wall), (cold.cpu, warm.cpu)
                numbers = [each for one, other in pairs for each in (one, other, one - other)]
                row = "".join(f"{number:>16.1f}" for number in numbers)
                print(f"{command + ' ' + label:<18}{row}{cold.files:>16}", flush=True)


if __name__ == "__main__":
    main()
