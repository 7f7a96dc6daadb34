"""A full stack, raw file to report, beside what one would do instead; all in one run on one machine.

Peers: reading the file once with ``readinto`` (the floor); the paper's EM on raw samples in vectorised numpy,
on all processors, on a sample of pixels and scaled; general optimisers (L-BFGS-B of scipy, and Minuit where
iminuit is installed) on the histograms of a sample of pixels, scaled; and the histograms as dask.array gives
them in an afternoon (map_blocks with one bincount a pixel), on some rows and scaled. Before each reading the
file is dropped from the memory of the operating system.

    python scripts/bench/bench_side_by_side.py /data/full/frames/frames.raw --workers 2
    python scripts/bench/bench_side_by_side.py small.raw --pixels 20 --rows 2 --no-report     # a look
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from process_tree import Took, run_measured
from running import PCHEM, evict, machine, read_once, stage_records

from pchem_pipeline.compute.environment import prepare_environment


@dataclass(frozen=True)
class Row:
    """One way to do one thing, in seconds for the whole sensor.

    Attributes:
        what: the way.
        seconds: wall time for the whole sensor, scaled where only a part was measured.
        measured: on what.
        ours: seconds of what it is compared with.
    """

    what: str
    seconds: float
    measured: str
    ours: float


def paper_em(x: NDArray[np.float64], most: int = 500, tolerance: float = 1e-6) -> int:
    """Run the EM of the paper, eqs. (update_eqns) to (gamma_nk), on a pixel's samples; return the steps."""
    from scipy.special import gammaln

    mean, variance = x.mean(), x.var()
    third = ((x - mean) ** 3).mean()
    gain = abs(variance / max(abs(third), 1e-9)) * 1.5
    exposure = max(variance * gain**2 * 0.9, 0.1)
    bias, sigma = mean - exposure / gain, 0.3 / gain
    k = np.arange(int(exposure + 8 * np.sqrt(exposure) + 8))
    steps = 0
    for _ in range(most):
        steps += 1
        terms = k * np.log(exposure) - gammaln(k + 1) - 0.5 * ((x[:, None] - bias - k / gain) / sigma) ** 2
        terms -= terms.max(axis=1, keepdims=True)
        gamma = np.exp(terms)
        gamma /= gamma.sum(axis=1, keepdims=True)
        electrons = gamma @ k
        a, b, c = electrons.mean(), (gamma @ k**2).mean(), (x * electrons).mean()
        new = (b - a * a) / (c - mean * a)
        moved = abs(new / gain - 1)
        exposure, gain = a, new
        bias = mean - a / gain
        sigma = np.sqrt(max(variance - (b - a * a) / gain**2, 1 / 12))
        if moved < tolerance:
            break
    return steps


def _paper_pixel(samples: NDArray[np.uint16]) -> float:
    """Return the CPU seconds of a pixel, without those of imports."""
    import scipy.special  # noqa: F401

    start = time.process_time()
    paper_em(samples.astype(np.float64))
    return time.process_time() - start


def _bincounts(part: NDArray[np.uint16], bins: int = 1024) -> NDArray[np.int64]:
    counts = [np.bincount(pixel, minlength=bins)[:bins] for pixel in part.reshape(part.shape[0], -1).T]
    return np.asarray(counts).reshape(*part.shape[1:], bins)


def dask_histograms(frames: NDArray[np.uint16], rows: int) -> float:
    """Return the seconds of dask.array for the histograms of some rows."""
    import dask
    import dask.array as da

    start = time.perf_counter()
    stack = da.from_array(frames[:, :rows], chunks=(len(frames), rows, 64))
    counts = stack.map_blocks(_bincounts, dtype=np.int64, drop_axis=0, new_axis=2, chunks=(rows, 64, 1024))
    with dask.config.set(scheduler="threads"):
        counts.compute()
    return time.perf_counter() - start


def optimisers(counts: NDArray[np.uint16], origin: NDArray[np.int32]) -> dict[str, float]:
    """Return the CPU seconds a pixel of general optimisers on histograms, from the same starts as ours."""
    from bench_fit import Drawn, cpu, scipy_fit

    from pchem_pipeline.methods.plain_em import starting_points
    from pchem_pipeline.model.law.pcd import log_pcd

    pixels = Drawn(counts, origin.astype(np.int64), np.ones((len(counts), 4)))
    scipy_fit(Drawn(*(each[:1] for each in pixels)))  # imports its libraries
    found = {"scipy L-BFGS-B on histograms": cpu(lambda: scipy_fit(pixels))[0] / len(counts)}
    try:
        from iminuit import Minuit
    except ImportError:
        return found
    starts = starting_points(counts, pixels.origin)[:, 0, :]

    def minuit() -> None:
        for histogram, first, start in zip(counts, pixels.origin, starts, strict=True):
            occupied = np.flatnonzero(histogram)
            x, c = (first + occupied).astype(float), histogram[occupied].astype(float)

            def cost(p: NDArray[np.float64], x: object = x, c: object = c) -> float:
                return -float(c @ log_pcd(x, *p))  # type: ignore[operator]

            fit = Minuit(cost, start, name=("h", "g", "mu", "s"))
            fit.errordef, fit.print_level = Minuit.LIKELIHOOD, 0
            fit.limits["h", "g", "s"] = (1e-4, None)
            fit.migrad()
            fit.hesse()

    found["iminuit (MIGRAD, HESSE) on histograms"] = cpu(minuit)[0] / len(counts)
    return found


