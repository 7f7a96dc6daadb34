"""A dask cluster of real processes that are killed: the work goes on, or stops with one line."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pchem_pipeline.compute import cluster
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.errors import ConfigError, IncompleteRunError


def slow_square(folder, number):
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.15)
    return number**2


@pytest.fixture
def processes(tmp_path):
    """A scheduler and two workers, each a process; ended afterwards."""
    file = tmp_path / "scheduler.json"
    started = []

    def start(kind, *options):
        command = [sys.executable, "-m", "dask", kind, "--no-dashboard", "--scheduler-file", str(file)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": here}  # the workers import this module
        started.append(subprocess.Popen([*command, *options], cwd=tmp_path, env=environment, **quiet))

    start("scheduler", "--host", "127.0.0.1", "--port", "0")
    for _ in range(2):
        start("worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1")
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    yield file, started
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def executor(processes):
    file, _ = processes
    made = make_executor(ComputeSettings(backend="distributed", scheduler=str(file)))
    made._client.wait_for_workers(2, timeout=60)
    yield made
    made.close()


def test_a_killed_worker_costs_nothing_but_time(processes, executor, tmp_path):
    _, (_, worker, _) = processes
    found = {}

    def on_result(number, outcome):
        found[number] = outcome.value
        if len(found) == 3:
            worker.send_signal(signal.SIGKILL)

    executor.map(functools.partial(slow_square, tmp_path), range(20), on_result)
    assert found == {number: number**2 for number in range(20)}
    assert worker.wait(10) == -signal.SIGKILL
    who = {int(path.name.split("-")[1]) for path in tmp_path.glob("[0-9]*-*")}
    assert worker.pid in who  # it had its share, and the other one did the rest
    assert len(who) == 2


def test_a_scheduler_that_goes_away_is_one_line(processes, executor, tmp_path):
    file, (scheduler, *_) = processes
    found = []

    def on_result(number, outcome):
        found.append(number)
        if len(found) == 3:
            scheduler.send_signal(signal.SIGKILL)

    with pytest.raises(IncompleteRunError, match="went away; finished tiles are kept") as caught:
        executor.map(functools.partial(slow_square, tmp_path), range(400), on_result)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert 3 <= len(found) < 400


def test_other_versions_are_refused(executor, monkeypatch, tmp_path):
    here = cluster.library_versions()
    monkeypatch.setattr(cluster, "library_versions", lambda: {**here, "numpy": "1.2.3"})
    with pytest.raises(ConfigError, match=r"has numpy .* instead of 1\.2\.3; install the same versions"):
        executor.map(functools.partial(slow_square, tmp_path), range(4), lambda item, outcome: None)
    assert not list(tmp_path.glob("[0-9]*-*"))
