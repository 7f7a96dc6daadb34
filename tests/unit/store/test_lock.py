"""The lock of a run: one owner at a time, and how it is freed on an object storage."""

import json
import os
import subprocess
import threading
import time

import fsspec
import pytest

from pchem_pipeline.base.errors import LockedError, StoreError
from pchem_pipeline.store import lock as locks
from pchem_pipeline.store.lock import is_locked
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture
def run():
    yield place_of("memory://lab/night.zarr")
    fsspec.filesystem("memory").store.clear()


@pytest.fixture
def lock(run):
    return run / ".pchem" / "lock.json"


def locked(run):
    return locks.locked(run, run / ".pchem")


def other(**changes):
    """Return the lock of another machine, which was made long ago by its clock."""
    held = {"host": "far", "machine": "far 1", "pid": 7, "time": "2020-01-01T00:00:00+00:00", **changes}
    return json.dumps(held).encode()


def test_the_lock_is_there_while_it_is_held(run, lock):
    with locked(run):
        held = json.loads(lock.read_bytes())
        assert held["pid"] == os.getpid()
        assert is_locked(run, run / ".pchem")
        with pytest.raises(LockedError, match="in use by pchem on"), locked(run):
            pass
        assert json.loads(lock.read_bytes()) == held
    assert not lock.exists()
    assert not is_locked(run, run / ".pchem")


@pytest.mark.parametrize("content", [other(), b"", b"\0", b"[]", b'"x"'])
def test_another_machine_has_it_or_nobody_knows(run, lock, content):
    """No clock frees it; the line that the message has does."""
    store = RunStore.create(run)
    lock.write_bytes(content)
    words = "on far .process 7, since 2020" if content == other() else "its lock memory://.* is damaged"
    with pytest.raises(LockedError, match=words) as refused, store.locked():
        pass
    exec(str(refused.value).partition('python -c "')[2].rpartition('"')[0])
    with store.locked():
        pass


def test_of_ten_that_come_at_once_one_gets_it(run, lock):
    got, refused, start = [], [], threading.Barrier(10)

    def come():
        start.wait()
        try:
            with locked(run):
                got.append(1)
                time.sleep(0.5)
        except LockedError:
            refused.append(1)

    threads = [threading.Thread(target=come) for _ in range(10)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(got), len(refused)) == (1, 9)


def test_a_killed_process_of_this_machine_leaves_no_lock(run, lock):
    gone = subprocess.Popen(["true"])
    gone.wait()
    lock.write_bytes(other(machine=locks._machine(), pid=gone.pid))
    with locked(run):
        pass
    lock.write_bytes(other(machine=locks._machine(), pid=os.getpid()))
    with pytest.raises(LockedError), locked(run):
        pass


def test_a_server_that_knows_no_conditions(run, lock, monkeypatch):
    storage = type(lock.storage)
    plain = storage.pipe_file

    def pipe_file(self, path, value, mode="overwrite", **more):
        if mode == "create":
            raise OSError("A header you provided implies functionality that is NotImplemented")
        plain(self, path, value, **more)

    monkeypatch.setattr(storage, "pipe_file", pipe_file)
    with locked(run), pytest.raises(LockedError), locked(run):
        pass


def test_what_only_a_disk_can_do_is_one_line(run):
    for name in ("stat", "open", "rename", "touch", "rglob"):
        with pytest.raises(StoreError, match=f"not possible in an object storage .{name}.; use a store on a"):
            getattr(run, name)()
        assert not hasattr(run, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = run.nothing
