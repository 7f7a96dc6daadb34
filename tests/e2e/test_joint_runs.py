"""``pchem joint``: runs of one sensor at several exposures, from the command line to maps and report."""

import json
import os
import re
import shutil

import numpy as np
import pytest
from helpers.commands import Shell
from helpers.places import ROOT

from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.commands.joint import find_joint, run_joint
from pchem_pipeline.run.session import Command
from pchem_pipeline.run.stage import Options
from pchem_pipeline.store.run_store import RunStore

QUIET = Command(Options(), quiet=True, progress="off")

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
def joint(tmp_path_factory, kernels):
    """Three exposures and a bias, fitted with one command in a folder of their own; do not change it."""
    folder = tmp_path_factory.mktemp("exposures")
    for seed, time in enumerate((1.0, 2.0, 5.0)):
        camera(folder, f"dark_{time:g}s", 10 + seed, time)
    camera(folder, "bias", 20, 0.001, dead=1.0)
    shell = Shell(folder, {**os.environ, "NUMBA_CACHE_DIR": kernels})
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    [command] = re.findall(r"```shell\n(pchem joint .*)\n```", readme)
    result = shell.ok(*command.split()[1:])
    assert result.stdout.strip() == str(folder.resolve() / "dark.zarr" / "report.html")
    return folder


def write(folder, name, samples, **joint):
    lines = ["samples:", *(f"  - {{run: {run}, {rest}}}" for run, rest in samples)]
    settings = ", ".join(f"{key}: {value}" for key, value in {"store": f"{name}.zarr", **joint}.items())
    path = folder / f"{name}.yaml"
    report = "report: {figure_formats: [], dpi: 72}"
    path.write_text("\n".join([*lines, f"joint: {{{settings}}}", report, ""]))
    return path


def test_dark_current_is_the_slope_and_the_pulls_are_normal(joint):
    store = RunStore.open(joint / "dark.zarr")
    status = store.read("joint/fit_status")
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
    assert (store.read("joint/quanta_exposure")[3] == 0).all()
    assert np.isnan(store.read("joint/linearity_residual")[3]).all()
    p = store.read("joint/linearity_p")[good]
    assert abs(p.mean() - 0.5) < 5 / np.sqrt(12 * p.size)


def test_report_numbers_and_yaml_are_there(joint):
    numbers = json.loads((joint / "dark.zarr" / "report.json").read_text())
    assert [each["integration_time"] for each in numbers["samples"]] == [1.0, 2.0, 5.0, None]
    assert 0.3 < numbers["maps"]["dark_current"]["median"] < 0.7
    page = (joint / "dark.zarr" / "report.html").read_text()
    for words in (
        "Dark current as the slope of H",
        "Variance against mean",
        "spurious charge",
        "dark_5s.zarr",
    ):
        assert words in page
    assert (joint / "dark.zarr" / "figures" / "exposures.svg").exists()
    assert "kind: bias" in (joint / "dark.yaml").read_text()


def test_nothing_is_done_twice_and_tiles_do_not_matter(joint):
    before = (joint / "dark.zarr" / "joint" / "bias").exists(), RunStore.open(joint / "dark.zarr")
    fit = find_joint([joint / "dark.zarr"])
    record = before[1].records.read("joint")
    run_joint(fit, QUIET)
    assert before[1].records.read("joint") == record
    other = write(
        joint,
        "wide",
        [("dark_1s.zarr", ""), ("dark_2s.zarr", ""), ("dark_5s.zarr", ""), ("bias.zarr", "kind: bias")],
        tile=16,
    )
    run_joint(find_joint([other]), QUIET)
    for name in ("maps/conversion_gain", "joint/quanta_exposure", "joint/covariance"):
        np.testing.assert_array_equal(
            RunStore.open(joint / "wide.zarr").read(name), before[1].read(name), err_msg=name
        )


def test_a_changed_time_fits_again_and_status_knows(joint, kernels):
    shutil.copytree(joint / "dark_1s.zarr", joint / "copy1.zarr")
    path = write(joint, "again", [("dark_1s.zarr", ""), ("dark_2s.zarr", "")])
    run_joint(find_joint([path]), QUIET)
    first = RunStore.open(joint / "again.zarr").read("maps/dark_current")
    write(joint, "again", [("dark_1s.zarr", "integration_time: 0.5"), ("dark_2s.zarr", "")])
    run_joint(find_joint([path]), QUIET)
    assert (RunStore.open(joint / "again.zarr").read("maps/dark_current") != first).all()
    shell = Shell(joint, {**os.environ, "NUMBA_CACHE_DIR": kernels})
    assert shell.ok("status", "again.zarr").stdout.split() == [
        "joint",
        "complete",
        "joint_report",
        "complete",
    ]
    assert "maps.fits" in shell.ok("export", "again.zarr", "--format", "fits").stdout


