"""TIFF: stacks as cameras write them, facts of its tags, what is reported and what is refused."""

import json
from typing import Any

import numpy as np
import pytest
import tifffile
from helpers import layouts
from helpers.camera_files import opened, overwrite, read, refused
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from pchem_pipeline.frames.formats.map_files import write_tiff_cube
from pchem_pipeline.frames.formats.tiff import TiffReader
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(11).integers(0, 4096, (6, 21, 34)).astype(np.uint16)


def test_twelve_bits_packed(tmp_path):
    """Bits packed without gaps, as machine-vision recorders write them: two samples in three bytes."""
    path = tmp_path / "packed.tif"
    layouts.tiff(path, STACK[0], metadata=None)
    bits = "".join(f"{value:012b}" for value in STACK[0].ravel())  # rows of 34 samples are whole bytes
    packed = int(bits, 2).to_bytes(len(bits) // 8, "big")
    with tifffile.TiffFile(path, mode="r+b") as file:
        page = file.pages[0]
        page.tags["BitsPerSample"].overwrite(12)
        page.tags["StripByteCounts"].overwrite(len(packed))
        start = page.dataoffsets[0]
    overwrite(path, start, packed)
    reader = TiffReader.open(path, InputSettings())
    assert reader.bit_depth == 12
    np.testing.assert_array_equal(reader.read(), STACK[:1])
    np.testing.assert_array_equal(reader.read(0, 1, 5, 9), STACK[:1, 5:9])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("shape", [(3, 5, 1), (3, 1, 5), (3, 4, 5)])
def test_calibrated_frames_of_one_row_or_column_are_pages(tmp_path, shape, dtype):
    stack = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    write_tiff_cube(tmp_path / "a.tif", iter([stack]), shape, stack.dtype, {"unit": "e-"})
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal([page.asarray() for page in file.pages], stack)
        assert file.is_imagej == (dtype == "float32")
        assert file.series[0].shape == shape


def test_stacks_with_one_directory(tmp_path):
    """ImageJ writes stacks above 4 GB with one directory, the number of images in its description."""
    path = tmp_path / "big_imagej.tif"
    description = f"ImageJ=1.53t\nimages={len(STACK)}\nframes={len(STACK)}\nhyperstack=true\n"
    layouts.tiff(path, STACK[0], byteorder=">", description=description, metadata=None)
    with path.open("ab") as stream, tifffile.TiffFile(path) as file:
        assert file.is_imagej
        assert len(file.pages) == 1
        assert path.stat().st_size == file.pages[0].dataoffsets[0] + STACK[0].nbytes
        stream.write(STACK[1:].astype(">u2").tobytes())
    np.testing.assert_array_equal(read(path), STACK)
    # MetaMorph counts the planes behind it by a tag of its own
    path = tmp_path / "a.stk"
    tags: list[Any] = [(33629, "2I", 6, tuple(range(12)), True)]
    tifffile.imwrite(path, STACK[0], metadata=None, photometric="minisblack", extratags=tags)
    with path.open("ab") as stream, tifffile.TiffFile(path) as file:
        assert path.stat().st_size == file.pages[0].dataoffsets[0] + STACK[0].nbytes
        stream.write(STACK[1:].tobytes())
    np.testing.assert_array_equal(read(path), STACK)


RGB = np.zeros((2, 8, 9, 3), np.uint8)
PALETTE = {"photometric": "palette", "colormap": np.zeros((3, 256), np.uint16)}


@pytest.mark.parametrize(
    ("data", "options", "words"),
    [
        (STACK, {"volumetric": True, "tile": (2, 16, 16)}, "pages of 6 x 21 x 34 uint16 are volumes"),
        (STACK, {"planarconfig": "separate", "compression": "zlib"}, "one page of 6 compressed planes"),
        (RGB, {"photometric": "rgb"}, r"a\.tif: colour or multi-channel images \(RGB, 3 samples per pixel\)"),
        (np.moveaxis(RGB, -1, 1), {"photometric": "rgb", "planarconfig": "separate"}, "colour"),
        (RGB[..., 0], PALETTE, "PALETTE"),
    ],
    ids=["volumes", "planes", "colour", "planes of colour", "palette"],
)
def test_volumes_planes_and_colour_are_refused(tmp_path, data, options, words):
    layouts.tiff(tmp_path / "a.tif", data, **options)
    refused(words, tmp_path / "a.tif")


def test_pages_are_frames_although_metadata_tell_several_series_or_they_are_coded_differently(tmp_path):
    path = tmp_path / "series.tif"
    with tifffile.TiffWriter(path) as writer:
        for block in (STACK[:2], STACK[2:3], STACK[3:]):
            writer.write(block, photometric="minisblack")
    with tifffile.TiffFile(path) as file:
        assert file.series[0].shape != STACK.shape
    np.testing.assert_array_equal(read(path), STACK)
    codings: list[dict[str, Any]] = [
        {"compression": "zlib", "rowsperstrip": 5}, {}, {"compression": "lzw"}, {"tile": (16, 16)},
    ]  # fmt: skip
    with tifffile.TiffWriter(path) as writer:
        for i, frame in enumerate(STACK):
            writer.write(frame, photometric="minisblack", metadata=None, **codings[i % len(codings)])
    reader = opened(path)
    np.testing.assert_array_equal(reader.read(), STACK)
    np.testing.assert_array_equal(reader.read(0, 6, 7, 18), STACK[:, 7:18])


RECORD = json.dumps({"Exposure-ms": 12.5}).encode()
PLANE = {"ExposureTime": [4870.0] * 6, "ExposureTimeUnit": ["ms"] * 6}


@pytest.mark.parametrize(
    ("name", "options", "seconds", "bits"),
    [
        ("exif.tif", {"extratags": [(33434, "2I", 1, (487, 100), True)]}, 4.87, None),
        ("a.ome.tif", {"metadata": {"axes": "TYX", "Plane": PLANE, "SignificantBits": 12}}, 4.87, 12),
        ("mm.tif", {"extratags": [(51123, "s", len(RECORD) + 1, RECORD, True)]}, 0.0125, None),
        ("plain.tif", {}, None, None),
    ],
)
def test_facts_are_taken_from_the_file(tmp_path, name, options, seconds, bits):
    layouts.tiff(tmp_path / name, STACK, **options)
    reader = TiffReader.open(tmp_path / name, InputSettings())
    assert reader.integration_time == (None if seconds is None else pytest.approx(seconds))
    assert reader.bit_depth == bits


def test_exposure_in_the_exif_directory(tmp_path):
    tags = ImageFileDirectory_v2()
    tags[34665] = {33434: IFDRational(487, 100)}
    Image.fromarray(STACK[0]).save(tmp_path / "a.tif", tiffinfo=tags)
    assert TiffReader.open(tmp_path / "a.tif", InputSettings()).integration_time == pytest.approx(4.87)


CFA = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\0\1\1\2", True)]
DNG = [(50706, "B", 4, b"\1\4\0\0", True)]


def write_mosaic(path, tags=(), **options):
    with tifffile.TiffWriter(path) as file:
        for frame in STACK:
            file.write(frame, photometric="cfa", extratags=[*CFA, *tags], metadata=None, **options)


@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "zlib"}, {"compression": "jpeg", "compressionargs": {"lossless": True}}],
    ids=["plain", "zlib", "lossless JPEG"],
)
def test_a_mosaic_is_read_as_its_samples(tmp_path, options):
    write_mosaic(tmp_path / "a.tif", **options)
    reader = opened(tmp_path / "a.tif")
    np.testing.assert_array_equal(reader.read(), STACK)
    assert any("a.tif: colour mosaic (RGGB): read as the mono" in note for note in reader.report.notes)


