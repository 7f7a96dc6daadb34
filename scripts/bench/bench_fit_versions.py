"""Speed of the fit beside that of another checkout, in CPU time, old and new taking turns.

Both fit the same histograms, each in a process of its own, a pass of the one and a pass of the other: what
the machine does meanwhile meets both. The best pass of each counts.

    python scripts/bench/bench_fit_versions.py --old ../checkout      # one to two minutes; --only good joint
"""

from __future__ import annotations

import argparse
import importlib
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Case = dict[str, Any]

HERE = Path(__file__).resolve().parents[2]


# -- histograms


def histograms(
    rng: np.random.Generator, truth: Mapping[str, Array], n_frames: int, spread: float = 0.0
) -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
    """Draw frames of pixels, rounded, and count them; ``spread``: noise of an electron's signal, e-."""
    n = truth["h"].size
    values = np.empty((n, n_frames), np.int32)
    for i in range(n):
        k = rng.poisson(truth["h"][i], n_frames)
        noise = np.sqrt(truth["noise"][i] ** 2 + spread**2 * k) * rng.standard_normal(n_frames)
        values[i] = np.rint(truth["bias"][i] + truth["step"][i] * (k + noise))
    origin = values.min(axis=1) - 1
    width = int((values.max(axis=1) - origin).max()) + 2
    rows = [np.bincount(row, minlength=width) for row in values - origin[:, None]]
    counts = np.array(rows, np.uint16)
    return counts, origin.astype(np.int64)


def pixels(
    rng: np.random.Generator, n: int, exposure: tuple[float, float], noise: tuple[float, float]
) -> Any:
    """Draw parameters."""
    return {
        "h": rng.uniform(*exposure, n),
        "step": rng.uniform(8.0, 14.0, n),
        "bias": rng.uniform(95.0, 105.0, n),
        "noise": rng.uniform(*noise, n),
    }


def cases(rng: np.random.Generator, share: float) -> dict[str, Case]:
    """Draw the histograms of all cases."""
    size = lambda n: max(int(n * share), 32)  # noqa: E731
    found: dict[str, Case] = {}
    for name, n, n_frames in (("good", 4000, 17_750), ("short", 4000, 1000)):
        counts, origin = histograms(rng, pixels(rng, size(n), (0.5, 8.0), (0.22, 0.42)), n_frames)
        found[name] = {"counts": counts, "origin": origin}
    truth = pixels(rng, size(1200), (0.3, 0.8), (0.22, 0.6))
    drawn = [histograms(rng, {**truth, "h": truth["h"] * scale}, 4000) for scale in (1.0, 3.0, 8.0)]
    found["joint"] = {"counts": [each[0] for each in drawn], "origin": [each[1] for each in drawn]}
    truth = pixels(rng, size(1200), (0.5, 5.0), (0.22, 0.4))
    counts, origin = histograms(rng, truth, 4000, spread=0.09)
    found["extended"] = {"counts": counts, "origin": origin, "variance_per_electron": 0.09**2}
    found["exact"] = {"counts": counts, "origin": origin, "likelihood": "exact"}
    return found


# -- the process of a checkout


def fitter(case: Case) -> Callable[[], Any]:
    """Return the fit of a case by the package that is imported here."""
    counts, origin = case["counts"], case["origin"]
    fit = importlib.import_module("pchem_pipeline.model.fit.api").fit_histograms
    settings = importlib.import_module("pchem_pipeline.model.fit.settings").FitSettings(
        likelihood=case.get("likelihood", "density")
    )
    law = None
    if "variance_per_electron" in case:
        law = importlib.import_module("pchem_pipeline.model.law.sample_law").SampleLaw(
            variance_per_electron=case["variance_per_electron"]
        )
    return lambda: fit(counts, origin, law=law, settings=settings)


def work(path: Path) -> None:
    """Fit the case of each line of standard input, and answer with CPU seconds and evaluations."""
    fits = {name: fitter(case) for name, case in pickle.loads(path.read_bytes()).items()}
    for line in sys.stdin:
        started = time.process_time()
        found = fits[line.strip()]()
        print(time.process_time() - started, found.n_iterations.mean(), flush=True)


def start(tree: Path, path: Path) -> subprocess.Popen[str]:
    """Start the process of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--work", str(path)]
    return subprocess.Popen(
        command, env=environment, cwd=tree, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def ask(process: subprocess.Popen[str], case: str) -> tuple[float, float]:
    """Have a case fitted; return CPU seconds and evaluations by pixel."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(case + "\n")
    process.stdin.flush()
    seconds, evaluations = process.stdout.readline().split()
    return float(seconds), float(evaluations)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--old", type=Path, help="the other checkout")
    parser.add_argument("--only", nargs="*", default=[], help="of good, short, joint, extended, exact")
    parser.add_argument("--share", type=float, default=1.0, help="of the pixels")
    parser.add_argument("--passes", type=int, default=7)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.work)
        return
    drawn = cases(np.random.default_rng(options.seed), options.share)
    drawn = {name: case for name, case in drawn.items() if not options.only or name in options.only}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cases"
        path.write_bytes(pickle.dumps(drawn))
        trees = {"old": options.old.resolve(), "new": HERE} if options.old else {"new": HERE}
        processes = {name: start(tree, path) for name, tree in trees.items()}
        print(
            f"{'':10s}{'pixels':>8s}"
            + "".join(f"{each + ', pixels/s':>18s}{'evaluations':>13s}" for each in trees)
        )
        for name, case in drawn.items():
            first = case["counts"] if not isinstance(case["counts"], list) else case["counts"][0]
            best = dict.fromkeys(trees, np.inf)
            evaluations = dict.fromkeys(trees, 0.0)
            for turn in range(options.passes + 1):
                for each, process in processes.items():
                    seconds, evaluations[each] = ask(process, name)
                    if turn > 0:  # the first compiles
                        best[each] = min(best[each], seconds)
            line = "".join(f"{len(first) / best[each]:18.0f}{evaluations[each]:13.1f}" for each in trees)
            ratio = f"   new/old {best['old'] / best['new']:.3f}" if options.old else ""
            print(f"{name:10s}{len(first):8d}{line}{ratio}", flush=True)
        for process in processes.values():
            process.kill()


if __name__ == "__main__":
    main()
