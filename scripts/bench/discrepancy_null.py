"""The null over the whole range of sensors: nothing is hidden, and nothing may be found.

Sensors are drawn at random (``tests/helpers/plain_camera.py``, which shares no code with the package): read
noise 0.15 to 0.8 e-, H 0.05 to 20, 3 to 30 DN per electron, 300 to 20,000 frames, 16^2 to 256^2 pixels, all
alike or laid out by taps, columns, colours, stars, reference columns and the like; of the largest, fewer
pixels and frames are simulated, so that many sensors fit into the time.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from discrepancy_figures import read_results, wilson

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
RIGHT = ("consistent", "cannot_tell")
MOST_SAMPLES = 3e6  # frames x pixels of a stack


def results_of_seeds(
    path: Path, first: int, minutes: float, one: Callable[[int], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield the records of a file, a line each, and those of the seeds that it lacks until the time is over.

    Args:
        path: file, to which each new record is added as soon as it is there.
        first: the first seed.
        minutes: no seed begins later.
        one: makes the record of a seed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    records = read_results(path)
    yield from records
    done, start = {r["seed"] for r in records}, time.monotonic()
    with path.open("a") as file:
        for seed in itertools.count(first):
            if time.monotonic() - start >= 60.0 * minutes:
                return
            if seed not in done:
                record = one(seed)
                file.write(json.dumps(record) + "\n")
                file.flush()
                yield record


def run_null_range(folder: Path, first: int, minutes: float, most_samples: float) -> None:
    """Look for discrepancies in stacks without any until the time is over, and print the share of alarms.

    The results are kept in ``null_range.jsonl``; a stack has at most so many samples (frames x pixels).
    """

    def one(seed: int) -> dict[str, Any]:
        record = one_of_range(seed, most_samples)
        print(_line(record), flush=True)
        return record

    print_null_range(list(results_of_seeds(folder / "null_range.jsonl", first, minutes, one)))


def print_null_range(records: list[dict[str, Any]]) -> None:
    """Print how often something was found where nothing is, with its 95 % interval (Wilson)."""
    words = Counter(r["verdict"] for r in records)
    print(
        f"\nNothing hidden, {len(records)} sensors: " + ", ".join(f"{w} {n}" for w, n in words.most_common())
    )
    judged = [r for r in records if r["verdict"] != "refused"]
    alarms = sum(r["verdict"] not in RIGHT for r in judged)
    low, high = (100 * end for end in wilson(alarms, len(judged)))
    share = 100 * alarms / max(len(judged), 1)
    interval = f"[{low:.1f}, {high:.1f}]"
    print(f"any name, or unexplained: {alarms}/{len(judged)}, {share:.1f} % {interval}   target <= 1 %")
    seconds = [r["cpu_seconds"] for r in judged] or [0.0]
    print(f"CPU: median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s")


def null_of_range(seed: int, most_samples: float = MOST_SAMPLES) -> dict[str, Any]:
    """Return verdict, cost and error of a stack with nothing hidden, as other records have them."""
    found = one_of_range(seed, most_samples)
    failed = found["why"] if found["verdict"] == "error" else None
    return {
        "verdict": {
            "verdict": found["verdict"],
            "effects": found.get("effects", ()),
            "replicates": 0,
            "work": found.get("work"),
        },
        "sensor": found,
        "cpu_seconds": found["cpu_seconds"],
        "error": failed,
    }


def one_of_range(seed: int, most_samples: float) -> dict[str, Any]:
    """Look for discrepancies in a stack of a random sensor in which nothing is hidden."""
    from helpers.plain_camera import drawn_camera

    from pchem_pipeline.base.errors import InputError, PchEmError
    from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies

    camera = drawn_camera(np.random.default_rng([seed, 1]), most_samples)
    sensor = {
        "read_noise_e": camera.read_noise_e, "exposure": camera.exposure, "step": camera.step,
        "shape": camera.shape, "n_frames": camera.n_frames, "layout": camera.layout,
    }  # fmt: skip
    record: dict[str, Any] = {"seed": seed, **sensor}
    cpu = time.process_time()
    try:
        found = find_discrepancies(camera.frames(seed)).verdict
        record |= {
            "verdict": found.verdict, "effects": found.effects, "p": found.p_global.before,
            "defects": found.defects, "work": found.work,
        }  # fmt: skip
    except (InputError, PchEmError) as error:
        record |= {"verdict": "refused", "why": str(error)}
    except Exception as error:  # one defect must not end a study of hours; it counts as an alarm
        record |= {"verdict": "error", "why": f"{type(error).__name__}: {error}"}
    return record | {"cpu_seconds": time.process_time() - cpu}


def _line(r: dict[str, Any]) -> str:
    size = f"{r['shape'][0]}x{r['shape'][1]}x{r['n_frames']}"
    sensor = f"s_e {r['read_noise_e']:.2f}  H {r['exposure']:7.3f}  {r['step']:4.1f} DN/e-  {size:14s}"
    sensor += f" {r.get('layout', 'even'):10s}"
    p = f"p {r['p']:.2g}" if "p" in r else r.get("why", "")[:90]
    said = f"{r['verdict']:12s} {p} {r.get('effects') or ''}"
    return f"{r['seed']:6d}  {sensor} {said}  ({r['cpu_seconds']:.0f} s)"
