"""A run in a notebook: lazy datasets with units and masks, pixels, figures, and the tutorial executed."""

import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from helpers.places import ROOT
from matplotlib.figure import Figure

import pchem_pipeline
from pchem_pipeline.base.errors import ConfigError, InputError, MissingDependencyError, StoreError
from pchem_pipeline.commands.figures import figures_of_run
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.charts.on_paper import drawing_bytes
from pchem_pipeline.run.progress import Reporter
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
    [first] = run.model_versions
    assert (first.number, first.source, first.effects) == (1, "config", ())
    assert run.model == first


def test_runs_and_figures_are_told_in_few_words(run):
    first, answers, medians = repr(run).split("\n")
    assert first == "<Run run.zarr: 20 x 28 pixels, 1,200 frames; complete>"
    assert answers.startswith("Is the sensor within limits? ")
    told = run.group("maps").attrs["summary"]["read_noise_e"]["median"]
    assert f"median read noise {told:.4f} ± " in medians
    assert len(repr(run.figures)) < 100 * len(run.figures)
    assert repr(run.figures["ensemble"]) == "<Figure ensemble: Ensemble histogram and its prediction>"


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
    for place in ((-1, 0), (20, 0), (0, 28), (3.5, 5)):
        with pytest.raises(ConfigError, match="is outside the sensor of 20 x 28"):
            run.pixel(*place)


def test_figures_are_those_of_pchem_figures(run, finished, tmp_path):
    assert len(run.figures) > 10
    figures_of_run(finished, tmp_path, Reporter("off"), formats=("svg",), only=("electron_numbers",))
    drawn = drawing_bytes(run.figure("electron_numbers"), "svg", dpi=600, title="Estimated electron numbers")
    assert drawn == (tmp_path / "electron_numbers.svg").read_bytes()
    assert run.figure("map_bias", width=60).get_figwidth() == pytest.approx(60 / 25.4)
    with pytest.raises(ConfigError, match="has no figure nothing; it has electron_cells, pixel_fits"):
        run.figure("nothing")


def test_plots_go_into_axes_of_the_user(run):
    figure = Figure(layout="constrained")
    axes = figure.subplots(2, 2)
    pixel = run.pixel(3, 5)
    assert pixel.plot(ax=axes[0, 0]) is axes[0, 0]
    run.maps.read_noise_e.plot(ax=axes[0, 1], add_colorbar=False)
    below = axes[1]
    assert pixel.plot(ax=below) is below
    assert figure.axes == axes.ravel().tolist()
    for shown in (axes[0, 0], axes[1, 0]):
        bars, fit = shown.patches[0].get_data(), shown.lines[0].get_xydata()
        seen = pixel.histogram.sel(dn=(bars.edges[:-1] + 0.5).round().astype(int)[5:-5])
        np.testing.assert_allclose(bars.values[5:-5], seen / 1200)
        assert 0.9 < np.trapezoid(fit[:, 1], fit[:, 0]) < 1.01
    assert axes[0, 0].get_xlabel() == "signal (DN)"
    assert axes[1, 1].get_ylabel().startswith("residual")
    for name, found in run.figures.items():
        others = Figure().subplots(1, sum(len(stack.panels) for stack in found.chart.stacks))
        assert run.figure(name, ax=others) is others
        assert all(each.has_data() for each in np.ravel(others))
    for ax, words in (
        (Figure(), "ax: Figure; give 1 axes of matplotlib"),
        (Figure().subplots(3), r"ax: Axes, Axes, Axes; give 2 axes .* plt\.subplots\(2\)"),
        ([], "ax: nothing; give 2 axes"),
    ):
        with pytest.raises(ConfigError, match=words):
            pixel.plot(ax=ax)


def test_the_table_has_a_row_for_each_pixel(run, store):
    table = run.table()
    quality, status = store.read("maps/quality"), store.read("fit/fit_status")
    assert list(table.columns[:2]) == ["y", "x"]
    assert len(table) == 20 * 28
    for name in ("bias", "bias_stderr", "read_noise_e", "quality"):
        np.testing.assert_array_equal(table[name], store.read(f"maps/{name}")[table.y, table.x])
    assert (table.fit_status == "ok").sum() == (status == 0).sum() == (quality == 0).sum()
    doubtful = table.fit_status.str.contains("bias_ambiguous").values
    np.testing.assert_array_equal(doubtful, (status.ravel() & FitStatus.BIAS_AMBIGUOUS) != 0)
    assert 0 < doubtful.sum() < 100
    assert table.attrs["conversion_gain"] == "e-/DN"


