"""What a run says while it works: bars on terminals, JSON lines, and a file for ``pchem status``."""

import json
import os
import time
from pathlib import Path

import pytest

from pchem_pipeline.base import kernel_cache
from pchem_pipeline.commands.watch import rows
from pchem_pipeline.run import progress
from pchem_pipeline.run.fingerprint import StageState
from pchem_pipeline.run.progress import (
    ProgressFile,
    Reporter,
    paced,
    parts_told,
    read_progress,
    telling_parts,
)
from pchem_pipeline.store.run_store import RunStore


def test_rate_and_remaining_time_are_means_of_this_run(capsys):
    pace = paced("fit", "tile", done=30, total=64, new=10, seconds=5.0)
    assert (pace["rate"], pace["remaining"]) == (2.0, 17.0)
    assert paced("fit", "tile", done=20, total=64, new=0, seconds=0.1)["remaining"] is None
    reporter = Reporter("on")
    with reporter.progress("fit", 3, "tile") as advance:
        advance()
    shown = capsys.readouterr().err
    assert "fit:   0%" in shown
    assert "0/3 [00:00<?, ? tile/s]" in shown


@pytest.fixture
def reporter(tmp_path):
    return Reporter("off", quiet=True, log=tmp_path / "run.log")


def logged(folder, reporter):
    reporter.close()
    return [json.loads(line) for line in (folder / "run.log").read_text().splitlines()]


def test_json_lines_tell_the_pace(tmp_path, reporter):
    with reporter.progress("fit", 4, "tile", done=1) as advance:
        for _ in range(3):
            advance()
    with reporter.progress("report", 1, hidden=True) as advance:
        advance()
    events = logged(tmp_path, reporter)
    assert {event["stage"] for event in events} == {"fit"}
    first, last = events[0], events[-1]
    assert (first["done"], first["rate"], first["remaining"]) == (1, None, None)
    assert (last["done"], last["total"], last["unit"], last["remaining"]) == (4, 4, "tile", 0.0)
    assert last["rate"] > 100


def test_a_bar_moves_within_a_unit(tmp_path, reporter, monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr("pchem_pipeline.run.progress.time.monotonic", lambda: 2.0 * next(clock))
    with reporter.progress("fit", 1, "tile") as advance, telling_parts(advance):
        assert list(parts_told("abc")) == ["a", "b", "c"]
    assert list(parts_told("abc")) == ["a", "b", "c"]  # nobody listens
    events = logged(tmp_path, reporter)
    assert [event["done"] for event in events] == [0, 0.33, 0.67, 1]
    assert events[1]["remaining"] > 0


def test_the_time_of_compiling_is_no_part_of_the_rate(tmp_path, reporter):
    with reporter.compilation("fit"), reporter.progress("fit", 1000, "tile") as advance:
        heard(("one", None), ("one", 1e4))
        for _ in range(1000):
            advance()
    rates = [event["rate"] for event in logged(tmp_path, reporter) if event["event"] == "progress"]
    assert rates[-1] == pytest.approx(1e6)


def test_phases_are_named_and_named_again_where_nothing_else_is_heard(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pchem_pipeline.run.progress._SILENCE", 0.5)
    run = RunStore.create(tmp_path / "run.zarr")
    store = run.path
    reporter = Reporter("off", log=tmp_path / "run.log", progress_file=ProgressFile(store))
    with run.locked(), reporter.phases("discrepancy") as tell:
        tell("drawing the fitted model")
        tell("comparing candidates")
        time.sleep(1.6)
        assert read_progress(store)["stage"] == "discrepancy: comparing candidates"
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["discrepancy: drawing the fitted model", "discrepancy: comparing candidates"]
    assert lines[2:]
    assert all(line.startswith("discrepancy: comparing candidates, ") for line in lines[2:])
    assert lines[-1].endswith(" s so far")
    assert [event["event"] for event in logged(tmp_path, reporter)[:3]] == ["phase", "phase", "still"]


def test_others_see_how_far_it_is_until_it_ends(tmp_path):
    run = RunStore.create(tmp_path / "run.zarr")
    store = run.path
    assert read_progress(store) is None
    reporter = Reporter("off", quiet=True, progress_file=ProgressFile(store))
    with run.locked(), reporter.progress("fit", 2) as advance:
        advance()
        advance()
        seen = read_progress(store)
        assert (seen["stage"], seen["done"], seen["total"], seen["pid"]) == ("fit", 2, 2, os.getpid())
    ProgressFile(store).remove()  # not its own file
    assert (store / ".pchem" / "progress.json").exists()
    assert read_progress(store) is None  # nobody works on it any more
    reporter.close()
    assert [path.name for path in (store / ".pchem").iterdir()] == ["lock"]


def test_what_a_killed_process_left_or_a_hand_wrote_does_not_get_through(tmp_path):
    """The lock decides, not a number of a process, which another one may have by now."""
    store = RunStore.create(tmp_path / "run.zarr")
    place = store.path / ".pchem" / "progress.json"
    left = {"stage": "fit", "pid": os.getpid(), "host": "another machine"}
    place.parent.mkdir()
    place.write_text(json.dumps(left))
    assert read_progress(store.path) is None
    with store.locked():
        assert read_progress(store.path) == left
        for text in ("", "[1]", "{", "3"):
            place.write_text(text)
            assert read_progress(store.path) is None
    content = {"stage": "fit\x1b[2J\x07: now", "unit": ["tile"], "done": "5", "total": None, "more": 1}
    content |= {"rate": float("nan"), "remaining": -3, "elapsed": 1e300}
    with store.locked():
        place.write_text(json.dumps(content))
        seen = read_progress(store.path)
    assert seen.keys() == {"stage"}
    assert seen["stage"].isprintable()
    told = rows([StageState("fit", "partial")], {"stage": "fit: now", "rate": 2.0})
    assert told == ["fit         running (now)"]


def test_a_folder_or_a_log_that_cannot_be_written_stops_nothing(tmp_path, capsys):
    (tmp_path / "file").touch()
    ProgressFile(tmp_path / "file").show({"stage": "fit"})
    ProgressFile(tmp_path / "file").remove()
    reporter = Reporter("off", log=Path("/dev/full"))
    reporter.event("start")
    reporter.event("end")
    reporter.close()
    assert capsys.readouterr().err.count("warning: --log-json: no further events written: No space") == 1


def heard(*calls):
    """Call the listeners of kernels that begin (None) or are compiled."""
    for kernel, seconds in calls:
        for listener in kernel_cache._listeners:
            listener(kernel, seconds)


def test_the_terminal_says_what_is_compiled(tmp_path, capsys, monkeypatch):
    def said(*calls, memory=None):
        with Reporter("off").compilation("maps", memory):
            heard(*calls)
        return capsys.readouterr().err.splitlines()

    one, two = (("one", None), ("one", 1.0)), (("two", None), ("two", 3.0))
    monkeypatch.setattr(progress, "cache_folder", lambda: tmp_path)
    assert said() == []
    assert said(*one, *two) == [
        "maps: compiling kernels (once after an installation or update)",
        "maps: 2 kernels compiled in 4 s",
    ]
    much = "490 MiB, more than compute.max_memory (--max-memory) allows (400 MiB)"
    assert much in said(*one, memory=400)[1]
    monkeypatch.setattr(progress, "cache_folder", lambda: Path("/proc/nowhere"))
    assert said(*one, memory=600)[1:] == [
        "maps: 1 kernel compiled in 1 s",
        "warning: maps: /proc/nowhere is not writable, so every command compiles its kernels again; set "
        "NUMBA_CACHE_DIR to another folder",
    ]
