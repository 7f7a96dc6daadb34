"""The camera's name, serial number, temperature and date, in every format that has a place for them."""

import itertools
import json
import struct

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits
from helpers.camera_files import not_opened, opened, write_fits, write_hdf5

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import (
    CameraFacts,
    bits_of,
    celsius,
    duration_of,
    seconds_of,
    shared_facts,
    text_of,
)
from pchem_pipeline.frames.formats import ser
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import StackFacts

STACK = np.random.default_rng(5).integers(0, 4096, (5, 6, 7)).astype(np.uint16)
TAKEN = 1_769_860_800.0  # 2026-01-31T12:00:00 UTC


def facts(path, **settings):
    frames = opened(path, **settings)
    np.testing.assert_array_equal(frames.read(), STACK)
    return frames.camera


@pytest.mark.parametrize(
    "cards",
    [
        {"CCD-TEMP": -20.0, "DATE-OBS": "2026-01-31T12:00:00"},
        {"CCD-TEMP": (253.15, "[K] of the detector"), "DATE-OBS": "2026-01-31", "TIME-OBS": "12:00:00"},
    ],
)
def test_fits(tmp_path, cards):
    path = write_fits(tmp_path / "a.fits", STACK, INSTRUME="qCMOS X", SERIALNO=1234, **cards)
    assert facts(path) == CameraFacts("qCMOS X", "1234", pytest.approx(-20.0), TAKEN)


def test_tiff_tags_and_records(tmp_path):
    texts = {271: "Maker", 272: "Model 7", 306: "2026:01:31 12:00:00"}
    tags = [(number, "s", 0, text, True) for number, text in texts.items()]
    tifffile.imwrite(tmp_path / "tags.tif", STACK, photometric="minisblack", extratags=tags, metadata=None)
    assert facts(tmp_path / "tags.tif") == CameraFacts("Maker Model 7", None, None, TAKEN)
    record = json.dumps(
        {"shape": STACK.shape, "camera": "Own", "serial_number": "S-1", "sensor_temperature": 4}
    )
    tifffile.imwrite(tmp_path / "json.tif", STACK, description=record, metadata=None)
    assert facts(tmp_path / "json.tif") == CameraFacts("Own", "S-1", 4.0, None)
    manager = json.dumps({"Camera": "Andor", "Andor-CCDTemperature": "-60"}).encode()
    tifffile.imwrite(tmp_path / "m.tif", STACK, extratags=[(51123, "s", 0, manager, True)], metadata=None)
    assert facts(tmp_path / "m.tif") == CameraFacts("Andor", None, -60.0, None)


def test_ome_tiff(tmp_path):
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, STACK, metadata={"axes": "TYX", "AcquisitionDate": "2026-01-31T12:00:00"})
    text = tifffile.tiffcomment(path)
    detector = '<Detector ID="Detector:0" Model="A &amp; B" SerialNumber="9"/>'
    extra = f'<Instrument ID="Instrument:0">{detector}</Instrument>'
    text = text.replace("<Image ", extra + "<Image ", 1)
    text = text.replace("<Pixels ", '<ImagingEnvironment Temperature="-10" TemperatureUnit="°C"/><Pixels ', 1)
    tifffile.tiffcomment(path, text.encode())
    found = facts(path)
    assert (found.name, found.serial, found.temperature, found.taken) == ("A & B", "9", -10.0, TAKEN)


