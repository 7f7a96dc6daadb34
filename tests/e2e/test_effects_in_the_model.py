"""A run whose model holds the effects of its camera: biased maps come right, and the pages say why."""

import json
import re
from typing import Any

import numpy as np
import pytest
from helpers.without_pictures import undrawn

from pchem_pipeline.base.variables import FREE_SATELLITES, PARAMETERS
from pchem_pipeline.commands.plan import make_plan
from pchem_pipeline.commands.view import RunView
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.fit.status import flags_of
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.store.run_store import RunStore

EFFECTS: list[dict[str, Any]] = [
    {"tag": "signal_dependent_noise", "noise_e": 0.09},
    {"tag": "row_noise", "row_noise_dn": 1.2},
    {"tag": "nonlinearity", "step_change": 0.004},
]
QUIET = Command(quiet=True)


def configured(folder, effects):
    simulate = {"shape": [16, 20], "n_frames": 3000, "seed": 3, "format": "npy", "truth_frames": 500}
    content = {"run": {"tile": 8}, "simulate": {**simulate, "effects": EFFECTS}}
    content |= {"model": {"effects": effects}, "compute": {"backend": "serial"}}
    path = folder / "run.yaml"
    path.write_text(dump_config(RunConfig.model_validate(content)), encoding="utf-8")
    return path


def mean_pulls(store):
    """Mean pull against the truth of the pixels with a good value, in units of its own standard error."""
    found = {}
    for name in (*PARAMETERS, "read_noise_e"):
        value, error = (store.read(f"maps/{name}{end}") for end in ("", "_stderr"))
        each = (value - store.read(f"truth/{name}")) / error
        each = each[np.isfinite(each) & (store.read("maps/quality") == 0)]
        assert each.size > 250
        found[name] = float(each.mean() * np.sqrt(each.size))
    return found


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The folder of the run, extended, and what was seen of it before."""
    folder = tmp_path_factory.mktemp("extended")
    path = configured(folder, [])
    run_stages(find_run(path), ["simulate", "ingest", "histogram", "fit", "maps", "ensemble"], QUIET)
    store = RunStore.open(folder / "run.zarr")
    assert not any(store.has(f"fit/{name}") for name in FREE_SATELLITES)
    before = {"pulls": mean_pulls(store), "facts": dict(store.attributes("ensemble"))}
    configured(folder, EFFECTS)
    with undrawn():
        run_stages(find_run(path), ["fit", "maps", "ensemble", "report"], QUIET)
    return path, before


def test_bias_is_cut_at_least_five_times_where_it_was_significant(both):
    path, before = both
    after = mean_pulls(RunStore.open(path.parent / "run.zarr"))
    significant = {name: was for name, was in before["pulls"].items() if abs(was) > 8}
    assert {"read_noise_dn", "read_noise_e", "conversion_gain"} <= significant.keys()
    for name, was in significant.items():
        assert abs(after[name]) < abs(was) / 5, name
    for name, now in after.items():
        assert abs(now) < 5, name


def test_a_plan_has_the_noise_of_the_effects(both):
    """As many frames as the run has give the error of the gain that its fit has."""
    path, _ = both
    store = RunStore.open(path.parent / "run.zarr")
    error = np.median(store.read("maps/conversion_gain_stderr") / store.read("maps/conversion_gain"))
    words = make_plan(path.parent / "run.zarr", frames=3000)
    planned = float(re.search(r"conversion_gain +([\d.]+) %", words)[1])
    assert planned == pytest.approx(100 * error, rel=0.1)
    assert "effects in the model of the run (signal_dependent_noise, row_noise, nonlinearity): noise" in words


def test_ensemble_and_electron_numbers_are_predicted_with_the_extended_law(both):
    path, before = both
    store = RunStore.open(path.parent / "run.zarr")
    facts, old = dict(store.attributes("ensemble")), before["facts"]
    assert facts["model"] == "PCD + signal_dependent_noise + row_noise + nonlinearity"
    assert "model" not in old
    assert store.read("ensemble/epcd_exact").sum() == pytest.approx(1.0, abs=1e-4)
    for name in ("epcd_exact", "nuced_exact"):
        floor = facts["rmse"]["noise_floor" if name == "epcd_exact" else "nuced_noise_floor"]
        assert facts["rmse"][name] < 1.3 * floor
        assert facts["rmse"][name] <= old["rmse"][name] * 1.001
    rows = {row["name"]: row for row in facts["moments"]}
    added = rows["effects"]["predicted"]
    assert added > 1.2**2
    for name in ("mean", "variance", "nuced_mean", "nuced_variance"):
        row = rows[name]
        assert abs(row["predicted"] - row["observed"]) < 5 * row["stderr"]
    # the total has the variance of all biases, its term leaves out that they may be an electron off
    bias, gain, gap = (store.read(f"fit/{name}") for name in ("bias", "conversion_gain", "likelihood_gap"))
    weight = np.tanh(gap / 2)
    weight[(store.read("fit/fit_status") & int(flags_of("conversion_gain"))) != 0] = 0.0
    square = (bias - np.average(bias, weights=weight)) ** 2 - (1 - weight**2) / (2 * gain) ** 2
    expected = pytest.approx(np.average(square, weights=weight), rel=1e-12)
    assert rows["variance_of_bias"]["predicted"] == expected
    terms = ("variance_of_signal", "mean_read_variance", "mean_shot_variance", "bias_signal_covariance")
    total = bias.var() + sum(rows[name]["predicted"] for name in (*terms, "effects"))
    assert total == pytest.approx(rows["variance"]["predicted"], rel=1e-12)
    # electron numbers err as often as predicted, and no more often than those of the plain fit
    rate, stderr = facts["error_rate"], facts["error_rate_stderr"]
    assert abs(rate - facts["expected_error_rate"]) < 5 * stderr + 0.05 * rate
    assert rate <= old["error_rate"] + stderr


def test_the_inspector_holds_the_law_of_the_extended_model(both):
    store = RunStore.open(both[0].parent / "run.zarr")
    pixel = RunView(store).answer("GET", "/api/pixel?y=3&x=4", {"host": "127.0.0.1:1"}, 1)
    content = json.loads(pixel.content)
    counts, mass = np.array(content["counts"]), np.array(content["mass"])
    assert 0.97 < mass.sum() < 1.0001
    expected = counts.sum() * mass
    many = expected > 20
    assert many.sum() > 20
    assert np.abs((counts - expected)[many] / np.sqrt(expected[many])).max() < 5
    fitted = [content["values"][f"maps/{name}"] for name in PARAMETERS]
    # row noise makes the peaks wider than the pixel's own read noise
    assert content["deciding"][3] > fitted[3] + 0.1
    page = (store.path / "report.html").read_text(encoding="utf-8")
    facts = json.loads(page.split('id="inspector-facts">', 1)[1].split("</script>", 1)[0])
    assert facts["model"].startswith("PCD + ")
    assert facts["sample"]["deciding"]
    assert facts["sample"]["masses"] == 300
