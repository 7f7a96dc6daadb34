"""``pchem discrepancy`` on real files: the verdict, the extended model, interruptions, wrong use."""

import json
import os
import shutil
import signal
import time

import numpy as np
import pytest
from helpers.commands import Shell

from pchem_pipeline import open_run

CAMERA = """
# the camera of the north bench
run: {store: run.zarr, tile: 8}   # small tiles
simulate:
  shape: [16, 16]
  n_frames: 1800
  seed: 5
  output: frames
  format: npy
  effects: [{tag: row_noise, row_noise_dn: 1.2}]
discrepancy:   # quick
  replicates: 20
  extended_replicates: 12
  candidates: [row_noise, frame_noise]
report: {figure_formats: [], dpi: 72}
"""


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, kernels):
    """A run that is fitted with the plain model; copy it."""
    shell = Shell(tmp_path_factory.mktemp("fitted"), {**os.environ, "NUMBA_CACHE_DIR": kernels})
    (shell.folder / "run.yaml").write_text(CAMERA)
    shell.ok("simulate", "run.yaml")
    for stage in ("ingest", "histogram", "fit"):
        shell.ok(stage, "run.yaml")
    return shell


def copy_of(shell, folder, text=None):
    """Copy a run, with another YAML if it is given."""
    shutil.copytree(shell.folder, folder, dirs_exist_ok=True)
    if text is not None:
        (folder / "run.yaml").write_text(text)
    return Shell(folder, shell.environment)


@pytest.fixture(scope="module")
def searched(tmp_path_factory, fitted):
    """A run whose search was not interrupted; do not change it."""
    shell = copy_of(fitted, tmp_path_factory.mktemp("searched"))
    before = read(shell, "fit/read_noise_dn")
    return shell, shell.ok("discrepancy", "run.yaml"), before


def read(shell, name):
    from pchem_pipeline.store.run_store import RunStore

    return RunStore.open(shell.folder / "run.zarr").read(name)


def verdict(shell):
    return json.loads((shell.folder / "run.zarr" / "discrepancy.json").read_text())


def test_the_effect_is_named_with_its_size_and_closes_the_gap(searched):
    shell, result, _ = searched
    found = verdict(shell)
    assert found["verdict"] == "named"
    assert found["effects"] == ["row_noise"]
    strength = found["steps"][0]["parameters"]["row_noise_dn"]
    assert abs(strength["value"] - 1.2) < 5 * strength["stderr"] + 0.05 * 1.2
    assert strength["unit"] == "DN"
    assert found["gap"]["after"] <= found["gap"]["floor"] < found["gap"]["before"]
    assert "row_noise" in result.stdout
    assert {"charge_lag", "charge_diffusion", "spurious_charge"} <= set(found["untestable"])


def test_the_model_grows_beside_the_users_file_which_stays(searched):
    shell, result, _ = searched
    assert (shell.folder / "run.yaml").read_text() == CAMERA
    assert "tag: row_noise" in (shell.folder / "run.effects.yaml").read_text()
    assert f"(in {shell.folder.resolve() / 'run.effects.yaml'})" in result.stderr


def test_the_fit_runs_with_the_extended_model_and_loses_its_bias(searched):
    shell, _, before = searched
    truth, after = read(shell, "truth/read_noise_dn"), read(shell, "fit/read_noise_dn")
    bias_before, bias_after = np.median(before - truth), np.median(after - truth)
    # row noise of 1.2 DN on 3.4 DN: 6 % too much before; the median of 256 pixels is known to 0.01 DN
    assert bias_before > 0.1
    assert abs(bias_after) < bias_before / 5


