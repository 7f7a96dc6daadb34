"""Bad input: one line with what, where and the cure, its exit code, and nothing lost."""

import shutil

import numpy as np
import pytest
import tifffile
from helpers.commands import RUN

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.store.run_store import RunStore, stored_config

GOOD = np.random.default_rng(2).integers(90, 130, (40, 8, 9), dtype=np.uint16)

OF_ONE_FILE = """
run: {store: run.zarr}
input: {files: [a.npy]}
"""


def tiff(path, data=GOOD):
    tifffile.imwrite(path, data, photometric="minisblack")


def test_bad_files_are_one_clear_line(shell):
    tiff(shell.folder / "good.tif")
    tiff(shell.folder / "other.tif", GOOD[:, :4])
    (shell.folder / "bad.tif").write_bytes(b"hello")
    for *files, word in (
        ("nowhere", "does not exist"), ("good.tif", "other.tif", "other.tif"), ("bad.tif", "bad.tif")
    ):  # fmt: skip
        result = shell("run", *files, "--quiet")
        assert (result.code, result.stderr.count("\n"), result.stdout) == (4, 1, ""), result.stderr
        assert word in result.last
        assert result.last.startswith("pchem: ")


def test_too_many_failed_pixels_is_exit_code_3_with_a_report(shell, undrawn):
    rng = np.random.default_rng(8)
    stack = np.rint(rng.poisson(2, (1500, 8, 8)) * 10 + rng.normal(100, 3, (1500, 8, 8))).astype(np.uint16)
    stack[:, :3] = 100
    np.save(shell.folder / "a.npy", stack)
    np.save(shell.folder / "mask.npy", np.repeat([[1.0], [0.0]], [3, 5], axis=0).repeat(8, axis=1))
    options = ("--mask", "mask.npy", "--frames", "5:", "--store", "masked.zarr")
    shell.ok("run", "a.npy", *options, "--until", "fit")
    store = RunStore.open(shell.folder / "masked.zarr")
    left_out = np.arange(8)[:, None] < 3
    assert ((store.read("fit/fit_status") == FitStatus.EXCLUDED) == left_out).all()
    assert (np.isnan(store.read("fit/conversion_gain")) == left_out).all()
    assert store.read("histogram/counts")[4, 4].sum() == 1495
    (shell.folder / "run.yaml").write_text(OF_ONE_FILE)
    assert "24 of 64 pixels have no value" in shell.refused(3, "run", "run.yaml")
    assert (shell.folder / "run.zarr" / "report.html").exists()
    # where all have failed no retry is asked for
    np.save(shell.folder / "a.npy", np.full((100, 8, 8), 100, np.uint16))
    (shell.folder / "run.yaml").write_text(OF_ONE_FILE.replace("run.zarr", "all.zarr"))
    result = shell("run", "run.yaml")
    assert result.code == 3
    assert "64 of 64 pixels have no value" in result.last
    assert "again" not in result.stderr
    assert "warning: no pixel has a value, so there is no ensemble" in result.stderr
    assert (shell.folder / "all.zarr" / "report.html").exists()
    assert {words.split()[0] for words in shell.states("run.yaml").values()} == {"complete"}


def test_a_stage_that_cannot_read_its_input_keeps_what_it_made(shell, frames):
    """The camera files of a run that refers to them are away for a while."""
    text = RUN + "histogram: {max_bins: 1024}\n"
    (shell.folder / "run.yaml").write_text(text)
    shell.ok("run", "run.yaml", "--until", "fit", "--workers", "1", "--max-memory", "3000")
    store = RunStore.open(shell.folder / "run.zarr")
    # what one command was given is no setting of the run
    assert "max_memory: null" in stored_config(store.path)
    assert "workers: 1\n" not in stored_config(store.path)
    before = store.read("histogram/counts")
    frames.rename(shell.folder / "away")
    (shell.folder / "run.yaml").write_text(text.replace("1024", "512"))
    for options in (("run", "run.yaml", "--until", "fit"), ("histogram", "run.yaml", "--force")):
        assert shell(*options).code == 4
        assert np.array_equal(RunStore.open(shell.folder / "run.zarr").read("histogram/counts"), before)
    (shell.folder / "away").rename(frames)
    (shell.folder / "run.yaml").write_text(text)
    again = shell.ok("run", "run.yaml", "--until", "fit")
    assert "histogram: up to date" in again.stderr


@pytest.mark.parametrize("stage", ["histogram", "fit", "report", "electrons"])
def test_a_stage_asked_for_too_early_leaves_nothing(shell, stage):
    np.save(shell.folder / "a.npy", GOOD)
    (shell.folder / "my run.yaml").write_text(OF_ONE_FILE)
    said = shell.refused(4, stage, "my run.yaml")
    assert said.startswith(f"pchem: {stage} needs ")
    assert said.endswith(f"'{shell.folder / 'my run.yaml'}'")  # there is no store to be named
    assert sorted(path.name for path in shell.folder.iterdir()) == ["a.npy", "my run.yaml"]


def test_a_refusal_leaves_files_in_place_of_folders_alone_and_neither_store_nor_yaml(shell):
    np.save(shell.folder / "a.npy", GOOD)
    (shell.folder / "a.yaml").write_text(OF_ONE_FILE)
    (shell.folder / "notes").write_text("of mine")
    no_folder = "a file is in place of the folder: choose another place"
    for code, *command, words in (
        (4, "run", "a.npy", "--store", "notes", "is not a run; choose another --store or remove it"),
        (2, "demo", "--output", "notes", "pchem: notes is a file; choose a folder with --output"),
        (2, "demo", "--output", "notes", "--hidden", "row_noise", "pchem: notes is a file; choose a folder"),
        (4, "run", "a.npy", "--store", "notes/run.zarr", no_folder),
        (4, "init", "notes/run.yaml", no_folder),
        (2, "run", "a.npy", "--log-json", ".", "--log-json .: cannot be written"),
        (4, "ingest", "a.yaml", "--append", "ingest is not complete"),
        (4, "view", "a.yaml", f"run: pchem run '{shell.folder / 'a.yaml'}'"),
        (4, "export", "a.yaml", f"run: pchem run '{shell.folder / 'a.yaml'}'"),
    ):
        assert words in shell.refused(code, *command)
        names = sorted(path.name for path in shell.folder.iterdir())
        assert names == ["a.npy", "a.yaml", "notes"], command
    assert (shell.folder / "notes").read_text() == "of mine"


@pytest.mark.parametrize("command", ["fit", "discrepancy"])
def test_a_region_beyond_the_sensor_is_one_line(shell, command, finished):
    shutil.copytree(finished.parent, shell.folder, dirs_exist_ok=True)
    before = sorted((shell.folder / "run.zarr").rglob("*"))
    assert shell.refused(2, command, "run.yaml", "--roi", "0:99,0:9") == (
        "pchem: --roi 0:99,0:9 exceeds the sensor of 20 x 28 pixels (y x x); choose within 0:20,0:28"
    )
    assert sorted((shell.folder / "run.zarr").rglob("*")) == before
