"""SPE, written by hand after the maker's description, of versions 2 and 3."""

import pickle

import numpy as np
import pytest
from helpers.camera_files import opened, read, refused
from helpers.spe_files import spe_bytes

STACK = np.random.default_rng(16).integers(0, 65536, (5, 11, 13)).astype("<u2")
NUMBERS = [(500_000 * i, 500_000 * i + 250_000, i + 1) for i in range(5)]


@pytest.mark.parametrize("dtype", ["u1", "<u2", "<u4", "<f4"])
def test_version_2(tmp_path, dtype):
    path = tmp_path / "a.spe"
    stack = (STACK & 255).astype(dtype)
    path.write_bytes(spe_bytes(stack))
    reader = opened(path)
    assert reader.dtype == {"<f4": np.uint32}.get(dtype, np.dtype(dtype))
    assert (reader.integration_time, reader.camera.temperature) == (0.5, -70.0)
    for each in (reader, pickle.loads(pickle.dumps(reader))):
        np.testing.assert_array_equal(each.read(), stack)
        np.testing.assert_array_equal(each.read(1, 4, 2, 9), stack[1:4, 2:9])


def test_version_3_has_stamps_behind_its_frames(tmp_path):
    path = tmp_path / "a.spe"
    path.write_bytes(spe_bytes(STACK, version=3.0, numbers=NUMBERS))
    reader = opened(path)
    np.testing.assert_array_equal(reader.read(), STACK)
    np.testing.assert_array_equal(reader.read(3, 5, 0, 1), STACK[3:, :1])
    assert (reader.integration_time, reader.bit_depth) == (0.25, 16)
    assert reader.camera.words() == "BLAZE, serial number 0705, sensor at -95 °C, gain High"
    zero = np.datetime64("2026-01-31T11:00:00.5").astype("datetime64[ns]").astype(float) / 1e9
    np.testing.assert_allclose(reader.timestamps - zero, [0.5 * i for i in range(5)], atol=1e-5)
    assert not reader.report.notes
    lost = [*NUMBERS[:3], *((a, b, count + 2) for a, b, count in NUMBERS[3:])]
    path.write_bytes(spe_bytes(STACK, version=3.0, numbers=lost))
    assert "2 are missing (after frame 2)" in opened(path).report.notes[0]


def test_signed_samples_and_floats_that_are_no_counts(tmp_path):
    path = tmp_path / "a.spe"
    path.write_bytes(spe_bytes((STACK >> 1).astype("<i2")))
    refused("signed samples .int16.; if none is negative, set input.dtype: uint16", path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), STACK >> 1)
    for odd in (-3.0, 0.5, np.nan, 3e9):
        values = STACK.astype("<f4")
        values[2, 3, 4] = odd
        path.write_bytes(spe_bytes(values))
        refused(rf"samples such as {odd:g}, raw whole".replace("+", r"\+"), path)


def test_refusals(tmp_path):
    path = tmp_path / "a.spe"
    good = spe_bytes(STACK, version=3.0, numbers=NUMBERS)
    for data, words in (
        (good[:4000], "truncated, or not SPE"),
        (spe_bytes(STACK)[:-1], r"truncated: 5 frames need 5530 bytes, the file has 5529 \(4 complete"),
        (good[:5600], "truncated before its footer"),
        (good[:-40], "not a valid SPE file, or truncated"),
        (spe_bytes(STACK, regions=2), "2 regions of interest; record one"),
        (spe_bytes(STACK, regions=3, version=3.0, numbers=NUMBERS), "3 regions of interest"),
        (good[:108] + b"\5\0" + good[110:], "samples of type 5; record whole numbers"),
        (good.replace(b'"Frame"', b'"Other"'), "not a valid SPE file"),
        (good.replace(b"<SpeFormat", b"<!DOCTYPE a><SpeFormat"), "its footer declares entities"),
    ):
        path.write_bytes(data)
        refused(words, path)
