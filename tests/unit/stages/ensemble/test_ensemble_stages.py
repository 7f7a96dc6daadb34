"""The stages maps, ensemble and electrons on a simulated sensor; the fit is its truth."""

import csv
import re
import shutil
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from astropy.io import fits
from helpers import written_fit
from helpers.pickled_tasks import PickledTasks
from helpers.stage_runs import completed, stage_context
from scipy.io import loadmat
from tifffile import imread

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError
from pchem_pipeline.base.variables import PARAMETERS, variables_of
from pchem_pipeline.commands.adapters import ADAPTERS, Calibration
from pchem_pipeline.commands.export import export_run
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.model.electrons.electrons import NO_NUMBER
from pchem_pipeline.model.ensemble.components import COMPONENT_CASES
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.pcd import thresholds
from pchem_pipeline.report.pages.summary import key_numbers, sentence
from pchem_pipeline.run.fingerprint import status
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages.ensemble import ensemble as ensemble_stage
from pchem_pipeline.stages.report.stored import read_run
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore

NY, NX, FRAMES = 40, 48, 400
FAILED_PIXEL = (3, 5)


def make_context(folder, *, tile=16, executor=None, store="run.zarr", input=None, **ensemble):
    simulate = {"shape": [NY, NX], "n_frames": FRAMES, "truth_frames": 120, "format": "npy"}
    sections = {"run": {"tile": tile, "store": store}, "simulate": simulate, "input": input or {}}
    return stage_context(folder, executor, **sections, ensemble=ensemble)


def write_fit(context, *, tiles=None, failed=True):
    """What the fit stage leaves behind, with the truth as its estimate."""
    status = np.zeros(context.sensor.shape, dtype=np.uint16)
    if failed:
        status[FAILED_PIXEL] = int(FitStatus.NOT_CONVERGED)
    status[0, 0] = int(FitStatus.POOR_FIT)
    written_fit.write_fit(context, status, status == int(FitStatus.NOT_CONVERGED), tiles)


