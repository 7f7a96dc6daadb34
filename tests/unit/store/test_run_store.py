import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from pchem_pipeline.base.errors import LockedError, StoreError
from pchem_pipeline.store import disk
from pchem_pipeline.store.files import fingerprint_of
from pchem_pipeline.store.records import Records
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture
def store(tmp_path):
    return RunStore.create(tmp_path / "läuft hier" / "run.zarr")


def test_xarray_reads_a_group_with_units_and_dimensions(store):
    store.create_array("fit/bias", (100, 70), chunks=(64, 64))
    store.write("fit/bias", (slice(0, 64), slice(0, 64)), np.full((64, 64), 3.5))
    store.fill("fit/bias")
    bias = xr.open_zarr(store.path, group="fit", consolidated=False).bias
    assert (bias.dims, bias.attrs["units"], bias.attrs["symbol"]) == (("y", "x"), "DN", "mu")
    assert float(bias[0, 0]) == 3.5
    assert np.isnan(bias[99, 69])
    with pytest.raises(KeyError):
        store.create_array("fit/not_registered", (4, 4), chunks=(4, 4))


@pytest.mark.parametrize("shards", [None, (8, 32, 40)])
def test_pixels_are_read_in_any_order_and_number(store, shards):
    rng = np.random.default_rng(6)
    counts = rng.integers(0, 2**16, (20, 70, 40), dtype=np.uint16)
    chunks = (4, 8, 40) if shards else (8, 32, 40)
    store.create_array("histogram/counts", counts.shape, chunks=chunks, shards=shards, dtype=np.uint16)
    store.write("histogram/counts", (slice(None),) * 3, counts)
    assert store.file_shape("histogram/counts") == (8, 32, 40)
    assert len(list((store.path / "histogram/counts/c").rglob("0"))) >= 3
    for n in (1, 5, 3000):
        y, x = rng.integers(0, 20, n), rng.integers(0, 70, n)
        np.testing.assert_array_equal(store.read_pixels("histogram/counts", y, x), counts[y, x])
    store.write_array("fit/bias", np.arange(1400.0).reshape(20, 70))
    y, x = np.array([19, 0]), np.array([0, 69])
    np.testing.assert_array_equal(store.read_pixels("fit/bias", y, x), [1330.0, 69.0])


def test_a_region_of_the_arrays_is_a_mapping(store):
    store.create_array("fit/bias", (8, 12), chunks=(4, 6))
    store.create_array("samples/mean", (3, 8, 12), chunks=(3, 4, 6))
    region = slice(4, 8), slice(6, 12)
    part = store.at(region)
    part.update({"fit/bias": np.full((4, 6), 2.0), "samples/mean": np.ones((3, 4, 6))})
    assert list(part) == ["fit/bias", "samples/mean"]
    assert "fit/correlation" not in part
    assert store.at(region, "samples")["mean"].shape == (3, 4, 6)
    for name in ("fit/bias", "samples/mean"):
        store.fill(name)
    assert store.at(group="fit")["bias"].shape == (8, 12)
    assert np.nansum(store.read("fit/bias")) == 48.0
    assert np.nansum(store.read("samples/mean")) == 72.0
    assert "" not in store.at(group="fit")
    [(name, values)] = store.at((slice(0), slice(0)), "fit").items()
    assert (name, values.size) == ("bias", 0)
    with pytest.raises(StoreError, match="has no fit/correlation"):
        store.at(group="fit").get("correlation")


def test_a_flipped_bit_is_never_silent_and_a_missing_array_names_the_cure(store):
    store.write_array("fit/bias", np.ones((8, 8)))
    chunk = store.path / "fit" / "bias" / "c" / "0" / "0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(StoreError, match=r"fit/bias is damaged .*; run it again: pchem fit .* --force"):
        store.read("fit/bias")
    with pytest.raises(StoreError, match=r"has no maps/bias; run it again: pchem maps .* --force"):
        store.read("maps/bias")


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda path: None, "pchem run"),
        (lambda path: zarr.create_group(path, zarr_format=3), "not a run; to read its frames: pchem run"),
        (lambda path: RunStore.create(path)._root.attrs.update(pchem_schema=99), r"version 99.* needs 1"),
        (lambda path: (path.mkdir(), (path / "zarr.json").write_text("{")), "damaged"),
    ],
)
def test_what_is_no_run_is_refused_with_the_cure(tmp_path, made, words):
    made(tmp_path / "run.zarr")
    with pytest.raises(StoreError, match=words):
        RunStore.open(tmp_path / "run.zarr")


