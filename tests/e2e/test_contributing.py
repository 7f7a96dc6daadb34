"""The examples of CONTRIBUTING.md as they stand: a package of others, and additions to a copy of ours."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.installed import install
from helpers.places import ROOT

from pchem_pipeline.store.run_store import RunStore

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
EXAMPLE = re.compile(
    r"<!-- file: (?P<file>\S+?)(?:, (?P<where>before|behind): (?P<anchor>.+?))? -->\n"
    r"```\w+\n(?P<text>.*?)```",
    re.S,
)


def write_examples(folder):
    """Write the files of the examples, and put the additions to ours into the copy of our package."""
    for example in EXAMPLE.finditer(TEXT):
        path, text = folder / example["file"], example["text"]
        if example["where"] is None:
            assert not path.exists()
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
            continue
        anchor = example["anchor"].replace("\\n", "\n")
        before, found, behind = path.read_text().partition(anchor)
        assert found, f"{example['file']} has no {anchor!r}"
        added = text + found if example["where"] == "before" else f"{found}\n{text.rstrip()}"
        path.write_text(before + added + behind)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The folder in which all commands of the page were run, in order."""
    folder = tmp_path_factory.mktemp("contributing")
    shutil.copytree(ROOT / "pchem_pipeline", folder / "pchem_pipeline")
    write_examples(folder)
    install(folder / "lab_effects", folder / "site")
    (folder / "bin").mkdir()
    pchem = folder / "bin" / "pchem"
    # not the line of a Python script: the path of the interpreter may hold a space
    pchem.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pchem_pipeline "$@"\n')
    pchem.chmod(0o755)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, (folder, folder / "site"))),
        "PATH": os.pathsep.join([str(folder / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]]),
    }
    script = "set -e\n" + "\n".join(re.findall(r"```bash\n(.*?)```", TEXT, re.S))
    result = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True, timeout=500
    )
    assert result.returncode == 0, result.stderr
    return folder


def test_the_effect_is_simulated_and_fitted(done):
    store = RunStore.open(done / "odd_even.zarr")
    fitted, true = store.read("fit/read_noise_dn"), store.read("truth/read_noise_dn")
    # without the effect in the law the fit would find (sigma^2 + 4)^(1/2) DN
    assert np.isfinite(fitted).mean() > 0.98
    assert abs(np.nanmedian(fitted / true) - 1) < 0.05
    assert np.median(np.hypot(true, 2.0) / true) > 1.1


def test_reader_method_stage_and_figure_do_their_work(done):
    store = RunStore.open(done / "night.zarr")
    assert store.read("maps/quanta_exposure").shape == (9, 10)
    assert np.nanmedian(store.read("maps/quanta_exposure")) == pytest.approx(2.0, abs=0.1)
    assert "low_side" in (done / "night.zarr" / "methods.json").read_text()
    expected = np.nanmedian(store.read("maps/read_noise_e"), axis=1)
    np.testing.assert_allclose(store.read("lines/read_noise_e"), expected)
    assert store.records.read("lines").finished
    assert "Read noise of the rows" in (done / "night.zarr" / "report.html").read_text()
    assert (done / "figures" / "read_noise_of_rows.svg").exists()
    head, *rows = (done / "figures" / "read_noise_of_rows.csv").read_text().splitlines()
    assert (head, len(rows)) == ("y,read noise (e-)", 9)


def test_the_files_that_it_names_exist():
    words = set(re.findall(r"`(\w+/[\w/]+\.(?:py|md|toml))\b", TEXT)) | set(
        re.findall(r"`((?:scripts|tests)/[\w/.]+)`", TEXT)
    )
    added = {example["file"] for example in EXAMPLE.finditer(TEXT)}
    for word in words:
        places = (ROOT / word, ROOT / "pchem_pipeline" / word)
        assert any(place.exists() for place in places) or word in added, word
    for folder in re.findall(r"^(\w+)/ ", TEXT, re.M):
        assert (ROOT / folder).is_dir() or (ROOT / "pchem_pipeline" / folder).is_dir(), folder