def test_light_levels_and_no_line(joint):
    samples = [("dark_1s.zarr", "light_level: 10"), ("dark_2s.zarr", "light_level: 20")]
    run_joint(find_joint([write(joint, "light", samples, against="light_level")]), QUIET)
    store = RunStore.open(joint / "light.zarr")
    assert 0.03 < np.nanmedian(store.read("maps/charge_per_level")) < 0.07
    run_joint(find_joint([write(joint, "plain", samples, against="none")]), QUIET)
    store = RunStore.open(joint / "plain.zarr")
    assert not store.has("maps/dark_current")
    assert not store.has("joint/linearity_chi2")
    assert np.isfinite(store.read("maps/conversion_gain")).mean() > 0.8


@pytest.mark.parametrize(
    ("samples", "joint_settings", "words"),
    [
        (
            [("dark_1s.zarr", ""), ("dark_1s.yaml", "")],
            {},
            "samples.1.run: dark_1s.yaml is the run of samples.0 again",
        ),
        (
            [("dark_2s.zarr", ""), ("dark_1s.zarr", "")],
            {},
            "integration time 1 is not above the 2 of samples.0",
        ),
        (
            [("dark_1s.zarr", ""), ("dark_2s.zarr", "integration_time: 1")],
            {},
            "is not above the 1 of samples.0",
        ),
        (
            [("dark_1s.zarr", ""), ("small.yaml", "")],
            {},
            "has 8 x 8 pixels, samples.0 (dark_1s.zarr) 8 x 12",
        ),
        (
            [("dark_1s.zarr", ""), ("twelve.yaml", "")],
            {},
            "has codes of 12 bits, samples.0 (dark_1s.zarr) of 14",
        ),
        ([("dark_1s.zarr", ""), ("twin.yaml", "")], {}, "holds the same frames as samples.0 (dark_1s.zarr)"),
        (
            [("timeless.yaml", ""), ("dark_2s.zarr", "")],
            {},
            "(timeless.yaml) has no integration time, so there is no",
        ),
        ([("dark_1s.zarr", ""), ("bias.zarr", "kind: bias")], {}, "a slope needs two exposures"),
        (
            [("dark_1s.zarr", ""), ("dark_2s.zarr", "")],
            {"against": "light_level"},
            "samples.0 (dark_1s.zarr) has no light_level",
        ),
        ([("bias.zarr", "kind: bias")], {}, "every sample is a bias"),
        ([("dark_1s.zarr", "knd: bias")], {}, "samples.0.knd: unknown key; did you mean kind?"),
        ([("nowhere.yaml", ""), ("dark_1s.zarr", "")], {}, "nowhere.yaml: no such file"),
    ],
)
def test_samples_that_do_not_belong_together_get_one_line(joint, samples, joint_settings, words):
    frames = "input: {files: [dark_1s-frames/*.npy], format: npy"
    others = {
        "small": f"{frames}, integration_time: 7, roi: [0, 8, 0, 8]}}",
        "twelve": f"{frames}, integration_time: 7, bit_depth: 12}}",
        "twin": f"{frames}, integration_time: 7}}",
        "timeless": f"{frames}}}",
    }
    for name, text in others.items():
        (joint / f"{name}.yaml").write_text(f"run: {{store: {name}.zarr, tile: 8}}\n{text}\n")
    path = write(joint, "bad", samples, **joint_settings)
    with pytest.raises(PchEmError) as caught:
        run_joint(find_joint([path]), QUIET)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message
    assert not (joint / "bad.zarr").exists()


def test_a_refused_list_leaves_its_name_free(joint):
    store = joint / "refused.zarr"
    for runs in (["dark_2s.yaml", "dark_1s.yaml"], ["dark_1s.yaml", "dark_1s.zarr"]):
        with pytest.raises(ConfigError, match=r"is not above|is the run of"):
            run_joint(find_joint([joint / run for run in runs], store=store), QUIET)
        assert not store.with_suffix(".yaml").exists()
    kept = write(joint, "kept", [("dark_2s.zarr", ""), ("dark_1s.zarr", "")])
    with pytest.raises(ConfigError):
        run_joint(find_joint([kept]), QUIET)
    assert kept.exists()


def test_what_is_no_joint_fit_says_so(joint):
    with pytest.raises(ConfigError, match=r"dark_1s\.yaml is a single run, and a joint fit needs several"):
        find_joint([joint / "dark_1s.yaml"])
    with pytest.raises(ConfigError, match="only for runs"):
        find_joint([joint / "dark.yaml"], store=joint / "x.zarr")
    with pytest.raises(ConfigError, match="exists with other settings"):
        find_joint([joint / "dark_1s.yaml", joint / "dark_2s.yaml"], store=joint / "dark.zarr")
    with pytest.raises(ConfigError, match="no such file"):
        find_joint([joint / "nothing.yaml"])
