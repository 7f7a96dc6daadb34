"""What holds in every format and layout: frames come back exactly, damaged or signed samples are refused."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.camera_files import check_reads, not_opened, opened, read, refused
from helpers.layouts import LAYOUTS, write

from pchem_pipeline.base.errors import InputError

SHAPE = (6, 21, 34)


#: layouts without samples of 32 bits
AT_MOST_16 = (
    "tiff, imagej", "tiff, imagej, time", "fits, HCOMPRESS_1", "dcimg", "dcimg, version 7", "dcimg, streamed",
    "dcimg, USB",
)  # fmt: skip


#: a layout of each way in which samples are stored
KINDS = ("npy", "tiff", "tiff, zlib", "fits", "fits, RICE_1", "hdf5", "hdf5, gzip, shuffle", "zarr", "raw")
every_kind = pytest.mark.parametrize("layout", KINDS)


def drawn(top, dtype):
    stack = np.random.default_rng(11).integers(0, top, SHAPE, dtype=dtype, endpoint=True)
    stack[0, 0, :2] = 0, top
    return stack


@pytest.mark.parametrize(
    ("layout", "dtype"),
    [
        (layout, dtype)
        for layout in LAYOUTS
        for dtype in (np.uint8, np.uint16, np.uint32)
        if not (dtype is np.uint32 and layout in AT_MOST_16)
    ],
)
def test_frames_are_read_exactly(tmp_path, layout, dtype):
    loses = (layout, dtype) == ("fits, HCOMPRESS_1", np.uint16)  # beyond 60,000
    stack = drawn(60_000 if loses else np.iinfo(dtype).max, dtype)
    check_reads(opened(write(tmp_path, layout, stack)), stack)


@every_kind
def test_many_threads_read_one_stack_of_files(tmp_path, layout):
    stack = drawn(65535, np.uint16)
    for name, part in (("a1", stack[:4]), ("a2", stack[4:])):
        write(tmp_path, layout, part, name)
    reader, rng = opened(tmp_path), np.random.default_rng(4)
    windows = [
        (*np.sort(rng.choice(7, 2, replace=False)), *np.sort(rng.choice(22, 2, replace=False)))
        for _ in range(60)
    ]

    def task(window):
        t0, t1, y0, y1 = map(int, window)
        return bool((reader.read(t0, t1, y0, y1) == stack[t0:t1, y0:y1]).all())

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(task, windows))


@every_kind
def test_a_file_that_vanishes_or_shrinks(tmp_path, layout):
    path = write(tmp_path, layout, drawn(65535, np.uint16))
    reader = opened(path)
    path.rename(tmp_path / "gone")
    with pytest.raises(InputError, match=r"disappeared while it was being read; restore"):
        reader.read()
    if layout.startswith(("hdf5", "zarr")):
        return
    (tmp_path / "gone").rename(path)
    os.truncate(path, path.stat().st_size // 2)
    words = r"(was truncated|size of the file changed) while it was being read; restore"
    with pytest.raises(InputError, match=words):
        reader.read()


@pytest.mark.parametrize("kept", [9, 60, 100, 129, 2879, 2880, 3380, 0.15, 0.5, 0.9, 0.95])
@pytest.mark.parametrize(
    "layout",
    [
        "npy", "tiff", "tiff pages", "tiff pages, strips", "tiff pages, tiles", "tiff pages, zlib",
        "bigtiff pages, big-endian", "fits", "fits, RICE_1", "hdf5",
    ],
)  # fmt: skip
def test_a_file_that_was_cut_is_refused(tmp_path, layout, kept):
    path = write(tmp_path, layout, drawn(4095, np.uint16))
    data = path.read_bytes()
    path.write_bytes(data[: kept if kept > 1 else int(len(data) * kept)])
    refused(rf"{path.name}: .*(truncated|not a valid|no image)", path)


@every_kind
def test_signed_samples_are_read_with_an_offset_or_where_none_is_negative(tmp_path, layout):
    stack = drawn(65535, np.uint16)
    path = write(tmp_path, layout, (stack.astype(np.int32) - 32768).astype(np.int16))
    not_opened(r"signed samples .*--offset 32768", path)
    frames = opened(path, offset=32768)
    np.testing.assert_array_equal(frames.read(), stack)
    refused(r"negative samples \(down to -\d+ DN, with the offset of 1000\)", path, offset=1000)
    not_opened("offset", path, offset=32769)
    if layout == "raw":
        return
    refused("negative samples", path, dtype="uint16")
    small = (stack // 2).astype(np.int16)
    path = write(tmp_path / "small", layout, small)
    refused(r"signed samples \(int16\).*input.dtype: uint16", path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), small)
    path = write(tmp_path / "large", layout, small.astype(np.int32))
    np.testing.assert_array_equal(read(path, dtype="uint32"), small)
    refused("floating-point samples", write(tmp_path / "float", layout, small.astype(np.float32)))


@pytest.mark.parametrize("layout", ["npy", "fits", "hdf5", "zarr, version 2"])
def test_axes_before_rows_and_columns_are_counted_in_turn(tmp_path, layout):
    stack = drawn(65535, np.uint16)
    for name, shape in (("a", (6, 1)), ("b", (1, 6)), ("c", (2, 3))):
        path = write(tmp_path, layout, stack.reshape(*shape, *SHAPE[1:]), name)
        reader = opened(path)
        np.testing.assert_array_equal(reader.read(), stack)
        assert any("read as 2 x 3 frames" in note for note in reader.report.notes) == (name == "c")