def test_frames_in_memory_are_calibrated_as_files_are(run, camera, tmp_path):
    [path, *_] = sorted((camera / "frames").glob("*.tif"))
    frames = tifffile.imread(path)
    found = run.apply(frames.astype(np.int64), what="electrons,exposure")
    assert found.electrons.variable._in_memory
    assert (found.electrons.attrs["units"], found.x.attrs["units"]) == ("e-", "pixel")
    assert {"electrons_stderr_read", "exposure_stderr"} <= set(found.data_vars)
    same = run.apply(path, what="electrons,exposure")
    assert found.drop_attrs().identical(same.drop_attrs())
    one = run.apply(frames[0], what="electrons")
    np.testing.assert_array_equal(one.electrons.values, found.electrons.values[:1])
    kept = run.apply(frames, tmp_path / "night.zarr", what="electrons")
    made = (tmp_path / "night.zarr" / "applied" / "electrons" / "zarr.json").stat().st_mtime_ns
    again = run.apply(list(frames), tmp_path / "night.zarr", what="electrons")
    assert (tmp_path / "night.zarr" / "applied" / "electrons" / "zarr.json").stat().st_mtime_ns == made
    assert not again.electrons.variable._in_memory
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(kept)).electrons, found.electrons)
    for wrong, error, words in (
        (frames[:, :4, :5], InputError, r"^array of shape .*, 4, 5\): frames of 4 x 5 pixels, .* 20 x 28"),
        (np.zeros((3, 20, 28)), ConfigError, "frames of float64: PCH-EM needs raw DN"),
        (np.zeros(7, int), ConfigError, r"frames of shape \(7,\): give an array \(frame, y, x\)$"),
        ([], ConfigError, "input.files is empty"),
    ):
        with pytest.raises(error, match=words):
            run.apply(wrong)


def test_all_that_a_run_returns_is_pickled(run):
    def copy(thing):
        return pickle.loads(pickle.dumps(thing))

    assert copy(run.maps).identical(run.maps)
    assert copy(run).maps.identical(run.maps)
    pixel = run.pixel(3, 5)
    assert repr(copy(pixel)) == repr(pixel)
    assert copy(pixel).histogram.identical(pixel.histogram)
    assert copy(run.figures).keys() == run.figures.keys()
    np.testing.assert_array_equal(copy(run.twin()).frames(1.0, 2), run.twin().frames(1.0, 2))
    for name in ("ensemble", "map_bias"):
        assert copy(run.figure(name))._repr_png_() == run.figure(name)._repr_png_()


def test_what_is_missing_or_damaged_is_said(run, finished, tmp_path, monkeypatch):
    with pytest.raises(StoreError, match=r"has no group truth; it has ensemble, .*maps, "):
        _ = run.truth
    for name in ("", "maps/bias"):
        with pytest.raises(StoreError, match="has no group"):
            run.group(name)
    with pytest.raises(StoreError, match="does not exist"):
        pchem_pipeline.open_run(tmp_path / "none.zarr")
    with pytest.raises(StoreError, match=r"not searched for yet; run: pchem discrepancy .*run\.yaml"):
        _ = run.verdict
    assert run.status()["report"] == "complete"
    path = shutil.copytree(finished, tmp_path / "a.zarr")
    (path / "report.json").write_text("[1]")
    shutil.copy(path / "fit/correlation/zarr.json", path / "fit/bias/zarr.json")
    damaged = pchem_pipeline.open_run(path)
    with pytest.raises(StoreError, match=r"report\.json is damaged; run again to write it"):
        damaged._repr_html_()
    with pytest.raises(StoreError, match=r"fit is damaged \(.*\); run it again: pchem fit .* --force"):
        _ = damaged.fit
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingDependencyError, match="pip install 'xarray>="):
        pchem_pipeline.open_run(finished)


def test_the_tutorial_runs(finished, store, tmp_path):
    (tmp_path / "pchem-demo").mkdir()
    shutil.copytree(finished, tmp_path / "pchem-demo" / "demo.zarr")
    shutil.copy(TUTORIAL, tmp_path)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    environment.pop("MPLBACKEND", None)  # that of notebooks shows what pyplot holds
    result = subprocess.run(
        [Path(sys.executable).with_name("jupyter-execute"), "--inplace", "tutorial.ipynb"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    cells = json.loads((tmp_path / "tutorial.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    text = "".join("".join(output.get("text", [])) for output in outputs)
    median = np.median(store.read("maps/bias")[store.read("maps/quality") == 0])
    assert f"bias             {median:9.4f} DN" in text
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert kinds.count("image/png") == 4  # nothing is shown twice
    assert (tmp_path / "ensemble.pdf").exists()
    assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)


def test_the_tutorial_is_kept_with_its_outputs():
    cells = [c for c in json.loads(TUTORIAL.read_text())["cells"] if c["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells[:-1])
    assert all(output["output_type"] != "error" for cell in cells for output in cell["outputs"])
    assert TUTORIAL.stat().st_size < 1_000_000
