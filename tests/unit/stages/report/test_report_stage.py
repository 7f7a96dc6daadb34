"""The stage report on a small simulated run whose fit is its truth."""

import json
import shutil
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.stage_runs import completed, stage_context
from helpers.without_pictures import page_without_pictures
from helpers.written_fit import write_fit

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.compute.executor import beside
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.pages.report_json import report_numbers
from pchem_pipeline.report.pages.summary import flags
from pchem_pipeline.run.fingerprint import status
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages.report.pixels import choose_pixels
from pchem_pipeline.stages.report.report import gather
from pchem_pipeline.stages.table import STAGES

NY, NX, FRAMES = 16, 24, 200


def make_context(folder, settings=None, **run):
    simulate = {"shape": [NY, NX], "n_frames": FRAMES, "format": "npy"}
    return stage_context(folder, run={"tile": 8, **run}, simulate=simulate, report=settings or {})


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A run up to the ensemble; 3 pixels failed."""
    context = completed(make_context(tmp_path_factory.mktemp("base")), "simulate", "ingest", "histogram")
    status_map = np.zeros((NY, NX), dtype=np.uint16)
    status_map[2, :3] = int(FitStatus.TOO_FEW_BINS)
    status_map[5, 5] = int(FitStatus.POOR_FIT)
    write_fit(context, status_map, status_map == int(FitStatus.TOO_FEW_BINS))
    return completed(context, "maps", "ensemble").base_dir


@pytest.fixture
def folder(base, tmp_path):
    shutil.copytree(base, tmp_path / "run")
    return tmp_path / "run"


def test_a_run_gets_page_and_numbers(folder, undrawn):
    context = completed(make_context(folder, title="My <sensor>"), "report")
    store = folder / "run.zarr"
    numbers = json.loads((store / "report.json").read_text())
    median = float(np.nanmedian(context.store.read("maps/read_noise_e")))
    assert numbers["summary"]["read_noise_e"]["median"] == pytest.approx(median)
    assert numbers["ensemble"]["rmse"] == pytest.approx(context.store.attributes("ensemble")["rmse"])
    assert numbers["fit_status"]["n_failed"] == 3
    assert numbers["fit_status"]["reasons"]["poor_fit"]["pixels"] == 1
    stages = ["simulate", "ingest", "histogram", "fit", "maps", "ensemble"]
    assert [row["stage"] for row in numbers["stages"]] == stages
    assert numbers["inputs"][0]["name"].endswith(".npy")
    assert len(numbers["moments"]) >= 4
    html = (store / "report.html").read_text(encoding="utf-8")
    assert "My &lt;sensor&gt;" in html
    assert str(folder) not in html
    assert status(STAGES["report"], context).state == "complete"


def test_chosen_pixels_are_shown_and_wrong_ones_refused(folder):
    context = make_context(folder, {"pixels": [[2, 1], [15, 23]]})
    data = gather(context.store, context.config, [])
    assert [(pixel.y, pixel.x) for pixel in data.pixels] == [(2, 1), (15, 23)]
    assert data.pixels[0].status == "fewer than 3 occupied bins"
    pixel = data.pixels[1]
    shown = np.repeat(pixel.origin + np.arange(pixel.counts.size), pixel.counts)
    np.testing.assert_array_equal(shown, np.sort(np.load(next(folder.rglob("*.npy")))[:, 15, 23]))
    with pytest.raises(ConfigError, match="y = 16, x = 0 is outside the sensor of 16 x 24"):
        execute("report", make_context(folder, {"pixels": [[16, 0]]}))


def test_a_report_is_the_same_whoever_works_on_it(folder):
    context = make_context(folder)
    context.store.write_config(dump_config(context.config))
    pages = []
    for workers in (1, 3):
        compute = context.config.compute.model_copy(update={"workers": workers})
        config = context.config.model_copy(update={"compute": compute})
        with beside(workers) as hand:
            data = gather(context.store, config, [], hand)
            pages.append(page_without_pictures(data))
    assert 'id="inspector-app"' in pages[0]
    assert len(set(pages)) == 1  # without pytest's comparison


def test_what_a_run_lacks_is_said(folder):
    context = make_context(folder)
    context.store.delete("ensemble")
    for name in ("maps/charge_rate", "maps/charge_rate_stderr"):
        context.store.delete(name)
    data = gather(context.store, context.config, [])
    assert set(data.missing) == {"charge_rate", "ensemble", "nuced", "electrons", "components", "methods"}
    assert "input.integration_time" in data.missing["charge_rate"]
    # pixels of unfinished tiles are not called good
    for name in ("maps/conversion_gain", "maps/read_noise_e"):
        values = context.store.read(name)
        values[8:, :8] = np.nan
        context.store.write_array(name, values)
    data = gather(context.store, context.config, [])
    assert data.unfitted.sum() == 64
    assert any("64 pixels not fitted yet" in flag.text for flag in flags(data))
    counted = report_numbers(data)["fit_status"]
    assert (counted["n_unfitted"], counted["n_failed"]) == (64, 3 + 64)


def test_a_figure_that_cannot_be_drawn_fails_the_report_with_its_reason(folder, monkeypatch):
    failing = Mock(side_effect=MemoryError("no room to draw"))
    monkeypatch.setattr("pchem_pipeline.stages.report.report.draw_figure", failing)
    state = execute("report", make_context(folder))
    assert state.state == "failed"
    assert state.why.startswith("1 of 1 units failed, first all: out of memory (no room to draw); use fewer")
    assert not (folder / "run.zarr" / "report.html").exists()


def test_the_good_pixel_nearest_to_a_corner_of_all_good_ones_is_chosen():
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((80, 70))
    exposure = np.exp(3.0 * noise + 0.1 * rng.standard_normal((80, 70)))  # none is near two of the corners
    fit_status = np.zeros(noise.shape, np.uint16)
    fit_status[:20] = int(FitStatus.POOR_FIT)
    ranks = [each[20:].ravel().argsort().argsort() / each[20:].size for each in (noise, exposure)]
    corners = ((0.1, 0.1), (0.1, 0.9), (0.9, 0.1), (0.9, 0.9))
    for (label, y, x), (low, high) in zip(choose_pixels(noise, exposure, fit_status), corners, strict=True):
        assert y >= 20
        assert (label.startswith("high"), label.endswith("high exposure")) == (low > 0.5, high > 0.5)
        distance = np.hypot(ranks[0] + 0.5 / ranks[0].size - low, ranks[1] + 0.5 / ranks[1].size - high)
        assert distance[(y - 20) * 70 + x] == pytest.approx(distance.min())
    # few or no pixels to choose from
    nan, one = np.full((2, 2), np.nan), np.array([[0.3, np.nan], [0.2, np.nan]])
    words = np.array([[2, 2], [8, 2]], dtype=np.uint16)
    assert choose_pixels(nan, nan, words) == [("no fit", 0, 0), ("no fit", 1, 0)]
    assert {(y, x) for _, y, x in choose_pixels(one, one, np.zeros((2, 2), np.uint16))} == {(0, 0), (1, 0)}
