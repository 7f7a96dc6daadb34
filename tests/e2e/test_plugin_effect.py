"""Somebody else's effect: installed beside the package, found, named, and added; broken ones are left out."""

import json
import os
import subprocess
import sys

from helpers.installed import install
from helpers.places import TESTS

RUN = """
run: {store: run.zarr}
input: {files: [stack/frames.npy], integration_time: 1.0}
discrepancy: {replicates: 20, extended_replicates: 12, candidates: [CANDIDATES]}
"""
RIVALS = "frame_noise, row_noise"
BROKEN = {"hasty_offset": "nobody divided the offsets", "careless_offset": "offsets were left on the desk"}


def test_a_plug_in_is_found_named_and_added_and_broken_ones_are_left_out(shell, tmp_path):
    site, stack = tmp_path / "site", shell.folder / "stack"
    install(TESTS / "plugin_package", site)  # as pip leaves it
    # the frames hide the effect, made by a process that knows neither package
    command = [sys.executable, TESTS / "hidden" / "make.py", "--effect", "checkerboard_offset"]
    command += ["--level", 3, "--seed", 21, "--shape", 12, 12, "--frames", 1200, "--out", stack]
    subprocess.run(list(map(str, [*command, "--key", tmp_path / "key.json"])), check=True)
    candidates = ", ".join([RIVALS, "chessboard_offset", *BROKEN])
    (shell.folder / "run.yaml").write_text(RUN.replace("CANDIDATES", candidates))
    path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    with_plugin = shell.alone(PYTHONPATH=path)
    with_plugin.ok("ingest", "run.yaml")
    result = with_plugin.ok("discrepancy", "run.yaml")
    found = json.loads((with_plugin.folder / "run.zarr" / "discrepancy.json").read_text())
    assert found["verdict"] == "named"
    assert found["effects"] == ["chessboard_offset"]
    assert found["gap"]["after"] < 0.2 * found["gap"]["before"]
    (key,) = json.loads((tmp_path / "key.json").read_text())["effects"]
    offset = found["steps"][0]["parameters"]["offset_dn"]
    assert abs(offset["value"] - key["strength"]) < 0.1 * key["strength"]
    for tag, reason in BROKEN.items():
        assert reason in found["defects"][tag]
        assert any(tag in line and reason in line for line in result.stderr.splitlines())
    assert any("lost_offset" in line for line in result.stderr.splitlines())
    assert "chessboard_offset" in (with_plugin.folder / "run.effects.yaml").read_text()
    # from now on the fit knows it
    with_plugin.ok("run", "run.yaml", "--until", "fit")
