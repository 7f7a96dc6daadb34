"""The stage simulate: every format holds the same frames, resuming, and what it refuses to overwrite."""

from typing import Any

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError, PchEmError, StoreError
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.operators.offsets import RowNoise
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
    return open_frames(target.config.input, target.base_dir).read()


def expected(target):
    settings = target.config.simulate
    return simulate_block(draw_truth(settings), settings, (0, settings.n_frames))


@pytest.mark.parametrize(
    ("format", "n_files", "backend", "limits", "options"),
    [
        ("tiff", 1, "threads", {}, {}),
        *((each, 5, "threads", {}, {}) for each in ("tiff", "fits", "hdf5", "npy", "raw", "zarr")),
        ("raw", 2, "processes", {}, {}),
        ("raw", 1, "threads", {"_BUDGET": 1, "_CHUNK": 3 * 4 * 9 * 11}, {}),  # small blocks
        ("raw", 23, "serial", {"_MOST_UNITS": 4}, {}),  # many files share few units
        ("raw", 1, "serial", {}, {"roi": (0, 1, 0, 1)}),  # a region leaves no frames out
    ],
)
def test_formats_blocks_units_and_processes_hold_the_same_frames_and_the_store_the_truth(
    tmp_path, monkeypatch, format, n_files, backend, limits, options
):
    for name, value in limits.items():
        monkeypatch.setattr(stage, name, value)
    per_file = None if n_files == 1 else -(-23 // n_files)
    target = prepare(tmp_path, backend=backend, format=format, frames_per_file=per_file)
    assert simulated(target, **options) == "complete"
    dn, electrons = expected(target)
    np.testing.assert_array_equal(frames_of(target), dn)
    store = RunStore.open(target.store)
    np.testing.assert_array_equal(store.read("truth/electron_number"), electrons[:10])
    maps = draw_truth(target.config.simulate).arrays()
    with np.load(tmp_path / "frames" / "truth.npz", allow_pickle=False) as beside:
        assert len(beside["files"]) == n_files
        for name, values in maps.items():
            np.testing.assert_array_equal(store.read(f"truth/{name}"), values)
            np.testing.assert_array_equal(beside[name], values)
    if format == "tiff":  # integration time and bit depth travel with the files
        bare = target.changed("input", integration_time=None, bit_depth=None)
        reader = open_frames(bare.config.input, target.base_dir)
        assert (reader.integration_time, reader.bit_depth) == (2.5, 12)


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


def test_a_missing_section_and_a_disk_too_small_are_noticed_before_the_work(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("input: {files: [nothing.tif]}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="no section simulate"):
        simulated(find_run(path))
    target = prepare(tmp_path, n_frames=10**12, truth_frames=0)
    with pytest.raises(StoreError, match="GB are free"):
        simulated(target)
    assert not list((tmp_path / "frames").iterdir())


def test_an_effect_that_fails_is_the_one_error(tmp_path, monkeypatch):
    """The stages behind it find no frames, which is no news."""
    monkeypatch.setattr(RowNoise, "apply", lambda *_: {}["lost"])
    with pytest.raises(IncompleteRunError, match=r"^simulate: .*'row_noise' .* failed: KeyError: 'lost'"):
        run_stages(prepare(tmp_path), ["simulate", "ingest", "histogram"], Command(quiet=True))
