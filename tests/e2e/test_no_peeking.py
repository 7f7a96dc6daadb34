"""The search for what is missing looks at the frames alone: without the truth the verdict is the same."""

import json
import shutil

import numpy as np
import pytest

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
discrepancy: {replicates: 30, grown_replicates: 12}
"""


def search(shell):
    shell.ok("ingest", "run.yaml")
    shell.ok("discrepancy", "run.yaml")
    return json.loads((shell.folder / "run.zarr" / "discrepancy.json").read_text())


@pytest.mark.parametrize("change", ["delete", "spoil"])
def test_the_truth_changes_nothing(shell, tmp_path, change):
    (shell.folder / "run.yaml").write_text(CAMERA)
    shell.ok("simulate", "run.yaml")
    copy = type(shell)(tmp_path / "copy", shell.environment)
    shutil.copytree(shell.folder, copy.folder)
    maps, group = copy.folder / "frames" / "truth.npz", copy.folder / "run.zarr" / "truth"
    assert maps.exists()
    assert group.exists()
    if change == "delete":
        maps.unlink()
        shutil.rmtree(group)
        # nor may the frames' own section of the YAML tell what was put in
        text = (copy.folder / "run.yaml").read_text()
        (copy.folder / "run.yaml").write_text(text.replace("row_noise_dn: 1.0", "row_noise_dn: 2.5"))
    else:
        np.savez(maps, quanta_exposure=np.zeros(3))
        for path in group.rglob("c/*"):
            if path.is_file():
                path.write_bytes(b"spoilt")
    with_truth, without = search(shell), search(copy)
    assert with_truth == without
    assert with_truth["effects"] == ["row_noise"]
