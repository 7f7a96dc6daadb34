"""DCIMG of all versions: samples that are stored apart, stamps, regions, and what is refused."""

import numpy as np
import pytest
from helpers.camera_files import check_reads, not_opened, opened, read
from helpers.dcimg_files import MARKER, SESSION, put, write_dcimg

from pchem_pipeline.frames.formats.dcimg import DcimgReader
from pchem_pipeline.frames.identity import content_identity
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.stream import HashedFrameStream

STACK = np.random.default_rng(5).integers(0, 4096, (20, 9, 14)).astype(np.uint16)
VERSIONS = pytest.mark.parametrize("version", [7, 0x1000000, 0x1050000, 0x2000000])


def reader_of(path):
    return DcimgReader.open(path, InputSettings())


@VERSIONS
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("row", [0, 4, 8, None])
def test_samples_that_are_stored_apart_come_to_their_place(tmp_path, version, dtype, row):
    path, stack = tmp_path / "a.dcimg", STACK.astype(dtype)
    write_dcimg(path, stack, version=version, row=row)
    assert path.read_bytes().count(MARKER.tobytes()) == len(stack) * (row is not None)
    frames = opened(path)
    assert not frames.report.notes
    check_reads(frames, stack)
    np.testing.assert_array_equal(frames.read(3, 7, 4, 5), stack[3:7, 4:5])
    np.testing.assert_array_equal(read(path, roi=(1, 7, 2, 13)), stack[:, 1:7, 2:13])


@VERSIONS
def test_they_do_so_in_the_stream_that_hashes_the_file(tmp_path, version):
    path = tmp_path / "a.dcimg"
    write_dcimg(path, STACK, version=version, row=4)
    frames = opened(path)
    with HashedFrameStream(frames, [(0, 4), (4, 6), (6, 9)], 7, files=[path]) as stream:
        found = np.concatenate([np.concatenate([*parts], axis=1) for _, parts in stream])
        assert stream.identity() == content_identity(frames.paths)
    np.testing.assert_array_equal(found, STACK)


@VERSIONS
@pytest.mark.parametrize("footer", [16, 32, 512])
def test_stamps_and_times(tmp_path, version, footer):
    path = tmp_path / "a.dcimg"
    stamps = np.r_[5:15, 15, 17:26]
    write_dcimg(path, STACK, version=version, stamps=stamps, footer=footer, row=None if footer == 16 else 3)
    reader = reader_of(path)
    np.testing.assert_array_equal(reader.frame_stamps, stamps)
    np.testing.assert_allclose(reader.timestamps, 1_700_000_000 + 0.05 * np.arange(20), rtol=0, atol=1e-6)
    assert reader.camera.taken == 1_700_000_000
    assert (reader.bit_depth, reader.integration_time) == (None, None)


def test_frames_without_footers_have_no_stamps_and_a_row_that_is_not_marked_is_told(tmp_path):
    write_dcimg(tmp_path / "a.dcimg", STACK, row=None, footer=0)
    reader = reader_of(tmp_path / "a.dcimg")
    np.testing.assert_array_equal(reader.read(), STACK)
    assert reader.frame_stamps is None is reader.timestamps
    path = tmp_path / "a.dcimg"
    write_dcimg(path, STACK, row=4)
    path.write_bytes(path.read_bytes().replace(MARKER.tobytes(), bytes(8)))
    reader = reader_of(path)
    assert "first 4 samples of a row are stored apart, and no row is marked" in reader.notes[0]
    assert (reader.read() != STACK).sum() == np.count_nonzero(STACK[:, 4, :4])


@VERSIONS
def test_longer_rows_are_read_whole(tmp_path, version):
    path = tmp_path / "a.dcimg"
    write_dcimg(path, STACK, version=version, more=3, sessions=2)
    frames = opened(path)
    assert frames.shape == (20, 9, 17)
    np.testing.assert_array_equal(frames.read()[:, :, :14], STACK)
    words = frames.report.message()
    assert "2 sessions, the first is read" in words
    assert "rows of 17 samples, 14 by the header" in words
    np.testing.assert_array_equal(read(path, roi=(0, 9, 0, 14)), STACK)


@VERSIONS
def test_what_is_refused(tmp_path, version):
    path = tmp_path / "a.dcimg"

    def refuse(words, change):
        write_dcimg(path, STACK, version=version, row=3)
        content = bytearray(path.read_bytes())
        path.write_bytes(change(content) or content)
        not_opened(words, path)

    first = SESSION + (32 if version == 7 else 60)
    refuse("pixel type 4; record monochrome", lambda content: put(content, first + 4, "<u4", 4))
    refuse("damaged header", lambda content: put(content, first + 24, "<u4", 77))
    refuse("unknown version 0x8; export", lambda content: put(content, 8, "<u4", 8))
    refuse("not a valid dcimg file, or truncated", lambda content: content[:40])
    refuse(r"a\.dcimg: does not begin as dcimg files do; correct its name", lambda content: b"text" * 999)
    refuse("truncated", lambda content: content[:-9])
    refuse("truncated: 20 frames need", lambda content: content[:3000])
    if version == 7:
        table = len(path.read_bytes()) and SESSION + 120 + STACK.nbytes + 160
        refuse("damaged footer", lambda content: put(content, table + 100, "<u4", 28 * 9))
        refuse("truncated in its footer", lambda content: put(content, table + 88, "<u8", 1 << 40))