BEFORE, AFTER = ("simulate", "ingest", "histogram"), ("maps", "ensemble", "electrons")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A run up to the histograms, at tiles of 16."""
    return completed(make_context(tmp_path_factory.mktemp("sensor")), *BEFORE).base_dir


@pytest.fixture
def sensor(prepared, tmp_path):
    """Return the context of a copy of that run with its fit, and with settings of the ensemble."""
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)

    def make(tiles=None, failed=True, **settings):
        context = make_context(tmp_path, **settings)
        write_fit(context, tiles=tiles, failed=failed)
        return context

    return make


@pytest.fixture(scope="module")
def finished(prepared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    shutil.copytree(prepared, folder, dirs_exist_ok=True)
    context = make_context(folder, frames=250)
    write_fit(context)
    return completed(context, *AFTER)


def ensemble_of(store):
    return {v.name: store.read(v.path) for v in variables_of("ensemble") if store.has(v.path)}


def assert_same(found, expected):
    for name, values in expected.items():
        if values.dtype.kind == "f":
            # far tails of a curve are sums of numbers below rounding; residuals are small differences
            smallest = 1e-10 if "residual" in name else 1e-17
            np.testing.assert_allclose(found[name], values, rtol=1e-12, atol=smallest, err_msg=name)
        else:
            np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_maps_are_the_fit_and_what_follows(finished):
    store = finished.store
    for name in (*PARAMETERS, "charge_rate"):
        rate = name == "charge_rate"
        truth = store.read("truth/quanta_exposure") / 4.87 if rate else store.read(f"truth/{name}")
        truth[FAILED_PIXEL] = np.nan
        np.testing.assert_allclose(store.read(f"maps/{name}"), truth, rtol=1e-7 * rate)
    quality = store.read("maps/quality")
    assert (quality[0, 0], quality[FAILED_PIXEL], quality[1, 1]) == (1, 2, 0)
    attributes = store.attributes("maps")
    assert attributes["summary"]["read_noise_e"]["n_missing"] == 1
    assert attributes["fit_status"]["not_converged"] == 1
    assert attributes["fit_status"]["ok"] == NY * NX - 2
    assert store.array("maps/charge_rate").attrs["units"] == "e-/px/s"


def test_no_integration_time_means_no_charge_rate(sensor, tmp_path):
    context = sensor()
    replace(context.sensor, integration_time=None).write(context.store)
    context.config = context.config.model_copy(
        update={"input": context.config.input.model_copy(update={"integration_time": None})}
    )
    completed(context, "maps")
    assert not context.store.has("maps/charge_rate")
    assert "integration_time" in context.notes[0]


@pytest.mark.parametrize("kind", ["dark", "light"])
def test_dark_current_is_of_the_dark_alone(sensor, tmp_path, kind):
    completed(sensor(), "maps")
    context = make_context(tmp_path, input={"kind": kind})
    wanted, other = ("dark_current", "charge_rate") if kind == "dark" else ("charge_rate", "dark_current")
    state = status(STAGES["maps"], context)
    assert state.words() == (
        "stale - input.rate charge_rate -> dark_current" if kind == "dark" else "complete"
    )
    completed(context, "maps")
    assert context.store.has(f"maps/{wanted}")
    assert not context.store.has(f"maps/{other}")
    assert wanted in context.store.attributes("maps")["summary"]
    data = read_run(context.store, context.config).data
    words = wanted.replace("_", " ")
    assert words in sentence(data)
    assert [number.label for number in key_numbers(data) if number.name == wanted] == [words]


def test_ensemble_is_that_of_the_chosen_frames(finished):
    frames = np.load(finished.base_dir / "frames" / "frames.npy")
    use = np.ones((NY, NX), dtype=bool)
    use[FAILED_PIXEL] = False
    found = ensemble_of(finished.store)
    for name, part in (("counts", frames[:250]), ("counts_all", frames)):
        expected = np.bincount(part[:, use].ravel(), minlength=found["dn"][-1] + 1)[found["dn"][0] :]
        np.testing.assert_array_equal(found[name], expected[: found["dn"].size])
    facts = finished.store.attributes("ensemble")
    assert (facts["n_frames"], facts["n_frames_all"]) == (250, FRAMES)
    assert (facts["n_pixels"], facts["n_pixels_without_value"]) == (NY * NX - 1, 1)
    assert facts["samples_beyond_dn"] == 0
    assert found["counts"].sum() == 250 * (NY * NX - 1)
    np.testing.assert_allclose(found["density"], found["counts"] / found["counts"].sum(), rtol=1e-12)
    assert found["nuced_counts"].sum() + facts["samples_beyond_electrons"] == found["counts"].sum()
    step = facts["nuced_bin_width"]
    assert found["nuced_density"].sum() * step == pytest.approx(1.0, abs=1e-3)


def test_copies_and_empty_frames_are_in_no_ensemble(sensor, tmp_path):
    context = sensor(frames=250)
    odd = {"copied": list(range(1, 200, 2)), "empty": [6, 399]}
    context.store.set_attributes("summary", {"odd_frames": odd})
    completed(context, "ensemble")
    kept = np.delete(np.load(tmp_path / "frames" / "frames.npy")[:250], [*odd["copied"], 6], 0)
    found = ensemble_of(context.store)
    expected = np.bincount(np.delete(kept.reshape(len(kept), -1), 3 * NX + 5, 1).ravel())[found["dn"][0] :]
    np.testing.assert_array_equal(found["counts"][: expected.size], expected)
    facts = context.store.attributes("ensemble")
    assert (facts["n_frames"], facts["n_frames_all"]) == (149, FRAMES - 102)


def check_moments(facts):
    for row in facts["moments"]:
        if row["observed"] is not None:
            assert abs(row["observed"] - row["predicted"]) < 5 * row["stderr"], row


def test_the_true_parameters_predict_to_the_noise(finished):
    facts = finished.store.attributes("ensemble")
    error = facts["rmse"]
    # the mean square has some tens of independent terms: its root scatters by about a tenth
    assert 0.6 < error["epcd_exact"] / error["noise_floor"] < 1.5
    assert 0.6 < error["nuced_exact"] / error["nuced_noise_floor"] < 1.5
    assert set(error) >= {"epcd_dependent", "epcd_independent", "nuced_dependent", "nuced_independent"}
    assert facts["rmse_all_frames"]["noise_floor"] == pytest.approx(error["noise_floor"] * np.sqrt(250 / 400))
    check_moments(facts)
    assert facts["component_cases"] == [list(case) for case in COMPONENT_CASES]


def test_error_rate_against_the_truth(finished):
    store = finished.store
    facts = store.attributes("ensemble")
    true = store.read("truth/electron_number")
    estimated = store.read("electrons/electron_number")[:120]
    use = estimated != NO_NUMBER
    assert facts["samples_compared"] == use.sum() == 120 * (NY * NX - 1)
    assert facts["error_rate"] == pytest.approx(np.mean(estimated[use] != true[use]))
    assert abs(facts["error_rate"] - facts["expected_error_rate"]) < 5 * facts["error_rate_stderr"]
    assert sum(facts["error_sizes"]) == facts["samples_compared"]
    # the fit is the truth here, so all three expectations are one
    assert facts["expected_error_rate_from_truth"] == pytest.approx(facts["expected_error_rate"])
    assert facts["least_error_rate"] == pytest.approx(facts["expected_error_rate"])


def test_error_rate_of_a_fit_that_is_off(sensor, tmp_path):
    context = sensor(failed=False)
    bias = context.store.read("fit/bias")
    context.store.write_array("fit/bias", bias + 2.0)
    completed(context, "ensemble")
    facts = context.store.attributes("ensemble")
    expected, error = facts["expected_error_rate_from_truth"], facts["error_rate_stderr"]
    assert abs(facts["error_rate"] - expected) < 5 * error
    # a bias wrong by 2 DN is a fifth of an electron: many more errors than the fit believes
    assert expected - facts["expected_error_rate"] > 20 * error
    assert facts["least_error_rate"] == pytest.approx(facts["expected_error_rate"], rel=0.02)


def test_electron_stack(finished):
    frames = np.load(finished.base_dir / "frames" / "frames.npy")
    maps = [finished.store.read(f"fit/{name}") for name in PARAMETERS]
    found = finished.store.read("electrons/electron_number")
    # the thresholds of the density, but for codes that lie on one
    edges = thresholds(*maps, 60)
    fitted = np.isfinite(edges).all(axis=-1)
    near = np.abs(edges - frames[..., None]).min(axis=-1) < 0.1
    sure = fitted & ~near
    np.testing.assert_array_equal(found[sure], (edges < frames[..., None]).sum(axis=-1)[sure])
    assert sure.mean() > 0.9
    assert (found[:, *FAILED_PIXEL] == NO_NUMBER).all()
    attributes = dict(finished.store.array("electrons/electron_number").attrs)
    assert attributes["no_number"] == NO_NUMBER
    ensemble = ensemble_of(finished.store)
    use = found[:250][found[:250] != NO_NUMBER]
    np.testing.assert_array_equal(ensemble["electron_counts"], np.bincount(use, minlength=ensemble["k"].size))


@pytest.mark.parametrize(
    ("tile", "executor"),
    [(64, make_executor(ComputeSettings(backend="threads", workers=3))), (32, PickledTasks())],
    ids=["threads", "pickled"],
)
def test_result_depends_on_neither_tile_nor_backend(finished, tmp_path, tile, executor):
    shutil.copytree(finished.base_dir / "frames", tmp_path / "frames")
    context = completed(make_context(tmp_path, tile=tile, executor=executor, frames=250), *BEFORE)
    write_fit(context)
    completed(context, *AFTER)
    assert_same(ensemble_of(context.store), ensemble_of(finished.store))
    for name in ("maps/read_noise_e", "maps/quality", "electrons/electron_number"):
        np.testing.assert_array_equal(context.store.read(name), finished.store.read(name))


def test_all_frames_need_no_frames(sensor, tmp_path, monkeypatch):
    context = sensor(frames="all")
    context.store.delete("truth/electron_number")
    monkeypatch.setattr(ensemble_stage, "open_source", lambda *_: pytest.fail("frames were opened"))
    completed(context, "ensemble")
    found = ensemble_of(context.store)
    np.testing.assert_array_equal(found["counts"], found["counts_all"])
    facts = context.store.attributes("ensemble")
    assert facts["rmse"]["epcd_exact"] == facts["rmse_all_frames"]["epcd_exact"]
    assert "error_rate" not in facts
    assert "truth" in facts["missing"]


def test_region_and_range_of_frames_find_their_truth(finished, tmp_path):
    shutil.copytree(finished.base_dir / "frames", tmp_path / "frames")
    crop = {"roi": [8, 32, 4, 48], "frame_range": [20, 300]}
    context = completed(make_context(tmp_path, input=crop, frames=150, first_frame=10), *BEFORE)
    write_fit(context, failed=False)
    completed(context, "ensemble")
    facts = context.store.attributes("ensemble")
    # frames 30 to 180 of the simulation, of which 120 have their truth
    assert facts["samples_compared"] == 90 * 24 * 44
    assert abs(facts["error_rate"] - facts["expected_error_rate"]) < 5 * facts["error_rate_stderr"]


def test_no_pixel_with_a_value_and_frames_that_do_not_exist(sensor, tmp_path):
    context = sensor()
    for name in PARAMETERS:
        context.store.write_array(f"fit/{name}", np.full((NY, NX), np.nan))
    state = execute("ensemble", context)
    assert state.state == "complete"
    assert context.store.records.read("ensemble").notes[0].startswith("no pixel has a value")
    assert not context.store.has("ensemble/density")
    assert execute("ensemble", context) == state
    with pytest.raises(ConfigError, match="first_frame: 1000, but the run has frames 0 to 399"):
        execute("ensemble", make_context(tmp_path, first_frame=1000))


def test_tiles_that_the_fit_finishes_later_are_added(finished, sensor, tmp_path):
    context = sensor(tiles=["0.0", "0.1", "0.2"], frames=250)
    state = execute("ensemble", context)
    assert state.state == "failed"
    assert re.search(r"fit of \S+ is not finished", state.why)
    facts = context.store.attributes("ensemble")
    assert (facts["n_pixels"], facts["tiles_missing"]) == (16 * NX - 1, 6)
    # nor is it called done where no pixel has a value so far
    for name in PARAMETERS:
        context.store.write_array(f"fit/{name}", np.full((NY, NX), np.nan))
    assert execute("ensemble", context).state == "failed"
    again = completed(sensor(frames=250), "ensemble")
    assert_same(ensemble_of(again.store), ensemble_of(finished.store))


@pytest.mark.parametrize("n_samples", [(20_000, 20_000), (5_000, 80_000)])
def test_ready_made_histograms(tmp_path, n_samples):
    rng = np.random.default_rng(8)
    truth = np.array([[0.8, 0.1, 100.0, 3.0], [2.5, 0.1, 104.0, 3.2]])
    counts = np.zeros((2, 250), dtype=np.int64)
    for row, n, (h, g, mu, sigma) in zip(counts, n_samples, truth, strict=True):
        dn = np.rint(mu + rng.poisson(h, n) / g + np.sqrt(sigma**2 - 1 / 12) * rng.standard_normal(n))
        row += np.bincount(dn.astype(int), minlength=250)
    np.savez(tmp_path / "spectra.npz", dn=np.arange(250), counts=counts)
    context = stage_context(tmp_path, input={"files": ["spectra.npz"], "format": "histogram"})
    completed(context, "ingest", "histogram")
    fit = dict(zip(PARAMETERS, truth.T[:, None], strict=True))
    fit |= {"likelihood_gap": np.full((1, 2), 50.0), "fit_status": np.zeros((1, 2), np.uint32)}
    for name, values in fit.items():
        context.store.write_array(f"fit/{name}", values)
    context.store.records.write(StageRecord("fit", 1, "truth", {}, keys=1))
    context.store.records.mark("fit", "truth", "0.0", {})
    completed(context, "ensemble")
    found = ensemble_of(context.store)
    shares = counts / np.array(n_samples)[:, None]
    first = found["dn"][0]
    expected = shares.mean(axis=0)[first : first + found["dn"].size]
    np.testing.assert_allclose(found["density"], expected, atol=1e-15)
    facts = context.store.attributes("ensemble")
    assert 0.5 < facts["rmse"]["epcd_exact"] / facts["rmse"]["noise_floor"] < 1.6
    assert "histograms" in facts["missing"]["frames"]
    check_moments(facts)
    with pytest.raises(InputError, match="camera files"):
        execute("electrons", context)


def test_export(finished, tmp_path):
    finished.store.write_config(dump_config(finished.config))
    written = export_run(
        finished.store.path, tmp_path / "out", ("fits", "tiff", "npz", "csv", "emva"), Reporter("off")
    )
    assert all(path.exists() for path in written)
    gain = finished.store.read("maps/conversion_gain")
    with fits.open(tmp_path / "out" / "maps.fits") as file:
        np.testing.assert_array_equal(file["CONVERSION_GAIN"].data, gain)
        assert file["CONVERSION_GAIN"].header["BUNIT"] == "electron / adu"
        assert file[0].header["NFRAMES"] == FRAMES
        assert file["FIT_STATUS"].data[FAILED_PIXEL] == int(FitStatus.NOT_CONVERGED)
    np.testing.assert_allclose(imread(tmp_path / "out" / "conversion_gain.tif"), gain, rtol=1e-7)
    with np.load(tmp_path / "out" / "maps.npz") as file:
        np.testing.assert_array_equal(file["quality"], finished.store.read("maps/quality"))
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = {row["map"]: row for row in csv.DictReader(file)}
    assert float(rows["conversion_gain"]["median"]) == pytest.approx(np.nanmedian(gain))
    assert rows["charge_rate"]["unit"] == "e-/px/s"
    assert rows["bias"]["n_missing"] == "1"
    with (tmp_path / "out" / "fit_status.csv").open() as file:
        assert {row["fit_status"]: row["pixels"] for row in csv.DictReader(file)}["poor_fit"] == "1"


def test_export_for_other_programs(finished, tmp_path):
    finished.store.write_config(dump_config(finished.config))
    written = export_run(finished.store.path, tmp_path, tuple(ADAPTERS), Reporter("off"))
    assert all(path.exists() for path in written)
    names = ("bias", "conversion_gain", "read_noise_e", "quanta_exposure")
    bias, gain, noise, exposure = (finished.store.read(f"maps/{name}") for name in names)
    fitted = np.isfinite(bias)
    assert 0 < (~fitted).sum() < bias.size / 2
    # of frames with light only the pixels' own noise is their variance without it
    variance = imread(next(path for path in written if path.name.startswith("variance_")))
    np.testing.assert_allclose(variance[fitted], noise[fitted] ** 2, rtol=1e-6)
    assert (variance[~fitted] == 1e8).all()  # such a pixel does not count
    for name, in_dn in (("off", bias), ("var", (noise / gain) ** 2)):
        found = imread(tmp_path / f"camera_maps/camera_{name}.tiff")
        np.testing.assert_allclose(found[fitted], in_dn[fitted], rtol=1e-6)
    camera = yaml.safe_load((tmp_path / "decode_camera.yaml").read_text())["Camera"]
    assert camera["read_sigma"] == pytest.approx(np.nanmedian(noise))
    [entry] = yaml.safe_load((tmp_path / "picasso_config.yaml").read_text())["Cameras"].values()
    assert entry["Sensitivity"] == pytest.approx(np.nanmedian(gain))
    # SMAP inverts the gain and takes its median; rows are y
    smap = loadmat(tmp_path / "smap/camera.mat")
    to_electrons = np.median(1 / smap["gainmap"])
    assert to_electrons == pytest.approx(np.nanmedian(gain), rel=1e-6)
    np.testing.assert_allclose(smap["offsetmap"][fitted], bias[fitted], rtol=1e-6)
    np.testing.assert_allclose(smap["varmap"][fitted], ((noise / gain) ** 2)[fitted], rtol=1e-6)
    # of dark frames they expect the dark current, too
    dark = finished.config.input.model_copy(update={"kind": "dark", "integration_time": None})
    config = finished.config.model_copy(update={"input": dark})
    sensor = replace(SensorInfo.read(finished.store), integration_time=None)
    found = Calibration.of(SimpleNamespace(config=config, sensor=lambda _: sensor), finished.store)
    np.testing.assert_allclose(found.offset[fitted], (bias + exposure / gain)[fitted], rtol=1e-12)
    np.testing.assert_allclose(found.variance[fitted], (noise**2 + exposure)[fitted], rtol=1e-12)
    for name in ("pyme", "banzai", "pyxel", "getframes"):
        with pytest.raises(ConfigError, match=r"exposure time.*set input\.integration_time"):
            ADAPTERS[name](found, tmp_path)
    taken = CameraFacts('A "B"', temperature=-20.0, taken=1.7e9)
    found = replace(found, integration_time=2.0, camera=taken)
    weak = replace(found, electrons=np.full_like(found.electrons, 1e-5))
    [path] = ADAPTERS["decode"](weak, tmp_path)
    assert yaml.safe_load(path.read_text())["Camera"]["spur_noise"] == 1e-5
    check_banzai(found, tmp_path)
    check_simulators(found, tmp_path)


def check_banzai(found, folder):
    """A dark frame as BANZAI reduces it, with the names of its headers: nothing but noise is left."""
    masters = {}
    for path in ADAPTERS["banzai"](found, folder):
        with fits.open(path) as file:
            data, header = file[0].data, file[0].header
        masters[header["OBSTYPE"]] = data, header
        assert min(header["SATURATE"], header["MAXLIN"]) > 0
        assert header["DATE-OBS"].startswith("2023-11-14T22:13:20")
        assert (header["CCDSTEMP"], header["CCDATEMP"], header["INSTRUME"]) == (-20, -20, 'A "B"')
    (bias, header), (dark, _) = masters["BIAS"], masters["DARK"]
    (noise, raw), (mask, _) = masters["READNOISE"], masters["BPM"]
    assert header["GAIN"] == 1
    left = found.offset * raw["GAIN"] - header["BIASLVL"] - bias - dark * found.integration_time
    np.testing.assert_allclose(left, 0, atol=1e-4)
    np.testing.assert_allclose(
        noise * raw["GAIN"], found.read_noise * np.median(found.gain) / found.gain, 1e-5
    )
    assert mask.dtype == np.uint8
    assert mask[~found.fitted].all()
    assert mask.sum() == (found.defects | ~found.fitted).sum() < mask.size / 2


def check_simulators(found, folder):
    """The mean code of a dark frame, and its noise in DN, as Pyxel and getframes make them."""
    gain, noise, rate = (np.median(v) for v in (found.gain, found.read_noise, found.dark_rate))
    pixel = np.median(found.bias) + found.integration_time * rate / found.gain
    path, _ = ADAPTERS["pyxel"](found, folder)
    content = yaml.safe_load(path.read_text())
    detector = content["cmos_detector"]["characteristics"]
    per_electron = np.load(path.parent / detector["charge_to_volt"]["value"])
    low, high = detector["adc_voltage_range"]
    codes = (2 ** detector["adc_bit_resolution"] - 1) / (high - low)
    steps = {step["name"]: step for group in content["pipeline"].values() for step in group}
    given = {name: step["arguments"] for name, step in steps.items()}
    [time] = content["exposure"]["readout"]["times"]
    volts = given["simple_dark_current"]["dark_rate"] * time * per_electron + given["dc_offset"]["offset"]
    np.testing.assert_allclose((volts - low) * codes - 0.5, pixel)
    deviation = given["output_node_noise"]["std_deviation"] * codes
    assert deviation == pytest.approx(np.median(found.read_noise / found.gain))
    assert steps["simple_adc"]["func"] == "pyxel.models.readout_electronics.simple_adc"
    [path] = ADAPTERS["getframes"](found, folder)
    camera = tomllib.loads(path.read_text())["camera"]
    assert (camera["name"], camera["resolution"]) == ('A "B"', [NY, NX])
    mean = camera["bias_offset_adu"] + time * camera["dark_current_e_per_s"] / camera["gain_e_per_adu"]
    assert mean == pytest.approx(np.median(found.bias) + time * rate / gain)
    spread = camera["read_noise_nonuniformity"]
    assert camera["read_noise_e"] * np.exp(-(spread**2) / 2) == pytest.approx(noise)
    assert camera["full_well_e"] / gain + camera["bias_offset_adu"] == pytest.approx(2**found.bits - 1)
    assert camera["dark_current_ref_temp_c"] == -20


def test_a_serial_number_never_leads_out_of_the_folder(finished, tmp_path):
    sensor = SensorInfo.read(finished.store)
    for serial, folder in (("../../etc", "etc"), ("..", "camera"), ("SN 7/2", "SN_7_2"), (None, "camera")):
        found = replace(sensor, camera=replace(sensor.camera, serial=serial), integration_time=1.0)
        target = SimpleNamespace(config=finished.config, sensor=lambda _, found=found: found)
        written = ADAPTERS["pyme"](Calibration.of(target, finished.store), tmp_path)
        assert {path.parent for path in written} == {tmp_path / "pyme" / folder}


def test_export_says_what_is_wrong(finished, tmp_path):
    run = finished.store.path
    finished.store.write_config(dump_config(finished.config))
    with pytest.raises(ConfigError, match="xlsx cannot be written; choose from fits, tiff, npz, csv"):
        export_run(run, tmp_path, ("fits", "xlsx"), Reporter("off"))
    empty = RunStore.create(tmp_path / "empty.zarr")
    empty.write_config(dump_config(finished.config))
    with pytest.raises(StoreError, match="no maps yet"):
        export_run(empty.path, tmp_path, ("csv",), Reporter("off"))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match="cannot use"):
        export_run(run, tmp_path / "file", ("csv",), Reporter("off"))