def test_hdf5_and_zarr(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("entry/detector")
        group["frames"] = STACK
        group.attrs["NX_class"] = "NXdetector"
        group["broken"] = h5py.ExternalLink("gone.h5", "/elsewhere")
        group["description"], group["serial_number"] = "Detector Y", "77"
        group["sensor_temperature"] = 250.0
        group["sensor_temperature"].attrs["units"] = "K"
    assert facts(tmp_path / "a.h5") == CameraFacts("Detector Y", "77", pytest.approx(-23.15), None)
    with h5py.File(tmp_path / "b.h5", "w") as file:  # a free text is no camera
        file["frames"], file["description"] = STACK, "our set-up"
        file["frames"].attrs["description"] = "dark frames of Monday"
    assert facts(tmp_path / "b.h5") == CameraFacts()
    attributes = {"camera": "Z", "sensor_temperature": 12.5, "start_time": "2026-01-31T13:00:00+01:00"}
    zarr.create_array(tmp_path / "a.zarr", data=STACK, attributes=attributes)
    assert facts(tmp_path / "a.zarr") == CameraFacts("Z", None, 12.5, TAKEN)


def test_ser_and_raw(tmp_path):
    ser.write_frames(tmp_path / "a.ser", iter([STACK]), StackFacts(STACK.shape, STACK.dtype, bit_depth=12))
    head = bytearray((tmp_path / "a.ser").read_bytes())
    head[82:122] = b"Planetary cam".ljust(40, b"\0")
    head[170:178] = struct.pack("<q", 621_355_968_000_000_000 + int(TAKEN * 1e7))
    (tmp_path / "a.ser").write_bytes(head)
    assert facts(tmp_path / "a.ser") == CameraFacts("Planetary cam", None, None, pytest.approx(TAKEN))
    STACK.astype("<u2").tofile(tmp_path / "a.raw")
    side = {"shape": STACK.shape, "dtype": "uint16", "camera": "R", "sensor_temperature": -5}
    (tmp_path / "a.raw.json").write_text(json.dumps(side))
    assert facts(tmp_path / "a.raw", format="raw") == CameraFacts("R", None, -5.0, None)


def test_several_files_share_what_they_state_alike(tmp_path):
    for i, temperature in enumerate((-20.0, -20.4, -17.0)):
        cards = {"CCD-TEMP": temperature, "SERIALNO": f"{i}"}  # which counts the files
        cards["DATE-OBS"] = f"2026-01-31T12:00:0{i}"
        write_fits(tmp_path / f"{i}.fits", STACK[i], INSTRUME="C", **cards)
    frames = opened(tmp_path / "*.fits")
    assert frames.camera == CameraFacts("C", None, pytest.approx(-57.4 / 3), TAKEN)
    assert [note for note in frames.report.notes if "-20.4 to -17 °C" in note]
    steady, remark = shared_facts([CameraFacts(temperature=1.0), CameraFacts(temperature=1.9)])
    assert (steady.temperature, remark) == (1.45, "")
    assert shared_facts([CameraFacts(temperature=1.0), CameraFacts()])[0].temperature is None


def test_a_pause_between_files_is_told(tmp_path):
    for i, time in enumerate(("01T23:50:00", "01T23:50:10", "03T01:50:10", "03T01:50:20")):
        write_fits(tmp_path / f"{i}.fits", STACK[i], **{"DATE-OBS": f"2026-02-{time}"})
    frames = opened(tmp_path / "*.fits")
    assert [note for note in frames.report.notes if "a pause of 26 h between 1.fits and 2.fits" in note]
    assert frames.last_taken - frames.camera.taken == 93_620.0
    assert opened(tmp_path / "[02]*.fits").moved == []  # the usual step


def test_files_of_two_cameras_are_no_stack(tmp_path):
    for i, serial in enumerate(("A1", "A1", "B2", "B2")):
        write_fits(tmp_path / f"{i}.fits", STACK[i], SERIALNO=serial)
    words = r"different cameras: serial number A1 in {}, serial number B2 in {}; give those of one at"
    for files, a, b in (
        (("*.fits",), r"0\.fits and 1\.fits", r"2\.fits and 3\.fits"),
        (("1.fits", "2.fits"), r"1\.fits", r"2\.fits"),
    ):
        with pytest.raises(InputError, match=words.format(a, b)):
            open_frames(InputSettings(files=files), tmp_path)
    write_fits(tmp_path / "4.fits", STACK[4])  # says nothing, contradicts nothing
    frames = open_frames(InputSettings(files=("0.fits", "1.fits", "4.fits")), tmp_path)
    assert frames.camera.serial is None


def test_files_of_two_settings_are_no_stack(tmp_path):
    for i, (gain, kind) in enumerate(((0, "DARK"), (0, "DARK"), (10, "DARK"), (0, "LIGHT"))):
        write_fits(tmp_path / f"{i}.fits", STACK[i], GAIN=gain, READMODE="fast", IMAGETYP=kind)
    words = r"different settings: GAIN = 0 in 0\.fits and 1\.fits and 3\.fits, GAIN = 10 in 2\.fits; give"
    not_opened(words, tmp_path / "*.fits")
    with pytest.raises(InputError, match=r"IMAGETYP = DARK in 0\.fits, IMAGETYP = LIGHT in 3\.fits"):
        open_frames(InputSettings(files=("0.fits", "3.fits")), tmp_path)
    frames = open_frames(InputSettings(files=("0.fits", "1.fits")), tmp_path)
    assert frames.camera.setup == {"GAIN": "0", "READMODE": "fast", "IMAGETYP": "DARK"}
    assert frames.camera.words() == "GAIN 0, READMODE fast, IMAGETYP DARK"
    for gain in (0, 1):  # files of the same name
        (tmp_path / f"gain{gain}").mkdir()
        write_fits(tmp_path / f"gain{gain}/0.fits", STACK[gain], GAIN=gain)
    with pytest.raises(InputError, match=r"GAIN = 0 in gain0/0\.fits, GAIN = 1 in gain1/0\.fits"):
        open_frames(InputSettings(files=("gain*/0.fits",)), tmp_path)


def test_a_temperature_is_one_of_a_sensor_or_none():
    known = [("-10", "°C"), (300, "K"), (-20, "deg_C"), (-20, "degrees Celsius")]
    assert [celsius(*each) for each in known] == pytest.approx([-10.0, 26.85, -20.0, -20.0])
    for value, unit in ((300, "C"), (77, "F"), (77, "mK"), (np.nan, "C"), ("warm", "C")):
        assert celsius(value, unit) is None, (value, unit)


def test_names_of_a_megabyte_in_every_format(tmp_path):
    text = "日本語 кир עברית \u202e\x1b[31m<script>" * 35_000
    image = fits.PrimaryHDU(STACK)
    image.header["INSTRUME"] = "Z" * 100_000
    for _ in range(10_000):
        image.header["COMMENT"] = "x" * 70
    image.writeto(tmp_path / "a.fits")
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        file["frames"], file["camera"] = STACK, text
        file["frames"].attrs["exposure_time"] = text
    named = {"camera": text, "sensor_temperature": text, "exposure_time": [1] * 200_000}
    zarr.create_array(tmp_path / "a.zarr", data=STACK, attributes=named)
    maker = [(271, "s", 0, "Z" * 1_000_000, True)]
    tifffile.imwrite(tmp_path / "a.tif", STACK, photometric="minisblack", extratags=maker, metadata=None)
    for name in ("a.fits", "a.h5", "a.zarr", "a.tif"):
        found = facts(tmp_path / name)
        assert found.temperature is None
        assert 40 < len(found.name) <= 80, name
        assert found.name.isprintable()


def test_xml_that_stands_for_a_billion_letters_is_not_read(tmp_path):
    names = "abcdefghij"
    more = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in itertools.pairwise(names))
    xml = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "{"a" * 10}">{more}]><OME><Image Name="&j;"/></OME>'
    tifffile.imwrite(tmp_path / "a.tif", STACK, description=xml, metadata=None)
    assert facts(tmp_path / "a.tif") == CameraFacts()


