"""How a run from camera files begins, and begins again."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from helpers.camera_files import write_hdf5
from helpers.commands import invoke

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.commands.new_run import find_joint, find_or_start, first_try
from pchem_pipeline.config.load import dump_config, load_config
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "f 1.tif"
    path.touch()
    return path


def ingested(place, config=None):
    """Leave a store whose frames are ingested, with the settings of a run."""
    store = RunStore.create(place)
    if config is not None:
        store.write_config(dump_config(config))
    store.records.write(StageRecord("ingest", 1, "f", {}, finished=True))


def test_a_wrong_option_is_one_line(tmp_path, file):
    for given, words in (
        ({"integration_time": 0.0}, r"input\.integration_time: .* greater than 0 \(given: 0\.0\)"),
        ({"integration_time": float("nan")}, r"input\.integration_time: .* finite"),
        ({"bit_depth": 40}, r"input\.bit_depth: .* 32 \(given: 40\)"),
    ):
        with pytest.raises(ConfigError, match=f"^the command line: {words}"):
            find_or_start([file], tmp_path / "run.zarr", given)
    assert not (tmp_path / "run.yaml").exists()


def test_what_files_do_not_say_of_themselves_has_an_option(tmp_path, monkeypatch):
    """Left-justified samples in one of two datasets of an HDF5 file."""
    monkeypatch.chdir(tmp_path)
    dark, light = np.random.default_rng(1).integers(100, 140, (2, 20, 4, 4)).astype(np.uint16) << 4
    write_hdf5(tmp_path / "a.h5", dark=dark, light=light)
    options = ["--dataset", "light", "--bit-shift", "4", "--bit-depth", "12", "--until", "histogram"]
    invoke("run", "a.h5", *options)
    written = load_config(tmp_path / "run.yaml").input
    assert (written.dataset, written.bit_shift, written.bit_depth) == ("light", 4, 12)
    assert RunStore.open(tmp_path / "run.zarr").read("histogram/origin").min() < 140


def begun(find, *given, **more):
    """Return the run that was found, its YAML written as by a command that does something."""
    target, is_new = find(*given, **more)
    with first_try(target):
        return target, is_new


def test_options_can_be_corrected_until_a_stage_is_finished(tmp_path, file):
    place = tmp_path / "run.zarr"
    target, _ = begun(find_or_start, [file], place, {"bit_depth": 8})
    store = RunStore.create(place)
    store.write_config(dump_config(target.config))
    again, _ = begun(find_or_start, [file], place, {"bit_depth": 14})
    yaml = tmp_path / "run.yaml"
    text = yaml.read_text()
    assert load_config(yaml) == again.config
    store.write_config(dump_config(again.config))
    edited = text.replace("bit_shift: null", "bit_shift: 4")  # an edited one is never replaced
    yaml.write_text(edited)
    with pytest.raises(ConfigError, match="exists with other settings"):
        find_or_start([file], place, {"bit_depth": 12})
    assert yaml.read_text() == edited
    yaml.write_text(text)
    ingested(place, again.config)
    with pytest.raises(ConfigError, match=r"exists with other settings.*'.*/run\.yaml'|run\.yaml"):
        find_or_start([file], place, {"bit_depth": 12})


def test_a_folder_of_files_is_one_pattern_wherever_the_store_is(tmp_path, monkeypatch):
    """The files were listed one by one where the store's folder was not there yet; then the command again
    was refused."""
    (tmp_path / "frames 1").mkdir()
    for i in range(12):
        (tmp_path / "frames 1" / f"f{i}.tif").touch()
    monkeypatch.chdir(tmp_path)
    files = sorted(Path("frames 1").glob("*.tif"))
    for _ in range(2):
        target, _ = begun(find_or_start, files, Path("new/run.zarr"), {})
        assert target.config.input.files == ("../frames 1/*.tif",)
    (tmp_path / "frames 1" / "f.tif").touch()
    ingested(target.store, target.config)
    with pytest.raises(ConfigError, match=r"input\.files .* in the file, .* here") as refused:
        find_or_start(files, Path("new/run.zarr"), {})
    assert len(str(refused.value)) < 700  # twice the path of the test


def test_the_same_command_goes_on_with_a_yaml_that_says_more(tmp_path, file, monkeypatch):
    """What a search names is written into the YAML, what a user sets too; the command that began goes on."""
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "run.zarr"
    begun(find_or_start, [file], place, {"bit_depth": 12}, (0, 8, 8, 16))
    ingested(place)
    path = tmp_path / "run.yaml"
    effects = "effects: [{tag: row_noise, row_noise_dn: 1.0}]  # named"
    edited = path.read_text().replace("effects: []", effects).replace("tail_guard: 0.001", "tail_guard: 0")
    path.write_text(edited)
    for given, roi in (({"bit_depth": 12}, (0, 8, 8, 16)), ({}, None)):
        again, is_new = begun(find_or_start, [file], place, given, roi)
        assert (is_new, again.config.fit.tail_guard, again.config.input.bit_depth) == (True, 0.0, 12)
        assert [effect.tag for effect in again.config.model.effects] == ["row_noise"]
        assert path.read_text() == edited
    with pytest.raises(ConfigError, match=r"\(input\.bit_depth 12 in the file, 14 here\); continue"):
        find_or_start([file], place, {"bit_depth": 14})
    with pytest.raises(ConfigError, match=r"\(input\.roi \[0, 8, 8, 16\] in the file, \[0, 8, 0, 8\] here\)"):
        find_or_start([file], place, {}, (0, 8, 0, 8))
    assert path.read_text() == edited


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "dark"):
        Path(f"{name}.yaml").write_text(f"run: {{store: {name}.zarr}}\ninput: {{files: [{name}.tif]}}\n")
    return [Path("a.yaml"), Path("b.yaml")]


def test_a_joint_fit_goes_on_with_its_edited_yaml(runs):
    """Integration times are edited there, and what a search names is written there."""
    begun(find_joint, runs, store=Path("j.zarr"))
    edited = Path("j.yaml").read_text().replace("integration_time: null", "integration_time: 2.0", 1)
    Path("j.yaml").write_text(edited)
    again, _ = begun(find_joint, runs, store=Path("j.zarr"))
    assert Path("j.yaml").read_text() == edited
    assert again.config.input.samples[0].integration_time == 2.0
    with pytest.raises(ConfigError, match="exists with other settings"):
        find_joint(runs[::-1], store=Path("j.zarr"))
    assert Path("j.yaml").read_text() == edited


def test_light_levels_are_those_of_the_runs(runs):
    target, _ = begun(find_joint, runs, [Path("dark.yaml")], store=Path("j.zarr"), levels=("1", "2.4"))
    found = target.config.input
    assert found.against == "light_level"
    assert [sample.light_level for sample in found.samples] == [1.0, 2.4, None]
    for options, words in (
        ({"levels": ("1",)}, "1 levels for 2 runs"),
        ({"levels": ("1", "bright")}, "no numbers"),
        ({"levels": ("1", "2"), "against": "integration_time"}, "only with --against light_level"),
    ):
        with pytest.raises(ConfigError, match=words):
            find_joint(runs, store=Path("k.zarr"), **options)
    with pytest.raises(ConfigError, match="--level: only with runs"):
        find_joint([Path("j.yaml")], levels=("1", "2"))


def test_a_refusal_that_names_a_setting_says_where_settings_are(tmp_path, monkeypatch):
    """The YAML of a first try that is refused is taken away: `pchem init` makes it."""
    monkeypatch.chdir(tmp_path)
    np.save("f.npy", np.full((9, 8, 8), (1 << 13) + 1, np.uint16))
    with pytest.raises(InputError, match=r"; for settings .*: pchem init 'my run.yaml' FILES, edit it"):
        invoke("run", "f.npy", "--store", "my run.zarr", "--bit-depth", "12")
    assert [path.name for path in tmp_path.iterdir()] == ["f.npy"]
    with pytest.raises(InputError) as refused:
        invoke("run", "g.npy")
    assert "pchem init" not in str(refused.value)


@pytest.mark.parametrize("options", [(), ("--roi", "0:99,0:4")])
def test_a_first_try_that_is_refused_leaves_nothing_behind(tmp_path, file, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    if options:
        tifffile.imwrite(file, np.full((9, 8, 8), 100, np.uint16), photometric="minisblack")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError):
        invoke("run", file, *options)
    if options:  # nor does a dry run
        assert "ingest: would run (missing)" in invoke("run", file, "--dry-run").stderr
    assert sorted(tmp_path.rglob("*")) == before
    # a YAML of one's own stays
    (tmp_path / "own.yaml").write_text(f"input: {{files: [{file.name!r}], roi: [0, 99, 0, 4]}}\n")
    with pytest.raises(InputError):
        invoke("run", "own.yaml")
    assert sorted(path.name for path in tmp_path.iterdir()) == [file.name, "own.yaml"]


def test_a_try_that_was_refused_later_keeps_what_was_done(tmp_path, file):
    target, _ = find_or_start([file], tmp_path / "run.zarr", {})

    def lose_a_file():
        RunStore.create(target.store).records.write(StageRecord("ingest", 1, "f", {}, keys=4))
        raise InputError("a file is gone")

    with pytest.raises(InputError), first_try(target):
        lose_a_file()
    assert target.store.exists()
    assert (tmp_path / "run.yaml").exists()
