#!/usr/bin/env python3
"""Run a stack on a dask cluster, kill two of its four workers and pause one; compare with threads.

``.venv/bin/python scripts/validation/cluster_kills.py`` makes a stack of 4,000 frames of 512 x 512 pixels
(2.1 GB), runs it with threads, and again on a scheduler and four workers of at most 2 GB each: one is killed,
one paused (`SIGSTOP`) when a tenth of the tiles are fitted, another killed when half of them are. It prints
what each process read of the camera file (noted by each at every read), all that it read by the kernel's
``/proc/PID/io`` (libraries and store included, looked at every 0.2 s) and its peak memory, and ends with 1
unless parameters, maps, ensemble and report are the same to the bit, and the frames were read as often as
with threads: once, and the 250 of the ensemble again.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from pathlib import Path

from kills import differences, results, started

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.cluster import cluster_processes, signal_group
from process_tree import kilobytes, tree
from running import STAGES, machine, stage_records, write_stack

from pchem_pipeline.compute.environment import prepare_environment

#: writes down what a Python process reads of the frames: bytes, by `os.preadv` and by files that it opens
_COUNTING = """
import io, os
open_, preadv = io.open, os.preadv
log = os.open(os.environ["READS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
frames = os.environ["READS_OF"]

def note(name, count):
    if str(name).endswith(frames):
        os.write(log, f"{os.getpid()} {count}\\n".encode())
    return count

class Counted(io.FileIO):
    def readinto(self, buffer):
        return note(self.name, super().readinto(buffer))

def opened(file, mode="r", buffering=-1, *more, **options):
    if str(file).endswith(frames) and mode == "rb":
        raw = Counted(file)
        return raw if buffering == 0 else io.BufferedReader(raw)
    return open_(file, mode, buffering, *more, **options)

io.open = opened
os.preadv = lambda file, *rest: note(os.readlink(f"/proc/self/fd/{file}"), preadv(file, *rest))
"""


class Watch:
    """Looks at processes until they end: what they have read, and their largest memory."""

    def __init__(self) -> None:
        self.roles: dict[int, str] = {}
        self.read: dict[int, int] = defaultdict(int)
        self.peak: dict[int, int] = defaultdict(int)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def end(self) -> None:
        """Look no more."""
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._ended.wait(0.2):
            for root in list(self.roles):
                for pid in tree(root):
                    with contextlib.suppress(OSError, IndexError):
                        io = Path(f"/proc/{pid}/io").read_text().split()
                        self.read[pid] = max(self.read[pid], int(io[1]))
                        self.peak[pid] = max(self.peak[pid], kilobytes(pid, "VmHWM"))
                        self.roles.setdefault(pid, self.roles[root])


def wait_for_marks(store: Path, stage: str, many: int) -> None:
    """Wait until a stage has set some markers."""
    deadline = time.monotonic() + 300
    while len(list((store / ".pchem" / "done" / stage).rglob("*.json"))) < many:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def counting_reads(folder: Path, log: Path, frames: str) -> dict[str, str]:
    """Return the environment in which Python processes note in a file what they read of the frames.

    Args:
        folder: to be made, for the module that every process imports.
        log: file.
        frames: the end of the name of the camera file.
    """
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(_COUNTING)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    return {"READS": str(log), "READS_OF": frames, "PYTHONPATH": path}


def bytes_read(log: Path) -> Counter[int]:
    """Return the bytes of the frames that each process read, by its number."""
    found: Counter[int] = Counter()
    for line in log.read_text().splitlines():
        process, count = map(int, line.split())
        found[process] += count
    return found


def write_config(folder: Path, compute: dict[str, object]) -> Path:
    """Write the YAML of a run into a new folder; return where its store will be."""
    content = {"run": {"store": "run.zarr"}, "compute": compute}
    content["input"] = {
        "files": ["../stack.raw"],
        "mode": "reference",
        "bit_depth": 14,
        "integration_time": 1,
    }
    folder.mkdir()
    (folder / "run.yaml").write_text(json.dumps(content))
    return folder / "run.zarr"


def ended(process: subprocess.Popen[str]) -> None:
    """Wait for a run, which must end well."""
    _, words = process.communicate(timeout=3600)
    if process.returncode:
        raise SystemExit(f"pchem run: exit code {process.returncode}: {words}")
    print(f"ended well, with {len(words.splitlines())} warnings")


def on_the_cluster(folder: Path, given: argparse.Namespace, tiles: int) -> tuple[Watch, Path]:
    """Run the stack while two of four workers are killed and one is paused."""
    environment = {**os.environ, **counting_reads(folder / "counting", folder / "reads", "stack.raw")}
    if given.worker_ttl:
        environment["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = f"{given.worker_ttl} s"
    watch = Watch()
    with cluster_processes(folder, 4, "--memory-limit", "2GB", environment=environment) as (file, started):
        scheduler, *workers = started
        compute: dict[str, object] = {"backend": "distributed", "scheduler": str(file), "workers": 2}
        store = write_config(folder / "cluster", compute)
        names = ("killed first", "killed second", "paused", "left alone")
        watch.roles |= {worker.pid: f"worker, {name}" for worker, name in zip(workers, names, strict=True)}
        watch.roles[scheduler.pid] = "scheduler"
        start = time.monotonic()
        process = started(store.parent, "run", "run.yaml", environment=environment)
        watch.roles[process.pid] = "pchem run"
        try:
            wait_for_marks(store, "fit", max(1, tiles // 10))
            signal_group(workers[0], signal.SIGKILL)
            signal_group(workers[2], signal.SIGSTOP)
            print(f"{time.monotonic() - start:.0f} s: one worker killed, one paused", flush=True)
            wait_for_marks(store, "fit", tiles // 2)
            signal_group(workers[1], signal.SIGKILL)
            print(f"{time.monotonic() - start:.0f} s: another killed", flush=True)
            ended(process)
            print(f"{time.monotonic() - start:.0f} s: the run has ended")
        finally:
            process.kill()
            watch.end()
        signal_group(workers[2], signal.SIGCONT)  # it may still do what it had begun
        time.sleep(5)
    return watch, store


def show(watch: Watch, reads: Path, size: int) -> float:
    """Print what each process did; return how often the camera file was read."""
    noted = bytes_read(reads)
    print(f"{'process':<24}{'frames read, times':>20}{'all read, MB':>14}{'peak MiB':>10}")
    for pid, role in watch.roles.items():
        times = f"{noted.get(pid, 0) / size:.3f}"
        print(f"{role:<24}{times:>20}{watch.read[pid] / 1e6:>14.0f}{watch.peak[pid] / 1024:>10.0f}")
    return sum(noted.values()) / size


def main() -> int:
    prepare_environment()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--side", type=int, default=512, help="rows and columns")
    parser.add_argument("--worker-ttl", type=int, default=20, help="seconds of dask's worker-ttl; 0: its own")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cluster-kills-") as made:
        folder = Path(made)
        write_stack(folder / "stack.raw", given.frames, (given.side, given.side))
        size = (folder / "stack.raw").stat().st_size
        plain = write_config(folder / "threads", {"backend": "threads", "workers": 2})
        counted = counting_reads(folder / "counting alone", folder / "reads alone", "stack.raw")
        print(
            f"{machine()}\n{given.frames} frames of {given.side} x {given.side} pixels, {size / 1e9:.1f} GB"
        )
        ended(started(plain.parent, "run", "run.yaml", environment={**os.environ, **counted}))
        tiles = len(list((plain / ".pchem" / "done" / "fit").rglob("*.json")))
        watch, store = on_the_cluster(folder, given, tiles)
        times = show(watch, folder / "reads", size)
        alone = sum(bytes_read(folder / "reads alone").values()) / size
        print(f"{'stage':<12}{'threads, s':>12}{'cluster, s':>12}")
        records = stage_records(plain), stage_records(store)
        for name in STAGES:
            print(f"{name:<12}" + "".join(f"{each[name]['seconds']:>12.1f}" for each in records))
        expected = results(plain)
        wrong = differences(results(store), expected)
        print(f"{tiles} tiles, {len(expected)} results compared, different: {', '.join(wrong) or 'none'}")
        print(f"frames read {times:.3f} times, with threads {alone:.3f} times")
        return 1 if wrong or abs(times - alone) > 0.001 else 0


if __name__ == "__main__":
    sys.exit(main())
