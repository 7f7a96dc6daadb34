"""Somebody else's effect: installed beside the package, found, named, and added; broken ones are left out."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from helpers.installed import install
from helpers.places import TESTS

RUN = """
run: {store: run.zarr}
input: {files: [stack/frames.npy], integration_time: 1.0}
discrepancy: {replicates: 20, extended_replicates: 12, candidates: [CANDIDATES]}
"""
RIVALS = "frame_noise, row_noise"
BROKEN = {"hasty_offset": "nobody divided the offsets", "careless_offset": "offsets were left on the desk"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the package as pip leaves it."""
    folder = tmp_path_factory.mktemp("site")
    install(TESTS / "plugin_package", folder)
    return folder


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A folder ``stack`` whose frames hide the effect, made by a process that knows neither package."""
    folder = tmp_path_factory.mktemp("hidden")
    command = [sys.executable, TESTS / "hidden" / "make.py", "--effect", "checkerboard_offset"]
    command += ["--level", 3, "--seed", 21, "--shape", 12, 12, "--frames", 1200, "--out", folder / "stack"]
    subprocess.run(list(map(str, command)), check=True)
    return folder


@pytest.fixture
def with_plugin(shell, site, stack):
    """Commands of an environment that has the plug-in, in a folder with the hidden stack and a YAML."""
    shutil.copytree(stack / "stack", shell.folder / "stack")
    candidates = ", ".join([RIVALS, "chessboard_offset", *BROKEN])
    (shell.folder / "run.yaml").write_text(RUN.replace("CANDIDATES", candidates))
    path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    return shell.alone(PYTHONPATH=path)


def test_a_plug_in_is_found_named_and_added_and_broken_ones_are_left_out(with_plugin, stack):
    with_plugin.ok("ingest", "run.yaml")
    result = with_plugin.ok("discrepancy", "run.yaml")
    found = json.loads((with_plugin.folder / "run.zarr" / "discrepancy.json").read_text())
    assert found["verdict"] == "named"
    assert found["effects"] == ["chessboard_offset"]
    assert found["gap"]["after"] < 0.2 * found["gap"]["before"]
    (key,) = json.loads((stack / "sealed" / "stack.json").read_text())["effects"]
    offset = found["steps"][0]["parameters"]["offset_dn"]
    assert abs(offset["value"] - key["strength"]) < 0.1 * key["strength"]
    for tag, reason in BROKEN.items():
        assert reason in found["defects"][tag]
        assert any(tag in line and reason in line for line in result.stderr.splitlines())
    assert any("lost_offset" in line for line in result.stderr.splitlines())
    assert "chessboard_offset" in (with_plugin.folder / "run.effects.yaml").read_text()
    # from now on the fit knows it
    with_plugin.ok("run", "run.yaml", "--until", "fit")