def our_run(raw: Path, folder: Path, workers: int, until: str) -> Took:
    """Run the pipeline, the file not in memory; its store is ``run.zarr``."""
    content = {
        "run": {"store": "run.zarr", "allowed_failed_pixels": 1.0},
        "input": {"files": [str(raw.resolve())], "integration_time": 4.87},
        "compute": {"workers": workers},
    }
    (folder / "run.yaml").write_text(json.dumps(content))
    evict(raw)
    return run_measured([PCHEM, "run", "run.yaml", "--until", until, "--quiet"], folder, must_succeed=True)


def compare(raw: Path, folder: Path, given: argparse.Namespace) -> list[Row]:
    """Measure everything."""
    from pchem_pipeline.store.run_store import RunStore

    took = our_run(raw, folder, given.workers, "report" if given.report else "maps")
    records = stage_records(folder / "run.zarr")
    seconds = {name: record["seconds"] for name, record in records.items()}
    fit = records["fit"]["cpu_seconds"] / given.workers  # CPU time, like that of the peers
    store = RunStore.open(folder / "run.zarr")
    sensor = store.attributes("frames")["sensor"]
    n, ny, nx = sensor["n_frames"], sensor["ny"], sensor["nx"]
    pixels = ny * nx
    until_maps = sum(seconds[name] for name in ("ingest", "histogram", "fit", "maps"))
    evict(raw)
    floor = read_once(raw)
    warm = read_once(raw)
    rows = [
        Row("pchem, raw to maps", until_maps, "all", until_maps),
        Row("pchem, raw to histograms and summaries", seconds["histogram"], "all", seconds["histogram"]),
        Row("pchem, fit", seconds["fit"], "all", seconds["fit"]),
        Row("pchem, fit, CPU time", fit, "all, shared by the cores", fit),
        Row("readinto, cold: the floor", floor, "all", until_maps),
        Row("readinto, from memory", warm, "all", until_maps),
    ]
    if given.report:
        rows.insert(0, Row("pchem run, raw to report", took.wall, "all", took.wall))
    frames = np.memmap(raw, np.uint16, "r", int(given.header), (n, ny, nx))
    few = min(given.rows, ny)
    evict(raw)
    spent = dask_histograms(frames, few)
    rows.append(
        Row(
            "dask.array map_blocks of bincount", spent * ny / few, f"{few} rows, scaled", seconds["histogram"]
        )
    )
    chosen = np.random.default_rng(1).choice(pixels, given.pixels, replace=False)
    samples = [np.array(frames[:, i // nx, i % nx]) for i in chosen]
    with ProcessPoolExecutor(given.workers) as pool:
        spent = sum(pool.map(_paper_pixel, samples, chunksize=4)) / given.workers
    part = f"{given.pixels} pixels, scaled to {given.workers} cores"
    rows.append(Row("the paper's EM on samples, numpy", spent * pixels / given.pixels, part, fit))
    counts = store.read("histogram/counts").reshape(pixels, -1)[chosen]
    origin = store.read("histogram/origin").ravel()[chosen]
    for name, each in optimisers(counts, origin).items():
        rows.append(Row(name, each * pixels / given.workers, part, fit))
    return rows


def show(rows: list[Row]) -> None:
    """Print a table, ready for a README."""
    print(f"| {'what':<40} | {'seconds':>9} | times ours | measured on |")
    print(f"|{'-' * 42}|{'-' * 10}:|-----------:|-------------|")
    for row in rows:
        ratio = row.seconds / row.ours
        spent = f"{row.seconds:,.0f}" if row.seconds >= 100 else f"{row.seconds:.3g}"
        print(f"| {row.what:<40} | {spent:>9} | {ratio:>10.3g} | {row.measured} |")


def main() -> None:
    prepare_environment()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("frames", type=Path, help="raw file, uint16, little endian, with its sidecar")
    parser.add_argument("--header", default=0, help="bytes before the first frame")
    parser.add_argument("--pixels", type=int, default=24, help="pixels for the peers of the fit")
    parser.add_argument("--rows", type=int, default=16, help="rows for dask.array")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--no-report", dest="report", action="store_false", help="stop at the maps")
    parser.add_argument("--folder", type=Path, help="where the store is written [a temporary folder]")
    given = parser.parse_args()
    size = given.frames.stat().st_size
    print(f"{machine()}\n{given.frames.name}, {size / 1e9:.2f} GB, {given.workers} workers")
    with tempfile.TemporaryDirectory(prefix="bench-side-", dir=given.folder) as place:
        rows = compare(given.frames, Path(place), given)
    show(rows)


if __name__ == "__main__":
    main()
