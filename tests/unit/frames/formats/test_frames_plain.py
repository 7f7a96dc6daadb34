"""Raw bytes with settings or sidecar, npy and SER, written as plain bytes, read back exactly."""

import json
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.camera_files import check_reads, opened, read, refused
from helpers.layouts import packed

from pchem_pipeline.frames.formats.ser import SerReader
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(14).integers(0, 65536, (5, 11, 13)).astype(np.uint16)


def raw_bytes(stack, dtype, header=0, padding=0, last_padding=True):
    frames = [frame.astype(dtype).tobytes() + b"\xaa" * padding for frame in stack]
    data = b"\x55" * header + b"".join(frames)
    return data if last_padding or not padding else data[:-padding]


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32"])
@pytest.mark.parametrize(
    ("header", "padding", "last"), [(0, 0, True), (7, 0, True), (0, 5, True), (512, 3, False)]
)
def test_raw_by_settings(tmp_path, order, dtype, header, padding, last):
    stack = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, STACK.shape, dtype=dtype, endpoint=True)
    path = tmp_path / "a.raw"
    code = (">" if order == "big" else "<") + np.dtype(dtype).str[1:]
    path.write_bytes(raw_bytes(stack, code, header, padding, last))
    settings: dict[str, Any] = {"dtype": dtype, "byte_order": order}
    settings |= {"header_bytes": header, "frame_padding_bytes": padding}
    for shape in ((11, 13), (5, 11, 13)):
        check_reads(opened(path, shape=shape, **settings), stack)


@pytest.mark.parametrize("packing", ["Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed"])
@pytest.mark.parametrize(("rows", "columns"), [(11, 16), (4, 13), (2, 6), (6, 1)])
def test_packed_raw(tmp_path, packing, rows, columns):
    """Rows may begin within a byte; frames are whole bytes."""
    bits = int(packing[4:6])
    stack = np.random.default_rng(2).integers(0, 1 << bits, (5, rows, columns)).astype(np.uint16)
    stack[0].flat[:2] = 0, (1 << bits) - 1
    path = tmp_path / "a.raw"
    if rows * columns % 4 and packing == "Mono10p":
        path.write_bytes(bytes(5000))
        refused("frames of 6 x 1 samples are no whole bytes", path, shape=(rows, columns), packing=packing)
        return
    frames = [packed(frame, packing) + b"--" for frame in stack]
    path.write_bytes(b"head" + b"".join(frames))
    layout: dict[str, Any] = {"header_bytes": 4, "frame_padding_bytes": 2, "packing": packing}
    reader = opened(path, shape=(rows, columns), **layout)
    assert reader.bit_depth == bits
    check_reads(reader, stack)
    path.with_name("a.raw.json").write_text(json.dumps({"shape": [rows, columns], **layout}))
    np.testing.assert_array_equal(read(path), stack)
    np.testing.assert_array_equal(read(path, bit_depth=16), stack)


@pytest.mark.parametrize("packing", ["Mono12p", "Mono12Packed"])
def test_the_other_packing_of_twelve_bits_is_told(tmp_path, packing):
    rng = np.random.default_rng(3)
    stack = np.rint(rng.uniform(90, 300, (11, 16)) + rng.normal(0, 30, (9, 11, 16))).clip(0).astype(np.uint16)
    path = tmp_path / "a.raw"
    for frames in (stack, stack << 4 & 4095):  # left-justified, too
        path.write_bytes(packed(frames, packing))
        np.testing.assert_array_equal(read(path, shape=(11, 16), packing=packing), frames)
    path.write_bytes(packed(stack, packing))
    other = {"Mono12p": "Mono12Packed", "Mono12Packed": "Mono12p"}[packing]
    refused(f"look like {packing}; correct input.packing", path, shape=(11, 16), packing=other)


