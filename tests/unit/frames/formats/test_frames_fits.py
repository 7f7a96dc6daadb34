"""FITS: facts of its headers, what must be chosen, what is reported and what is refused."""

from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from helpers.camera_files import read, refused, write_fits

from pchem_pipeline.frames.formats.fits import FitsReader
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(12).integers(0, 65536, (5, 18, 23)).astype(np.uint16)


@pytest.mark.parametrize("keyword", ["EXPTIME", "EXPOSURE", "TELAPSE"])
@pytest.mark.parametrize("extension", [False, True])
def test_facts_are_taken_from_the_header(tmp_path, keyword, extension):
    primary = fits.PrimaryHDU() if extension else fits.PrimaryHDU(STACK)
    primary.header[keyword] = 4.87
    primary.header["BITDEPTH"] = 16
    path = tmp_path / "a.fits"
    fits.HDUList([primary, fits.ImageHDU(STACK)] if extension else [primary]).writeto(path)
    reader = FitsReader.open(path, InputSettings())
    assert reader.integration_time == 4.87
    assert reader.bit_depth == 16


def test_values_that_may_be_no_samples_mosaics_and_lossy_compression_are_reported(tmp_path):
    for i in range(3):
        write_fits(tmp_path / f"f{i}.fits", STACK[i : i + 3], BLANK=-32768)
    reader = open_frames(InputSettings(files=(str(tmp_path),)), tmp_path)
    assert reader.report.notes == [
        "f0.fits and 2 more: BLANK = -32768 marks pixels without a value; read as stored",
        "f0.fits and 2 more: its 3 planes are read as frames; if they are colours, write one file per colour",
    ]
    path = write_fits(tmp_path / "a.fits", STACK, BAYERPAT="RGGB")
    assert (
        "colour mosaic (RGGB): read as the monochrome samples"
        in FitsReader.open(path, InputSettings()).notes[0]
    )
    for scale, notes in ((0, 0), (4, 1)):
        unit = fits.CompImageHDU(
            STACK, compression_type="HCOMPRESS_1", hcomp_scale=scale, tile_shape=(1, *STACK.shape[1:])
        )
        unit.writeto(path, overwrite=True)
        reader = FitsReader.open(path, InputSettings())
        assert len(reader.notes) == notes
        assert np.array_equal(reader.read(), STACK) == (scale == 0)


def test_unsigned_plio_is_refused(tmp_path):
    """The format's own library writes it, shifted by an offset that astropy does not take back."""
    path = tmp_path / "a.fits"
    fits.CompImageHDU((STACK & 0xFFF).astype(np.int16), compression_type="PLIO_1").writeto(path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), STACK & 0xFFF)
    with fits.open(path, mode="update", disable_image_compression=True) as file:
        file[1].header["BZERO"] = 32768
    refused("unsigned samples compressed by PLIO", path)


def test_several_images_must_be_chosen_from(tmp_path):
    path = tmp_path / "two.fits"
    units = [fits.PrimaryHDU(), fits.ImageHDU(STACK, name="DARK"), fits.ImageHDU(STACK + 1, name="FLAT")]
    fits.HDUList(units).writeto(path)
    refused(r"two\.fits: images in the file: 1 \(DARK\), 2 \(FLAT\).*input.dataset", path)
    np.testing.assert_array_equal(read(path, dataset="DARK"), STACK)
    np.testing.assert_array_equal(read(path, dataset="2"), STACK + 1)
    refused("with this name: none", path, dataset="BIAS")


@pytest.mark.parametrize("coding", [None, "RICE_1", "GZIP_2"])
def test_extensions_of_a_frame_each_are_a_stack(tmp_path, coding):
    path = tmp_path / "a.fits"

    def write(cards=None, primary=None, last=STACK[-1], names=("", "", "", "", "")):
        units = [fits.PrimaryHDU(primary)]
        for frame, name in zip([*STACK[:-1], last], names, strict=True):
            kind = fits.ImageHDU if coding is None else partial(fits.CompImageHDU, compression_type=coding)
            units.append(kind(frame, name=name, header=fits.Header([("EXPTIME", 0.25), ("GAIN", 2)])))
        units[-1].header.update(cards or {})
        fits.HDUList(units).writeto(path, overwrite=True)

    for names in ([""] * 5, [f"FRAME_{i}" for i in range(5)]):
        write({"EXPTIME": 0.25001}, names=names)
        reader = open_frames(InputSettings(files=("a.fits",)), tmp_path)
        np.testing.assert_array_equal(reader.read(), STACK)
        np.testing.assert_array_equal(reader.read(1, 4, 3, 9), STACK[1:4, 3:9])
        assert reader.integration_time == 0.25
        assert "its 5 images are read as frames" in reader.report.notes[0]
    for differing in ("EXPTIME", "GAIN", "DETSEC"):
        write({differing: 3})
        refused(rf"4 \(\w+\), 5 \(\w+\), which differ in {differing}; choose one", path)
    write(names=("SCI", "SCI", "SCI", "SCI", "DQ"))
    refused("which differ in EXTNAME", path)
    np.testing.assert_array_equal(read(path, dataset="SCI"), STACK[:4])
    if coding is None:
        write()
        path.write_bytes(path.read_bytes()[:-2400])
        refused("truncated", path)
    write(last=STACK[-1, 1:])
    refused("which differ in NAXIS2", path)
    write(primary=STACK[0])
    refused(r"0 \(PRIMARY\), 1 \(", path)


def test_an_offset_is_added_scaled_values_and_no_image_are_refused(tmp_path):
    samples = STACK // 2
    path = write_fits(tmp_path / "a.fits", (samples.astype(np.int32) - 1000).astype(np.int16), BZERO=1000)
    np.testing.assert_array_equal(read(path), samples)
    scaled = write_fits(tmp_path / "f.fits", STACK.astype(np.int16), BSCALE=0.5, BZERO=10.0)
    refused(r"scaled data \(BSCALE 0.5", scaled)
    path = tmp_path / "table.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(np.zeros(3, [("a", "i4")]))]).writeto(path)
    refused("no image", path)
