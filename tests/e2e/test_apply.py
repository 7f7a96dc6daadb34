"""pchem apply: frames of a characterised camera in electrons, as a user gets them."""

import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import tifffile
import xarray as xr
import yaml
from helpers.commands import Shell, imported_by
from helpers.known_camera import KnownCamera, pink
from helpers.without_pictures import undrawn

from pchem_pipeline.commands.apply.characterisation import read_calibration
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.exposure import estimate_exposure

SHAPE, N_NIGHT = (16, 24), 500
N = SHAPE[0] * SHAPE[1]


def the_camera():
    rng = np.random.default_rng(60)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.2, 0.3))
    exposure = rng.uniform(0.3, 1.5, SHAPE)
    return rng, camera, exposure


@pytest.fixture(scope="module")
def night(make_once):
    """A run of 2000 frames at 2 e-, and 500 of a scene, ``night.tif``; one pixel is dead."""

    def make(folder):
        rng, camera, exposure = the_camera()
        bright = np.full(SHAPE, 2.0)
        _, dn = camera.frames(rng, bright, 2000)
        dn[:, 3, 5] = 77
        tifffile.imwrite(folder / "dark.tif", dn)
        electrons, dn = camera.frames(rng, exposure, N_NIGHT)
        tifffile.imwrite(folder / "night.tif", dn)
        np.save(folder / "electrons.npy", electrons)
        options = ["--store", "run.zarr", "--bit-depth", "14", "--integration-time", "1"]
        Shell(folder).ok("run", "dark.tif", *options, "--until", "maps")

    return make_once("night", make)


@pytest.fixture
def lab(shell, night):
    """The folder of the shell with links to the run and its frames."""
    for name in ("run.zarr", "night.tif"):
        (shell.folder / name).symlink_to(night / name)
    return shell


def opened(path):
    return xr.open_zarr(path, group="applied", consolidated=False)


def refused(lab, *arguments):
    """Apply a run to frames, which must be refused in one line; return it."""
    said = lab("apply", *arguments)
    assert (said.code, said.stderr.count("\n")) == (4, 1)
    return said.stderr


def test_calibrated_frames_have_the_truth_within_their_errors(lab, night):
    result = lab.ok("apply", "run.zarr", "night.tif", "--output", "out.zarr")
    assert result.stdout.strip() == "out.zarr"
    found = opened(lab.folder / "out.zarr").load()
    _, camera, exposure = the_camera()
    electrons = np.load(night / "electrons.npy")
    good = found.quality.values == 0
    assert good.sum() > 0.9 * N
    z = ((found.exposure - exposure) / found.exposure_stderr).values[good]
    assert abs(z.mean()) < 5 / np.sqrt(N) + 0.1  # few events: skewed
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * N) + 0.02
    difference = (found.electrons.values - electrons)[:, good]
    noise = found.electrons_stderr_read.values[good]
    common = found.electrons_stderr_calibration.values[good]
    pull = difference.mean(axis=0) / np.hypot(noise / np.sqrt(N_NIGHT), common)
    assert abs(pull.std() - 1) < 5 / np.sqrt(2 * N)
    assert abs((difference / noise).std() - 1) < 0.02
    wrong = (found.electron_number.values != electrons)[:, good]
    limit = camera.least_error(exposure)[good].mean()
    assert abs(wrong.mean() - limit) < 5 * np.sqrt(limit / wrong.size) + 0.05 * limit
    # the dead pixel has no value, says why, and nothing is invented
    dead = found.isel(y=3, x=5)
    assert int(dead.quality) != 0
    assert np.isnan(dead.electrons).all()
    assert np.isnan(dead.exposure)
    assert (dead.electron_number == found.electron_number.attrs["no_number"]).all()
    # units, names and what it was made of
    assert found.electrons.attrs["units"] == found.exposure.attrs["units"] == "e-"
    assert found.electrons.dims == ("frame", "y", "x")
    made_of = found.attrs["provenance"]
    assert made_of["run"] == "run.zarr"
    assert len(made_of["run_digest"]) == 64
    assert made_of["frames"][0]["name"] == "night.tif"
    assert "too_few_bins" in found.quality.attrs["flag_meanings"]


def test_nothing_is_overwritten_without_force(lab):
    (lab.folder / "mine").mkdir()
    (lab.folder / "mine" / "notes.txt").write_text("keep")
    given = ["apply", "run.zarr", "night.tif", "--output"]
    lab.ok(*given, "out.zarr", "--what", "exposure")
    assert "up to date" in lab.ok(*given, "out.zarr", "--what", "exposure").stderr
    for *options, words in (
        ("out.zarr", "--what", "electrons", "--force"),  # the cure
        ("run.zarr", "--force", "has no calibrated frames"),
        ("mine", "--format", "zarr", "--force", ""),
        ("mine", "--format", "tiff", "--force", ""),
        ("s3://lab/far", "--format", "tiff", "s3://lab/far: only stores can be in an object storage"),
    ):
        assert words in lab.refused(2, *given, *options)
    lab.ok(*given, "out.zarr", "--what", "electrons", "--force")
    found = opened(lab.folder / "out.zarr")
    assert "electrons" in found
    assert "exposure" not in found
    assert (lab.folder / "mine" / "notes.txt").read_text() == "keep"
    assert not (lab.folder / "s3:").exists()


