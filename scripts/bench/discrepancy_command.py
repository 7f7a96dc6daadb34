"""A few cases of the study through the installed command, with what they cost."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from discrepancy_cases import EFFECTS, Case, make
from discrepancy_figures import Answer
from numpy.typing import NDArray
from process_tree import Took, run_measured
from running import PCHEM

RUN = """run: {{store: run.zarr}}
compute: {{workers: {workers}}}
input: {{files: [frames.npy], integration_time: 1.0}}
"""


def command_verdict(frames: NDArray[np.uint16], folder: Path) -> dict[str, Any]:
    """Return the verdict of ``pchem discrepancy`` on frames in a file, and what that took."""
    place = folder / "run"
    place.mkdir()
    np.save(place / "frames.npy", frames)
    (place / "run.yaml").write_text(RUN.format(workers=1))
    _timed(place, "run", "--until", "fit")
    took = _timed(place, "discrepancy", "--no-refit")
    verdict = json.loads((place / "run.zarr" / "discrepancy.json").read_text())
    return {"seconds": took.wall, "cpu_seconds": took.cpu, "verdict": verdict}


def run_commands(count: int, first: int, shape: tuple[int, int, int], folder: Path, workers: int) -> None:
    """Print verdict, wall and CPU time of ``pchem run`` and ``pchem discrepancy`` on hidden stacks."""
    print(
        f"{'hidden':26s}{'said':40s}{'run, s':>9s}{'discrepancy, s':>16s}"
        f"{'wall':>8s}{'CPU':>8s}{'memory, MiB':>12s}"
    )
    ratios = []
    for i in range(count):
        case = Case("command", (EFFECTS[(7 * (first + i) + 4) % len(EFFECTS)],), 4.0, first + i, shape)
        place = folder / f"command-{case.hidden[0]}-{case.index}"
        shutil.rmtree(place, ignore_errors=True)
        make(case.hidden, case.level, case.seed, shape, place, folder / "sealed" / f"{place.name}.json")
        (place / "run.yaml").write_text(RUN.format(workers=workers))
        run = _timed(place, "run")
        search = _timed(place, "discrepancy")
        verdict = json.loads((place / "run.zarr" / "discrepancy.json").read_text())
        answer = Answer({"case": case.to_json(), "verdict": verdict})
        ratios.append(search.wall / run.wall)
        print(
            f"{case.hidden[0]:26s}{answer.names[:39]:40s}{run.wall:9.1f}{search.wall:16.1f}{ratios[-1]:7.1f}x"
            f"{search.cpu / run.cpu:7.1f}x{search.largest:12.0f}",
            flush=True,
        )
    print(
        f"cost: median {np.median(ratios):.1f} times the plain pipeline, most {max(ratios):.1f}"
        " (target: at most 20)"
    )


def _timed(place: Path, stage: str, *options: str) -> Took:
    return run_measured([PCHEM, stage, "run.yaml", *options], place, must_succeed=True)
