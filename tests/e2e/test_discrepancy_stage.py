"""``pchem discrepancy`` on real files: the verdict, the extended model, interruptions, wrong use."""

import json
import shutil
import signal
import time

import numpy as np
import pytest
from helpers.commands import Shell

from pchem_pipeline import open_run
from pchem_pipeline.store.run_store import RunStore

CAMERA = """
# the camera of the north bench
run: {store: run.zarr, tile: 8}   # small tiles
input: {files: [frames/frames.npy], bit_depth: 14}
simulate:
  shape: [12, 16]
  n_frames: 1500
  seed: 5
  output: frames
  format: npy
  effects: [{tag: row_noise, row_noise_dn: 1.2}]
discrepancy:   # quick
  replicates: 20
  extended_replicates: 12
  candidates: [row_noise, frame_noise]
"""


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run that is fitted with the plain model; copy it."""
    shell = Shell(tmp_path_factory.mktemp("fitted"))
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
    return Shell(folder)


@pytest.fixture(scope="module")
def searched(tmp_path_factory, fitted):
    """A run whose search was not interrupted; do not change it."""
    shell = copy_of(fitted, tmp_path_factory.mktemp("searched"))
    before = read(shell, "fit/read_noise_dn")
    return shell, shell.ok("discrepancy", "run.yaml"), before


def read(shell, name):
    return RunStore.open(shell.folder / "run.zarr").read(name)


def verdict(shell):
    return json.loads((shell.folder / "run.zarr" / "discrepancy.json").read_text())


def test_the_effect_is_named_with_its_size_closes_the_gap_and_is_in_the_model(searched):
    shell, result, before = searched
    found = verdict(shell)
    assert found["verdict"] == "named"
    assert found["effects"] == ["row_noise"]
    strength = found["steps"][0]["parameters"]["row_noise_dn"]
    assert abs(strength["value"] - 1.2) < 5 * strength["stderr"] + 0.05 * 1.2
    assert strength["unit"] == "DN"
    assert found["gap"]["after"] <= found["gap"]["floor"] < found["gap"]["before"]
    assert "row_noise" in result.stdout
    assert {"charge_lag", "charge_diffusion", "spurious_charge"} <= set(found["untestable"])
    # the model grows beside the user's file, which stays
    assert (shell.folder / "run.yaml").read_text() == CAMERA
    assert "tag: row_noise" in (shell.folder / "run.effects.yaml").read_text()
    assert f"(in {shell.folder.resolve() / 'run.effects.yaml'})" in result.stderr
    # the fit has it and loses its bias: row noise of 1.2 DN on 3.4 DN, 6 % too much before; the median of
    # 192 pixels is known to 0.012 DN
    truth, after = read(shell, "truth/read_noise_dn"), read(shell, "fit/read_noise_dn")
    was = np.median(before - truth)
    assert was > 0.1
    assert abs(np.median(after - truth)) < was / 5
    run = open_run(shell.folder / "run.yaml")
    again = run.discrepancy()  # up to date
    assert again.effects == run.verdict.effects == ("row_noise",)
    assert repr(again).startswith("<Verdict named: The data show row noise")
    assert "<li>row means of the readout residuals" in again._repr_html_()


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


def test_a_stopped_search_without_the_truth_goes_on_to_the_same_verdict(searched, fitted, tmp_path):
    shell, _, _ = searched
    # the section that made the frames may not tell what was put into them either
    text = CAMERA.replace("row_noise_dn: 1.2", "row_noise_dn: 2.5")
    other = copy_of(fitted, tmp_path, text)
    (tmp_path / "frames" / "truth.npz").unlink()
    shutil.rmtree(tmp_path / "run.zarr" / "truth")
    markers = tmp_path / "run.zarr" / ".pchem" / "done" / "discrepancy"
    with other.start("discrepancy", "run.yaml", "--no-refit") as process:
        while process.poll() is None and len(list(markers.glob("*/*"))) < 16:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 143  # clusters wait for 30 s
    assert not (tmp_path / "run.zarr" / "discrepancy.json").exists()
    other.ok("discrepancy", "run.yaml", "--no-refit")
    assert verdict(other) == verdict(shell)
    assert (tmp_path / "run.yaml").read_text() == text  # --no-refit leaves the model alone


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[row_noise, frame_noise]", "[row_nois]", "effect 'row_nois' is unknown; did you mean row_noise"),
        ("n_frames: 1500", "n_frames: 250", "take more frames"),
        ("shape: [12, 16]", "shape: [4, 4]", "32 are needed"),
    ],
)
def test_what_cannot_be_searched_is_one_clear_line(tmp_path, old, new, message):
    other = Shell(tmp_path)
    (tmp_path / "run.yaml").write_text(CAMERA.replace(old, new))
    other.ok("simulate", "run.yaml")
    assert message in other.refused(2 if "effect" in message else 4, "discrepancy", "run.yaml")
