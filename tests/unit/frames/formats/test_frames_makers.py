"""SPE of versions 2 and 3, SIF and ND2, written by hand after what is known of them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.camera_files import check_reads, opened, read, refused
from helpers.nd2_files import nd2_bytes
from helpers.sif_files import sif_bytes
from helpers.spe_files import spe_bytes

STACK = np.random.default_rng(16).integers(0, 65536, (5, 11, 13)).astype("<u2")
SMALL = STACK >> 4
NUMBERS = [(500_000 * i, 500_000 * i + 250_000, i + 1) for i in range(5)]
WORDS = "Flash4.0, SN:VSC-01412&#13;&#10;Sample 1:&#13;&#10;  Exposure: 100 ms&#13;&#10;  Binning: 1x1"


@pytest.mark.parametrize("dtype", ["u1", "<u2", "<u4", "<f4"])
def test_spe_version_2(tmp_path, dtype):
    path = tmp_path / "a.spe"
    stack = (STACK & 255).astype(dtype)
    path.write_bytes(spe_bytes(stack))
    reader = opened(path)
    assert (reader.integration_time, reader.camera.temperature) == (0.5, -70.0)
    check_reads(reader, stack.astype(np.uint32) if dtype == "<f4" else stack)


def test_spe_version_3_has_stamps_behind_its_frames(tmp_path):
    path = tmp_path / "a.spe"
    path.write_bytes(spe_bytes(STACK, version=3.0, numbers=NUMBERS))
    reader = opened(path)
    check_reads(reader, STACK)
    assert (reader.integration_time, reader.bit_depth) == (0.25, 16)
    assert reader.camera.words() == "BLAZE, serial number 0705, sensor at -95 °C, gain High"
    zero = np.datetime64("2026-01-31T11:00:00.5").astype("datetime64[ns]").astype(float) / 1e9
    np.testing.assert_allclose(reader.timestamps - zero, [0.5 * i for i in range(5)], atol=1e-5)
    assert not reader.report.notes
    lost = [*NUMBERS[:3], *((a, b, count + 2) for a, b, count in NUMBERS[3:])]
    path.write_bytes(spe_bytes(STACK, version=3.0, numbers=lost))
    assert "2 are missing (after frame 2)" in opened(path).report.notes[0]


def test_spe_of_signed_samples_and_floats_that_are_no_counts(tmp_path):
    path = tmp_path / "a.spe"
    path.write_bytes(spe_bytes((STACK >> 1).astype("<i2")))
    refused("signed samples .int16.; if none is negative, set input.dtype: uint16", path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), STACK >> 1)
    for odd in (-3.0, 0.5, np.nan, 3e9):
        values = STACK.astype("<f4")
        values[2, 3, 4] = odd
        path.write_bytes(spe_bytes(values))
        refused(rf"samples such as {odd:g}, raw whole".replace("+", r"\+"), path)


def test_spe_refusals(tmp_path):
    path = tmp_path / "a.spe"
    good = spe_bytes(STACK, version=3.0, numbers=NUMBERS)
    for data, words in (
        (good[:4000], "truncated before its footer"),
        (spe_bytes(STACK)[:-1], r"truncated: 5 frames need 5530 bytes, the file has 5529 \(4 complete"),
        (good[:5600], "truncated before its footer"),
        (good[:-40], "not a valid spe file, or truncated"),
        (spe_bytes(STACK, regions=2), "2 regions of interest; record one"),
        (spe_bytes(STACK, regions=3, version=3.0, numbers=NUMBERS), "3 regions of interest"),
        (good[:108] + b"\5\0" + good[110:], "samples of type 5; record whole numbers"),
        (good.replace(b'"Frame"', b'"Other"'), "not a valid spe file"),
        (good.replace(b"<SpeFormat", b"<!DOCTYPE a><SpeFormat"), "its footer declares entities"),
    ):
        path.write_bytes(data)
        refused(words, path)


def test_sif(tmp_path):
    pytest.importorskip("sif_parser")
    path = tmp_path / "a.sif"
    path.write_bytes(sif_bytes(STACK))
    reader = opened(path)
    check_reads(reader, STACK.astype(np.uint32))
    assert reader.integration_time == 0.25
    assert reader.camera.words() == "DU-897_BV, sensor at -80 °C, binning 1 x 1, gain 300"
    np.testing.assert_allclose(reader.timestamps, 1.7e9 + 0.5 * np.arange(5))
    assert not reader.report.notes
    path.write_bytes(sif_bytes(STACK, sums=3, step=0))
    reader = opened(path)
    assert reader.timestamps is None
    assert "each frame is the sum of 3 exposures" in reader.report.notes[0]


def test_sif_refusals(tmp_path):
    pytest.importorskip("sif_parser")
    path = tmp_path / "a.sif"
    good = sif_bytes(STACK)
    path.write_bytes(sif_bytes(STACK, tracks=2))
    refused("2 tracks or areas", path)
    for kept in (40, 100, 200, 300, len(good) - STACK.size * 4 - 8, len(good) - 1):
        path.write_bytes(good[:kept])
        refused(r"a\.sif: .*(not a valid sif file, or )?truncated", path)
    path.write_bytes(sif_bytes(STACK - 0.5))
    refused("samples such as .*, raw whole numbers are needed", path)


@pytest.mark.parametrize("compressed", [False, True])
def test_nd2(tmp_path, compressed):
    pytest.importorskip("nd2")
    path = tmp_path / "a.nd2"
    path.write_bytes(nd2_bytes(SMALL, words=WORDS, compressed=compressed))
    reader = opened(path)
    assert (reader.integration_time, reader.bit_depth) == (pytest.approx(0.1), 12)
    assert reader.camera.words() == "Flash4.0, serial number VSC-01412"
    assert not reader.report.notes
    check_reads(reader, SMALL)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda t: reader.read(t % 5, t % 5 + 1)[0], range(40)))
    np.testing.assert_array_equal(found, SMALL[np.arange(40) % 5])
    path.write_bytes(nd2_bytes(SMALL[:, :1]))
    np.testing.assert_array_equal(opened(path).read(), SMALL[:, :1])


def test_nd2_refusals(tmp_path):
    pytest.importorskip("nd2")
    path = tmp_path / "a.nd2"
    good = nd2_bytes(SMALL)
    colours = np.stack([SMALL, SMALL], axis=-1)
    for data, words in (
        (nd2_bytes(colours, channels=2), "2 channels or colours; export one"),
        (nd2_bytes(SMALL.astype("<f4"), bits=32), "floating-point samples"),
        (good[:-100], r"not a valid nd2 file, or truncated"),
        (good[:300], r"not a valid nd2 file, or truncated"),
        (b"\0\0\0\x0cjP  " + bytes(200), "old kind|not a valid nd2 file"),
    ):
        path.write_bytes(data)
        refused(words, path)
