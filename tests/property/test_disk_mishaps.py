"""Every write fails once, and the power is cut at every moment: the same command goes on to the same bits."""

import errno
import functools
import re
import threading
from collections import Counter

import numpy as np
import pytest
from helpers.disk_mishaps import FailingDisk, ForgetfulDisk, materialised

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.compute.executor import SerialExecutor
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.run.declaration import Stage
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.signals import StopRequest
from pchem_pipeline.run.stage import WHOLE, Command, StageContext, open_store
from pchem_pipeline.runner import execute as runner
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.store.files import write_json
from pchem_pipeline.store.run_store import RunStore

SENSOR = SensorInfo("frames", 10, 8, 16, "uint16", 14, 4.87, "copy", {})
NUMBERS = [errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EROFS]


def fit_tile(tile, store, *, value):
    store.write("fit/bias", tile.region, np.full(tile.shape, value + tile.ix))


def maps_tile(tile, store):
    bias = store.read("fit/bias", tile.region)
    assert np.isfinite(bias).all()  # a marker stands for what is in the store
    store.write("maps/bias", tile.region, 2 * bias)


def fit_run(context):
    context.create("fit/bias")
    task = functools.partial(fit_tile, value=context.config.fit.gap_threshold)
    context.run_units(context.tiles(), task)


def maps_run(context):
    context.create("maps/bias")
    context.run_units(context.tiles(), maps_tile, needs="fit")


def page_run(context):
    def page(unit, store):
        context.store.write_file("report.html", b"<html>" + context.store.read("maps/bias").tobytes())

    context.run_units([WHOLE], page)


def stage(name, upstream, settings, writes, run):
    return Stage(name, 1, upstream, settings, writes, f"{__name__}:{run.__name__}")


STAGES = {
    "fit": stage("fit", (), ("fit.gap_threshold",), ("fit",), fit_run),
    "maps": stage("maps", ("fit",), (), ("maps",), maps_run),
    "page": stage("page", ("maps",), (), (), page_run),
}


@pytest.fixture(autouse=True)
def stages(monkeypatch):
    monkeypatch.setattr(runner, "STAGES", STAGES)


def run(path, threshold=0.5, forced=""):
    """Bring a run of two tiles and three stages up to date; return its results."""
    open_store.cache_clear()
    content = f"input: {{files: [a]}}\nrun: {{tile: 8}}\nfit: {{gap_threshold: {threshold}}}"
    with RunStore.create(path).locked():
        store = RunStore.open(path, writable=True)
        try:
            known = "sensor" in store.attributes("frames")
        except StoreError:
            known = False
        if not known:
            store.delete("frames")
            SENSOR.write(store)
        write_json(path / "number.json", {"number": threshold})
        executor, reporter = SerialExecutor(), Reporter("off", quiet=True)
        context = StageContext(parse_config(content), path.parent, store, executor, reporter, StopRequest())
        for name in STAGES:
            context.command = Command(force=name == forced)
            state = execute(name, context)
            if state.state == "failed":
                raise StoreError(f"{name}: {state.why}; cure")
        return store.read("fit/bias"), store.read("maps/bias"), (path / "report.html").read_bytes()


def gone_on(path):
    """Return the results of a run after a power cut, and how often a line named the stage to be forced."""
    forced = ""
    for refused in range(5):
        try:
            return run(path, forced=forced), refused
        except StoreError as error:
            words = str(error)
            assert str(path) in words
            forced = re.search(r"run it again: pchem (\w+) \S+ --force", words)[1]
    raise AssertionError(words)


def assert_same(found, expected):
    np.testing.assert_array_equal(found[:2], expected[:2])
    assert found[2] == expected[2]


@pytest.mark.parametrize("step", [11, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("before", [None, 0.25], ids=["new", "over older results"])
def test_every_operation_fails_once(tmp_path, monkeypatch, before, step):
    expected = run(tmp_path / "expected.zarr")
    failing = FailingDisk(monkeypatch)
    if before is not None:
        run(tmp_path / "count.zarr", before)
    failing.fail(None, 0)
    run(tmp_path / "count.zarr")
    total = failing.count
    assert total > 70
    refused = 0
    for at in range(3, total, step):
        path = tmp_path / f"{at}.zarr"
        if before is not None:
            run(path, before)
        failing.fail(at, NUMBERS[at % len(NUMBERS)])
        try:
            run(path)
        except StoreError as error:
            refused, words = refused + 1, str(error)
            assert str(path) in words
            assert ";" in words  # the cure
        failing.fail(None, 0)
        assert_same(run(path), expected)
    assert refused > 0.9 * len(range(3, total, step))


@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("before", [None, 0.25], ids=["new", "over older results"])
def test_a_power_cut_at_any_moment(tmp_path, monkeypatch, before, step):
    expected = run(tmp_path / "expected.zarr")
    old = tmp_path / "run.zarr"
    with monkeypatch.context() as patch:
        forgetful = ForgetfulDisk(patch)
        if before is not None:
            run(old, before)
        start = len(forgetful.log)
        run(old)
    rng = np.random.default_rng(8)
    lost = 0
    for end in range(start, len(forgetful.log) + 1, step):
        left = forgetful.after_power_cut(end, rng)
        found, refused = gone_on(materialised(left, old, tmp_path / "cut.zarr"))
        assert_same(found, expected)
        lost += refused
    assert lost > 0 or step > 1  # chunks are not synced: their loss is found by whoever reads them


def test_readers_while_a_writer_works(tmp_path):
    """Whoever reads meanwhile finds a finished tile whole, or is told in one line that there is nothing."""
    path = tmp_path / "run.zarr"
    run(path)
    seen, wrong, ended = Counter(), [], threading.Event()

    def read():
        while not ended.is_set():
            try:
                store = RunStore.open(path)
                record = store.records.read("maps")
                for key in store.records.done("maps", record.fingerprint) if record else ():
                    column = 8 * int(key.partition(".")[2])
                    tile = np.s_[0:8, column : column + 8]
                    whole = all(np.ptp(store.read(name, tile)) == 0 for name in ("fit/bias", "maps/bias"))
                    seen["whole" if whole else "torn"] += 1
            except StoreError as error:
                seen["refused" if "\n" not in str(error) else "lines"] += 1
            except Exception as error:
                wrong.append(error)

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for i in range(4):
        run(path, 0.25 + 0.25 * (i % 2))
    ended.set()
    for reader in readers:
        reader.join()
    assert wrong == []
    assert seen["whole"] > 5
    assert seen["lines"] == 0
