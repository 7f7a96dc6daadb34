"""``pchem methods`` and ``pchem plan`` as a user runs them."""

import json

import numpy as np
import pytest
from helpers.commands import Shell
from helpers.without_pictures import undrawn

from pchem_pipeline.methods.base import methods
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture(scope="module")
def exposures(tmp_path_factory):
    """Runs of the same 8 x 8 pixels: bright.zarr (fitted), dark.zarr and half.zarr (histograms)."""
    shell = Shell(tmp_path_factory.mktemp("exposures"))
    rng = np.random.default_rng(4)
    step, bias = rng.normal(11, 0.5, (8, 8)), rng.normal(100, 2, (8, 8))
    for name, light in (("bright", 2.0), ("dark", 0.0), ("half", 1.0)):
        electrons = rng.poisson(light, (1500, 8, 8)) + 0.3 * rng.standard_normal((1500, 8, 8))
        np.save(shell.folder / f"{name}.npy", np.rint(electrons * step + bias).astype(np.uint16))
        text = f"run: {{store: {name}.zarr, tile: 8}}\ninput: {{files: [{name}.npy], bit_depth: 12}}\n"
        (shell.folder / f"{name}.yaml").write_text(text)
        for stage in ("ingest", "histogram"):
            shell.ok(stage, f"{name}.yaml", "--quiet")
    with undrawn():
        shell.ok("run", "bright.yaml", "--quiet")
    return shell


@pytest.mark.usefixtures("undrawn")
def test_methods_with_other_exposures(exposures):
    others = ("--with", "dark.zarr", "--with", "half.zarr")
    result = exposures.ok("methods", "bright.zarr", *others, "--study-pixels", "0")
    found = json.loads((exposures.folder / "bright.zarr" / "methods.json").read_text())
    names = [method["name"] for method in found["methods"]]
    assert names == list(methods())
    assert all(not method["missing"] for method in found["methods"])
    assert [sample["n_frames"] for sample in found["samples"]] == [1500] * 3
    assert found["samples"][1]["quanta_exposure"] == pytest.approx(0, abs=0.02)
    transfer = found["methods"][names.index("photon_transfer")]
    # delta method: 5.5 % at 1500 frames; the fit itself errs by a sixth of that
    assert transfer["errors"]["conversion_gain"]["rmse"] == pytest.approx(0.055, rel=5 / np.sqrt(128) + 0.1)
    assert transfer["title"] in result.stdout
    assert result.stdout.splitlines()[-1].endswith("report.html")
    store = RunStore.open(exposures.folder / "bright.zarr")
    gains = store.read("methods/conversion_gain")
    assert gains.shape == (len(names), 64)
    assert store.attributes("methods/conversion_gain")["methods"] == names
    fit = store.read("fit/conversion_gain")[store.read("methods/pixel_y"), store.read("methods/pixel_x")]
    np.testing.assert_array_equal(gains[names.index("pchem_em")], fit)
    page = (exposures.folder / "bright.zarr" / "report.html").read_text()
    assert "Comparison with other methods" in page
    assert transfer["title"] in page
    # what the command line chose stays in force, also where the YAML is asked; other settings make it anew
    for run in ("bright.zarr", "bright.yaml"):
        assert "methods     complete" in exposures.ok("status", run).stdout
    again = exposures.ok("methods", "bright.yaml", "--pixels", "20", "--study-pixels", "0", "--dry-run")
    assert "input.chosen.pixels None → 20" in again.stderr
    # what is up to date is not done again, and a wrong sample costs nothing of it
    before = (exposures.folder / "bright.zarr" / "methods.json").stat().st_mtime_ns
    for others, words in (
        (["bright.zarr"], "list each run once"),
        (["dark.zarr", "dark.zarr"], "list each run once"),
        (["none.zarr"], "does not exist"),
    ):
        options = [option for name in others for option in ("--with", name)]
        refused = exposures("methods", "bright.zarr", *options, "--quiet")
        assert (refused.code in (2, 4), refused.stderr.count("\n")) == (True, 1)
        assert words in refused.last
    assert (exposures.folder / "bright.zarr" / "methods.json").stat().st_mtime_ns == before


def test_samples_of_other_pixels_or_the_same_frames_are_refused(exposures):
    frames = np.load(exposures.folder / "dark.npy")
    np.save(exposures.folder / "small.npy", frames[:, :4])
    for name, file, words in (
        ("small", "small.npy", "has 4 x 8 pixels, this run 8 x 8"),
        ("again", "bright.npy", "has the same frames as this run"),
    ):
        text = f"run: {{store: {name}.zarr, tile: 8}}\ninput: {{files: [{file}]}}\n"
        (exposures.folder / f"{name}.yaml").write_text(text)
        exposures.ok("run", f"{name}.yaml", "--until", "histogram", "--quiet")
        assert words in exposures.refused(2, "methods", "bright.zarr", "--with", f"{name}.zarr", "--quiet")