def test_electrons_start_without_compiled_loops(night, tmp_path):
    """numba and scipy take as long to load as a thousand frames of 256 x 256 pixels to calibrate."""
    files, output = (night / "run.zarr", night / "night.tif"), tmp_path / "out.zarr"
    found = imported_by("apply", *files, "--output", output, "--what", "electrons")
    assert not found & {"numba", "scipy", "pandas", "xarray"}
    assert output.exists()


def test_tiff_and_fits_hold_what_zarr_holds(lab):
    from astropy.io import fits

    given = ["apply", "run.zarr", "night.tif", "--workers", "1", "--prior", "flat", "--output"]
    lab.ok(*given, "out.zarr")
    lab.ok(*given, "out_tiff", "--format", "tiff")
    lab.ok(*given, "out_fits", "--format", "fits")
    found = opened(lab.folder / "out.zarr").load()
    for name in ("electrons", "electron_number", "exposure", "quality"):
        values = found[name].values
        with tifffile.TiffFile(lab.folder / "out_tiff" / f"{name}.tif") as file:
            np.testing.assert_array_equal(np.squeeze(file.asarray()), values.astype(file.pages[0].dtype))
            if name == "electrons":
                assert file.is_imagej
                assert file.imagej_metadata["frames"] == N_NIGHT
                about = json.loads(file.imagej_metadata["Info"])
                assert about["unit"] == "e-"
                assert about["provenance"]["run"] == "run.zarr"
        of_all = name in ("exposure", "quality")
        with fits.open(lab.folder / "out_fits" / f"{name if of_all else 'night'}.fits") as file:
            image = file[0 if of_all or name == "electrons" else name].data
            np.testing.assert_array_equal(image, values)
    with fits.open(lab.folder / "out_fits" / "exposure.fits") as file:
        np.testing.assert_array_equal(file["ERR"].data, found.exposure_stderr)
        assert file["SCI"].header["BUNIT"] == file["ERR"].header["BUNIT"] == "electron"
    with fits.open(lab.folder / "out_fits" / "night.fits") as file:
        assert [image.shape for image in file[:3]] == [found.electrons.shape] * 3
        assert file["ELECTRON_NUMBER"].header["NONUMBER"] == found.electron_number.attrs["no_number"]
    assert not list(lab.folder.glob(".*unfinished*"))


def exposures(lab, *folders):
    """Write frames of the night as FITS files of one exposure each, as at a telescope; return the headers."""
    from astropy.io import fits

    headers = []
    for number, name in enumerate(folders):
        samples = tifffile.imread(lab.folder / "night.tif")[number]
        samples[7, 9] = samples[7, 9] if number else 16383  # a star that saturates the first exposure alone
        image = fits.PrimaryHDU(samples)
        image.header.update(
            {"OBJECT": "M 13", "FILTER": "V", "EXPTIME": (1.0, "[s] shutter"), "BITDEPTH": 14}
            | {"DATE-OBS": f"2026-03-0{number + 1}T21:00:00.125", "CRVAL1": 250.4 + 0.01 * number}
            | {"DATAMAX": 16383, "RADESYS": "ICRS", "BUNIT": "adu", "CRVAL2": 36.46, "HISTORY": "guided"}
            | {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 12.5, "CRPIX2": 8.5}
            | {"CD1_1": -1e-4, "CD1_2": 2e-5, "CD2_1": 2e-5, "CD2_2": 1e-4, "HIERARCH LAB DOME": "open"}
        )
        path = lab.folder / name
        path.parent.mkdir(exist_ok=True)
        image.writeto(path)
        headers.append(image.header)
    return headers


