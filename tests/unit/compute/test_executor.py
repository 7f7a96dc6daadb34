import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError
from pchem_pipeline.compute import executor as executor_module
from pchem_pipeline.compute.executor import Stop, beside, make_executor
from pchem_pipeline.compute.memory import BASE_BYTES, affordable, keep_to_limit, resident_bytes
from pchem_pipeline.compute.settings import ComputeSettings

BACKENDS = ["serial", "threads", "processes", "distributed"]


def reciprocal(number):
    return 1 / number


def die(number):
    os._exit(9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_backend_reports_values_and_errors_alike(backend):
    found = {}
    with contextlib.closing(make_executor(ComputeSettings(backend=backend, workers=2))) as executor:
        executor.map(reciprocal, [1, 2, 0, 4], lambda item, outcome: found.update({item: outcome}))
    assert {item: outcome.value for item, outcome in found.items()} == {1: 1.0, 2: 0.5, 0: None, 4: 0.25}
    assert isinstance(found[0].error, ZeroDivisionError)
    assert "reciprocal" in found[0].trace


def test_a_local_cluster_starts_beside_a_busy_dashboard_port_and_listens_on_loopback_only():
    with socket.socket() as other:
        with contextlib.suppress(OSError):  # whoever holds the port already serves as well
            other.bind(("127.0.0.1", 8787))
            other.listen()
        made = make_executor(ComputeSettings(backend="distributed", workers=1))
        with contextlib.closing(made) as executor:
            assert executor._cluster.scheduler.http_server.address == "127.0.0.1"


@pytest.mark.parametrize("backend", BACKENDS[:2])
def test_stop_lets_running_items_finish_and_starts_no_others(backend):
    executor = make_executor(ComputeSettings(backend=backend, workers=2))
    started, lock = [], threading.Lock()

    def work(item):
        with lock:
            started.append(item)

    def stop(item, outcome):
        raise Stop

    with pytest.raises(Stop):
        executor.map(work, range(100), stop)
    assert 1 <= len(started) < 20  # of 100: those that ran when it was heard


def test_a_dead_worker_process_or_a_machine_without_shared_memory_is_one_clear_line(monkeypatch):
    executor = make_executor(ComputeSettings(backend="processes", workers=1))
    with pytest.raises(IncompleteRunError, match="worker process died"):
        executor.map(die, [1], lambda *_: None)
    monkeypatch.setattr(executor_module._SPAWN, "Lock", Mock(side_effect=PermissionError))
    with pytest.raises(ConfigError, match="use --backend threads"):
        make_executor(ComputeSettings(backend="processes", workers=2)).map(abs, [1], lambda *_: None)


class Interrupted(BaseException):
    """As a signal raises it."""


def note_and_sleep(folder):
    (folder / f"{os.getpid()}-{threading.get_ident()}").touch()
    deadline = time.monotonic() + 20
    while not (folder / "end").exists() and time.monotonic() < deadline:
        time.sleep(0.05)


def pids(folder, n):
    """Return the processes that have begun to work, once there are so many."""
    deadline = time.monotonic() + 60
    while len(found := list(folder.glob("*-*"))) < n and time.monotonic() < deadline:
        time.sleep(0.05)
    return [int(path.name.split("-")[0]) for path in found]


def gone(pid):
    """Return whether a process ends within some seconds."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("backend", ["threads", "processes"])
def test_an_interruption_waits_for_nothing_that_was_begun(tmp_path, backend):
    executor = make_executor(ComputeSettings(backend=backend, workers=2))

    def on_alarm(number, frame):
        if len(list(tmp_path.glob("*-*"))) == 2:
            signal.setitimer(signal.ITIMER_REAL, 0)
            raise Interrupted

    before = signal.signal(signal.SIGALRM, on_alarm)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    start = time.monotonic()
    try:
        with pytest.raises(Interrupted):
            executor.map(note_and_sleep, [tmp_path] * 4, lambda item, outcome: None)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - start < 15
    (tmp_path / "end").touch()
    for thread in threading.enumerate():
        if thread.name.startswith("tile"):
            thread.join()
    assert len(pids(tmp_path, 2)) == 2
    assert backend == "threads" or all(gone(pid) for pid in pids(tmp_path, 2))


def test_worker_processes_end_with_a_parent_that_is_killed(tmp_path):
    code = (
        "import sys; from pathlib import Path; sys.path[:] = eval(sys.argv[2])\n"
        "from test_executor import note_and_sleep\n"
        "from pchem_pipeline.compute.executor import make_executor\n"
        "from pchem_pipeline.compute.settings import ComputeSettings\n"
        "make_executor(ComputeSettings(backend='processes', workers=2)).map(\n"
        "    note_and_sleep, [Path(sys.argv[1])] * 2, lambda item, outcome: None)"
    )
    paths = [str(Path(__file__).parent), *sys.path]
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path), repr(paths)], stderr=subprocess.DEVNULL
    ) as parent:
        workers = pids(tmp_path, 2)
        parent.kill()
    assert len(workers) == 2
    assert all(gone(pid) for pid in workers)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"backend": "distributed", "scheduler": "no/such/file.json"}, "no scheduler at"),
        # as earlier versions started it
        ({"backend": "distributed", "cluster": {"class": "dask_jobqueue.SLURMCluster"}}, "give its address"),
        ({"workers": 0}, "workers"),
    ],
)
def test_settings_without_workers_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        make_executor(ComputeSettings.model_validate(settings))


def test_a_configuration_of_dask_that_is_malformed_is_one_line(tmp_path):
    (tmp_path / "dask.yaml").write_text("a: [b")
    code = (
        "from pchem_pipeline.compute.executor import make_executor\n"
        "from pchem_pipeline.compute.settings import ComputeSettings\n"
        "make_executor(ComputeSettings(backend='threads', workers=2)).map(abs, [-1, 2], lambda *_: None)\n"
        "make_executor(ComputeSettings(backend='distributed'))"
    )
    environment = {**os.environ, "DASK_CONFIG": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    last = found.stderr.strip().splitlines()[-1]
    assert "ConfigError: A dask config file at" in last
    assert str(tmp_path / "dask.yaml") in last
    assert last.endswith("; correct that file")


def take_too_much(number):
    return bytearray(1 << 60)


@pytest.mark.parametrize("backend", BACKENDS[:2])
def test_a_lack_of_memory_is_one_line_with_its_cure(backend):
    executor = make_executor(ComputeSettings(backend=backend, workers=1))
    found = []
    executor.map(take_too_much, [1], lambda item, outcome: found.append(outcome))
    assert isinstance(found[0].error, IncompleteRunError)
    assert str(found[0].error).startswith("out of memory; use fewer --workers, a smaller --max-memory")
    assert "take_too_much" in found[0].trace


def test_workers_are_as_many_as_memory_is_enough_for():
    four = make_executor(ComputeSettings(workers=4, backend="threads"))
    here = resident_bytes()
    assert here > 20 << 20
    assert affordable(four, here + (900 << 20), 100 << 20, "it") is four
    assert affordable(four, here + (250 << 20), 100 << 20, "it").workers == 2
    with pytest.raises(ConfigError, match=r"it needs at least \d+ MiB, compute.max_memory"):
        affordable(four, here + (50 << 20), 100 << 20, "it")
    processes = make_executor(ComputeSettings(workers=4, backend="processes"))
    fewer = affordable(processes, here + 2 * BASE_BYTES + (250 << 20), 100 << 20, "it")
    assert (fewer.workers, fewer.shares_memory) == (2, False)
    keep_to_limit(None)
    with pytest.raises(ConfigError, match="64 MiB, but the program needs"):
        keep_to_limit(64)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_task_beside_is_done_once_and_before_those_behind_it(threads):
    done = []

    def task(number):
        done.append((number, threading.current_thread() is threading.main_thread()))
        return reciprocal(number)

    with beside(threads) as hand:
        half, none = hand(lambda: task(2)), hand(lambda: task(0))
        double = hand(lambda: half() * task(4))  # may ask for what was handed on before
        assert (double(), half(), double()) == (0.125, 0.5, 0.125)
        with pytest.raises(ZeroDivisionError):
            none()
    here = threads == 1
    assert sorted(done) == [(0, here), (2, here), (4, here)]


def test_after_an_error_nothing_more_is_begun_beside():
    done, ready, ended = [], threading.Event(), threading.Event()

    def first():
        deadline = time.monotonic() + 30
        while not second.__self__.cancelled() and time.monotonic() < deadline:
            time.sleep(0.01)
        ended.set()

    with contextlib.suppress(ZeroDivisionError), beside(2) as hand:
        hand(lambda: ready.wait(30) and first())
        second = hand(lambda: done.append(1))
        ready.set()
        reciprocal(0)
    assert ended.is_set()  # what was begun is waited for
    assert done == []
    with beside(1) as hand:  # a single thread does nothing that nobody asks for
        hand(lambda: reciprocal(0))
