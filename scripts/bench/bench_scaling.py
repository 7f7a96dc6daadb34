"""How the pass over the camera file and the fit scale with workers: threads, processes, a local dask cluster.

A stack is made of a simulated block of 64 x 64 pixels and 1,000 frames, repeated in space and time (or a raw
file of yours with its sidecar is taken). Each backend runs it with each number of workers, in a process of
its own; printed are seconds of the stages, start-up of the command left out, and the gain over the fewest
workers; drawn, too. Every result is compared with the first one to the bit. With threads and processes one
process reads the file, once; a cluster reads it once for the hash and once by bands of rows, which its
workers count.

    python scripts/bench/bench_scaling.py --output scaling                    # 512 x 512 pixels, 1,000 frames
    python scripts/bench/bench_scaling.py --frames 500 --side 64 --repeat 1   # a look
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_growth import write_stack
from running import Outcome, evict, machine, plain_numbers, run_pchem, save_figure

from pchem_pipeline.compute.environment import prepare_environment

_PHASES = {"pass": ("ingest", "histogram"), "fit": ("fit",)}
_COMPARED = ("histogram/counts", "histogram/origin", "fit/bias", "fit/conversion_gain", "fit/read_noise_dn")


@dataclass(frozen=True)
class Row:
    """A backend with some workers.

    Attributes:
        backend: threads, processes or distributed.
        workers: their number.
        seconds: wall time of each phase, the best of the repetitions.
    """

    backend: str
    workers: int
    seconds: dict[str, float]


def make_stack(folder: Path, frames: int, side: int) -> Path:
    """Write a simulated stack as a raw file."""
    raw = folder / "stack.raw"
    write_stack(raw, frames, (side, side))
    return raw


def run_once(raw: Path, folder: Path, backend: str, workers: int, given: argparse.Namespace) -> Outcome:
    """Run the stack as far as the fit."""
    config = folder / "run.yaml"
    content = {
        "run": {"store": "run.zarr", "tile": given.tile},
        "input": {"files": [str(raw.resolve())], "mode": "reference", "bit_depth": 14},
        "compute": {"workers": workers, "backend": backend},
    }
    config.write_text(json.dumps(content))
    shutil.rmtree(folder / "run.zarr", ignore_errors=True)
    if given.cold:
        evict(raw)
    return run_pchem(config, ("ingest", "histogram", "fit"))


def measure(raw: Path, folder: Path, given: argparse.Namespace) -> tuple[list[Row], bool]:
    """Return what each backend took, and whether all results are the same to the bit."""
    from pchem_pipeline.store.run_store import RunStore

    run_once(raw, folder, "threads", 1, given)  # compiles and loads the kernels
    store = RunStore.open(folder / "run.zarr")
    expected = {name: store.read(name) for name in _COMPARED}
    rows, same = [], True
    for backend in given.backends.split(","):
        for workers in map(int, given.workers.split(",")):
            took = [run_once(raw, folder, backend, workers, given) for _ in range(given.repeat)]
            store = RunStore.open(folder / "run.zarr")
            for name, values in expected.items():
                same &= bool(np.array_equal(values, store.read(name), equal_nan=values.dtype.kind == "f"))
            best = {
                phase: min(sum(each.seconds[name] for name in names) for each in took)
                for phase, names in _PHASES.items()
            }
            rows.append(Row(backend, workers, best))
    return rows, same


def gain(rows: list[Row], row: Row, phase: str) -> float:
    """Return how much faster a phase is than with the fewest workers of the same backend."""
    first = min((each for each in rows if each.backend == row.backend), key=lambda each: each.workers)
    return first.seconds[phase] / row.seconds[phase]


def show(rows: list[Row], size: float, pixels: int) -> None:
    """Print a table, ready for a README."""
    print("| backend     | workers | pass, s | GB/s | gain | fit, s | pixels/s | gain |")
    print("|-------------|--------:|--------:|-----:|-----:|-------:|---------:|-----:|")
    for row in rows:
        cells = (f"{row.seconds['pass']:7.2f}", f"{size / row.seconds['pass']:4.2f}")
        cells += (f"{gain(rows, row, 'pass'):4.2f}", f"{row.seconds['fit']:6.2f}")
        cells += (f"{pixels / row.seconds['fit']:8.0f}", f"{gain(rows, row, 'fit'):4.2f}")
        print(f"| {row.backend:<11} | {row.workers:7} | {' | '.join(cells)} |")


def draw(rows: list[Row], folder: Path, title: str) -> None:
    """Draw seconds against workers."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
    backends = list(dict.fromkeys(row.backend for row in rows))
    for each, phase in zip(axes, _PHASES, strict=True):
        for backend, marker in zip(backends, "osD^", strict=False):
            chosen = [row for row in rows if row.backend == backend]
            workers = np.array([row.workers for row in chosen])
            seconds = [row.seconds[phase] for row in chosen]
            (line,) = each.plot(workers, seconds, marker + "-", label=backend)
            each.plot(workers, seconds[0] * workers[0] / workers, ":", color=line.get_color(), lw=1)
        each.set_xscale("log", base=2)
        each.set_yscale("log")
        plain_numbers(each, [row.workers for row in rows])
        each.set(xlabel="workers (dotted: in proportion)", ylabel="seconds", title=phase)
        each.grid(alpha=0.3, which="both")
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=9)
    save_figure(figure, folder, "scaling")


def main() -> None:
    """Measure, print and draw."""
    prepare_environment()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("raw", type=Path, nargs="?", help="raw file with its sidecar [a simulated stack]")
    parser.add_argument("--frames", type=int, default=1000, help="of the simulated stack")
    parser.add_argument("--side", type=int, default=512, help="rows and columns of the simulated stack")
    parser.add_argument("--tile", type=int, default=64, help="run.tile")
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--backends", default="threads,processes,distributed")
    parser.add_argument("--repeat", type=int, default=2, help="of each the best is taken")
    parser.add_argument("--cold", action="store_true", help="drop the file from memory before each run")
    parser.add_argument("--folder", type=Path, help="where the stack is written [a temporary folder]")
    parser.add_argument("--output", type=Path, default=Path("bench-scaling"), help="folder of the figure")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-scaling-", dir=given.folder) as place:
        raw = given.raw or make_stack(Path(place), given.frames, given.side)
        rows, same = measure(raw, Path(place), given)
        size, pixels = raw.stat().st_size / 1e9, _pixels(Path(place))
    what = "cold" if given.cold else "from memory"
    title = f"{raw.name}, {size:.2f} GB, {pixels} pixels, tiles of {given.tile}, file {what}"
    print(f"{machine()}\n{title}")
    show(rows, size, pixels)
    print(f"same bits from all: {'yes' if same else 'NO'}")
    draw(rows, given.output, title)


def _pixels(folder: Path) -> int:
    from pchem_pipeline.store.run_store import RunStore

    return int(np.prod(RunStore.open(folder / "run.zarr").array("fit/bias").shape))


if __name__ == "__main__":
    main()
