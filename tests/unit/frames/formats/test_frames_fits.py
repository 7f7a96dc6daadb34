"""FITS in every layout, written by astropy, read back exactly."""

from __future__ import annotations

import itertools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from helpers.camera_files import opened, read, refused
from numpy.typing import NDArray

from pchem_pipeline.frames.formats.fits import FitsReader
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(12).integers(0, 65536, (5, 18, 23)).astype(np.uint16)


@pytest.mark.parametrize(
    ("dtype", "place"),
    [
        *itertools.product([np.uint8, np.uint16, np.uint32], ["primary", "extension", "RICE_1", "GZIP_2"]),
        # lossless to 16 bits only
        *itertools.product([np.uint8, np.uint16], ["HCOMPRESS_1"]),
    ],
)
def test_cube(tmp_path: Path, dtype: type, place: str) -> None:
    top = np.iinfo(dtype).max if place != "HCOMPRESS_1" else 60_000 % (np.iinfo(dtype).max + 1)
    stack = np.random.default_rng(1).integers(0, top, STACK.shape, dtype=dtype, endpoint=True)
    stack[0, 0, :2] = 0, top
    path = tmp_path / "cube.fits"
    if place == "primary":
        fits.PrimaryHDU(stack).writeto(path)
    elif place == "extension":
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(stack, name="SCI")]).writeto(path)
    else:
        options: dict[str, Any] = {"tile_shape": (1, 18, 23)} if place == "HCOMPRESS_1" else {}
        fits.HDUList(
            [fits.PrimaryHDU(), fits.CompImageHDU(stack, compression_type=place, **options)]
        ).writeto(path)
    reader = opened(tmp_path / "cube.fits")
    assert reader.shape == stack.shape
    assert reader.dtype == dtype
    np.testing.assert_array_equal(reader.read(), stack)
    for t0, t1, y0, y1 in [(0, 1, 0, 18), (1, 4, 5, 6), (4, 5, 17, 18), (2, 5, 3, 11)]:
        np.testing.assert_array_equal(reader.read(t0, t1, y0, y1), stack[t0:t1, y0:y1])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reader)).read(1, 3), stack[1:3])


@pytest.mark.parametrize("compressed", [False, True])
def test_list_of_single_images(tmp_path: Path, compressed: bool) -> None:
    for i, frame in enumerate(STACK):
        hdu = fits.CompImageHDU(frame) if compressed else fits.PrimaryHDU(frame)
        hdu.writeto(tmp_path / f"dark{i + 8}.fit")
    np.testing.assert_array_equal(read(tmp_path), STACK)


def test_four_axes(tmp_path: Path) -> None:
    path = tmp_path / "four.fits"
    fits.PrimaryHDU(STACK[:, None]).writeto(path)
    np.testing.assert_array_equal(read(path), STACK)
    fits.PrimaryHDU(STACK[None]).writeto(path, overwrite=True)
    np.testing.assert_array_equal(read(path), STACK)
    fits.PrimaryHDU(np.stack([STACK, STACK])).writeto(path, overwrite=True)
    refused("2 axes before rows and columns", path)


@pytest.mark.parametrize("keyword", ["EXPTIME", "EXPOSURE", "TELAPSE"])
@pytest.mark.parametrize("extension", [False, True])
def test_facts_are_taken_from_the_header(tmp_path: Path, keyword: str, extension: bool) -> None:
    primary = fits.PrimaryHDU() if extension else fits.PrimaryHDU(STACK)
    primary.header[keyword] = 4.87
    primary.header["BITDEPTH"] = 16
    path = tmp_path / "a.fits"
    fits.HDUList([primary, fits.ImageHDU(STACK)] if extension else [primary]).writeto(path)
    reader = FitsReader.open(path, InputSettings())
    assert reader.integration_time == 4.87
    assert reader.bit_depth == 16


@pytest.mark.parametrize(
    ("comment", "seconds"), [("[ms] exposure", 0.0125), ("exposure", 12.5), ("[s] it", 12.5)]
)
def test_unit_of_the_exposure(tmp_path: Path, comment: str, seconds: float) -> None:
    unit = fits.PrimaryHDU(STACK)
    unit.header["EXPOSURE"] = (12.5, comment)
    unit.writeto(tmp_path / "a.fits")
    assert FitsReader.open(tmp_path / "a.fits", InputSettings()).integration_time == pytest.approx(seconds)


