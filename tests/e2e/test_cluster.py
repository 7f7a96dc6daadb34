"""A dask cluster of real processes that are killed: the work goes on, or stops with one line."""

import functools
import os
import shutil
import signal
import time

import numpy as np
import pytest
from helpers.cluster import cluster_processes
from helpers.commands import assert_same_results

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError
from pchem_pipeline.compute import cluster
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.run.signals import InterruptedRunError
from pchem_pipeline.store.run_store import RunStore


def slow_square(folder, number):
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.15)
    return number**2


@pytest.fixture
def processes(tmp_path):
    """A scheduler and two workers."""
    with cluster_processes(tmp_path, 2, "--no-nanny") as made:
        yield made


def workers_of(file, **settings):
    """Return settings of the cluster whose scheduler is told by a file."""
    return ComputeSettings(backend="distributed", scheduler=str(file), **settings)


def numbers_of_workers(folder):
    return {int(path.name.split("-")[1]) for path in folder.glob("[0-9]*-*")}


def test_a_killed_worker_costs_nothing_but_time_and_the_last_one_is_waited_for(processes, tmp_path):
    file, (_, first, last) = processes
    lines = []
    executor = make_executor(workers_of(file, wait_for_workers=2), lines.append)
    executor._client.wait_for_workers(2, timeout=60)
    found = {}

    def on_result(number, outcome):
        found[number] = outcome.value
        if first.poll() is None and first.pid in numbers_of_workers(tmp_path):  # it has had its share
            first.send_signal(signal.SIGKILL)

    executor.map(functools.partial(slow_square, tmp_path), range(20), on_result)
    assert found == {number: number**2 for number in range(20)}
    assert first.wait(10) == -signal.SIGKILL
    who = numbers_of_workers(tmp_path)
    assert first.pid in who  # it had its share, and the other one did the rest
    assert len(who) == 2
    assert lines == []
    found.clear()
    try:
        task = functools.partial(slow_square, tmp_path)
        with pytest.raises(IncompleteRunError, match="had no worker for 2 s"):
            executor.map(task, range(400), lambda number, _: (found.setdefault(number), last.kill()))
    finally:
        executor.close()
    assert 1 <= len(found) < 10
    assert len(lines) == 1


def test_other_versions_are_refused_and_a_scheduler_that_goes_away_is_one_line(
    processes, monkeypatch, tmp_path
):
    file, (scheduler, *_) = processes
    executor = make_executor(workers_of(file))
    executor._client.wait_for_workers(2, timeout=60)
    here, found, task = cluster.library_versions(), [], functools.partial(slow_square, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "library_versions", lambda: {**here, "numpy": "1.2.3"})
        with pytest.raises(ConfigError, match=r"has numpy .* instead of 1\.2\.3; install the same versions"):
            executor.map(task, range(4), lambda number, _: found.append(number))
    assert not numbers_of_workers(tmp_path)

    def on_result(number, _):
        found.append(number)
        if len(found) == 3:
            scheduler.send_signal(signal.SIGKILL)

    with pytest.raises(IncompleteRunError, match="stopped; finished tiles are kept") as caught:
        executor.map(task, range(400), on_result)
    executor.close()
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert 3 <= len(found) < 400


def test_a_worker_over_its_memory_is_one_line_and_the_run_goes_on_to_the_same_bits(shell, finished):
    shutil.copytree(finished.parent, shell.folder, dirs_exist_ok=True)
    store = shell.folder / "run.zarr"
    shutil.rmtree(store / ".pchem" / "done" / "fit")  # as if nothing had been fitted
    RunStore.open(store, writable=True).write("fit/bias", (slice(0, 8), slice(0, 8)), np.zeros((8, 8)))
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    with cluster_processes(shell.folder, 1, "--memory-limit", "170MiB", environment=environment) as (file, _):
        settings = f"compute: {{backend: distributed, scheduler: {file}}}\n"
        (shell.folder / "small.yaml").write_text((shell.folder / "run.yaml").read_text() + settings)
        killed = shell("fit", "small.yaml", "--roi", "0:8,0:8")
    assert killed.code == 3
    (line,) = [each for each in killed.stderr.splitlines() if each.startswith("pchem: ")]
    assert "1 worker died on it, the last at tcp://127.0.0.1" in line
    assert "above their memory of 170 MiB; give each more memory (fewer workers" in line
    assert "Traceback" not in killed.stderr
    shell.ok("fit", "run.yaml")
    assert_same_results(store, finished)


def test_a_scheduler_without_workers_is_said_and_given_up(tmp_path):
    lines, asked, words = [], [], r"had no worker for 1 s \(compute.wait_for_workers\)"
    with cluster_processes(tmp_path, 0) as (file, _):
        with pytest.raises(IncompleteRunError, match=words) as caught:
            make_executor(workers_of(file, wait_for_workers=1), lines.append, lambda: asked.append(1))

        def stopped():
            raise InterruptedRunError(signal.SIGTERM)

        with pytest.raises(InterruptedRunError, match="stopped by SIGTERM"):
            make_executor(workers_of(file), check=stopped)
    assert lines == [f"waiting for workers of the dask scheduler {file}"]
    assert len(asked) > 3
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_paused_workers_are_not_waited_for_forever(monkeypatch):
    lines = []
    executor = cluster.DistributedExecutor.__new__(cluster.DistributedExecutor)
    executor._name, executor._seconds = "the dask scheduler x", 0.05
    executor._say, executor._check = lines.append, lambda: None
    executor._since, executor._said = None, False
    workers = [{"status": "paused", "memory_limit": 300 << 20}] * 2
    monkeypatch.setattr(executor, "_workers", lambda: workers)
    assert not executor._can_work()
    time.sleep(0.03)
    assert not executor._can_work()
    time.sleep(0.03)
    with pytest.raises(IncompleteRunError, match="all 2 workers were paused") as caught:
        executor._can_work()
    assert "300 MiB" in str(caught.value)
    assert lines == ["waiting for workers of the dask scheduler x: all 2 are paused, memory nearly full"]
    workers.append({"status": "running", "memory_limit": 0})
    assert executor._can_work()
