"""How time and memory of the one pass and of the fit grow with frames and with pixels.

Stacks are made of a simulated block of 64 x 64 pixels and 1,000 frames, repeated in space and time, written
as raw files, and removed again; fitted are those in which no frame is repeated. Each is run in a process of
its own. Printed are seconds, CPU seconds, the peak of the resident memory beside what the plan said, and the
exponents fitted to the times; drawn, too.

    python scripts/bench/bench_growth.py --output growth  # 10 GB of disk at a time, some minutes
    python scripts/bench/bench_growth.py --frames 500,1000 --sides 64,128 --base-side 64 --base-frames 500
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from running import Outcome, machine, plain_numbers, run_pchem, save_figure

from pchem_pipeline.compute.environment import prepare_environment

_SIMULATED, _AT_ONCE = 1000, 100  # frames


@dataclass(frozen=True)
class Row:
    """One size and what it took."""

    frames: int
    side: int
    said: float
    took: Outcome

    @property
    def single_pass(self) -> float:
        """Seconds of the one pass."""
        return self.took.seconds["histogram"]

    @property
    def fit(self) -> float:
        """Seconds of the fit; NaN where there was none."""
        return self.took.seconds.get("fit", math.nan)


def write_stack(path: Path, frames: int, shape: tuple[int, int]) -> None:
    """Write a raw file of uint16 frames of some rows and columns, with its sidecar.

    The first 1,000 frames are simulated, and repeated from then on: a fit would find that out.
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
            first = start % _SIMULATED
            some = small[first : first + min(_AT_ONCE, frames - start)].astype("<u2")
            stream.write(np.ascontiguousarray(np.tile(some, (1, *times))[:, :rows, :columns]).data)
    path.with_name(f"{path.name}.json").write_text(json.dumps({"shape": shape, "dtype": "uint16"}))


def measure(folder: Path, frames: int, side: int, workers: int) -> Row:
    """Write a stack, run it as far as the histograms, or the fit if no frame is repeated, and remove it."""
    from pchem_pipeline.config.load import load_config
    from pchem_pipeline.stages.histogram.dry_run import make_plan
    from pchem_pipeline.stages.histogram.memory import single_pass_bytes

    raw, config = folder / "stack.raw", folder / "stack.yaml"
    write_stack(raw, frames, (side, side))
    content = {"run": {"store": "stack.zarr"}, "compute": {"workers": workers}}
    content["input"] = {"files": ["stack.raw"], "mode": "reference", "bit_depth": 14}
    config.write_text(json.dumps(content))
    parsed = load_config(config)
    plan = make_plan(parsed, folder)
    said = single_pass_bytes(parsed, plan.shape, np.dtype(np.uint16), plan.bins) / 2**20
    took = run_pchem(config, ("ingest", "histogram", "fit")[: 3 if frames <= _SIMULATED else 2])
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    return Row(frames, side, said, took)


def exponent(x: list[float], y: list[float]) -> float:
    """Return the power with which y grows with x, by least squares on logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def show(rows: list[Row]) -> None:
    """Print a table."""
    titles = ("frames", "side", "GB", "pass s", "CPU s", "fit s", "peak MiB", "said", "ratio")
    print("".join(f"{title:>9}" for title in titles))
    for row in rows:
        size = row.frames * row.side**2 * 2 / 1e9
        peak = row.took.peak["histogram"]
        cells = (f"{row.frames}", f"{row.side}", f"{size:.2f}", f"{row.single_pass:.2f}")
        cells += (f"{row.took.cpu['histogram']:.1f}", f"{row.fit:.2f}", f"{peak:.0f}", f"{row.said:.0f}")
        print("".join(f"{cell:>9}" for cell in (*cells, f"{peak / row.said:.2f}")))


def draw(folder: Path, by_frames: list[Row], by_side: list[Row], powers: dict[str, float]) -> None:
    """Draw time and memory against frames and pixels."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    n = [row.frames for row in by_frames]
    first = f"pass, power {powers['pass/frames']:.2f}"
    axes[0].loglog(n, [row.single_pass for row in by_frames], "o-", label=first)
    axes[0].set(xlabel=f"frames of {by_frames[0].side} x {by_frames[0].side} pixels", ylabel="seconds")
    pixels = [row.side**2 for row in by_side]
    for name, label in (("single_pass", "pass"), ("fit", "fit")):
        power = powers[f"{label}/pixels"]
        axes[1].loglog(
            pixels, [getattr(row, name) for row in by_side], "o-", label=f"{label}, power {power:.2f}"
        )
    axes[1].set(xlabel=f"pixels, {by_side[0].frames} frames", ylabel="seconds")
    for rows, marker, what in ((by_frames, "o", "more frames"), (by_side, "s", "more pixels")):
        axes[2].plot([r.said for r in rows], [r.took.peak["histogram"] for r in rows], marker, label=what)
    limits = np.array([0.0, axes[2].get_xlim()[1]])
    axes[2].plot(limits, limits, "-", color="0.5", lw=1, label="as said")
    axes[2].plot(limits, 1.2 * limits, "--", color="0.5", lw=1, label="1.2 times")
    plain_numbers(axes[0], n)
    plain_numbers(axes[1], pixels, 2)
    axes[2].set(xlabel="memory said, MiB", ylabel="peak memory, MiB")
    for each in axes:
        each.legend(frameon=False, fontsize=8)
        each.grid(alpha=0.3)
    save_figure(figure, folder, "growth")


def main() -> None:
    """Measure, print and draw."""
    prepare_environment()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", default="1000,4000,17750", help="numbers of frames")
    parser.add_argument("--base-side", type=int, default=512, help="rows and columns for these")
    parser.add_argument("--sides", default="128,512,1024,2048", help="rows and columns")
    parser.add_argument("--base-frames", type=int, default=1000, help="frames for these")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where the stacks are written [a temporary folder]")
    parser.add_argument("--output", type=Path, default=Path("bench-growth"), help="folder of the figure")
    given = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory(prefix="bench-growth-", dir=given.folder) as place:
        folder = Path(place)
        measure(folder, 300, 64, given.workers)  # compiles and loads the kernels
        by_frames = [measure(folder, int(n), given.base_side, given.workers) for n in given.frames.split(",")]
        by_side = [measure(folder, given.base_frames, int(s), given.workers) for s in given.sides.split(",")]
    show(by_frames + by_side)
    frames, pixels = [row.frames for row in by_frames], [row.side**2 for row in by_side]
    powers = {
        "pass/frames": exponent(frames, [row.single_pass for row in by_frames]),
        "memory/frames": exponent(frames, [row.took.peak["histogram"] for row in by_frames]),
        "pass/pixels": exponent(pixels, [row.single_pass for row in by_side]),
        "fit/pixels": exponent(pixels, [row.fit for row in by_side]),
        "memory/pixels": exponent(pixels, [row.took.peak["histogram"] for row in by_side]),
    }
    for name, power in powers.items():
        print(f"{name:<15} grows with the power {power:.2f}")
    draw(given.output, by_frames, by_side, powers)


if __name__ == "__main__":
    main()
