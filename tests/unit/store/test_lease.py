"""The lock of a run on an object storage: one owner, its signs of life, and how it is taken over."""

import json
import os
import threading
import time

import fsspec
import pytest

from pchem_pipeline.base.errors import LockedError, StoreError
from pchem_pipeline.store import lease
from pchem_pipeline.store.lease import leased
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield place_of("memory://lab/night.zarr")
    fsspec.filesystem("memory").store.clear()


@pytest.fixture
def lock(run):
    return run / ".pchem" / "lock.json"


def other(lock, **changes):
    """Put the lock of another machine."""
    lock.write_bytes(
        json.dumps({"token": "x", "host": "far", "machine": "far 1", "pid": 7, **changes}).encode()
    )


def test_the_lock_is_there_while_it_is_held(run, lock):
    with leased(lock, run):
        held = json.loads(lock.read_bytes())
        assert held["pid"] == os.getpid()
        with pytest.raises(LockedError, match="last sign of life"), leased(lock, run):
            pass
        assert json.loads(lock.read_bytes()) == held
    assert not lock.exists()


def test_another_machine_has_it(run, lock):
    store = RunStore.create(run)
    other(lock)
    with (
        pytest.raises(
            LockedError, match=r"in use by pchem on far \(process 7, last sign.*remove memory://.*lock"
        ),
        store.locked(),
    ):
        pass
    lock.unlink()  # what the message says
    with store.locked():
        pass


def test_of_ten_that_come_at_once_one_gets_it(run, lock):
    got, refused, start = [], [], threading.Barrier(10)

    def come():
        start.wait()
        try:
            with leased(lock, run):
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


def test_a_lock_without_signs_of_life_is_taken_over(run, lock, monkeypatch):
    other(lock)
    monkeypatch.setattr(lease, "LEFT_BEHIND", -1.0)
    with leased(lock, run):
        assert json.loads(lock.read_bytes())["pid"] == os.getpid()


def test_a_killed_process_of_this_machine_leaves_no_lock(run, lock):
    child = os.spawnlp(os.P_WAIT, "true", "true")
    assert child == 0
    gone = os.posix_spawnp("true", ["true"], os.environ)
    os.waitpid(gone, 0)
    other(lock, machine=lease._machine(), pid=gone)
    with leased(lock, run):
        pass
    other(lock, machine=lease._machine(), pid=os.getpid())
    with pytest.raises(LockedError), leased(lock, run):
        pass


@pytest.mark.parametrize("content", [b"", b"\0", b"[]", b"{}", b'{"pid": "x"}'])
def test_a_damaged_lock_is_a_lock(run, lock, content):
    lock.write_bytes(content)
    with pytest.raises(LockedError, match="in use by pchem on another machine"), leased(lock, run):
        pass


def test_who_lost_the_lock_marks_nothing_more(run, lock, monkeypatch):
    monkeypatch.setattr(lease, "BEAT", 0.02)
    store = RunStore.create(run)
    with store.locked():
        store.records.mark("fit", "f" * 64, "0.0", {})
        first = json.loads(lock.read_bytes())
        other(lock)
        deadline = time.monotonic() + 10
        while not lease._HELD[str(run)].lost and time.monotonic() < deadline:
            other(lock)
            time.sleep(0.01)
        with pytest.raises(LockedError, match="has taken over this run"):
            store.records.mark("fit", "f" * 64, "0.1", {})
    assert first["token"] != "x"
    assert json.loads(lock.read_bytes())["token"] == "x"  # it is not ours to remove
    assert store.records.done("fit", "f" * 64) == {"0.0"}


def test_a_server_that_knows_no_conditions(run, lock, monkeypatch):
    storage = type(lock.storage)
    plain = storage.pipe_file

    def pipe_file(self, path, value, mode="overwrite", **more):
        if mode == "create":
            raise OSError("A header you provided implies functionality that is NotImplemented")
        plain(self, path, value, **more)

    monkeypatch.setattr(storage, "pipe_file", pipe_file)
    with leased(lock, run), pytest.raises(LockedError), leased(lock, run):
        pass


def test_what_only_a_disk_can_do_is_one_line(run):
    for name in ("stat", "open", "rename", "touch", "rglob"):
        with pytest.raises(StoreError, match=f"an object storage cannot do that .{name}.; use a store on a"):
            getattr(run, name)()
        assert not hasattr(run, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = run.nothing
