"""The ingest stage: copy and reference, resume, identity, histograms, bad input."""

import os
import shutil

import numpy as np
import pytest
import tifffile
from helpers.stage_runs import stage_context
from hypothesis import given
from hypothesis import strategies as st

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run import input as run_input
from pchem_pipeline.run.fingerprint import status
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.signals import InterruptedRunError, StopRequest
from pchem_pipeline.run.stage import Command, open_store
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages import ingest
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore

STACK = np.random.default_rng(16).integers(0, 4096, (40, 30, 26)).astype(np.uint16)


@pytest.fixture
def small_chunks(monkeypatch):
    """Make many units of a small stack."""
    monkeypatch.setattr(ingest, "_CHUNK", (16, 8, 8))
    monkeypatch.setattr(ingest, "_UNIT_BYTES", 16 * 8 * 26 * 2)


def make_context(folder, *, executor=None, command=None, stop=None, **settings):
    content = {"files": ["cam"], "mode": "copy", **settings}
    return stage_context(folder, executor, command, stop, input=content)


def run(context):
    return execute("ingest", context)


def state_of(context):
    return status(STAGES["ingest"], context)


def assert_copied(context):
    np.testing.assert_array_equal(context.store.read("frames/dn"), STACK)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "cam").mkdir()
    for i, part in enumerate(np.split(STACK, 4), 8):
        tifffile.imwrite(tmp_path / "cam" / f"f{i}.tif", part, photometric="minisblack")
    return tmp_path


@pytest.mark.parametrize("backend", ["serial", "threads"])
def test_copy(folder, small_chunks, backend):
    executor = make_executor(ComputeSettings(backend=backend, workers=2))
    # tiles of the command line do not cut the input
    given = {"executor": executor, "command": Command(roi=(0, 1, 0, 1))}
    context = make_context(folder, **given, integration_time=4.87, bit_depth=12)
    assert run(context).state == "complete"
    array = context.store.array("frames/dn")
    assert array.chunks == (16, 8, 8)
    assert array.metadata.dimension_names == ("frame", "y", "x")
    assert_copied(context)
    sensor = SensorInfo.read(context.store)
    assert (sensor.kind, sensor.n_frames, sensor.shape, sensor.dtype) == ("frames", 40, (30, 26), "uint16")
    assert (sensor.bit_depth, sensor.integration_time, sensor.mode) == (12, None, "copy")
    assert sensor.identity["n_files"] == 4
    assert [file["name"] for file in sensor.identity["files"]] == ["f8.tif", "f9.tif", "f10.tif", "f11.tif"]
    assert state_of(context).done == 3 * 4
    assert run(context).state == "complete"


def test_reference_copies_nothing(folder):
    context = make_context(folder, mode="reference")
    assert context.config.input.mode == InputSettings().mode
    assert run(context).state == "complete"
    assert not context.store.has("frames/dn")
    assert context.sensor.mode == "reference"
    assert (context.sensor.n_frames, context.sensor.shape) == (40, (30, 26))
    assert open_source(context).shape == STACK.shape
    place = folder / "cam" / "f9.tif"
    os.utime(place, ns=(0, 0))
    assert open_source(context).shape == STACK.shape
    tifffile.imwrite(place, STACK[10:20] ^ 1, photometric="minisblack")  # other frames of the same shape
    with pytest.raises(InputError, match=r"files changed since they were ingested .*; run: pchem"):
        open_source(context)


def test_stop_and_resume(folder, small_chunks, monkeypatch):
    stop, done = StopRequest(), []
    real = ingest._copy

    def copy(unit, store, **rest):
        done.append(unit.key)
        if len(done) == 5:
            stop.signal = 2
        real(unit, store, **rest)

    monkeypatch.setattr(ingest, "_copy", copy)
    with pytest.raises(InterruptedRunError):
        run(make_context(folder, stop=stop))
    open_store.cache_clear()
    context = make_context(folder)
    assert state_of(context).words().startswith("partial 5 of 12")
    assert run(context).state == "complete"
    assert len(done) == len(set(done)) == 12
    assert_copied(context)


def test_identity_is_hashed_once(folder, monkeypatch):
    hashed: list[list[str]] = []
    real = run_input.content_identity

    def content(paths, advance):
        hashed.append([path.name for path in paths])
        return real(paths, advance)

    monkeypatch.setattr(run_input, "content_identity", content)
    run(make_context(folder))
    assert len(hashed) == 1
    again = make_context(folder)
    assert state_of(again).state == "complete"
    assert len(hashed) == 1
    # another time of change, the same content: hashed again, still complete
    os.utime(folder / "cam" / "f9.tif", ns=(5, 5))
    assert state_of(make_context(folder)).state == "complete"
    assert len(hashed) == 2
    # other content: stale, and why
    changed = STACK[:10].copy()
    changed[0, 0, 0] ^= 1
    tifffile.imwrite(folder / "cam" / "f8.tif", changed, photometric="minisblack")
    state = state_of(make_context(folder))
    assert (state.state, state.why) == ("stale", "the input has changed")
    context = make_context(folder)
    assert run(context).state == "complete"
    assert context.store.read("frames/dn", (slice(0, 1), slice(0, 1), slice(0, 1))).item() == changed[0, 0, 0]


