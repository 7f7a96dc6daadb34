#!/usr/bin/env python3
"""Stop commands at random moments, with their workers, resume them, and compare with undisturbed ones.

``.venv/bin/python scripts/validation/kills.py --kills 200`` kills `run`, `discrepancy`, `joint`, `electrons`,
`report`, `ingest --append` and `apply` in turn, each of a small sensor, up to three times before it may end,
and compares every array of the store bit by bit, the verdict, and the numbers of the report (but for times
and paths). ``--signals INT,TERM`` sends what Ctrl-C and a batch system send: the command must end within
`PATIENCE` seconds, with the code of the signal and one line. It prints a line for each command that was
stopped, and ends with 1 where one of them differs, cannot go on, or did not end well.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.store.run_store import RunStore

PCHEM = str(Path(sys.executable).with_name("pchem"))

CAMERA = """
run: {{store: {name}.zarr, tile: 8}}
compute: {{backend: {backend}, workers: 2}}
simulate:
  shape: [{side}, {side}]
  n_frames: {frames}
  seed: {seed}
  sensor_seed: 3
  output: {name}_frames
  format: npy
  frames_per_file: {per_file}
  integration_time: {time}
  effects: [{{tag: row_noise, row_noise_dn: 1.2}}]
discrepancy: {{replicates: 20, extended_replicates: 12, candidates: [row_noise]}}
"""

JOINT = """
run: {store: joint.zarr, tile: 8}
compute: {backend: threads, workers: 2}
input: {samples: [{run: a.yaml}, {run: b.yaml}]}
"""

#: seconds that a command may take to end after a signal that it hears
PATIENCE = 60.0

#: numbers that tell when and how long, or where
_PASSING = re.compile(
    r"second|time|date|made|rss|cpu|started|path|version|elapsed|host|base_dir|config$|memory|digest_of", re.I
)


@dataclass(frozen=True)
class Work:
    """A command that is killed.

    Attributes:
        name: what it is called here.
        command: arguments of ``pchem``.
        before: commands that bring about what it begins with.
        store: what it changes.
    """

    name: str
    command: tuple[str, ...]
    before: tuple[tuple[str, ...], ...]
    store: str


WORKS = (
    Work("run", ("run", "a.yaml"), (("simulate", "a.yaml"),), "a.zarr"),
    Work("discrepancy", ("discrepancy", "a.yaml"), (("run", "a.yaml", "--until", "ensemble"),), "a.zarr"),
    Work("joint", ("run", "joint.yaml"), (("simulate", "a.yaml"), ("simulate", "b.yaml")), "joint.zarr"),
    Work("electrons", ("electrons", "a.yaml"), (("run", "a.yaml", "--until", "ensemble"),), "a.zarr"),
    Work("report", ("report", "a.yaml"), (("run", "a.yaml", "--until", "ensemble"),), "a.zarr"),
    Work("append", ("ingest", "a.yaml", "--append"), (("run", "part.yaml", "--until", "maps"),), "a.zarr"),
    Work(
        "apply",
        ("apply", "a.yaml", "b_frames", "--output", "out.zarr"),
        (("simulate", "b.yaml"), ("run", "a.yaml", "--until", "ensemble")),
        "out.zarr",
    ),
)


def started(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Start a command of ``pchem`` in a process group of its own."""
    return subprocess.Popen(
        [PCHEM, *arguments, "--quiet"],
        cwd=folder,
        env=environment,
        text=True,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


class Bench:
    """A folder in which commands run, and copies of its states."""

    def __init__(self, folder: Path, backend: str, side: int = 16, frames: int = 900) -> None:
        self.folder, self.case = folder, folder / "case"
        self._camera = {"backend": backend, "side": side, "frames": frames, "per_file": frames // 3}
        self._states: dict[tuple[Any, ...], Path] = {}

    def pchem(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command."""
        return started(self.case, *arguments)

    def ok(self, *arguments: str) -> float:
        """Run a command to its end, which must be good; return its seconds."""
        start = time.perf_counter()
        _, words = (process := self.pchem(*arguments)).communicate()
        if process.returncode not in (0, 3):  # 3: a verdict with something to say
            raise AssertionError(f"pchem {' '.join(arguments)}: {process.returncode}: {words[-400:]}")
        return time.perf_counter() - start

    def begin(self, work: Work) -> None:
        """Bring the folder to the state in which a command begins."""
        if work.before not in self._states:
            self._start_anew()
            for command in work.before:
                if command[1] == "part.yaml":
                    self._first_files_only()
                self.ok(*command)
            saved = self.folder / f"state{len(self._states)}"
            shutil.copytree(self.case, saved)
            self._states[work.before] = saved
        shutil.rmtree(self.case, ignore_errors=True)
        shutil.copytree(self._states[work.before], self.case)

    def _start_anew(self) -> None:
        shutil.rmtree(self.case, ignore_errors=True)
        self.case.mkdir(parents=True)
        for seed, (name, seconds) in enumerate((("a", 2.0), ("b", 6.0))):
            text = CAMERA.format(name=name, seed=seed, time=seconds, **self._camera)
            (self.case / f"{name}.yaml").write_text(text)
        (self.case / "joint.yaml").write_text(JOINT)
        self.ok("simulate", "a.yaml")

    def _first_files_only(self) -> None:
        """Write the YAML of the first two of three files, which `append` goes on from."""
        files = sorted(path.name for path in (self.case / "a_frames").glob("*.npy"))
        shown = ", ".join(f"a_frames/{name}" for name in files)
        first = ", ".join(f"a_frames/{name}" for name in files[:-1])
        text = (self.case / "a.yaml").read_text()
        text = re.sub(r"simulate:\n(  .*\n)*", "input: {files: [FILES], integration_time: 2.0}\n", text)
        (self.case / "part.yaml").write_text(text.replace("FILES", first))
        (self.case / "a.yaml").write_text(text.replace("FILES", shown))


def results(store: Path) -> dict[str, Any]:
    """Return all arrays of a run, its verdict, and the numbers of its report."""
    found: dict[str, Any] = {}
    run = RunStore.open(store)
    for path in sorted(store.rglob("zarr.json")):
        record = json.loads(path.read_text())
        if record["node_type"] == "array":
            name = path.parent.relative_to(store).as_posix()
            found[name] = run.read(name)
    for path in (*store.glob("*.json"), *store.glob("model/*.json")):
        if path.name != "zarr.json":
            found |= lasting(str(path.relative_to(store)), json.loads(path.read_text()))
    return found


def lasting(name: str, content: Any) -> dict[str, Any]:
    """Return the values of JSON data by their places, without those that tell when, how long and where."""
    if not isinstance(content, (dict, list)):
        return {name: content}
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    kept = [(key, value) for key, value in pairs if not _PASSING.search(str(key))]
    return {place: each for key, value in kept for place, each in lasting(f"{name}/{key}", value).items()}


def differences(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Return the names of what is not the same to the bit."""
    names = found.keys() ^ expected.keys()
    for name in found.keys() & expected.keys():
        one, other = found[name], expected[name]
        if isinstance(one, np.ndarray):
            same = one.shape == other.shape and one.dtype == other.dtype and one.tobytes() == other.tobytes()
        else:
            same = one == other
        names |= set() if same else {name}
    return sorted(names)


def stop(process: subprocess.Popen[str], number: int) -> str:
    """Send a signal to a command and its workers; return what is wrong with how it ended, or nothing."""
    os.killpg(process.pid, number)
    start = time.perf_counter()
    try:
        _, words = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return f"went on for {PATIENCE:g} s after {signal.Signals(number).name}"
    name, seconds = signal.Signals(number).name, time.perf_counter() - start
    # 0 and 3: it had ended; a negative code: before it, or its interpreter, listened
    if number == signal.SIGKILL or process.returncode in (0, 3, -number):
        return ""
    ours = words.strip().splitlines()[-1:] or ["pchem: "]  # typer says nothing before the command begins
    if process.returncode != 128 + number or "Traceback" in words or not ours[0].startswith("pchem: "):
        return f"{name}: code {process.returncode} after {seconds:.1f} s: {words[-2000:]}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="threads", choices=["threads", "processes"])
    parser.add_argument("--only", help="names of commands, with commas")
    parser.add_argument("--signals", default="KILL", help="KILL, INT, TERM, with commas: one is drawn a time")
    options = parser.parse_args()
    signals = [signal.Signals[f"SIG{name}"] for name in options.signals.split(",")]
    rng = random.Random(options.seed)
    bench = Bench(Path(tempfile.mkdtemp(prefix="kills_")), options.backend)
    works = [work for work in WORKS if options.only is None or work.name in options.only.split(",")]
    expected, seconds = {}, {}
    kills: Counter[str] = Counter()
    wrong: list[str] = []
    for work in works:
        bench.begin(work)
        bench.ok(*work.command)  # compiles
        expected[work.name] = results(bench.case / work.store)
        bench.begin(work)
        seconds[work.name] = bench.ok(*work.command)
        if other := differences(results(bench.case / work.store), expected[work.name]):
            wrong.append(f"{work.name} in peace differs")
            print(f"{work.name}: twice in peace, {len(other)} results differ: {', '.join(other[:8])}")
        print(
            f"{work.name}: {seconds[work.name]:.1f} s in peace, {len(expected[work.name])} results",
            flush=True,
        )
    while sum(kills.values()) < options.kills:
        work = works[sum(kills.values()) % len(works)]
        bench.begin(work)
        moments: list[str] = []
        ends: list[str] = []
        for _ in range(rng.randint(1, 3)):
            process = bench.pchem(*work.command)
            moment, number = rng.uniform(0.0, seconds[work.name]), rng.choice(signals)
            moments.append(f"{moment:.2f}")
            try:
                process.wait(timeout=moment)
            except subprocess.TimeoutExpired:
                ends.append(stop(process, number))
                kills[work.name] += 1
                continue
            process.communicate()
            break
        try:
            bench.ok(*work.command)
            other = differences(results(bench.case / work.store), expected[work.name])
            words = f"differs: {len(other)}: {', '.join(other[:8])}" if other else "same"
        except AssertionError as error:
            words = f"cannot go on: {error}"
        words = "; ".join(filter(None, ends)) or words
        if words != "same":
            wrong.append(f"{work.name} {words}")
            shutil.copytree(bench.case, bench.folder / f"wrong{len(wrong)}")
        print(f"{sum(kills.values()):4d} {work.name}: stopped at {' '.join(moments)} s: {words}", flush=True)
    print(f"{sum(kills.values())} kills ({dict(kills)}), {len(wrong)} wrong; in {bench.folder}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