def test_dng_with_its_preview_edges_and_table(tmp_path):
    area = (50829, "I", 4, (2, 3, 21, 30), True)
    for i, frame in enumerate(STACK):
        with tifffile.TiffWriter(tmp_path / f"f{i}.dng") as file:
            exposure = (33434, "2I", 1, (1, 50), True)
            preview = {"photometric": "rgb", "subfiletype": 1, "subifds": 1, "extratags": [*DNG, exposure]}
            file.write(np.zeros((7, 11, 3), np.uint8), **preview)
            file.write(frame, photometric="cfa", extratags=[*CFA, area])
    reader = opened(tmp_path / "*.dng")
    excluded = np.ones(STACK.shape[1:], bool)
    excluded[2:21, 3:30] = False
    np.testing.assert_array_equal(reader.excluded, excluded)
    np.testing.assert_array_equal(reader.read()[:, ~excluded], STACK[:, ~excluded])
    assert reader.integration_time == 0.02
    write_mosaic(tmp_path / "table.dng", [*DNG, (50712, "H", 3, (0, 4, 9), True)])
    notes = TiffReader.open(tmp_path / "table.dng", InputSettings()).notes
    assert any("codes of a table" in note for note in notes)


def test_channels_beside_frames_are_refused(tmp_path):
    """Frames of two channels in turn are no samples of one law; frames called channels are frames."""
    imagej, ome = tmp_path / "imagej.tif", tmp_path / "a.ome.tif"
    mixed = STACK.reshape(3, 2, *STACK.shape[1:])
    tifffile.imwrite(imagej, mixed, imagej=True, metadata={"axes": "TCYX"})
    tifffile.imwrite(ome, mixed, metadata={"axes": "TCYX"}, photometric="minisblack")
    for path in (imagej, ome):
        refused("the 6 images as 2 channels of 3;", path)
    tifffile.imwrite(imagej, STACK, imagej=True, metadata={"axes": "CYX"})
    reader = TiffReader.open(imagej, InputSettings())
    np.testing.assert_array_equal(reader.read(), STACK)
    assert "6 channels; read as frames" in reader.notes[0]
    text = tifffile.tiffcomment(ome)
    tifffile.imwrite(ome, STACK[:3], description=text.encode(), metadata=None, photometric="minisblack")
    np.testing.assert_array_equal(read(ome), STACK[:3])  # the other channel lies in another file


