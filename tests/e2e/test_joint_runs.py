"""``pchem joint``: a run whose samples are runs of one sensor, from command line to report and verdict."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import Shell
from helpers.places import ROOT
from helpers.without_pictures import undrawn

from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.commands.first_screen import run_to_first_screen
from pchem_pipeline.commands.new_run import find_joint
from pchem_pipeline.commands.notebook import open_run
from pchem_pipeline.commands.view import RunView
from pchem_pipeline.config.load import write_model
from pchem_pipeline.discrepancy.verdict import read_verdict
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages, run_status, up_to
from pchem_pipeline.stages.fit.fitted_model import fitted_effects
from pchem_pipeline.stages.table import pipeline, pipeline_of
from pchem_pipeline.store.run_store import RunStore

QUIET = Command(quiet=True, progress="off")
PIPELINE = pipeline()[1:]

CAMERA = """
run: {{store: {name}.zarr, tile: 8}}
simulate:
  shape: [8, 12]
  n_frames: 1500
  seed: {seed}
  sensor_seed: 3
  integration_time: {time}
  output: {name}-frames
  format: npy
  parameters:
    dark_current: {{kind: lognormal, median: 0.5, log_std: 0.3}}
    analog_read_noise_e: {{kind: constant, value: 0.6}}
    hot_pixels: {{fraction: 0.0}}
    dead_fraction: {dead}
