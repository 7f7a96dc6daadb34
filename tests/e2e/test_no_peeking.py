"""The search for what is missing looks at the frames alone: without the truth the verdict is the same."""

import json
import shutil

from helpers.commands import Shell

CAMERA = """
run: {store: run.zarr}
input: {files: [frames/*.tif], integration_time: 1.0, bit_depth: 14}
simulate:
  shape: [16, 16]
  n_frames: 1200
  seed: 21
  output: frames
  integration_time: 1.0
  effects: [{tag: row_noise, row_noise_dn: 1.0}]
discrepancy: {replicates: 24, extended_replicates: 12, candidates: [row_noise, frame_noise, column_noise]}
"""


def search(shell):
    shell.ok("ingest", "run.yaml")
    shell.ok("discrepancy", "run.yaml", "--no-refit")
    return json.loads((shell.folder / "run.zarr" / "discrepancy.json").read_text())


def test_without_the_truth_the_verdict_is_the_same(shell, tmp_path):
    (shell.folder / "run.yaml").write_text(CAMERA)
    shell.ok("simulate", "run.yaml")
    copy = Shell(tmp_path / "copy")
    shutil.copytree(shell.folder, copy.folder)
    maps, group = copy.folder / "frames" / "truth.npz", copy.folder / "run.zarr" / "truth"
    assert maps.exists()
    assert group.exists()
    maps.unlink()
    shutil.rmtree(group)
    # nor may the section that made the frames tell what was put into them
    text = (copy.folder / "run.yaml").read_text()
    (copy.folder / "run.yaml").write_text(text.replace("row_noise_dn: 1.0", "row_noise_dn: 2.5"))
    with_truth, without = search(shell), search(copy)
    assert with_truth == without
    # it did find something to say
    assert with_truth["verdict"] != "consistent"
    assert any(place["statistic"].startswith("space.row") for place in with_truth["where"])
