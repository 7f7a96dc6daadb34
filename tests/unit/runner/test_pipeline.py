"""The driver of the stages, with small stages of our own."""

import contextlib
import errno
import functools
import json
import re
import signal
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from helpers.commands import sigint

from pchem_pipeline.base.errors import ConfigError, InputError, LockedError, StoreError
from pchem_pipeline.compute.executor import SerialExecutor
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.run.declaration import Stage
from pchem_pipeline.run.fingerprint import differences, status
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.signals import InterruptedRunError, StopRequest, stop_on_signals
from pchem_pipeline.run.stage import WHOLE, Command, StageContext, open_store
from pchem_pipeline.runner import execute as runner
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.runner.session import nothing_left_of_a_refusal
from pchem_pipeline.store.run_store import RunStore

CALLS: list[str] = []
BROKEN: set[str] = set()


def number_tile(tile, store, *, value):
    CALLS.append(tile.key)
    if tile.key in BROKEN:
        raise ValueError("this tile is odd")
    store.write("fit/bias", tile.region, np.full(tile.shape, value + tile.iy))
    return {"iy": tile.iy}


def double_tile(tile, store):
    store.write("maps/bias", tile.region, 2 * store.read("fit/bias", tile.region))


def fit_run(context):
    context.create("fit/bias")
    task = functools.partial(number_tile, value=context.config.fit.gap_threshold)
    context.run_units(context.tiles(), task)


def maps_run(context):
    context.create("maps/bias")
    context.run_units(context.tiles(), double_tile, needs="fit")


def ensemble_run(context):
    context.run_units([WHOLE], lambda unit, store: {"sum": 1})


def stage(name, upstream, settings, writes, run):
    return Stage(name, 1, upstream, settings, writes, f"{__name__}:{run.__name__}")


FAKES = {
    "fit": stage("fit", (), ("fit.gap_threshold",), ("fit",), fit_run),
    "maps": stage("maps", ("fit",), (), ("maps",), maps_run),
    "ensemble": stage("ensemble", ("maps",), (), (), ensemble_run),
}


@pytest.fixture
def make(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "STAGES", FAKES)
    CALLS.clear()
    BROKEN.clear()
    open_store.cache_clear()
    store = RunStore.create(tmp_path / "run.zarr")
    SensorInfo("frames", 10, 20, 30, "uint16", 14, 4.87, "copy", {}).write(store)

    reporter = Reporter("off", quiet=True, log=tmp_path / "log.jsonl")

    def context(config="", **options):
        found = parse_config(f"input: {{files: [a]}}\nrun: {{tile: 8}}\n{config}")
        command = Command(**options)
        return StageContext(found, tmp_path, store, SerialExecutor(), reporter, StopRequest(), command)

    yield context
    reporter.close()


def test_a_second_run_does_nothing_nor_does_a_setting_that_no_stage_reads(make):
    for config in ("", "", "compute: {workers: 7}"):
        context = make(config)
        assert execute("fit", context).state == "complete"
        assert len(CALLS) == 12
    # the record keeps what was used
    record = context.store.records.read("fit")
    assert record.content["settings"] == {"fit.gap_threshold": 5.0}
    assert record.versions["numpy"] == np.__version__
    assert min(record.seconds, record.peak_rss_bytes) > 0
    assert str(context.store.path) not in json.dumps(record.content)


def test_what_a_hand_took_out_of_the_store_is_made_again(make, monkeypatch):
    """`maps` was up to date, and what reads them sent to `maps`."""
    context = make()
    execute("fit", context)
    execute("maps", context)
    context.store.delete("maps")
    assert status(FAKES["maps"], context).words() == "stale - maps is missing in the store"
    assert execute("maps", context).state == "complete"
    assert context.store.read("maps/bias").shape == (20, 30)
    # one that may write nothing is stale without what it wrote, and complete where it wrote nothing
    context.store.delete("maps")
    monkeypatch.setitem(FAKES, "maps", replace(FAKES["maps"], may_write_nothing=True))
    assert status(FAKES["maps"], context).words() == "stale - maps/zarr.json is missing or has changed"
    (context.store.path / "maps").mkdir()  # nor with another description than was written
    (context.store.path / "maps/zarr.json").write_text('{"zarr_format": 3')
    assert "maps/zarr.json is damaged" in status(FAKES["maps"], context).words()
    context.store.delete("maps")
    record = context.store.records.read("maps")
    context.store.records.write(replace(record, files={}))
    assert status(FAKES["maps"], context).state == "complete"


