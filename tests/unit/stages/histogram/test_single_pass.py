"""The one pass over the camera files: every byte read once, and the results of the separate stages."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers import layouts
from helpers.commands import arrays_of, assert_equal_arrays
from helpers.drawn_pixels import codes
from helpers.stage_runs import completed, stage_context

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.run.signals import InterruptedRunError, StopRequest
from pchem_pipeline.stages.bands import cut_rows
from pchem_pipeline.stages.histogram import arrays, single_pass

FRAMES, NY, NX = 300, 150, 40


@pytest.fixture(scope="module")
def frames():
    rng = np.random.default_rng(31)
    dn = codes(rng, (FRAMES, NY, NX), 1.5, 11, 0.3, rng.normal(100, 6, (NY, NX))).astype(np.uint16)
    dn[200:, 7, 7] += 900  # a pixel that outgrows its window after the first block
    return dn


def _raw(folder, frames):
    """Big-endian raw frames, left-justified, behind a header, with padding, in two files."""
    for name, part in (("a.raw", frames[:140]), ("b.raw", frames[140:])):
        padded = b"".join((frame << 2).astype(">u2").tobytes() + b"-" * 10 for frame in part)
        (folder / name).write_bytes(b"header" + padded)
        facts = {"shape": [NY, NX], "dtype": "uint16", "byte_order": "big", "header_bytes": 6}
        facts |= {"frame_padding_bytes": 10, "bit_shift": 2}
        (folder / f"{name}.json").write_text(json.dumps(facts))


def _packed(folder, frames):
    a, b = frames.reshape(-1, 2).T
    np.stack([a & 255, a >> 8 | (b & 15) << 4, b >> 4], axis=1).astype(np.uint8).tofile(folder / "a.raw")
    (folder / "a.raw.json").write_text(json.dumps({"shape": [NY, NX], "packing": "Mono12p"}))


WRITERS = {
    "npy": lambda folder, frames: layouts.npy(folder / "a.npy", frames),
    "raw": _raw,
    "raw, packed": _packed,
    "tiff": lambda folder, frames: [
        layouts.tiff(folder / f"f{i}.tif", part) for i, part in enumerate(np.array_split(frames, 5))
    ],
    "zlib": lambda folder, frames: layouts.tiff(
        folder / "f.tif", frames, compression="zlib", rowsperstrip=50
    ),
    "fits": lambda folder, frames: layouts.fits_image(folder / "f.fits", frames),
    "hdf5": lambda folder, frames: layouts.hdf5(
        folder / "f.h5", frames, chunks=(10, NY, NX), compression="gzip"
    ),
}
#: suffixes of the files, without the sidecars
SUFFIXES = (".npy", ".raw", ".tif", ".fits", ".h5")


def make_context(folder, store, *, workers=2, **sections):
    files = sorted(str(path) for path in folder.iterdir() if path.suffix in SUFFIXES)
    content = {"input": {"files": files, "mode": "reference"}, "compute": {"workers": workers}}
    content |= {"histogram": {"block_frames": 96, "window_frames": 64}, "run": {"store": store}}
    content = {name: values | sections.get(name, {}) for name, values in content.items()}
    return stage_context(folder, make_executor(ComputeSettings(**content["compute"])), **content)


def run_both(context):
    return completed(context, "ingest", "histogram")


def compare(folder, **sections):
    """Run both ways and compare everything that they leave."""
    apart = run_both(make_context(folder, "apart.zarr", **sections))
    once = make_context(folder, "once.zarr", **sections)
    single_pass.count_in_one_pass(once)
    assert set(once.prepared.stages) == {"ingest", "histogram"}
    run_both(once)
    groups = ("frames", "histogram", "summary")
    expected, found = (arrays_of(context.store.path, groups) for context in (apart, once))
    assert_equal_arrays(found, expected)
    for name in expected:
        assert once.store.array(name).chunks == apart.store.array(name).chunks
    assert once.sensor == apart.sensor
    for stage in ("ingest", "histogram"):
        left, right = apart.store.records.read(stage), once.store.records.read(stage)
        assert (left.fingerprint, left.content, left.notes) == (right.fingerprint, right.content, right.notes)
    return apart, once


@pytest.mark.parametrize("name", WRITERS)
def test_the_results_are_those_of_the_stages(tmp_path, frames, name):
    WRITERS[name](tmp_path, frames)
    apart, once = compare(tmp_path)
    np.testing.assert_array_equal(once.store.read("histogram/maximum"), frames.max(axis=0))
    assert any("outside" in note for note in once.notes) == any("outside" in n for n in apart.notes)


@pytest.mark.parametrize(
    ("name", "sections"),
    [
        ("raw", {"input": {"mode": "copy"}}),
        ("zlib", {"input": {"mode": "copy", "roi": [8, 140, 3, 31]}}),
        ("raw", {"input": {"frame_range": [17, 290]}, "run": {"tile": 16}}),
        ("raw", {"histogram": {"summaries": False, "window_frames": 300}}),
        ("zlib", {"compute": {"workers": 5}, "histogram": {"window_frames": 7}}),
    ],
)
def test_settings_change_nothing_in_that(tmp_path, frames, monkeypatch, name, sections):
    monkeypatch.setattr("pchem_pipeline.stages.ingest._CHUNK", (32, 16, 16))
    WRITERS[name](tmp_path, frames)
    compare(tmp_path, **sections)


def _bytes_read():
    facts = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(facts["rchar"])


@pytest.mark.parametrize("name", ["raw", "tiff"])
def test_every_byte_is_read_once(tmp_path, frames, name):
    WRITERS[name](tmp_path, np.concatenate([frames] * 3))
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    # what is imported or compiled at the first use is read there, and not counted
    single_pass.count_in_one_pass(make_context(tmp_path, "first.zarr"))
    context = make_context(tmp_path, "run.zarr")
    before = _bytes_read()
    single_pass.count_in_one_pass(context)
    assert set(context.prepared.stages) == {"ingest", "histogram"}
    tags = 900 * 8192 if name == "tiff" else 0  # looking for the pages of frames as small as these
    assert size <= _bytes_read() - before < 1.1 * size + tags
    # the separate stages read all twice, so the count is a count
    other = make_context(tmp_path, "other.zarr")
    before = _bytes_read()
    run_both(other)
    assert _bytes_read() - before > 1.9 * size


def test_where_memory_is_short_the_stages_do_it(tmp_path, frames, monkeypatch):
    WRITERS["npy"](tmp_path, frames)
    context = make_context(tmp_path, "run.zarr", compute={"max_memory": 64})
    single_pass.count_in_one_pass(context)
    assert not context.prepared
    context = make_context(tmp_path, "run.zarr")
    # what the first block shows can be too much, too
    room = arrays.single_pass_bytes(context.config, frames.shape, frames.dtype, bins=0) + 1000
    monkeypatch.setattr(single_pass, "allowed_bytes", lambda config, workers: room)
    single_pass.count_in_one_pass(context)
    assert not context.prepared
    run_both(context)
    np.testing.assert_array_equal(context.store.read("histogram/maximum"), frames.max(axis=0))
    # a known input is left to them, too
    monkeypatch.undo()
    context.store.records.forget("histogram")
    single_pass.count_in_one_pass(context)
    assert not context.prepared


@pytest.mark.parametrize("name", ["npy", "hdf5"])
def test_a_stopped_or_killed_pass_leaves_nothing_half_done(tmp_path, frames, name):
    WRITERS[name](tmp_path, frames)
    context = make_context(tmp_path, "run.zarr")

    class Soon(StopRequest):
        calls = 0

        def check(self):
            self.calls += 1
            if self.calls > 3:
                raise InterruptedRunError(15)

    context.stop = Soon()
    with pytest.raises(InterruptedRunError):
        single_pass.count_in_one_pass(context)
    assert not context.prepared
    assert context.store.has("histogram/counts")
    assert all(context.store.records.read(stage) is None for stage in ("ingest", "histogram"))
    again = make_context(tmp_path, "run.zarr")
    single_pass.count_in_one_pass(again)
    assert set(again.prepared.stages) == {"ingest", "histogram"}
    run_both(again)
    np.testing.assert_array_equal(again.store.read("histogram/counts").sum(axis=2).max(), FRAMES)


def test_a_file_that_shrinks_meanwhile_is_said(tmp_path, frames, monkeypatch):
    WRITERS["npy"](tmp_path, frames)
    context = make_context(tmp_path, "run.zarr")
    whole = (tmp_path / "a.npy").read_bytes()
    real = single_pass._create

    def shrink(*arguments):
        (tmp_path / "a.npy").write_bytes(whole[:-1000])
        real(*arguments)

    monkeypatch.setattr(single_pass, "_create", shrink)
    with pytest.raises(InputError, match="was truncated"):
        single_pass.count_in_one_pass(context)
    assert not context.prepared


def test_rows_are_cut_at_whole_steps():
    assert cut_rows(20, 64, 4) == [(0, 20)]
    bands = cut_rows(2000, 64, 2)
    assert (bands[0][0], bands[-1][1]) == (0, 2000)
    assert all(a[1] == b[0] for a, b in pairwise(bands))
    assert all(y0 % 64 == 0 for y0, _ in bands)
    assert 8 <= len(bands) <= 12