def test_going_back_to_an_older_model_and_forth_gives_the_same_bits(searched, tmp_path):
    shell, _, before = searched
    other = Shell(tmp_path / "copy", shell.environment)
    shutil.copytree(shell.folder, other.folder)
    status = [" ".join(line.split()) for line in other.ok("status", "run.yaml").stdout.splitlines()]
    assert "fit complete (with model 2)" in status
    assert "discrepancy complete (searched from model 1)" in status
    listed = other.ok("model", "run.yaml").stdout.splitlines()
    assert listed[1].split() == ["1", "config", "discrepancy", "plain", "model"]
    assert listed[2].startswith("* 2 ")
    assert "plain model + row_noise 1.2" in listed[2]
    beside = other.folder / "run.effects.yaml"
    after, text = read(other, "fit/read_noise_dn"), beside.read_text()
    words = other.ok("model", "run.yaml", "--use", "1").stdout
    assert "stale: fit; to update: pchem run" in words
    assert not beside.exists()
    assert "fit         stale - model 2 -> 1  (with model 2)" in other.ok("status", "run.yaml").stdout
    other.ok("run", "run.yaml", "--until", "fit")
    assert np.array_equal(read(other, "fit/read_noise_dn"), before, equal_nan=True)
    # a search that is up to date is asked for what it named, and nothing is searched again
    again = other.ok("discrepancy", "run.yaml")
    assert "discrepancy: up to date" in again.stderr
    assert "model 2 is now in use" in again.stderr
    assert beside.read_text() == text
    assert np.array_equal(read(other, "fit/read_noise_dn"), after, equal_nan=True)


def test_a_second_search_has_nothing_to_do(searched):
    shell, _, _ = searched
    again = shell.ok("discrepancy", "run.yaml", "--no-refit")
    assert "up to date" in again.stderr
    assert "discrepancy complete" in " ".join(shell.ok("status", "run.yaml").stdout.split())
    dry = shell.ok("discrepancy", "run.yaml", "--dry-run")
    assert "nothing to do" in dry.stderr


def test_a_search_ends_at_its_limit_and_goes_further_with_a_higher_one(fitted, tmp_path):
    shell = copy_of(fitted, tmp_path)
    result = shell.ok("discrepancy", "run.yaml", "--no-refit", "--effort", "0.0001")
    found = verdict(shell)
    assert found["effects"] == []
    assert "row_noise" in found["limit"]
    words = " ".join(result.stdout.split())
    assert "the search used its budget before row_noise was fitted" in words
    assert "go on with a larger --effort" in words


def test_an_effect_that_the_model_has_is_not_added_twice(searched, fitted, tmp_path):
    text = (searched[0].folder / "run.effects.yaml").read_text()
    other = copy_of(fitted, tmp_path)
    (tmp_path / "run.effects.yaml").write_text(text)
    other.ok("discrepancy", "run.yaml")
    found = verdict(other)
    assert found["verdict"] == "consistent"
    assert [e["tag"] for e in found["model_effects"]] == ["row_noise"]
    assert (tmp_path / "run.effects.yaml").read_text() == text


@pytest.mark.parametrize(("moment", "number"), [(0.8, signal.SIGTERM), (2.0, signal.SIGKILL)])
def test_a_killed_search_goes_on_to_the_same_verdict(searched, fitted, tmp_path, moment, number):
    shell, _, _ = searched
    other = copy_of(fitted, tmp_path)
    with other.start("discrepancy", "run.yaml", "--no-refit") as process:
        markers = tmp_path / "run.zarr" / ".pchem" / "done" / "discrepancy"
        wanted = int(12 * moment)
        while process.poll() is None and len(list(markers.glob("*/*"))) < wanted:
            time.sleep(0.02)
        process.send_signal(number)
        assert process.wait(20) == (143 if number == signal.SIGTERM else -number)  # clusters wait for 30 s
    assert not (tmp_path / "run.zarr" / "discrepancy.json").exists()
    other.ok("discrepancy", "run.yaml", "--no-refit")
    assert verdict(other) == verdict(shell)
    assert (tmp_path / "run.yaml").read_text() == CAMERA  # --no-refit leaves the model alone