@pytest.mark.filterwarnings("ignore:'datfix'")  # MJD-OBS from DATE-OBS
def test_each_exposure_becomes_a_fits_file_as_astronomers_know_it(lab):
    from astropy import units
    from astropy.io import fits
    from astropy.nddata import CCDData, StdDevUncertainty
    from astropy.wcs import WCS

    names = ["m13.001.fits", "m13.002.fits"]
    headers = exposures(lab, *(f"raw/{name}" for name in names))
    given = ["apply", "run.zarr", "raw", "--what", "electrons,exposure", "--output"]
    lab.ok(*given, "out.zarr")
    said = lab.ok(*given, "out", "--format", "fits")
    assert {f"out/{name}" for name in (*names, "exposure.fits", "provenance.json")} <= set(
        said.stdout.split()
    )
    found = opened(lab.folder / "out.zarr").load()
    for number, (name, header) in enumerate(zip(names, headers, strict=True)):
        ccd = CCDData.read(lab.folder / "out" / name, hdu_uncertainty="ERR", hdu_mask="DQ")
        electrons = found.electrons[number].values
        assert ccd.unit == units.electron
        np.testing.assert_array_equal(ccd.data, electrons)
        assert ccd.mask[3, 5]
        assert isinstance(ccd.uncertainty, StdDevUncertainty)
        powers = electrons[None] ** np.arange(3)[:, None, None]
        variance = found.electrons_stderr_read.values**2 + (found.calibration_variance.values * powers).sum(0)
        np.testing.assert_allclose(ccd.uncertainty.array, np.sqrt(variance), rtol=1e-5)
        corners = np.array([[0, 0], [SHAPE[1], SHAPE[0]]])
        world = WCS(header).wcs_pix2world(corners, 0)
        np.testing.assert_allclose(ccd.wcs.wcs_pix2world(corners, 0), world, rtol=0, atol=1e-10)
        with fits.open(lab.folder / "out" / name) as file:
            file.verify("exception")
            kept, dq = file["SCI"].header, file["DQ"]
            for card in ("OBJECT", "FILTER", "EXPTIME", "DATE-OBS", "CRVAL1", "CD1_2", "LAB DOME"):
                assert (kept[card], kept.comments[card]) == (header[card], header.comments[card])
            assert "guided" in kept["HISTORY"]
            assert "DATAMAX" not in kept
            assert kept["PCHEMRUN"] == "run.zarr"
            assert kept["PCHEMSHA"] == found.attrs["provenance"]["run_digest"]
            bits = {dq.header[card]: 1 << int(card[5:]) for card in dq.header["DQBIT*"]}
            assert dq.data[3, 5] & bits["too_few_bins"]
            other = found.quality.values & ~np.uint32(bits["at_adc_limit"])
            marked = found.at_adc_limit[number].values * np.uint32(bits["at_adc_limit"])
            np.testing.assert_array_equal(dq.data, other | marked)
            assert (marked[7, 9] > 0) == (number == 0)
            assert "peaks_overlap" not in bits  # of electron numbers only
    # of all exposures: what they have alike, and no half of the world coordinates
    ccd = CCDData.read(lab.folder / "out" / "exposure.fits", hdu_uncertainty="ERR", hdu_mask="DQ")
    np.testing.assert_array_equal(ccd.data, found.exposure)
    np.testing.assert_array_equal(ccd.uncertainty.array, found.exposure_stderr)
    assert ccd.wcs is None
    assert (ccd.header["OBJECT"], ccd.header["DATE-OBS"]) == ("M 13", headers[0]["DATE-OBS"])
    assert not {"CTYPE1", "CRVAL2", "CD1_1"} & set(ccd.header)
    # what is there stays
    again = lab.refused(2, *given, "out", "--format", "fits", "--what", "electrons")
    assert "out exists and was made from other frames or with other settings" in again
    assert "up to date" in lab.ok(*given, "out", "--format", "fits").stderr


def test_files_that_would_overwrite_others_are_refused(lab):
    exposures(lab, "a/1.fits", "b/1.fits", "c/quality.fits")
    name = "its calibrated frames would have the name of"
    for *given, output, words in (
        ("a", "b", "out", f"b/1.fits: {name} those of"),
        ("c", "out", f"c/quality.fits: {name} a map, quality.fits"),
        ("a", "a", f"a/1.fits: {name} the file itself, 1.fits"),
    ):
        assert words in refused(lab, "run.zarr", *given, "--output", output, "--format", "fits", "--force")
        assert not (lab.folder / "out").exists()