def test_packed_raw_that_is_described_twice_or_wrong(tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(packed(STACK[:, :, :12] >> 4, "Mono12p")[:-1])
    raw: dict[str, Any] = {"shape": (11, 12), "packing": "Mono12p"}
    refused(r"Mono12p says what the samples are; remove dtype and byte_order", path, dtype="uint16",
            byte_order="big", **raw)  # fmt: skip
    refused(r"not 11 x 12 Mono12p: 989 bytes .*correct input.shape, input.packing", path, **raw)
    refused(r"truncated: 5 frames need 990 bytes", path, shape=(5, 11, 12), packing="Mono12p")
    refused(r"frames of 11 x 13 samples are no whole bytes", path, shape=(11, 13), packing="Mono12Packed")


@pytest.mark.parametrize("name", ["a.raw.json", "a.json", "a.raw.yaml", "a.yml"])
def test_raw_by_sidecar(tmp_path, name):
    path = tmp_path / "a.raw"
    path.write_bytes(raw_bytes(STACK >> 4 << 4, ">u2", 16, 4))
    side: dict[str, Any] = {"shape": [11, 13], "dtype": "uint16", "byte_order": "big", "header_bytes": 16}
    side |= {"frame_padding_bytes": 4, "bit_shift": 4, "integration_time": 0.25, "camera": "left alone"}
    lines = "\n".join(f"{k}: {json.dumps(v)}" for k, v in side.items())
    (tmp_path / name).write_text(json.dumps(side) if name.endswith("json") else lines)
    reader = opened(tmp_path / "*.raw")
    np.testing.assert_array_equal(reader.read(), STACK >> 4)
    assert (reader.bit_shift, reader.bit_depth, reader.integration_time) == (4, 12, 0.25)
    # a setting wins over the sidecar
    np.testing.assert_array_equal(read(path, bit_shift=0), STACK >> 4 << 4)


INF = """information file for
D:\\movie.dax
machine name = storm3
data type = 16 bit integers (binary, {order} endian)
number of frames = 5
frame dimensions = 13 x 11
binning = 1 x 1
EMCCD Gain = 30
Preamp Gain = NA
Exposure Time = 0.05
camera temperature (deg. C) = -68
camera head = DU897_BV
x_start = 1
notes =
"""


@pytest.mark.parametrize(("order", "dtype"), [("big", ">u2"), ("little", "<u2")])
def test_dax_movie_with_its_inf(tmp_path, order, dtype):
    path = tmp_path / "movie.dax"
    path.write_bytes(raw_bytes(STACK, dtype))
    refused(r"raw frames need input.shape and input.dtype", path)
    path.with_suffix(".inf").write_text(INF.format(order=order))
    for place in (path, tmp_path, tmp_path / "movie.*"):
        reader = opened(place)
        np.testing.assert_array_equal(reader.read(), STACK)
    assert reader.integration_time == 0.05
    assert reader.camera.words() == "DU897_BV, sensor at -68 °C, gain 30, binning 1 x 1"
    path.write_bytes(raw_bytes(STACK, dtype)[:-1])
    refused(r"movie\.dax: truncated: 5 frames need 1430 bytes", path)
    for old, new, words in (
        ("13 x 11", "none", "raw frames need input.shape;"),
        ("= 5", "= some", r"sidecar movie\.inf cannot be read .*correct the sidecar"),
    ):
        path.with_suffix(".inf").write_text(INF.format(order=order).replace(old, new))
        refused(words, path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "cannot be read"),
        ("[1]", "Input should be a valid dictionary"),
        ('{"shape": [5, 5], "dtype": "int16"}', "dtype"),
        ('{"shape": "x", "dtype": "uint8"}', "shape"),
        ('{"shape": [0, 5], "dtype": "uint8"}', "are invalid"),
        ('{"shape": [5, 5], "dtype": "uint8", "header_bytes": -3}', "are invalid"),
    ],
)
def test_raw_with_a_bad_sidecar(tmp_path, text, words):
    path = tmp_path / "a.raw"
    path.write_bytes(bytes(100))
    path.with_name("a.raw.json").write_text(text)
    refused(words, path)


