"""A dask cluster of real processes, and what they read of the frames."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

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


@contextmanager
def cluster_processes(folder, n_workers, *options, environment=None):
    """A scheduler and workers, each a process with its own group; ended afterwards."""
    file, tests = folder / "scheduler.json", Path(__file__).parents[1]
    started = []

    def start(kind, *options):
        command = [sys.executable, "-m", "dask", kind, "--no-dashboard", "--scheduler-file", str(file)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        folders = [str(tests), str(tests / "e2e")]
        base = environment or os.environ
        here = os.pathsep.join([*folders, base.get("PYTHONPATH", "")])
        own = {**base, "PYTHONPATH": here}  # the workers import the modules of tests
        started.append(
            subprocess.Popen([*command, *options], cwd=folder, env=own, start_new_session=True, **quiet)
        )

    start("scheduler", "--host", "127.0.0.1", "--port", "0")
    for _ in range(n_workers):
        start("worker", "--nthreads", "1", "--host", "127.0.0.1", *options)
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    try:
        yield file, started
    finally:
        for process in started:
            signal_group(process, signal.SIGKILL)
            process.wait()


def signal_group(process, number):
    """Send a signal to a worker with the process that watches over it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def wait_for_marks(store, stage, many):
    """Wait until a stage has set some markers."""
    deadline = time.monotonic() + 300
    while len(list((store / ".pchem" / "done" / stage).rglob("*.json"))) < many:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def counting_reads(folder, log, frames):
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


def bytes_read(log):
    """Return the bytes of the frames that each process read, by its number."""
    found = Counter()
    for line in log.read_text().splitlines():
        process, count = map(int, line.split())
        found[process] += count
    return found
