"""FITS files that are written: cards of the input files, and units."""

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.wcs import WCS
from helpers.camera_files import opened, write_fits

from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.frames.formats.fits_files import FitsImage, image_cards, input_cards, write_images

GRID = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 250.4, "CRVAL2": 36.5, "CRPIX1": 6, "CRPIX2": 4}
STACK = np.arange(2 * 8 * 12, dtype=np.uint16).reshape(2, 8, 12)


def header_of(frames):
    readers = [reader for reader, *_ in frames.pieces(0, frames.shape[0])]
    return fits.Header(input_cards(frames, readers, frames.camera, frames.stated_integration_time))


def test_world_coordinates_stay_with_the_pixels_of_a_region(tmp_path):
    """Of an image that is an extension, and compressed."""
    image = fits.CompImageHDU(STACK, fits.Header(GRID | {"CDELT1": -1e-4, "CDELT2": 1e-4}))
    image.header["TRIMSEC"] = "[1:12,1:8]"
    primary = fits.PrimaryHDU()
    primary.header.update({"OBJECT": "M 13", "EXPTIME": 2.5})
    fits.HDUList([primary, image]).writeto(tmp_path / "a.fits.fz")
    frames = opened(tmp_path / "a.fits.fz", roi=(3, 8, 4, 12))
    header = header_of(frames)
    world = [
        WCS(each, naxis=2).wcs_pix2world([[x, y]], 0) for each, x, y in ((header, 1, 2), (image.header, 5, 5))
    ]
    np.testing.assert_allclose(*world, rtol=0, atol=1e-12)
    assert (header["OBJECT"], header["EXPTIME"]) == ("M 13", 2.5)
    assert not {"TRIMSEC", "BITPIX", "NAXIS3", "BZERO", "ZIMAGE", "ZCMPTYPE", "TTYPE1", "EXTNAME"} & set(
        header
    )


def test_cards_that_break_the_standard_do_no_harm(tmp_path):
    for number in range(2):
        path = write_fits(tmp_path / f"{number}.fits", STACK + 5 * number, BADVALUE=1, CRPIX1=2, DOME="open")
        whole = path.read_bytes()
        for name, value in (("BADVALUE", "1.2.3 / no number"), ("CRPIX1", "'centre'")):
            at = whole.index(f"{name:8}=".encode())
            whole = whole[:at] + f"{name:8}= {value}".ljust(80).encode() + whole[at + 80 :]
        path.write_bytes(whole)
    frames = opened(tmp_path / "*.fits")
    header = header_of(frames)
    write_images(tmp_path / "made.fits", [FitsImage([STACK[0]], (8, 12), STACK.dtype, header.cards)])
    np.testing.assert_array_equal(fits.getdata(tmp_path / "made.fits"), STACK[0])
    assert fits.getheader(tmp_path / "made.fits")["DOME"] == "open"


@pytest.mark.parametrize("group", ["maps", "fit", "applied"])
def test_astropy_knows_the_units(group):
    for variable in variables_of(group):
        for unit in (card[1] for card in image_cards("a", variable.unit, "-") if card[0] == "BUNIT"):
            assert units.Unit(unit) != units.dimensionless_unscaled
        if variable.unit not in ("1", "nat"):
            assert "BUNIT" in dict(image_cards("a", variable.unit, "-"))