def test_fits_files_that_cannot_be_written_are_refused_before_anything_is_done(lab, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io.fits", None)
    said = lab("apply", "run.zarr", "night.tif", "--output", "none", "--format", "fits")
    assert said.code != 0
    assert said.stderr.startswith("pchem: FITS files: astropy.io.fits is needed; pip install")
    assert not [*lab.folder.glob("*none*")]


@pytest.mark.filterwarnings("ignore:'datfix'")  # MJD-OBS from DATE-OBS
def test_a_tiff_file_gives_a_fits_file_with_what_is_known_of_the_camera(lab):
    from astropy.nddata import CCDData

    facts = {"camera": "Câm X", "sensor_temperature": -20.5, "exposure_time": 250, "exposure_time_unit": "ms"}
    night_file(lab, "one.tif", start_time="2026-03-01T21:00:00.125", **facts)
    lab.ok("apply", "run.zarr", "one.tif", "--output", "out", "--what", "numbers", "--format", "fits")
    ccd = CCDData.read(lab.folder / "out" / "one.fits", hdu_uncertainty="ERR", hdu_mask="DQ")
    assert (ccd.shape, ccd.mask.shape, str(ccd.unit)) == ((20, *SHAPE), (20, *SHAPE), "electron")
    assert ccd.uncertainty is None
    known = {"EXPTIME": 0.25, "DATE-OBS": "2026-03-01T21:00:00.125", "INSTRUME": "C?m X", "CCD-TEMP": -20.5}
    assert {card: ccd.header[card] for card in known} == known


def test_killed_it_goes_on_and_gives_the_same(lab):
    given = ["apply", "run.zarr", "night.tif", "--prior", "run", "--output"]
    lab.ok(*given, "whole.zarr", "--workers", "1")
    given += ["killed.zarr", "--workers", "2"]
    (lab.folder / "killed.zarr").mkdir()  # as a process leaves it that is killed at its first file
    (lab.folder / "killed.zarr" / ".zarr.json.01.partial").touch()
    for seconds in (1.5, 2.5):
        with lab.start(*given) as process:
            try:
                process.wait(timeout=seconds)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
    lab.ok(*given)
    whole, killed = (opened(lab.folder / f"{name}.zarr").load() for name in ("whole", "killed"))
    assert set(whole) == set(killed)
    for name in whole:
        np.testing.assert_array_equal(whole[name].values, killed[name].values)


def test_wrong_frames_are_refused_in_one_line_and_a_moved_offset_is_told(lab):
    dn = tifffile.imread(lab.folder / "night.tif")
    for wrong, words in (
        (dn[:, :8], "frames of 8 x 24 pixels"),
        (dn.astype(np.uint8), "a bit depth of 14"),
        (dn - 40, "below the bias"),
    ):
        tifffile.imwrite(lab.folder / "wrong.tif", wrong)
        assert words in refused(lab, "run.zarr", "wrong.tif", "--output", "out.zarr")
        assert not (lab.folder / "out.zarr").exists()
    tifffile.imwrite(lab.folder / "moved.tif", dn[:1] - 15)
    result = lab.ok("apply", "run.zarr", "moved.tif", "--output", "out.zarr", "--what", "electrons")
    assert "the offset has changed" in result.stderr


def night_file(lab, name, **record):
    """Write some frames of the night with what a camera writes beside them."""
    frames = tifffile.imread(lab.folder / "night.tif")[:20]
    about = json.dumps({"shape": frames.shape, **record})
    tifffile.imwrite(lab.folder / name, frames, description=about, metadata=None)


def taken_with(run, *facts):
    """Let the camera files of a run have told these facts of the camera."""
    store = RunStore.open(run, writable=True)
    replace(SensorInfo.read(store), camera=CameraFacts(*facts)).write(store)


def test_frames_of_another_camera_or_temperature(lab, night):
    """The camera files name serial number and temperature: another camera is refused, another warmth told."""
    shutil.copytree(night / "run.zarr", lab.folder / "own.zarr")
    setup = {"gain": "0", "image_type": "dark"}
    taken_with(lab.folder / "own.zarr", "Camera X", "42", -20.0, None, setup)
    night_file(lab, "other.tif", camera="Camera X", serial_number="43")
    words = refused(lab, "own.zarr", "other.tif", "--output", "out.zarr")
    assert "serial number 43, but the run has 42" in words
    night_file(lab, "high.tif", gain=10)
    words = refused(lab, "own.zarr", "high.tif", "--output", "out.zarr")
    assert "gain = 10, but the run has 0; give a run of the same camera and setting" in words
    same = {"camera": "camera x", "serial_number": "42", "gain": 0, "image_type": "light"}
    night_file(lab, "warm.tif", sensor_temperature=-10, **same)
    warm = lab.ok("apply", "own.zarr", "warm.tif", "--output", "out.zarr", "--what", "electrons")
    assert "-10 °C, but -20 °C in the characterisation" in warm.stderr
    assert "in the run" not in warm.stderr
    night_file(lab, "cold.tif", camera="Camera Y", sensor_temperature=-21)
    cold = lab.ok("apply", "own.zarr", "cold.tif", "--output", "cold.zarr", "--what", "electrons")
    assert "camera Camera Y, but Camera X in the run" in cold.stderr
    assert "°C" not in cold.stderr


def test_the_run_of_a_folder_is_chosen_by_camera_setting_and_date(lab, night):
    runs = lab.folder / "runs"
    kinds = {
        "old": ("42", "0", -20.0, 1), "new": ("42", "0", -20.0, 8), "high": ("42", "10", -20.0, 9),
        "warm": ("42", "0", -10.0, 9), "other": ("43", "0", -20.0, 9),
    }  # fmt: skip
    for name, (serial, gain, temperature, day) in kinds.items():
        shutil.copytree(night / "run.zarr", runs / f"{name}.zarr")
        taken = datetime(2026, 1, day, tzinfo=UTC).timestamp()
        taken_with(runs / f"{name}.zarr", "Camera X", serial, temperature, taken, {"gain": gain})
    record = {"serial_number": "42", "gain": 0, "sensor_temperature": -20.5}
    for date, name, words in (
        ("2026-01-05", "old", "4.0 days before"), ("2026-01-09", "new", "1.0 days before"),
        ("2025-12-30", "old", "2.0 days after"),
    ):  # fmt: skip
        night_file(lab, "dated.tif", date=date, **record)
        done = lab.ok("apply", "runs", "dated.tif", "--output", f"{date}.zarr", "--what", "electrons")
        assert f"calibrated with runs/{name}.zarr, taken {words} the frames" in done.stderr
    output = ("--output", "out.zarr")
    words = refused(lab, "runs", "dated.tif", *output, "--max-age", "1")
    assert "taken 2.0 days after the frames, more than --max-age 1" in words
    night_file(lab, "late.tif", date="2026-03-30", **record)
    words = refused(lab, "runs", "dated.tif", "late.tif", *output, "--max-age", "50")
    assert "taken 88.0 days before the frames" in words
    words = lab.refused(2, "apply", "runs/old.zarr", "dated.tif", *output, "--max-age", "1")
    assert "is no folder of finished runs" in words
    shutil.copytree(runs / "old.zarr", runs / "more" / "old.zarr")
    words = refused(lab, "runs", "dated.tif", *output)
    assert "more/old.zarr and old.zarr in runs were taken at the same time; name one" in words
    shutil.rmtree(runs / "more")
    night_file(lab, "undated.tif", **record)
    words = refused(lab, "runs", "undated.tif", *output)
    assert "without a date, so none of new.zarr, old.zarr can be chosen" in words
    night_file(lab, "set.tif", **(record | {"gain": 5}))
    words = refused(lab, "runs", "set.tif", *output)
    assert "no run in runs fits" in words
    assert "high.zarr: gain = 5, but the run has 10" in words
    unfit = RunStore.open(runs / "high.zarr", writable=True)
    status = unfit.read("fit/fit_status")
    unfit.write_array("fit/fit_status", status | np.uint16(FitStatus.GAIN_AMBIGUOUS))
    night_file(lab, "open.tif", **(record | {"gain": 10}))
    words = refused(lab, "runs", "open.tif", *output)
    assert "high.zarr: the frames do not fix the gain of 100 % of the pixels" in words
    done = lab.ok("apply", "runs/high.zarr", "open.tif", *output)
    assert "high.zarr: the frames do not fix the gain of 100 % of the pixels" in done.stderr


def applied(shell, rng, camera, exposure, n_frames, until, n_night):
    """Characterise a camera; return the electrons of frames at 1 e-, the frames, and what is made of them."""
    tifffile.imwrite(shell.folder / "dark.tif", camera.frames(rng, exposure, n_frames)[1])
    electrons, frames = camera.frames(rng, 1.0, n_night)
    tifffile.imwrite(shell.folder / "night.tif", frames)
    shell.ok("run", "dark.tif", "--store", "run.zarr", "--bit-depth", "14", "--until", until, "--quiet")
    shell.ok("apply", "run.zarr", "night.tif", "--output", "out.zarr", "--what", "exposure,numbers")
    return electrons, frames, opened(shell.folder / "out.zarr").load()


def test_errors_where_peaks_overlap_hold_what_the_likelihood_leaves_open(shell):
    """A read noise of 0.45 e-: by the curvature of the characterisation they are too small by far."""
    rng = np.random.default_rng(62)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.45, 0.45), gain=(0.08, 0.12))
    electrons, frames, found = applied(shell, rng, camera, 2.0, 4000, "fit", 300)
    pulls = ((found.exposure - 1.0) / found.exposure_stderr).values
    square = np.sqrt(np.nanmean(pulls**2))
    assert 0.7 < square < 1.25
    histograms = histogram_frames(frames)
    calibration = read_calibration(RunStore.open(shell.folder / "run.zarr"))
    curved = estimate_exposure(histograms.counts, histograms.origin, calibration)
    np.testing.assert_allclose(curved.exposure, found.exposure, rtol=1e-6)
    assert np.sqrt(np.nanmean(((curved.exposure - 1.0) / curved.stderr) ** 2)) > 1.2 * square
    wrong = (found.electron_number.values != electrons).mean()
    assert abs(wrong / (1 - found.number_probability.values.mean()) - 1) < 0.1