def test_strips_that_were_never_written_are_lost_or_damaged(tmp_path):
    """GDAL leaves empty strips out: offset 0 and 0 bytes, where other bytes of the file must not be read."""
    path = tmp_path / "sparse.tif"
    tifffile.imwrite(path, STACK, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path, mode="r+b") as file:
        tags = file.pages[2].tags
        tags["StripOffsets"].overwrite(0)
        tags["StripByteCounts"].overwrite(0)
    reader = TiffReader.open(path, InputSettings())
    expected = STACK.copy()
    expected[2] = 0
    np.testing.assert_array_equal(reader.read(), expected)
    assert "1 of 6 strips or tiles was not written; read as the fill value" in reader.notes[0]
    path = tmp_path / "unfinished.tif"
    tifffile.imwrite(path, STACK, photometric="minisblack", metadata=None, rowsperstrip=8, compression="lzw")
    with tifffile.TiffFile(path) as file:
        place = file.pages[1].tags["StripOffsets"].offset
    overwrite(path, place, (40_000).to_bytes(2, "little"))  # a tag that no program knows
    refused(r"unfinished\.tif: page 1 has 0 strips or tiles and 3 sizes", path)
    path = tmp_path / "broken.tif"
    tifffile.imwrite(path, STACK, photometric="minisblack", compression="zlib")
    with tifffile.TiffFile(path) as file:
        start = file.pages[2].dataoffsets[0]
    overwrite(path, start, bytes(40))
    refused(r"broken\.tif: page 2 cannot be decoded", path)


def test_samples_that_are_not_as_the_camera_made_them_are_reported(tmp_path):
    lossy = [Image.fromarray((frame >> 4).astype(np.uint8)) for frame in STACK]
    lossy[0].save(tmp_path / "jpeg.tif", save_all=True, append_images=lossy[1:], compression="jpeg")
    tifffile.imwrite(tmp_path / "white.tif", STACK, photometric="miniswhite")
    tifffile.imwrite(tmp_path / "planes.tif", STACK, photometric="minisblack", planarconfig="separate")
    words = {"jpeg": "JPEG compression can be lossy", "white": "declare 0 as white", "planes": "the 6 planes"}
    for name, said in words.items():
        assert said in TiffReader.open(tmp_path / f"{name}.tif", InputSettings()).notes[0]


def test_previews_are_left_out_and_pages_of_another_shape_or_type_refused(tmp_path):
    path = tmp_path / "odd.tif"
    layouts.tiff_pages(path, STACK)
    tifffile.imwrite(path, STACK[0, ::2, ::2], append=True, metadata=None, subfiletype=1)
    reader = opened(path)
    np.testing.assert_array_equal(reader.read(), STACK)
    assert "1 reduced page" in reader.report.message()
    for odd in (STACK[0, :5], STACK[0].astype(np.uint8)):
        layouts.tiff_pages(path, STACK[:2])
        tifffile.imwrite(path, odd, append=True, metadata=None)
        refused(r"odd\.tif: page 2 is .* page 0 is 21 x 34 uint16", path)