"""


def camera(folder, name, seed, time, dead=0.0):
    (folder / f"{name}.yaml").write_text(CAMERA.format(name=name, seed=seed, time=time, dead=dead))


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """Three exposures and a bias, fitted with one command in a folder of their own; do not change it."""
    folder = tmp_path_factory.mktemp("exposures")
    for seed, seconds in enumerate((1.0, 2.0, 5.0)):
        camera(folder, f"dark_{seconds:g}s", 10 + seed, seconds)
    camera(folder, "bias", 20, 0.001, dead=1.0)
    shell = Shell(folder)
    manual = (ROOT / "docs" / "howto" / "several_exposures.md").read_text(encoding="utf-8")
    [command] = re.findall(r"^\$ (pchem joint .*)$", manual, re.MULTILINE)
    with undrawn():
        result = shell.ok(*command.split()[1:])
    assert result.stdout.strip() == str(folder.resolve() / "dark.zarr" / "report.html")
    return folder


def write(folder, name, samples, tile=8, **input_settings):
    path = folder / f"{name}.yaml"
    settings = "".join(f"  {key}: {value}\n" for key, value in input_settings.items())
    listed = "".join(f"    - {{run: {sample}}}\n" for sample in samples)
    path.write_text(f"run: {{store: {name}.zarr, tile: {tile}}}\ninput:\n{settings}  samples:\n{listed}")
    return path


def fit(path, until="maps"):
    target = find_run(path)
    run_stages(target, up_to(until, pipeline_of(target.config)), QUIET)
    return RunStore.open(target.store)


def test_dark_current_is_the_slope_and_the_pulls_are_normal(joint):
    store = RunStore.open(joint / "dark.zarr")
    status = store.read("fit/fit_status")
    good = status == 0
    assert good.mean() > 0.9
    truth = RunStore.open(joint / "dark_1s.zarr")
    wanted = {name: truth.read(f"truth/{name}") for name in ("conversion_gain", "bias", "read_noise_dn")}
    wanted |= {"dark_current": truth.read("truth/quanta_exposure"), "spurious_charge": np.zeros(good.shape)}
    for name, values in wanted.items():
        pulls = ((store.read(f"maps/{name}") - values) / store.read(f"maps/{name}_stderr"))[good]
        assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size), name
        # 96 pixels: the sd of a sd is 1 / sqrt(2 n)
        assert abs(pulls.std() - 1) < 5 / np.sqrt(2 * pulls.size), name
        if name != "spurious_charge":
            # a wrong gain, bias or time by a tenth would be far outside
            errors = store.read(f"maps/{name}_stderr")[good]
            assert 0.1 * np.median(values) / np.median(errors) * np.sqrt(pulls.size) > 20, name
    assert (store.read("samples/quanta_exposure")[3] == 0).all()
    assert np.isnan(store.read("samples/linearity_residual")[3]).all()
    p = store.read("samples/linearity_p")[good]
    assert abs(p.mean() - 0.5) < 5 / np.sqrt(12 * p.size)


def test_report_numbers_and_yaml_are_there_and_the_shown_sample(joint):
    numbers = json.loads((joint / "dark.zarr" / "report.json").read_text())
    assert numbers["samples"]["against"] == "integration_time"
    assert [each["x"] for each in numbers["samples"]["rows"]] == [1.0, 2.0, 5.0, None]
    assert 0.3 < numbers["summary"]["dark_current"]["median"] < 0.7
    page = (joint / "dark.zarr" / "report.html").read_text()
    for words in (
        *("Dark current as the slope of H", "Variance against mean", "spurious charge", "dark_5s.zarr"),
        "4 samples; maps and ensemble show dark_5s.zarr",
    ):
        assert words in page
    assert 'id="figure-exposures"' in page
    assert "bias: true" in (joint / "dark.yaml").read_text()
    # the shown sample stands in fit and maps
    store, shown = (RunStore.open(joint / f"{name}.zarr") for name in ("dark", "dark_5s"))
    for end in ("", "_stderr"):
        wanted = store.read(f"samples/quanta_exposure{end}")[2]
        for name in ("fit", "maps"):
            np.testing.assert_array_equal(store.read(f"{name}/quanta_exposure{end}"), wanted)
    np.testing.assert_array_equal(store.read("histogram/counts"), shown.read("histogram/counts"))
    assert store.has("ensemble/density")


def test_nothing_is_done_twice_and_tiles_do_not_matter(joint):
    store = RunStore.open(joint / "dark.zarr")
    target, is_new = find_joint([joint / "dark.zarr"])
    assert not is_new
    record = store.records.read("fit")
    run_stages(target, pipeline_of(target.config), QUIET)
    assert store.records.read("fit") == record
    four = ["dark_1s.zarr", "dark_2s.zarr", "dark_5s.zarr", "bias.zarr, bias: true"]
    other = fit(write(joint, "wide", four, tile=16))
    for name in ("maps/conversion_gain", "samples/quanta_exposure", "samples/covariance"):
        np.testing.assert_array_equal(other.read(name), store.read(name), err_msg=name)


def test_a_changed_time_makes_new_maps_of_the_same_fit(joint):
    path = write(joint, "again", ["dark_1s.zarr", "dark_2s.zarr"])
    store = fit(path)
    first, record = store.read("maps/dark_current"), store.records.read("fit")
    write(joint, "again", ["dark_1s.zarr, integration_time: 0.5", "dark_2s.zarr"])
    states = {state.stage: state.words() for state in run_status(find_run(path))}
    assert states["maps"].startswith("stale - input.exposures [1.0, 2.0] -> [0.5, 2.0]")
    assert states["fit"] == "complete"
    assert (fit(path).read("maps/dark_current") != first).all()
    assert store.records.read("fit") == record
    states = Shell(joint).states("again.zarr")
    assert all(states[stage].startswith("complete") for stage in ("ingest", "histogram", "fit", "maps"))


def test_effects_found_in_one_run_are_carried_over(joint, tmp_path):
    shutil.copytree(joint, tmp_path / "joint")
    found = ModelSettings.model_validate({"effects": [{"tag": "row_noise", "row_noise_dn": 0.7}]})
    write_model(tmp_path / "joint" / "dark_5s.yaml", found)
    manual = (ROOT / "docs" / "howto" / "several_exposures.md").read_text(encoding="utf-8")
    [block] = re.findall(r"```bash\n(.*?)```", manual, re.DOTALL)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-ec", block], cwd=tmp_path / "joint", env=environment, check=True, timeout=300)
    assert fitted_effects(RunStore.open(tmp_path / "joint" / "dark.zarr")) == found.effects


def test_histograms_made_again_make_the_fit_stale(joint):
    shutil.copytree(joint / "dark_2s.zarr", joint / "moved.zarr")
    path = write(joint, "two", ["dark_1s.zarr", "moved.zarr"])
    fit(path, "histogram")
    (joint / "moved.zarr" / ".pchem" / "stages" / "histogram.json").unlink()
    states = {state.stage: state.words() for state in run_status(find_run(path))}
    assert states["ingest"] == "complete"  # as last known
    sample = find_run(joint / "moved.zarr").changed("histogram", window_frames=500)
    run_stages(sample, ["histogram"], QUIET)
    states = {state.stage: state.words() for state in run_status(find_run(path))}
    assert states["ingest"].startswith("stale - input.samples")


def test_light_levels_and_no_line(joint):
    samples = ["dark_1s.zarr, light_level: 10", "dark_2s.zarr, light_level: 20"]
    store = fit(write(joint, "light", samples, against="light_level", integration_time=2.0))
    assert 0.03 < np.nanmedian(store.read("maps/charge_per_level")) < 0.07
    store = fit(write(joint, "plain", samples, against="none"))
    assert not store.has("maps/dark_current")
    assert not store.has("samples/linearity_chi2")
    assert np.isfinite(store.read("maps/conversion_gain")).mean() > 0.8


def test_what_looks_at_a_run_looks_at_this_one(joint, tmp_path):
    shell = Shell(joint)
    here = ("-o", tmp_path)
    assert "maps.fits" in shell.ok("export", "dark.zarr", *here, "--format", "fits,csv,defects").stdout
    assert "spurious_charge" in (tmp_path / "summary.csv").read_text()
    shutil.copytree(joint / "dark.zarr", joint / "same.zarr")
    words = shell.ok("compare", "dark.zarr", "same.zarr", *here).stdout
    assert words == "no change\n"
    drawn = shell.ok("figures", "dark.zarr", *here, "--only", "exposures,pixel_fits").stdout
    assert "exposures.pdf" in drawn
    run = open_run(joint / "dark.zarr")
    assert run.samples.quanta_exposure.dims == ("sample", "y", "x")
    assert run.samples.sample.values.tolist()[2:] == ["dark_5s.zarr", "bias.zarr"]
    assert "4 samples of 6,000 frames in all" in repr(run)
    assert run.pixel(2, 3).histogram.sum() == 1500
    assert "dark_current" in run.maps
    view, host = RunView(RunStore.open(joint / "dark.zarr")), {"host": "127.0.0.1:1"}
    answer = view.answer("GET", "/api/pixel?y=2&x=3", host, 1)
    assert answer.status == 200
    assert json.loads(answer.content)
    refused = shell.refused(4, "electrons", "dark.zarr")
    assert "was made from samples; electron numbers need" in refused
    assert "electrons" not in run.status()


@pytest.mark.parametrize(
    ("samples", "against", "words"),
    [
        (["dark_1s.zarr", "dark_1s.yaml"], "", "dark_1s.yaml is the run of dark_1s.zarr again"),
        (["dark_2s.zarr", "dark_1s.zarr"], "", "is not above 2 of sample dark_2s.zarr"),
        (["dark_1s.zarr", "dark_2s.zarr, integration_time: 1"], "", "of equal ones give the levels"),
        (["dark_1s.zarr", "small.yaml"], "", "has 8 x 8 pixels, sample dark_1s.zarr 8 x 12"),
        (["dark_1s.zarr", "twelve.yaml"], "", "has 12 bits, sample dark_1s.zarr 14"),
        (["dark_1s.zarr", "twin.yaml"], "", "has the same frames as sample dark_1s.zarr"),
        (["timeless.yaml", "dark_2s.zarr"], "", "has no integration time, needed for the charge rate"),
        (["dark_1s.zarr", "lit.yaml"], "", "some are dark and some are not"),
        (["dark_1s.zarr", "bias.zarr, bias: true"], "", "a slope needs two exposures"),
        (["dark_1s.zarr", "dark_2s.zarr"], "light_level", "give one for each: pchem joint RUNS --level"),
        (["bias.zarr, bias: true"], "", "every sample is a bias"),
        (["dark_1s.zarr, bia: true"], "", "input.samples.0.bia: unknown key; did you mean bias?"),
        (["nowhere.yaml", "dark_1s.zarr"], "", "nowhere.yaml: no such file"),
    ],
)
def test_samples_that_do_not_belong_together_get_one_line(joint, samples, against, words):
    frames = "input: {files: [dark_1s-frames/*.npy], format: npy"
    others = {
        "small": f"{frames}, integration_time: 7, roi: [0, 8, 0, 8]}}",
        "twelve": f"{frames}, integration_time: 7, bit_depth: 12}}",
        "twin": f"{frames}, integration_time: 7}}",
        "timeless": f"{frames}}}",
        "lit": f"{frames.replace('1s', '2s')}, integration_time: 9, bit_depth: 14, kind: light}}",
    }
    for name, text in others.items():
        (joint / f"{name}.yaml").write_text(f"run: {{store: {name}.zarr, tile: 8}}\n{text}\n")
    path = write(joint, "bad", samples, **({"against": against} if against else {}))
    with pytest.raises(PchEmError) as caught:
        run_stages(find_joint([path])[0], PIPELINE, QUIET)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message
    assert not (joint / "bad.zarr").exists()


def test_a_refused_list_leaves_its_name_free(joint):
    store = joint / "refused.zarr"
    for runs in (["dark_2s.yaml", "dark_1s.yaml"], ["dark_1s.yaml", "dark_1s.zarr"]):
        target, _ = find_joint([joint / run for run in runs], store=store)
        with pytest.raises(ConfigError, match=r"is not above|is the run of"):
            run_to_first_screen(target, PIPELINE, QUIET, print, is_new=True)
        assert not store.with_suffix(".yaml").exists()
    kept = write(joint, "kept", ["dark_2s.zarr", "dark_1s.zarr"])
    with pytest.raises(ConfigError):
        run_to_first_screen(find_joint([kept])[0], PIPELINE, QUIET, print, is_new=True)
    assert kept.exists()


def test_what_is_no_joint_fit_says_so(joint):
    for runs, options, words in (
        (["dark_1s.yaml"], {}, r"dark_1s\.yaml is a single run; a joint fit needs several"),
        (["dark.yaml"], {"store": joint / "x.zarr"}, "only with runs"),
        (["dark_1s.yaml", "dark_2s.yaml"], {"store": joint / "dark.zarr"}, "exists with other settings"),
        (["nothing.yaml"], {}, "no such file"),
        (["dark.yaml"], {"against": "none"}, r"--against: only with runs; .*input\.against"),
    ):
        with pytest.raises(ConfigError, match=words):
            find_joint([joint / run for run in runs], **options)
    runs = [joint / "dark_1s.yaml", joint / "dark_2s.yaml"]
    target, _ = find_joint(runs, store=joint / "unordered.zarr", against="none")
    assert target.config.input.against == "none"


def test_a_search_looks_at_all_samples_and_the_fit_takes_what_it_names(tmp_path):
    """Charge that does not grow with time: one exposure takes it for dark current, three of them do not."""
    shell = Shell(tmp_path)
    for seconds in (1.0, 3.0, 9.0):
        name = f"dark_{seconds:g}s"
        camera(tmp_path, name, int(seconds), seconds)
        path = tmp_path / f"{name}.yaml"
        text = path.read_text().replace("value: 0.6", "value: 0.25").replace("[8, 12]", "[6, 8]")
        path.write_text(text + "  effects: [{tag: spurious_charge, mean_e: 0.2}]\n")
        shell.ok("simulate", path.name)
    runs = [f"dark_{seconds}s.yaml" for seconds in (1, 3, 9)]
    path = write(tmp_path, "together", runs)
    search = "{replicates: 20, candidates: [branching_counts, nonlinearity, spurious_charge]}"
    path.write_text(path.read_text() + f"discrepancy: {search}\n")
    fit(path)
    said = shell.ok("discrepancy", path.name, "--quiet").stdout
    assert said.startswith("NAMED: The data show spurious")
    found = read_verdict(tmp_path / "together.zarr")
    assert found.effects == ("spurious_charge",)
    fitted = found.steps[0].parameters["mean_e"]
    assert abs(fitted.value - 0.2) < 5 * fitted.stderr < 0.1
    assert found.examined.rows == (0, 6)
    assert found.examined.columns == (0, 8)
    assert fitted_effects(RunStore.open(tmp_path / "together.zarr"))[0].tag == "spurious_charge"
    assert "spurious_charge" in path.with_suffix(".effects.yaml").read_text()
    assert shell.ok("status", "together.zarr").stdout.count("complete") >= 5