def test_one_frame_is_as_often_right_as_it_says_though_a_bias_may_be_an_electron_off(shell):
    """At 8 e- and 1,000 frames a tenth of the biases are; and no frame is its own prior."""
    rng = np.random.default_rng(63)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.18))
    electrons, _, found = applied(shell, rng, camera, 8.0, 1000, "maps", 1)
    stated = found.number_probability.values.mean()
    right = (found.electron_number.values == electrons).mean()
    assert abs(right - stated) < 4 * np.sqrt(0.1 * 0.9 / N)
    assert stated < 0.93
    assert float(found.exposure_stderr.max()) < 4.0
    run = RunStore.open(shell.folder / "run.zarr")
    pulls = (run.read("maps/quanta_exposure") - 8.0) / run.read("maps/quanta_exposure_stderr")
    assert 0.7 < np.sqrt(np.mean(pulls**2)) < 1.2
    summary = run.attributes("maps")["summary"]
    assert summary["conversion_gain"]["n_left_out"] == 0
    assert summary["quanta_exposure"]["n_left_out"] > 0.8 * N


ROW_NOISE = 2.5  # DN: 0.24 e-, as much as the read noise


@pytest.fixture(scope="module")
def striped(make_once):
    """A run whose model has row noise, and frames of a scene with it: ``night.tif``."""

    def make(folder):
        rng = np.random.default_rng(61)
        camera = KnownCamera.drawn(rng, (12, 40), read_noise=(0.2, 0.25))
        for name, n, exposure in (("dark.tif", 2500, 2.0), ("night.tif", 400, 0.7)):
            rows = ROW_NOISE * rng.standard_normal((n, 12, 1))
            electrons, dn = camera.frames(rng, exposure, n, rows)
            tifffile.imwrite(folder / name, dn)
        np.save(folder / "electrons.npy", electrons)
        (folder / "run.yaml").write_text(
            "run: {store: run.zarr}\ninput: {files: [dark.tif], bit_depth: 14}\n"
            f"model: {{effects: [{{tag: row_noise, row_noise_dn: {ROW_NOISE}}}]}}\n"
        )
        Shell(folder).ok("run", "run.yaml", "--until", "fit")

    return make_once("striped", make)