def test_moved_and_renamed_input_is_the_same_and_one_that_is_gone_leaves_the_copy_valid(folder):
    run(make_context(folder))
    shutil.move(folder / "cam", folder / "elsewhere")
    for i in range(8, 12):
        (folder / "elsewhere" / f"f{i}.tif").rename(folder / "elsewhere" / f"dark{i}.tif")
    assert state_of(make_context(folder, files=["elsewhere/*.tif"])).state == "complete"
    shutil.rmtree(folder / "elsewhere")
    context = make_context(folder)
    assert run(context).state == "complete"
    assert_copied(context)
    # but another, mistyped name is a mistake
    with pytest.raises(InputError, match="no such file or folder"):
        run(make_context(folder, files=["camm"]))


def test_which_settings_make_it_stale(folder):
    run(make_context(folder))
    for key, value, stale in (
        ("roi", (0, 10, 0, 10), True),
        ("mode", "reference", True),
        ("bit_depth", 12, True),
        ("frame_range", (0, 20), True),
        ("integration_time", 3.0, False),
        ("files", ["cam/*.tif"], False),
    ):
        state = state_of(make_context(folder, **{key: value}))
        assert state.state == ("stale" if stale else "complete"), key
        assert (f"input.{key}" in state.why) == stale


def test_stated_time_is_kept_apart_from_the_configured_one(tmp_path):
    (tmp_path / "cam").mkdir()
    tifffile.imwrite(
        tmp_path / "cam" / "a.tif", STACK, photometric="minisblack", metadata={"integration_time": 4.87}
    )
    context = make_context(tmp_path)
    run(context)
    assert context.sensor.integration_time == 4.87
    configured = make_context(tmp_path, integration_time=2.0)
    run(configured)
    assert SensorInfo.read(configured.store).integration_time == 4.87
    assert configured.sensor.integration_time == 2.0


def test_sidecar_belongs_to_the_content(tmp_path):
    (tmp_path / "cam").mkdir()
    (tmp_path / "cam" / "a.raw").write_bytes(STACK.tobytes())
    side = tmp_path / "cam" / "a.raw.json"
    side.write_text('{"shape": [30, 26], "dtype": "uint16"}')
    run(make_context(tmp_path))
    side.write_text('{"shape": [26, 30], "dtype": "uint16"}')
    context = make_context(tmp_path)
    assert state_of(context).state == "stale"
    run(context)
    np.testing.assert_array_equal(context.store.read("frames/dn"), STACK.reshape(40, 26, 30))


@given(
    n=st.integers(2, 40_000),
    ny=st.integers(1, 9000),
    nx=st.integers(1, 9000),
    itemsize=st.sampled_from([1, 2, 4]),
)
def test_units_are_whole_chunks_within_memory(n, ny, nx, itemsize):
    shape = (n, ny, nx)
    chunk = ingest.chunk_shape(shape, itemsize)
    units = ingest.copy_units(shape, itemsize, chunk)
    t = y = 0
    for number, unit in enumerate(units):
        t0, t1, y0, y1 = unit.content
        assert (t0, y0) == (t, y)
        assert t0 % chunk[0] == y0 % chunk[1] == 0
        assert t1 == n or t1 % chunk[0] == 0
        assert y1 == ny or y1 % chunk[1] == 0
        assert (t1 - t0) * (y1 - y0) * nx * itemsize <= 128 << 20
        t, y = (t0, y1) if y1 < ny else (t1, 0)
        if number > 200:
            return
    assert (t, y) == (n, 0)


def test_chunks_share_files_on_a_large_sensor_and_a_small_disk_is_told(folder, monkeypatch):
    monkeypatch.setattr(ingest, "_CHUNK", (16, 8, 8))
    monkeypatch.setattr(ingest, "_MANY_FILES", 24)
    monkeypatch.setattr(RunStore, "free_bytes", lambda self: 1000)
    context = make_context(folder)
    run(context)
    assert any("set input.mode: reference" in note for note in context.notes)  # the disk is small
    array = context.store.array("frames/dn")
    assert (array.chunks, array.shards) == ((16, 8, 8), (16, 8, 16))
    assert_copied(context)
    np.testing.assert_array_equal(
        open_store(context.store.path).read("frames/dn")[:, 3:9, 5:20], STACK[:, 3:9, 5:20]
    )
    files = list((context.store.path / "frames" / "dn").rglob("c/*/*/*"))
    assert len(files) == 3 * 4 * 2


@given(n=st.integers(2, 20_000), ny=st.integers(1, 9000), nx=st.integers(1, 9000))
def test_no_stack_has_many_files_that_could_be_fewer(n, ny, nx):
    chunk = ingest.chunk_shape((n, ny, nx), 2)
    shard = ingest.shard_shape((n, ny, nx), chunk) or chunk
    files = -(-n // shard[0]) * -(-ny // shard[1]) * -(-nx // shard[2])
    assert files <= 1500 or shard[2] >= nx
    assert shard[:2] == chunk[:2]
    assert shard[2] % chunk[2] == 0


def test_a_run_keeps_the_tiles_that_it_has(folder):
    context = make_context(folder)
    run(context)
    assert context.tile == (64, 64)
    content = {"settings": {"run.tile": [8, 16]}}
    context.store.records.write(StageRecord("histogram", 1, "f", content))
    assert context.tile == (8, 16)
    assert context.tiles()[-1].key == "3.1"