def test_effects_beside_one_that_is_no_candidate_are_named_in_part_and_a_killed_search_goes_on(
    kernels, tmp_path
):
    """Sets of effects, and what is measured beside them: stacks of many models, each under its own name."""
    hidden = "{tag: row_noise, row_noise_dn: 1.2}"
    others = "{tag: frame_noise, frame_noise_dn: 0.8}, {tag: exposure_flicker, rms: 0.05}"
    text = CAMERA.replace(hidden, f"{hidden}, {others}").replace("[16, 16]", "[12, 12]")
    shell = Shell(tmp_path / "whole", {**os.environ, "NUMBA_CACHE_DIR": kernels})
    shell.folder.mkdir()
    # a third one, that is not there, to be asked for beside the others
    text = text.replace("[row_noise, frame_noise]", "[row_noise, frame_noise, column_noise]")
    (shell.folder / "run.yaml").write_text(text.replace("1800", "1000"))
    shell.ok("simulate", "run.yaml")
    shell.ok("run", "run.yaml", "--until", "fit")
    other = copy_of(shell, tmp_path / "killed")
    shell.ok("discrepancy", "run.yaml", "--no-refit")
    found = verdict(shell)
    # what flickers is no candidate: noise of frames may be named, or described with it
    assert found["verdict"] in ("named_in_part", "described")
    assert {"row_noise"} <= set(found["effects"]) <= {"row_noise", "frame_noise"}
    noise = next(s["parameters"]["row_noise_dn"] for s in found["steps"] if s["effect"] == "row_noise")
    assert abs(noise["value"] - 1.2) < 5 * noise["stderr"] + 0.05 * 1.2

    markers = other.folder / "run.zarr" / ".pchem" / "done" / "discrepancy"

    def several_sets():
        return len({path.name.split("-")[2] for path in markers.glob("*/grown-null-*")}) > 4

    with other.start("discrepancy", "run.yaml", "--no-refit") as process:
        while process.poll() is None and not several_sets():
            time.sleep(0.02)
        process.kill()
    assert several_sets()
    assert not (other.folder / "run.zarr" / "discrepancy.json").exists()
    other.ok("discrepancy", "run.yaml", "--no-refit")
    assert verdict(other) == found


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[row_noise, frame_noise]", "[row_nois]", "unknown effects row_nois"),
        ("n_frames: 1800", "n_frames: 250", "take more frames"),
        ("shape: [16, 16]", "shape: [4, 4]", "32 are needed"),
    ],
)
def test_what_cannot_be_searched_is_one_clear_line(kernels, tmp_path, old, new, message):
    other = Shell(tmp_path, {**os.environ, "NUMBA_CACHE_DIR": kernels})
    (tmp_path / "run.yaml").write_text(CAMERA.replace(old, new))
    other.ok("simulate", "run.yaml")
    result = other("discrepancy", "run.yaml")
    assert result.code in (2, 4)
    assert message in result.last
    assert "Traceback" not in result.stderr


def test_without_add_the_model_stays(fitted, tmp_path):
    text = CAMERA.replace("# quick\n", "# quick\n  add: false\n")
    other = copy_of(fitted, tmp_path, text)
    for _ in range(2):
        other.ok("discrepancy", "run.yaml")
    assert verdict(other)["effects"] == ["row_noise"]
    assert (tmp_path / "run.yaml").read_text() == text
    assert [path.name for path in (tmp_path / "run.zarr/model").glob("0*")] == ["0001.json"]


def test_a_notebook_has_the_search_and_its_verdict(searched, tmp_path):
    shell = copy_of(searched[0], tmp_path)
    run = open_run(shell.folder / "run.yaml")
    found = run.discrepancy()  # up to date
    assert found.effects == run.verdict.effects == ("row_noise",)
    assert repr(found).startswith("<Verdict named: The model was missing row noise")
    assert "<li>row means of the readout residuals" in found._repr_html_()