def test_row_noise_of_the_model_is_taken_from_the_frames(striped, shell):
    given = ["apply", striped / "run.zarr", striped / "night.tif", "--output"]
    said = shell.ok(*given, "out.zarr").stderr
    assert "subtracted row_noise" in said
    shell.ok(*given, "kept.zarr", "--reference", "none")
    found, kept = (opened(shell.folder / name).load() for name in ("out.zarr", "kept.zarr"))
    electrons = np.load(striped / "electrons.npy")
    good = found.quality.values == 0
    errors = [(each.electrons.values - electrons)[:, good] for each in (found, kept)]
    scatter = [(each - each.mean(axis=0)).std() for each in errors]
    assert scatter[0] < 0.8 * scatter[1]
    numbers = re.findall(r"(0\.\d+) ± (0\.\d+) e⁻", said)
    for (noise, error), spread in zip(numbers, scatter[::-1], strict=True):
        assert abs(float(noise) - spread) < 5.0 * float(error)
        assert float(error) < 0.1 * spread
    # the error says what is left, in either
    for each, spread in zip((found, kept), scatter, strict=True):
        assert abs(spread / np.sqrt((each.electrons_stderr_read.values[good] ** 2).mean()) - 1) < 0.08
    wrong = [(each.electron_number.values != electrons)[:, good].mean() for each in (found, kept)]
    assert wrong[0] < 0.5 * wrong[1]
    claimed = 1 - found.number_probability.values[:, good].mean()
    assert abs(wrong[0] / claimed - 1) < 0.2
    assert (found.noise_after < found.noise_before).values[good].mean() > 0.9
    assert "row_offset" in found
    assert "column_offset" not in found  # nothing is subtracted from columns
    assert "row_offset" not in kept


def fitted_run(folder, rng, camera, n, offset_of, effect):
    """Fit n frames of 2 e- with an effect in the model; return the shell and what makes other frames."""

    def write(name, n, exposure):
        offset = offset_of(n)
        electrons, dn = camera.frames(rng, exposure, n, offset)
        tifffile.imwrite(folder / name, dn)
        return electrons, offset

    write("light.tif", n, 2.0)
    (folder / "run.yaml").write_text(
        "run: {store: run.zarr}\ninput: {files: [light.tif], bit_depth: 14}\n"
        f"model: {{effects: [{effect}]}}\n"
    )
    shell = Shell(folder)
    shell.ok("run", "run.yaml", "--until", "fit")
    return shell, write


def test_noise_along_the_readout_is_taken_from_the_frames_with_what_was_subtracted(tmp_path):
    rng = np.random.default_rng(64)
    camera = KnownCamera.drawn(rng, (12, 30), read_noise=(0.15, 0.2))
    effect = "{tag: read_order_noise, noise_dn: 3.0}"
    shell, write = fitted_run(tmp_path, rng, camera, 1500, lambda n: 3.0 * pink(rng, (12, 30), 1, n), effect)
    electrons, offset = write("night.tif", 60, 0.7)
    assert (
        "subtracted read_order_noise"
        in shell.ok("apply", "run.zarr", "night.tif", "--output", "o.zarr").stderr
    )
    found = opened(tmp_path / "o.zarr").load()
    good = found.quality.values == 0
    assert not {"row_offset", "column_offset"} & set(found)
    assert np.corrcoef(found.readout_offset.values[:, good].ravel(), offset[:, good].ravel())[0, 1] > 0.5
    assert (found.noise_after < found.noise_before).values[good].mean() > 0.9
    assert (found.electrons.values - electrons)[:, good].std() < 0.27


def test_telegraph_jumps_are_taken_from_dark_frames_and_the_noise_left_is_as_stated(tmp_path):
    rng = np.random.default_rng(65)
    camera = KnownCamera.drawn(rng, (12, 20), read_noise=(0.18, 0.22))
    trapped = rng.random(camera.bias.shape) < 0.3

    def jumps(n):
        return trapped * rng.choice([-2.5, 0.0, 2.5], (n, *trapped.shape), p=[0.1, 0.8, 0.1]) / camera.gain

    effect = "{tag: rts_noise, fraction: 0.3, amplitude_e: 2.5}"
    shell, write = fitted_run(tmp_path, rng, camera, 2500, jumps, effect)
    electrons, _ = write("dark.tif", 200, 0.1)
    said = shell.ok("apply", "run.zarr", "dark.tif", "--output", "o.zarr", "--what", "electrons").stderr
    assert "telegraph jumps subtracted in" in said
    shell.ok("apply", "run.zarr", "dark.tif", "--output", "k.zarr", "--reference", "none")
    found, kept = (opened(tmp_path / name).load() for name in ("o.zarr", "k.zarr"))
    good = (found.quality.values == 0) & trapped
    assert good.sum() > 40
    left, before = ((each.electrons.values - electrons)[:, good] for each in (found, kept))
    stated = np.sqrt(np.mean(found.electrons_stderr_read.values[good] ** 2))
    error = (left**2).std() / np.sqrt(left.size) / (2.0 * stated)
    assert abs(np.sqrt(np.mean(left**2)) - stated) < 5.0 * error + 0.01
    assert stated < 0.3 < 1.0 < np.sqrt(np.mean(before**2))
    clean = (found.quality.values == 0) & ~trapped
    np.testing.assert_array_equal(found.electrons.values[:, clean], kept.electrons.values[:, clean])


OVERSCAN = 8  # columns, of 40; between it and the others is one of neither
LIGHT = np.s_[..., : 39 - OVERSCAN]


def the_telescope():
    rng = np.random.default_rng(62)
    return rng, KnownCamera.drawn(rng, (24, 40), read_noise=(0.2, 0.25))


