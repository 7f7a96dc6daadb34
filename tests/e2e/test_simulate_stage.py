"""The stage simulate: every format holds the same frames, resuming, and what it refuses to overwrite."""

from typing import Any

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError, PchEmError, StoreError
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.stages import simulate as stage
from pchem_pipeline.store.run_store import RunStore

SIMULATE: dict[str, Any] = {
    "shape": [9, 11],
    "n_frames": 23,
    "seed": 4,
    "bit_depth": 12,
    "integration_time": 2.5,
    "format": "raw",
    "truth_frames": 10,
    "effects": [{"tag": "row_noise", "row_noise_dn": 1.0}],
}


def prepare(folder, *, backend="serial", **changes):
    content = {
        "run": {"tile": 8},
        "simulate": {**SIMULATE, **changes},
        "compute": {"backend": backend, "workers": 2},
    }
    path = folder / "config.yaml"
    path.write_text(dump_config(RunConfig.model_validate(content)), encoding="utf-8")
    return find_run(path)


def simulated(target, **options):
    command = Command(**options, quiet=True)
    return run_stages(target, ["simulate"], command)[0].state


def frames_of(target):
    reader = open_frames(target.config.input, target.base_dir)
    frames = np.empty(reader.shape, reader.dtype)
    reader.read_into(frames, 0, reader.shape[0])
    return frames


def expected(target):
    settings = target.config.simulate
    return simulate_block(draw_truth(settings), settings, (0, settings.n_frames))


@pytest.mark.parametrize(
    ("format", "frames_per_file"),
    [("tiff", None), *((each, 5) for each in ("tiff", "fits", "hdf5", "npy", "raw", "zarr"))],
)
def test_every_format_holds_the_frames_and_the_store_the_truth(tmp_path, format, frames_per_file):
    target = prepare(tmp_path, backend="threads", format=format, frames_per_file=frames_per_file)
    assert simulated(target) == "complete"
    dn, electrons = expected(target)
    np.testing.assert_array_equal(frames_of(target), dn)
    store = RunStore.open(target.store)
    np.testing.assert_array_equal(store.read("truth/electron_number"), electrons[:10])
    maps = draw_truth(target.config.simulate).arrays()
    with np.load(tmp_path / "frames" / "truth.npz", allow_pickle=False) as beside:
        assert len(beside["files"]) == (1 if frames_per_file is None else 5)
        for name, values in maps.items():
            np.testing.assert_array_equal(store.read(f"truth/{name}"), values)
            np.testing.assert_array_equal(beside[name], values)


def test_integration_time_and_bit_depth_travel_with_the_files(tmp_path):
    target = prepare(tmp_path, format="tiff")
    simulated(target)
    bare = target.changed("input", integration_time=None, bit_depth=None)
    reader = open_frames(bare.config.input, target.base_dir)
    assert (reader.integration_time, reader.bit_depth) == (2.5, 12)


@pytest.mark.parametrize(
    ("backend", "limits", "n_files"),
    [
        ("processes", {}, 2),
        ("threads", {"_BUDGET": 1, "_CHUNK": 3 * 4 * 9 * 11}, 1),  # small blocks
        ("serial", {"_MOST_UNITS": 4}, 23),  # many files share few units
    ],
)
def test_blocks_units_and_processes_give_the_same_frames(tmp_path, monkeypatch, backend, limits, n_files):
    for name, value in limits.items():
        monkeypatch.setattr(stage, name, value)
    target = prepare(tmp_path, backend=backend, frames_per_file=-(-23 // n_files))
    assert simulated(target) == "complete"
    dn, electrons = expected(target)
    np.testing.assert_array_equal(frames_of(target), dn)
    np.testing.assert_array_equal(RunStore.open(target.store).read("truth/electron_number"), electrons[:10])
    assert len(list((tmp_path / "frames").glob("*.raw"))) == n_files


def test_a_failed_run_goes_on_where_it_was(tmp_path, monkeypatch):
    target = prepare(tmp_path, frames_per_file=4)
    real, written = stage.write_frames, []

    def failing(format, path, *args, **kwargs):
        if path.stem == "frames_00004" and len(written) < 10:
            raise PchEmError("the cable fell out")
        written.append(path.name)
        return real(format, path, *args, **kwargs)

    monkeypatch.setattr(stage, "write_frames", failing)
    with pytest.raises(PchEmError, match="cable"):
        simulated(target)
    assert len(written) == 5
    monkeypatch.setattr(stage, "write_frames", lambda *a, **k: (written.append(a[1].name), real(*a, **k)))
    assert simulated(target) == "complete"
    assert written[5:] == ["frames_00004.raw"]
    np.testing.assert_array_equal(frames_of(target), expected(target)[0])
    assert simulated(target) == "complete"
    assert len(written) == 6


def test_regions_do_not_leave_frames_out(tmp_path):
    target = prepare(tmp_path)
    assert simulated(target, roi=(0, 1, 0, 1)) == "complete"
    np.testing.assert_array_equal(frames_of(target), expected(target)[0])


def test_a_changed_setting_replaces_the_old_files_and_nothing_else(tmp_path):
    simulated(prepare(tmp_path, frames_per_file=4))
    notes = tmp_path / "frames" / "notes.txt"
    notes.write_text("mine")
    (notes.parent / ".partial-frames_00002.raw").write_bytes(b"left by a kill")
    target = prepare(tmp_path, n_frames=6, format="npy", truth_frames=0)
    assert simulated(target) == "complete"
    assert sorted(path.name for path in notes.parent.iterdir()) == ["frames.npy", "notes.txt", "truth.npz"]
    np.testing.assert_array_equal(frames_of(target), expected(target)[0])
    assert not RunStore.open(target.store).has("truth/electron_number")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("measurement.tif", b"precious"),
        ("truth.npz", b"precious"),
        ("truth.npz", b""),
        ("truth.npz", b"PK\3\4"),
    ],
)
def test_a_folder_of_other_files_is_left_alone(tmp_path, name, content):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / name).write_bytes(content)
    with pytest.raises(ConfigError, match="choose another folder"):
        simulated(prepare(tmp_path))
    assert (tmp_path / "frames" / name).read_bytes() == content


def test_a_disk_too_small_is_noticed_before_the_work(tmp_path):
    target = prepare(tmp_path, n_frames=10**12, truth_frames=0)
    with pytest.raises(StoreError, match="GB are free"):
        simulated(target)
    assert not list((tmp_path / "frames").iterdir())


def test_a_run_without_the_section_says_so(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("input: {files: [nothing.tif]}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="no section simulate"):
        run_stages(find_run(path), ["simulate"], Command(quiet=True))
