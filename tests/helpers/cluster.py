"""A dask cluster of real processes."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path


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