@pytest.fixture(scope="module")
def astronomer(make_once):
    """A run of a FITS file that states its overscan, and frames of a scene; its model has no row noise."""

    def make(folder):
        from astropy.io import fits

        folder = folder / "nuit é"
        folder.mkdir()
        rng, camera = the_telescope()
        for name, n, exposure in (("dark", 1500, 2.0), ("night", 300, 0.7), ("cold", 50, 0.7)):
            light = np.full((24, 40), exposure) * (np.arange(40) < 40 - OVERSCAN)
            offset = ROW_NOISE * rng.standard_normal((n, 24, 1)) - 40.0 * (name == "cold")
            electrons, dn = camera.frames(rng, light, n, offset)
            image = fits.PrimaryHDU(dn)
            image.header.update(TRIMSEC=f"[1:{39 - OVERSCAN},1:24]", BIASSEC=f"[{41 - OVERSCAN}:40,1:24]")
            image.writeto(folder / f"{name}.fits")
            np.save(folder / f"{name}.npy", electrons[LIGHT])
        with undrawn():
            Shell(folder).ok("run", "dark.fits", "--store", "run.zarr", "--bit-depth", "14")

    return make_once("astronomer", make) / "nuit é"


def test_overscan_takes_row_noise_from_frames_as_far_as_theory_allows(astronomer, shell):
    """The read noise of the run includes the row noise, that of the calibrated frames what stays of it."""
    _, camera = the_telescope()
    given = ["apply", astronomer / "run.zarr", astronomer / "night.fits", "--output"]
    said = shell.ok(*given, "out.zarr", "--reference", "overscan").stderr
    assert "subtracted frame_noise, row_noise" in said
    own = 1 / (camera.sigma[:, -OVERSCAN:] ** -2.0).sum(axis=1).mean()  # variance of the mean of a row
    left = ROW_NOISE**2 * own / (ROW_NOISE**2 + own)
    # what is said is measured in the light-sensitive pixels
    numbers = re.findall(r"(\d\.\d+) ± (\d\.\d+) DN", said)
    for (value, error), truth in zip(numbers, (ROW_NOISE, left**0.5), strict=True):
        assert abs(float(value) - truth) < 5 * float(error) + 0.02 * truth
        assert float(error) < 0.1 * truth
    found = opened(shell.folder / "out.zarr").load()
    good, true = found.quality.values[LIGHT] == 0, np.load(astronomer / "night.npy")
    assert good.mean() > 0.9
    off = (found.electrons.values[LIGHT] - true)[:, good]
    theory = (camera.gain**2 * (camera.sigma**2 + left))[LIGHT][good].mean()
    # pixels of a row share some of it
    assert abs(off.var(axis=0).mean() / theory - 1) < 5 * np.sqrt(2 / (300 * 24))
    stated = (found.electrons_stderr_read.values[LIGHT][good] ** 2).mean()
    assert abs(stated / theory - 1) < 5 * np.sqrt(2 / (256 * 24))
    wrong = (found.electron_number.values[LIGHT] != true)[:, good].mean()
    claimed = 1 - found.number_probability.values[LIGHT][:, good].mean()
    assert abs(wrong / claimed - 1) < 0.2
    assert np.isnan(found.electrons.values[..., 39 - OVERSCAN :]).all()


def test_overscan_tells_a_bias_that_moved_and_without_it_frames_or_runs_are_refused(astronomer, lab, shell):
    from astropy.io import fits

    asked = ["--reference", "overscan", "--output", "none.zarr"]
    words = refused(lab, "run.zarr", "night.tif", *asked)
    assert "run.zarr: no overscan is known; set input.overscan" in words
    fits.writeto(lab.folder / "bare.fits", fits.getdata(astronomer / "night.fits"))
    assert "bare.fits: no overscan is known" in refused(lab, astronomer / "run.zarr", "bare.fits", *asked)
    given = ["apply", astronomer / "run.zarr", astronomer / "cold.fits", "--what", "electrons", "--output"]
    assert "DN below the bias of the run" in shell.refused(4, *given, "kept.zarr")
    shell.ok(*given, "out.zarr", "--reference", "overscan")
    found = opened(shell.folder / "out.zarr").load()
    off = found.electrons.values[LIGHT] - np.load(astronomer / "cold.npy")
    assert (found.quality.values[LIGHT] == 0).mean() > 0.9
    assert abs(np.nanmean(found.mean_signal.values[LIGHT]) - 0.7) < 0.1
    _, camera = the_telescope()
    error = ROW_NOISE * camera.gain.mean() / np.sqrt(50 * 24)  # at most: of the rows of all frames
    assert abs(np.nanmedian(off)) < 5 * error + 0.02