def test_no_store_is_made_over_other_files(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(StoreError, match="is not a run"):
        RunStore.create(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "precious"


def test_several_processes_that_make_the_same_store_at_once_have_it_all(tmp_path):
    program = (
        "import sys, zarr; from pathlib import Path; from pchem_pipeline.store.run_store import RunStore\n"
        "print(flush=True); sys.stdin.readline()\n"
        "for number in range(40): RunStore.create(Path(sys.argv[1]) / f'{number}.zarr').write_config('')\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    makers = [subprocess.Popen(command, text=True, **pipes) for _ in range(3)]
    for maker in makers:
        maker.stdout.readline()
    for maker in makers:
        maker.stdin.write("\n")
        maker.stdin.flush()
    for maker in makers:
        _, words = maker.communicate(timeout=120)
        assert maker.returncode == 0, words
    assert len(list(tmp_path.glob("*.zarr/zarr.json"))) == 40


def test_a_folder_that_another_process_makes_meanwhile_is_no_stranger(tmp_path, monkeypatch):
    asked, is_dir = [], Path.is_dir

    def meanwhile(path):
        found = is_dir(path)
        if path.name == "run.zarr" and not found:
            asked.append(path)
            if len(asked) == 1:  # while it is looked for strangers
                path.mkdir()
        return found

    monkeypatch.setattr(Path, "is_dir", meanwhile)
    RunStore.create(tmp_path / "run.zarr")
    assert len(asked) == 1


def test_second_process_finds_the_run_locked_and_a_killed_one_frees_it(store):
    code = (
        "import sys, time; from pathlib import Path; from pchem_pipeline.store.run_store import RunStore\n"
        "with RunStore.open(Path(sys.argv[1]), writable=True).locked():\n"
        "    print('locked', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(store.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(LockedError, match="another pchem process"), store.locked():
            pass
        process.kill()
    orphan = store.path / "fit" / "c" / "x.partial"  # what it had begun to write is removed
    orphan.parent.mkdir(parents=True)
    orphan.write_bytes(b"half")
    with store.locked():
        assert not orphan.exists()


def test_fingerprint_depends_on_content_not_on_order():
    one, same, other = ({"a": 1, "b": 2}, {"b": 2, "a": 1}, {"a": 1, "b": 3})
    assert fingerprint_of(one) == fingerprint_of(same) != fingerprint_of(other)


def test_markers_that_a_writer_removes_while_they_are_listed_are_no_markers(tmp_path, monkeypatch):
    records, glob = Records(tmp_path), Path.glob
    for key in ("r0/row_noise-0", "../0.1", ".0"):
        with pytest.raises(ValueError, match="not a file name"):
            records.mark("fit", "a" * 64, key, {})
    records.mark("fit", "a" * 64, "0.0", {})

    def removed_first(folder, pattern):
        monkeypatch.setattr(Path, "glob", glob)
        records.unmark_all("fit")
        return glob(folder, pattern)

    monkeypatch.setattr(Path, "glob", removed_first)
    assert records.done("fit", "a" * 64) == set()
    assert not (tmp_path / "done" / "fit").exists()


def test_a_new_group_is_never_on_the_disk_without_its_attributes(tmp_path, monkeypatch):
    store = RunStore.create(tmp_path / "run.zarr")
    written, write = [], disk.write
    monkeypatch.setattr(disk, "write", lambda path, data: (written.append(bytes(data)), write(path, data))[1])
    store.set_attributes("applied", {"provenance": "theirs"})
    assert written
    assert all(b"theirs" in each for each in written)
    store.set_attributes("applied", {"title": "more"})
    assert store.attributes("applied") == {"provenance": "theirs", "title": "more"}