def test_a_changed_setting_redoes_the_stages_that_read_it(make):
    with pytest.raises(StoreError, match="maps needs fit first; run: pchem fit"):
        execute("maps", make())
    execute("fit", make())
    execute("maps", make())
    changed = make("fit: {gap_threshold: 7}")
    state = status(FAKES["fit"], changed)
    assert state.words() == "stale - fit.gap_threshold 5.0 -> 7.0"
    execute("fit", changed)
    assert status(FAKES["maps"], changed).words() == "stale - new fit"
    execute("maps", changed)
    assert changed.store.read("maps/bias")[0, 0] == 14


class Elsewhere(SerialExecutor):
    """Works as other processes would; the first unit hangs, and is kept for later."""

    shares_memory = False

    def __init__(self):
        self.hanging = None

    def map(self, function, items, on_result):
        first, *rest = items
        self.hanging = functools.partial(function, first)
        super().map(function, rest, on_result)


def test_a_worker_that_wakes_after_another_run_writes_nothing(make):
    context = make()
    context.executor = Elsewhere()
    execute("fit", context)
    assert np.isnan(context.store.read("fit/bias")[0, 0])  # it hangs
    changed = make("fit: {gap_threshold: 7}")
    changed.executor = other = Elsewhere()
    execute("fit", changed)
    with pytest.raises(LockedError, match="has taken over"):
        context.executor.hanging()
    assert np.isnan(context.store.read("fit/bias")[0, 0])
    assert not context.store.records.done("fit", context.fingerprint)
    other.hanging()  # nobody came after this one
    assert context.store.read("fit/bias")[0, 0] == 7
    assert len(changed.store.records.done("fit", changed.fingerprint)) == 12
    context.store.write("fit/bias", (slice(0, 8), slice(0, 8)), np.zeros((8, 8)))  # this thread has no turn


def test_one_bad_tile_stops_nothing_and_is_retried(make):
    BROKEN.add("1.2")
    context = make()
    state = execute("fit", context)
    assert state.state == "failed"
    assert "first 1.2: ValueError: this tile is odd" in state.why
    assert status(FAKES["fit"], context).words().startswith("partial 11 of 12 - 1 failed")
    assert np.isnan(context.store.read("fit/bias")[8, 16])
    maps = make()
    assert execute("maps", maps).state == "failed"
    assert re.fullmatch(r"stage fit of \S+ is not finished", maps.failed["1.2"])
    BROKEN.clear()
    CALLS.clear()
    assert execute("fit", make()).state == "complete"
    assert CALLS == ["1.2"]
    assert execute("maps", make()).state == "complete"
    assert np.isfinite(context.store.read("maps/bias")).all()
    assert status(FAKES["maps"], make()).state == "complete"


def test_an_undivided_stage_starts_again_when_upstream_grew(make):
    BROKEN.add("0.0")
    for name in FAKES:
        execute(name, make())
    assert status(FAKES["ensemble"], make()).state == "complete"
    BROKEN.clear()
    execute("fit", make())
    execute("maps", make())
    assert status(FAKES["ensemble"], make()).words() == "stale - new maps"


def test_tiles_of_a_new_stage_leave_it_partial_and_redo_a_part_only_with_force(make):
    assert execute("fit", make(roi=(0, 1, 0, 1))).words() == "partial 1 of 12"
    assert execute("fit", make()).state == "complete"
    CALLS.clear()
    assert execute("fit", make(roi=(0, 3, 0, 9))).state == "complete"
    assert CALLS == []
    execute("fit", make(roi=(0, 3, 0, 9), force=True))
    assert CALLS == ["0.0", "0.1"]
    execute("fit", make(force=True))
    assert len(CALLS) == 2 + 12
    with pytest.raises(ConfigError):  # even where nothing is to be done
        execute("fit", make(roi=(0, 9, 90, 99)))


def test_changes_of_the_input_are_said_in_words():
    def told(name, *values):
        same = {"version": 1, "settings": {}, "upstream": {}}
        return differences(*({**same, "input": {name: value}} for value in values))

    assert told("integration_time", 4.87, 5.0) == ["input.integration_time 4.87 -> 5.0"]
    assert told("content", "ab", "cd") == ["the input has changed"]


@pytest.mark.parametrize(
    ("heard", "number", "words"),
    [
        (3, signal.SIGTERM, "partial 3 of 12"),
        # between the last unit and the end of a stage it must not leave it complete
        (12, signal.SIGINT, "partial 12 of 12 - interrupted"),
    ],
)
def test_a_signal_stops_behind_a_unit_and_the_rest_is_done_later(make, heard, number, words):
    context = make()

    class Interrupting(SerialExecutor):
        def map(self, function, items, on_result):
            assert context.store.records.read("fit").keys == 12  # the total is known while it runs

            def hear(item, outcome):
                if len(CALLS) == heard:
                    context.stop.signal = number
                on_result(item, outcome)

            super().map(function, items, hear)

    context.executor = Interrupting()
    with pytest.raises(InterruptedRunError, match=f"stopped by {number.name}") as caught:
        execute("fit", context)
    assert caught.value.exit_code == 128 + number
    assert status(FAKES["fit"], make()).words() == words
    CALLS.clear()
    assert execute("fit", make()).state == "complete"
    assert len(CALLS) == 12 - heard