def test_overscan_is_in_the_report_and_in_nothing_else(astronomer, shell):
    from pchem_pipeline import open_run

    (_, camera), run = the_telescope(), open_run(astronomer / "run.zarr")
    report = json.loads((astronomer / "run.zarr/report.json").read_text())
    medians, dark = run.overscan, np.s_[:, -OVERSCAN:]
    assert report["overscan"] == medians
    noise = np.hypot(camera.sigma, ROW_NOISE)
    for name, truth in (("bias", camera.bias), ("read_noise_dn", noise)):
        for where, some in (("overscan", dark), ("active", LIGHT)):
            cell = medians[name][where]
            assert abs(cell["median"] - np.median(truth[some])) < 5 * cell["median_stderr"]
        assert medians[name]["overscan"]["n_pixels"] == 24 * OVERSCAN
        group = run.group("overscan")
        z = ((group[name] - truth) / group[f"{name}_stderr"]).values[dark]
        # the pixels of a row share most of the error
        assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / 24)
    assert abs(medians["row_noise_dn"] / ROW_NOISE - 1) < 5 / np.sqrt(2 * 1024 * 23)
    assert "Overscan" in (astronomer / "run.zarr/report.html").read_text()
    summary, n = report["summary"]["bias"], 24 * (39 - OVERSCAN)
    assert report["fit_status"]["n_pixels"] == summary["n_pixels"] + summary["n_flagged"] == n
    # nor does its constant dilute what rows share in the sums of the quick look
    [row] = [check for check in report["quick_look"]["checks"] if check["name"] == "row_noise"]
    assert abs(row["size"] / ROW_NOISE - 1) < 5 / np.sqrt(2 * 1500 * 23) + 0.02
    # one column is of neither
    assert set(run.defects().query("kind == 'excluded'").x) <= {39 - OVERSCAN}
    shell.ok("export", astronomer / "run.zarr", "--format", "defects", "--output", "out")
    assert len((shell.folder / "out/defects.csv").read_text().splitlines()) < 24 * OVERSCAN
    shell.ok("compare", astronomer / "run.zarr", astronomer / "run.zarr", "--output", "same")
    run = json.loads((shell.folder / "same/compare.json").read_text())["runs"][0]
    assert sum(run["pixels"].values()) == n


def test_a_sample_at_the_limit_less_its_offset_is_censored(striped, shell):
    """Without the offset of its row each has a limit of its own."""
    electrons, night = np.load(striped / "electrons.npy"), tifffile.imread(striped / "night.tif")
    for limit in (106, 118):
        frames = np.minimum(night, limit)
        tifffile.imwrite(shell.folder / f"{limit}.tif", frames)
        said = shell.ok("apply", striped / "run.zarr", f"{limit}.tif", "--output", f"{limit}.zarr").stderr
        # offsets that the limit hides stay in the frames
        assert ("row_noise not subtracted" in said) == (limit == 106)
    found = opened(shell.folder / "118.zarr").load()
    stated, at = found.number_probability.values, frames == 118
    good = at & np.isfinite(stated)
    assert good.sum() > 0.98 * at.sum()
    right = (found.electron_number.values == electrons)[good].mean()
    assert abs(right - stated[good].mean()) < 0.05
    assert stated[good].mean() < 0.8


def test_a_twin_has_the_effects_of_the_run_in_its_model(striped, shell):
    """The run knew of row noise: the twin has it too, and the read noise of its pixels is without it."""
    shell.ok("twin", striped / "run.zarr", "--output", "twin.yaml", "--seed", "4", "--frames", "600")
    content = yaml.safe_load((shell.folder / "twin.yaml").read_text())
    assert content["model"]["effects"] == content["simulate"]["effects"]
    assert "parameters" not in content["simulate"]
    # the noise of the rows is no part of the pixels': left out of the model it would widen each by a third
    fitted = RunStore.open(striped / "run.zarr").read("fit/read_noise_dn")
    with np.load(shell.folder / "twin_maps.npz") as maps:
        np.testing.assert_allclose(np.where(maps["defect"], fitted, maps["read_noise_dn"]), fitted)


def test_a_twin_looks_at_a_scene_and_is_calibrated_again(lab, night):
    from pchem_pipeline import open_run

    run = open_run(lab.folder / "run.zarr")
    image = np.linspace(0.2, 1.5, N).reshape(SHAPE)
    np.save(lab.folder / "scene.npy", image)
    said = lab.ok("twin", "run.zarr", "--output", "scene.yaml", "--scene", "scene.npy", "--frames", "600")
    assert said.stdout.split() == ["scene.yaml", "scene_maps.npz"]
    assert lab("twin", "run.zarr", "--output", "scene.yaml").code == 2
    with np.load(lab.folder / "scene_maps.npz") as maps:
        assert maps["defect"][3, 5] == 3
    lab.ok("simulate", "scene.yaml", "--quiet")
    found = run.apply(lab.folder / "scene_frames", lab.folder / "scene_applied.zarr", what="exposure")
    good = found.quality.values == 0
    z = ((found.exposure - image) / found.exposure_stderr_counting).values[good]  # maps and twin are the same
    assert abs(z.mean()) < 5 / np.sqrt(z.size) + 0.1
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) + 0.02
    frames = run.twin().frames(image, 50)
    assert frames.shape == (50, *SHAPE)
    assert run.twin(shape=(8, 70)).frames(1.0, 5).shape == (5, 8, 70)
    np.save(lab.folder / "small.npy", np.ones((3, 3)))
    for wrong in (["--scene", "small.npy"], ["--scene", "no.npy"], ["--size", "8"], ["--scene", "-1"]):
        said = lab("twin", "run.zarr", "--output", "no.yaml", *wrong)
        assert (said.code in (2, 4), said.stderr.count("\n")) == (True, 1)