def test_values_that_may_be_no_samples_are_reported(tmp_path: Path) -> None:
    for i in range(3):
        unit = fits.PrimaryHDU(STACK[i : i + 3])
        unit.header["BLANK"] = -32768
        unit.writeto(tmp_path / f"f{i}.fits")
    with open_frames(InputSettings(files=(str(tmp_path),)), tmp_path) as reader:
        assert reader.report.notes == [
            "f0.fits and 2 more: BLANK = -32768 marks pixels without a value; read as stored",
            "f0.fits and 2 more: its 3 planes are read as frames; if they are colours, write one file per "
            "colour",
        ]


def test_compression_that_loses_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    for scale, notes in ((0, 0), (4, 1)):
        unit = fits.CompImageHDU(
            STACK, compression_type="HCOMPRESS_1", hcomp_scale=scale, tile_shape=(1, *STACK.shape[1:])
        )
        unit.writeto(path, overwrite=True)
        reader = FitsReader.open(path, InputSettings())
        assert len(reader.notes) == notes
        assert np.array_equal(reader.read(), STACK) == (scale == 0)


def test_unsigned_plio_is_refused(tmp_path: Path) -> None:
    """The format's own library writes it, shifted by an offset that astropy does not take back."""
    path = tmp_path / "a.fits"
    fits.CompImageHDU((STACK & 0xFFF).astype(np.int16), compression_type="PLIO_1").writeto(path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), STACK & 0xFFF)
    with fits.open(path, mode="update", disable_image_compression=True) as file:
        file[1].header["BZERO"] = 32768
    refused("unsigned samples compressed by PLIO", path)


def test_several_images_must_be_chosen_from(tmp_path: Path) -> None:
    path = tmp_path / "two.fits"
    units = [fits.PrimaryHDU(), fits.ImageHDU(STACK, name="DARK"), fits.ImageHDU(STACK + 1, name="FLAT")]
    fits.HDUList(units).writeto(path)
    refused(r"two\.fits: images in the file: 1 \(DARK\), 2 \(FLAT\).*input.dataset", path)
    np.testing.assert_array_equal(read(path, dataset="DARK"), STACK)
    np.testing.assert_array_equal(read(path, dataset="2"), STACK + 1)
    refused("with this name: none", path, dataset="BIAS")


@pytest.mark.parametrize("compressed", [False, True])
def test_signed_samples(tmp_path: Path, compressed: bool) -> None:
    values = (STACK & 0x7FFF).astype(np.int16)
    path = tmp_path / "s.fits"

    def write(data: NDArray[np.int16]) -> None:
        (fits.CompImageHDU(data) if compressed else fits.PrimaryHDU(data)).writeto(path, overwrite=True)

    write(values)
    refused(r"signed samples \(int16\); .* set input.dtype: uint16", path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), values)
    values[2, 3, 4] = -7
    write(values)
    refused("negative samples", path, dtype="uint16")


def test_float_and_scaled(tmp_path: Path) -> None:
    path = tmp_path / "f.fits"
    fits.PrimaryHDU(STACK.astype(np.float32)).writeto(path)
    refused("floating-point samples", path)
    scaled = fits.PrimaryHDU(STACK.astype(np.int16))
    scaled.header["BSCALE"], scaled.header["BZERO"] = 0.5, 10.0
    scaled.writeto(path, overwrite=True)
    refused(r"scaled data \(BSCALE 0.5", path)


@pytest.mark.parametrize("kept", [100, 2879, 2880, 2880 + 500, 2880 + 18 * 23 * 2 * 4])
def test_truncated_cube(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cut.fits"
    fits.PrimaryHDU(STACK).writeto(path)
    path.write_bytes(path.read_bytes()[:kept])
    refused(r"cut\.fits: .*(truncated|not a valid)", path)


def test_truncated_compressed_cube(tmp_path: Path) -> None:
    path = tmp_path / "cut.fits"
    fits.CompImageHDU(STACK).writeto(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 2880 * 2])
    refused(r"cut\.fits: .*truncated: ", path)


def test_no_image(tmp_path: Path) -> None:
    path = tmp_path / "table.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(np.zeros(3, [("a", "i4")]))]).writeto(path)
    refused("no image", path)
