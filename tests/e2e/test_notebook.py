"""A run in a notebook: lazy datasets with units and masks, pixels, figures, and the tutorial executed."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.places import ROOT

import pchem_pipeline
from pchem_pipeline.base.errors import ConfigError, MissingDependencyError, StoreError
from pchem_pipeline.commands.figures import figures_of_run
from pchem_pipeline.report.charts.on_paper import drawing_bytes
from pchem_pipeline.store.run_store import RunStore

TUTORIAL = ROOT / "docs" / "tutorial.ipynb"


@pytest.fixture(scope="module")
def run(finished):
    return pchem_pipeline.open_run(finished)


@pytest.fixture(scope="module")
def store(finished):
    return RunStore.open(finished)


def test_maps_are_lazy_and_know_their_units(run, store, finished):
    maps = pchem_pipeline.open_run(str(finished)).maps
    assert not maps.bias.variable._in_memory
    assert maps.bias.dims == ("y", "x")
    assert (maps.conversion_gain.attrs["units"], maps.x.attrs["units"]) == ("e-/DN", "pixel")
    assert {"quality", "fit_status", "y", "x"} <= set(maps.coords)
    assert not maps.attrs
    assert "summary" in run.group("maps").attrs
    np.testing.assert_array_equal(maps.bias.values, store.read("maps/bias"))
    np.testing.assert_array_equal(maps.fit_status.values, store.read("fit/fit_status"))
    assert maps.sel(y=3, x=5).bias.item() == store.read("maps/bias")[3, 5]
    for name in ("fit", "histogram", "summary", "ensemble"):
        assert len(getattr(run, name).data_vars) > 3
    assert run.ensemble.density.coords["dn"].attrs["units"] == "DN"
    assert int(run.ensemble.counts.sum()) == int(store.read("ensemble/counts").sum())


def test_the_model_is_told(run):
    [first] = run.model_versions
    assert (first.number, first.source, first.effects) == (1, "config", ())
    assert run.model == first


def test_masks_leave_out_what_is_not_to_be_believed(run, store):
    quality = store.read("maps/quality")
    assert 0 < (quality == 0).sum() < quality.size
    np.testing.assert_array_equal(run.good.values, quality == 0)
    np.testing.assert_array_equal(run.usable.values, quality <= 1)
    kept = run.maps.where(run.good).bias.values
    np.testing.assert_array_equal(np.isfinite(kept), (quality == 0) & np.isfinite(store.read("maps/bias")))


def test_a_pixel_is_that_of_the_store(run, store):
    y, x = (int(i) for i in np.argwhere(store.read("maps/quality") == 0)[7])
    pixel = run.pixel(y, x)
    assert pixel.parameters["bias"] == store.read("maps/bias")[y, x]
    assert pixel.stderr["bias"] == store.read("maps/bias_stderr")[y, x]
    assert (pixel.status, f"y = {y}, x = {x}" in repr(pixel)) == ("", True)
    counts, origin = store.read("histogram/counts")[y, x], store.read("histogram/origin")[y, x]
    assert int(pixel.histogram.sum()) == 1200
    dn = pixel.histogram.dn.values
    np.testing.assert_array_equal(pixel.histogram.values, counts[dn - origin])
    assert pixel.histogram.values[[0, -1]].min() > 0
    z = (pixel.histogram - pixel.expected) / np.sqrt(pixel.expected)
    known = z.values[pixel.expected.values > 5]
    # 20 to 30 bins: the mean square of N(0, 1) within five standard errors
    assert abs((known**2).mean() - 1) < 5 * np.sqrt(2 / known.size)
    assert pixel.plot(width="60mm")._repr_png_().startswith(b"\x89PNG")
    assert pixel.plot().axes[0].get_title("left").startswith(f"pixel y = {y}, x = {x}\n")
    assert len(run.pixels([(0, 0), (1, 2)])) == 2


@pytest.mark.parametrize("place", [(-1, 0), (20, 0), (0, 28)])
def test_pixels_outside_are_refused(run, place):
    with pytest.raises(ConfigError, match="is outside the sensor of 20 x 28"):
        run.pixel(*place)


def test_figures_are_those_of_pchem_figures(run, finished, tmp_path):
    assert len(run.figures) > 10
    figures_of_run(finished, tmp_path, formats=("svg",), only=("electron_numbers",), progress="off")
    drawn = drawing_bytes(run.figure("electron_numbers"), "svg", dpi=600, title="Estimated electron numbers")
    assert drawn == (tmp_path / "electron_numbers.svg").read_bytes()
    assert run.figure("map_bias", width=60).get_figwidth() == pytest.approx(60 / 25.4)
    with pytest.raises(
        ConfigError, match="this run has no figure nothing; it has electron_cells, pixel_fits"
    ):
        run.figure("nothing")


def test_what_is_missing_is_said(run, finished, tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="has no truth yet; for the state of the run: pchem status"):
        _ = run.truth
    with pytest.raises(StoreError, match="does not exist"):
        pchem_pipeline.open_run(tmp_path / "none.zarr")
    assert repr(run).startswith("<Run run.zarr: 20 x 28 pixels, 1,200 frames; ")
    assert run.status()["report"] == "complete"
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingDependencyError, match="pip install 'xarray>="):
        pchem_pipeline.open_run(finished)


def test_files_of_another_kind_are_damage(finished, tmp_path):
    path = shutil.copytree(finished, tmp_path / "a.zarr")
    (path / "report.json").write_text("[1]")
    shutil.copy(path / "fit/correlation/zarr.json", path / "fit/bias/zarr.json")
    damaged = pchem_pipeline.open_run(path)
    with pytest.raises(StoreError, match=r"report\.json is damaged; run again to write it"):
        damaged._repr_html_()
    with pytest.raises(StoreError, match=r"fit is damaged \(.*\); run it again: pchem fit .* --force"):
        _ = damaged.fit


def test_the_tutorial_runs(finished, tmp_path):
    (tmp_path / "pchem-demo").mkdir()
    shutil.copytree(finished, tmp_path / "pchem-demo" / "demo.zarr")
    shutil.copy(TUTORIAL, tmp_path)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    result = subprocess.run(
        [Path(sys.executable).with_name("jupyter-execute"), "--inplace", "tutorial.ipynb"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    cells = json.loads((tmp_path / "tutorial.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    text = "".join("".join(output.get("text", [])) for output in outputs)
    median = np.median(
        RunStore.open(finished).read("maps/bias")[RunStore.open(finished).read("maps/quality") == 0]
    )
    assert f"bias             {median:9.4f} DN" in text
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert kinds.count("image/png") == 3
    assert (tmp_path / "ensemble.pdf").exists()
    assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)


def test_the_tutorial_is_kept_with_its_outputs():
    cells = [c for c in json.loads(TUTORIAL.read_text())["cells"] if c["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells[:-1])
    assert all(output["output_type"] != "error" for cell in cells for output in cell["outputs"])
    assert TUTORIAL.stat().st_size < 1_000_000