def test_a_stage_stopped_before_its_first_unit_starts_anew(make, monkeypatch):
    """It may have made some of its arrays only."""
    execute("fit", make())
    context = make("fit: {gap_threshold: 9}")
    context.stop.signal = signal.SIGTERM
    monkeypatch.setattr(context, "create", lambda name: context.stop.check())
    with pytest.raises(InterruptedRunError):
        execute("fit", context)
    # it had not made any, and what was there is not lost
    assert context.store.has("fit/bias")
    assert execute("fit", make()).state == "complete"

    def create_some(name):
        context.begin()
        context.stop.check()

    monkeypatch.setattr(context, "create", create_some)
    with pytest.raises(InterruptedRunError):
        execute("fit", context)
    assert not context.store.has("fit/bias")
    again = make("fit: {gap_threshold: 9}")
    assert execute("fit", again).state == "complete"
    assert again.fresh
    assert again.store.read("fit/bias")[0, 0] == 9


@pytest.mark.parametrize("moment", ["unmark_all", "write", "delete"])
def test_a_stage_killed_while_it_begins_anew_is_still_known(make, moment):
    for name in ("fit", "maps"):
        execute(name, make("fit: {gap_threshold: 3}"))
    owner = RunStore if moment == "delete" else type(make().store.records)
    with patch.object(owner, moment, side_effect=SystemExit), pytest.raises(SystemExit):
        execute("fit", make("fit: {gap_threshold: 7}"))
    assert status(FAKES["fit"], make("fit: {gap_threshold: 7}")).state != "missing"
    for name in ("fit", "maps"):
        assert execute(name, make("fit: {gap_threshold: 7}")).state == "complete"
    np.testing.assert_array_equal(make().store.read("maps/bias")[0], 14)


def test_handlers_turn_the_first_signal_into_a_request_but_what_the_shell_ignores_and_are_removed():
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.signal == signal.SIGTERM
        with pytest.raises(InterruptedRunError):
            stop.check()
    assert signal.getsignal(signal.SIGTERM) is before
    with sigint(signal.SIG_IGN), stop_on_signals() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.signal is None
        signal.raise_signal(signal.SIGTERM)
        assert stop.signal == signal.SIGTERM
    with sigint(signal.default_int_handler), stop_on_signals() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.signal == signal.SIGINT


def test_at_once_a_signal_ends_what_guards_against_errors():
    passed = []

    def work(stop, *numbers):
        with stop.at_once(), stop.at_once():
            for number in numbers:
                with contextlib.suppress(Exception):
                    signal.raise_signal(number)
            passed.append(numbers)

    with stop_on_signals() as stop:
        with pytest.raises(InterruptedRunError, match="stopped by SIGTERM"):
            work(stop, signal.SIGTERM)
        with pytest.raises(InterruptedRunError):
            work(stop)  # not begun after the signal
    with stop_on_signals() as stop:
        work(stop)
        signal.raise_signal(signal.SIGTERM)  # behind the block it is only remembered
        assert stop.signal == signal.SIGTERM
    assert passed == [()]


@pytest.mark.parametrize(
    ("raised", "error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), StoreError, "free space"),
        (InputError("frames.raw vanished; put it back"), InputError, "put it back"),
    ],
)
def test_a_full_disk_or_vanished_camera_files_stop_the_run_at_once(make, monkeypatch, raised, error, words):
    def fail(self, name, region, data):
        with self._translated(name):
            raise raised

    monkeypatch.setattr(RunStore, "write", fail)
    with pytest.raises(error, match=words):
        execute("fit", make())
    assert CALLS == ["0.0"]


@pytest.mark.parametrize(("begun", "stays"), [([], False), (["histogram"], True)])
def test_a_store_is_removed_after_a_refusal_only_while_no_stage_has_written(tmp_path, begun, stays):
    def refused():
        with nothing_left_of_a_refusal(tmp_path / "run.zarr"):
            store = RunStore.create(tmp_path / "run.zarr")
            for name in begun:
                store.set_attributes(name, {})
            raise StoreError("the disk is full")

    with pytest.raises(StoreError):
        refused()
    assert (tmp_path / "run.zarr").exists() == stays