def test_hostile_values_become_one_short_line_or_nothing():
    assert text_of(b"a\x1b[31m\n<b>\0rest") == "a [31m <b>"
    assert text_of("x" * 1_000_000) == "x" * 80
    assert (text_of(b"\0\0"), text_of(None), text_of(True)) == (None, None, None)
    assert (seconds_of("yesterday"), seconds_of("1800-01-01"), seconds_of(5)) == (None, None, None)
    assert [bits_of(value) for value in (12, np.int16(16))] == [12, 16]
    assert [bits_of(value) for value in (0, 33, 12.0, "12", True)] == [None] * 5


#: what the words beside a time of 100 make of it, s
WORDS = {
    0.1: (
        "exposure time in ms", "EXPTIME (msec.)", "Exposure time, milliseconds", "exposure_ms", "m_sec",
        "exposure time in milli-seconds",
    ),
    1e-4: ("[\u03bcs] shutter open", "exposure in us of the shutter"),
    100.0: (
        "exposure (shutter) time in seconds", "exposure time of the second frame",
        "exposure time in the dark mode",
    ),
    None: (
        "exposure time in ticks", "exposure time in clock cycles", "exposure time [ms/10]",
        "exposure time, ticks", "[lines] exposure time", "[s] exposure time in ms",
        "exposure in units of 10 us", "exposure in tenths of seconds", "tenths of a second",
        "exposure time, tenths of a second", "exposure time (tenths of a second)",
        "exposure of half seconds", "exposure time, deci-seconds", "exposure time, deciseconds",
        "1/s", "frames per second",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("value", "unit", "seconds"),
    [
        (20, "ms", 0.02),
        ("250", "us", 2.5e-4),
        (np.float32(2), None, 2.0),
        (1.5, b"min", 90.0),
        (3.0, "fortnights", None),
        *((value, "s", None) for value in (0.0, np.nan, True, [1.0, 2.0], None)),
        ("100 ms", None, 0.1),
        ("100ms", None, 0.1),
        ("1/30 s", None, None),
        *((2, words, 2000.0) for words in ("exposure time, kiloseconds", "kilo-seconds", "ks")),
        (2, "exposure time (hours)", 7200.0),
        *((100, words, seconds) for seconds, alike in WORDS.items() for words in alike),
    ],
)
def test_durations(value, unit, seconds):
    comment = unit if isinstance(unit, str) and " " in unit else ""
    found = duration_of("exposure", value, None if comment else unit, comment=comment)
    assert (found and found.seconds) == (None if seconds is None else pytest.approx(seconds))


def test_the_unit_of_a_duration_is_read_wherever_it_is_stated(tmp_path):
    time = (100, "exposure time")
    write_fits(tmp_path / "plain.fits", STACK, EXPTIME=time)
    write_fits(tmp_path / "unit.fits", STACK, EXPTIME=time, TIMEUNIT="ms")
    write_fits(tmp_path / "doubt.fits", STACK, EXPTIME=(100, "exposure in s"), TIMEUNIT="ms")
    units = {"a": {"exposure_time_unit": "ms"}, "b": {"time_unit": "ms"}, "c": {"unit": "ms"}}
    units["d"] = {"unit": "DN"}  # that of the samples says nothing about the time
    units["e"] = {"exposure_time_units": "ms", "bit_depth_readout": 12}
    for name, unit in units.items():
        zarr.create_array(tmp_path / f"{name}.zarr", data=STACK, attributes={"exposure_time": 100, **unit})
    write_hdf5(tmp_path / "a.h5", frames=STACK, exposure_ms=100)
    with h5py.File(write_hdf5(tmp_path / "b.h5", frames=STACK), "a") as file:  # each number an array of one
        attributes = {"exposure_time": np.array([100.0]), "bit_depth_readout": np.array([12])}
        file["frames"].attrs.update({"exposure_time_units": "ms", **attributes})
    STACK.astype("<u2").tofile(tmp_path / "a.raw")
    side = {"shape": STACK.shape, "dtype": "uint16", "integration_time": 100, "integration_time_unit": "ms"}
    (tmp_path / "a.raw.json").write_text(json.dumps(side))
    known = ("unit.fits", "a.zarr", "b.zarr", "c.zarr", "e.zarr", "a.h5", "b.h5", "a.raw")
    seconds = dict.fromkeys(known, 0.1)
    seconds |= {"plain.fits": 100.0, "d.zarr": 100.0, "doubt.fits": None}
    for name, right in seconds.items():
        stack = opened(tmp_path / name)
        assert stack.integration_time == (None if right is None else pytest.approx(right)), name
        assert name in stack.time_words
        assert "--integration-time" not in stack.time_words or right is None
        assert stack.bit_depth == (12 if name in ("e.zarr", "b.h5") else None)


def test_statements_that_contradict_each_other_leave_the_time_unknown(tmp_path):
    cards = {
        "apart": ({"EXPTIME": (0.1, "[s]"), "EXPOSURE": (0.2, "[s]")}, None),
        "alike": ({"EXPTIME": (0.0333, "[s]"), "EXPOSURE": (33.3333, "[ms]")}, 0.0333),
        "total": ({"EXPTIME": (0.1, "[s]"), "TELAPSE": (12.0, "[s]")}, 0.1),
        "alone": ({"TELAPSE": (12.0, "[s]")}, 12.0),
    }
    for name, (header, seconds) in cards.items():
        stack = opened(write_fits(tmp_path / f"{name}.fits", STACK, **header))
        assert stack.integration_time == seconds
    write_hdf5(tmp_path / "a.h5", frames=STACK, exposure_ms=100, integration_time=0.2)
    both_of = {"apart.fits": "EXPTIME = 0.1 ([s]), but EXPOSURE = 0.2 ([s])", "a.h5": "0.2 (s), but"}
    for name, both in both_of.items():
        stack = opened(tmp_path / name)
        assert stack.integration_time is None
        assert both in stack.time_words
        assert "set input.integration_time (--integration-time SECONDS)" in stack.time_words