def test_raw_without_its_description_truncated_or_of_another_shape(tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(raw_bytes(STACK, "<u2")[:-1])
    refused(r"raw frames need input.shape and input.dtype; .*sidecar a\.raw\.json", path)
    refused(r"raw frames need input.dtype;", path, shape=(5, 5))
    raw: dict[str, Any] = {"shape": (11, 13), "dtype": "uint16"}
    refused(r"a\.raw: truncated, or not 11 x 13 uint16: 1429 bytes .*input.shape", path, **raw)
    words = r"truncated: 5 frames need 1430 bytes, the file has 1429 \(4 complete frames\)"
    refused(words, path, shape=(5, 11, 13), dtype="uint16")
    refused("truncated, or not", path, header_bytes=10_000, **raw)
    path.write_bytes(raw_bytes(STACK, "<u2"))
    reader = opened(path, shape=(3, 11, 13), dtype="uint16")
    np.testing.assert_array_equal(reader.read(), STACK[:3])
    assert "has 5 frames; the first 3 are used" in reader.report.message()


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.array([[{"a": 1}, None]] * 2), "object array"),
        (STACK.astype(np.complex64), "floating-point"),
        (STACK.astype(bool), "samples of type bool"),
        (STACK.astype(np.uint64), "samples of type uint64"),
        (np.zeros(3, np.uint8), r"needed: \(frames"),
        (np.zeros((2, 1, 6, 5, 3), np.uint8), "looks like colour"),
        (np.zeros((1, 6, 5, 3), np.uint8), "looks like colour"),
        (np.asfortranarray(STACK), "Fortran order"),
        (STACK, "input.dtype is uint8"),
        (np.zeros((3, 4), np.dtype([("a", "u1"), ("b", "u2")])), "objects instead of numbers"),
    ],
)
def test_npy_refusals(tmp_path, array, words):
    path = tmp_path / "a.npy"
    np.save(path, array)
    refused(f"^{path}.*{words}", path, **({"dtype": "uint8"} if array is STACK else {}))


def test_npy_never_opens_a_pickle(tmp_path):
    """A file that would run code when unpickled."""

    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    np.save(tmp_path / "a.npy", np.array([Trap(), Trap()], dtype=object), allow_pickle=True)
    refused("never opened", tmp_path / "a.npy")
    (tmp_path / "b.npy").write_bytes(pickle.dumps(Trap()))
    refused("does not begin as npy files do", tmp_path / "b.npy")
    assert not (tmp_path / "sprung").exists()


def ser_bytes(stack, depth, colour=0, flag=0, times=False):
    """Build a SER file by hand, from the text of the format."""
    n, rows, columns = stack.shape
    head = b"LUCAM-RECORDER" + struct.pack("<7i", 0, colour, flag, columns, rows, depth, n) + bytes(120)
    head += struct.pack("<2q", 637_000_000_000_000_000, 637_000_000_000_000_000)
    assert len(head) == 178
    tail = (637_000_000_000_000_000 + 5_000_000 * np.arange(n)).astype("<i8").tobytes() if times else b""
    return head + stack.tobytes() + tail


def test_ser(tmp_path):
    path = tmp_path / "a.ser"
    kinds = [("u1", 8, 0), ("<u2", 12, 0), ("<u2", 16, 0), (">u2", 16, 1)]
    for dtype, depth, flag in kinds:
        stack = (STACK & (2**depth - 1)).astype(dtype)
        path.write_bytes(ser_bytes(stack, depth, flag=flag))
        reader = opened(tmp_path / "a.ser")
        check_reads(reader, stack)
        assert reader.bit_depth == depth
        assert reader.timestamps is None
    path.write_bytes(ser_bytes(STACK.astype(">u2"), 16, flag=0))
    np.testing.assert_array_equal(read(path, byte_order="big"), STACK)
    for colour, pattern in ((8, "RGGB"), (11, "BGGR"), (16, "CYYM")):
        path.write_bytes(ser_bytes(STACK, 16, colour=colour))
        reader = opened(path)
        np.testing.assert_array_equal(reader.read(), STACK)
        assert f"a.ser: colour mosaic ({pattern}): read as the monochrome samples" in reader.report.notes[0]
    path.write_bytes(ser_bytes(STACK, 16, times=True))
    times = SerReader.open(path, InputSettings()).timestamps
    np.testing.assert_allclose(np.diff(times), 0.5, atol=1e-6)
    assert np.datetime64(int(times[0]), "s").astype(str).startswith("2019-07-2")
    both = opened(tmp_path / "a.ser", frame_range=(2, 5))
    np.testing.assert_array_equal(both.timestamps, times[2:5])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ser_bytes(STACK, 16, colour=100), r"colour video \(ColorID 100\); record raw"),
        (ser_bytes(STACK, 33), "damaged header"),
        (b"text" * 999, r"a\.ser: does not begin as ser files do; correct its name"),
        (ser_bytes(STACK, 16)[:100], "not a valid ser file, or truncated"),
        (ser_bytes(STACK, 16)[:-1], r"truncated: 5 frames need 1608 bytes, the file has 1607 \(4 compl"),
    ],
    ids=range(5),
)
def test_ser_refusals(tmp_path, data, words):
    (tmp_path / "a.ser").write_bytes(data)
    refused(words, tmp_path / "a.ser")
