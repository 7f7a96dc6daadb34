"""FITS files that are written: images that come by blocks, and their cards."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import require
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.frames.reader import FrameReader
from pchem_pipeline.store.files import whole_file

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence

#: unit -> as FITS files have it and astropy reads it; others are numbers
_UNITS = {
    "e-": "electron",
    "e-2": "electron2",
    "DN": "adu",
    "DN2": "adu2",
    "1/DN": "1 / adu",
    "1/e-": "1 / electron",
    "e-/DN": "electron / adu",
    "e-/px/s": "electron / (pix s)",
    "e-/level": "electron",
    "pixel": "pix",
}
#: BITPIX -> BZERO of unsigned integers of that size
UNSIGNED_ZERO = {16: 1 << 15, 32: 1 << 31}
#: of parts of the sensor, which a region of interest moves
_SECTIONS = ("DATASEC", "TRIMSEC", "BIASSEC", "CCDSEC", "DETSEC")
#: of the world coordinates, of which a part alone would be wrong
_WCS = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA)\d+[A-Z]?|(CD|PC|PV|PS)\d+_\d+[A-Z]?|(LONPOLE|LATPOLE|WCSAXES)[A-Z]?"
    r"|(A|B|AP|BP)_(ORDER|\d+_\d+)"
)


class FitsImage(NamedTuple):
    """An image of a FITS file: blocks of planes, the shape of all together, their type, and further cards.

    Of a header alone, blocks and shape are empty. Cards are those of astropy, or tuples that make one.
    """

    blocks: Iterable[NDArray[Any]]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    cards: Sequence[Any]


def image_cards(name: str, unit: str, long_name: str) -> list[tuple[str, str]]:
    """Return the cards that say what an image is; see `base.variables`."""
    unit = _UNITS.get(unit, "")
    return [("EXTNAME", name.upper()), *([("BUNIT", unit)] if unit else []), ("COMMENT", long_name)]


def camera_cards(camera: CameraFacts, integration_time: float | None) -> list[tuple[str, Any, str]]:
    """Return what is known of the camera and its frames as the usual cards."""
    taken = None if camera.taken is None else datetime.fromtimestamp(camera.taken, UTC)
    name = camera.name and camera.name.encode("ascii", "replace").decode()  # no other signs are allowed
    cards = [
        ("EXPTIME", integration_time, "[s] integration time"),
        ("DATE-OBS", taken and taken.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3], "UTC, start of the first frame"),
        ("INSTRUME", name, "camera"),
        ("CCD-TEMP", camera.temperature, "[degC] temperature of the sensor"),
    ]
    return [card for card in cards if card[1] is not None]


def input_cards(
    frames: FrameSequence, readers: Sequence[FrameReader], camera: CameraFacts, time: float | None
) -> list[Any]:
    """Return the cards that all input files have alike, for the region of interest, and those of the camera.

    World coordinates are kept if all their cards are alike. The integration time is in s; None: not known.
    """
    from astropy.io import fits

    headers = (fits.Header(reader.cards()) for reader in readers)
    header = next(headers)
    for other in headers:
        alike = {str(card) for card in other.cards}
        kept = [card for card in header.cards if str(card) in alike]
        if any(_WCS.fullmatch(card.keyword) for card in header.cards if str(card) not in alike):
            kept = [card for card in kept if not _WCS.fullmatch(card.keyword)]
        header = fits.Header(kept)
    for name in list(header):
        if (axis := re.fullmatch("CRPIX([12])[A-Z]?", name)) and isinstance(header[name], int | float):
            header[name] -= frames.corner[2 - int(axis[1])]
        elif name in _SECTIONS and not frames.whole_frames:
            del header[name]
    header.extend(camera_cards(camera, time), unique=True)
    return list(header.cards)


def write_images(path: Path, images: Sequence[FitsImage]) -> None:
    """Write a file of images that come by blocks, the first as the primary one, the others as extensions.

    Raises:
        StoreError: the folder cannot be written.
        MissingDependencyError: astropy is not installed.
    """
    require("astropy.io.fits", "fits", "FITS files")
    from astropy.io import fits

    quiet = warnings.catch_warnings(action="ignore")  # cards of cameras may have to be mended
    with whole_file(path) as part, part.open("wb") as stream, quiet:
        for number, (blocks, shape, dtype, cards) in enumerate(images):
            bits = 8 * dtype.itemsize
            zero = UNSIGNED_ZERO.get(bits, 0) if dtype.kind == "u" else 0
            header = fits.Header(
                [
                    ("XTENSION", "IMAGE") if number else ("SIMPLE", True),
                    ("BITPIX", -bits if dtype.kind == "f" else bits),
                    ("NAXIS", len(shape)),
                    *((f"NAXIS{axis}", length) for axis, length in enumerate(reversed(shape), 1)),
                    *([("PCOUNT", 0), ("GCOUNT", 1)] if number else []),
                    *([("BSCALE", 1), ("BZERO", zero)] if zero else []),
                ]
            )
            header.extend(cards)
            stream.write(header.tostring().encode("ascii"))
            for block in blocks:
                values = np.asarray(block, dtype)
                values = values ^ dtype.type(zero) if zero else values
                stream.write(np.ascontiguousarray(values, dtype.newbyteorder(">")).data)
            stream.write(bytes(-stream.tell() % 2880))
