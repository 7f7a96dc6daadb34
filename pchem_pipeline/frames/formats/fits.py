"""FITS cubes, lists of single images, a frame in each extension, and tile-compressed images.

FITS stores unsigned integers as signed ones with BZERO = 2**(bits - 1). Uncompressed images are read
straight from their offset, byte-swapped, and get their sign bit flipped in place; compressed ones go
through astropy. Not astropy for all: it cannot map such integers into memory, and its sections read less
than half as fast (0.9 against 2.4 GB/s) into arrays of their own.
"""

from __future__ import annotations

import itertools
import math
import re
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, require
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.frames.camera import (
    TIME_UNIT,
    CameraFacts,
    Duration,
    agreed_duration,
    bits_of,
    celsius,
    duration_of,
    first_of,
    seconds_of,
    text_of,
    texts_of,
)
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, even_offsets
from pchem_pipeline.frames.formats.fits_files import UNSIGNED_ZERO, FitsImage, camera_cards, write_images
from pchem_pipeline.frames.formats.kinds import (
    check_coded,
    check_unpacked_size,
    chosen_pieces,
    mosaic_note,
    windows,
)
from pchem_pipeline.frames.registry import check_unpacked
from pchem_pipeline.frames.settings import Area, InputSettings
from pchem_pipeline.frames.writing import StackFacts

_TIME_KEYWORDS = ("EXPTIME", "EXPOSURE", "INTTIME", "ITIME")
_CAMERA_KEYWORDS = ("CAMERA", "DETNAM", "DETECTOR", "INSTRUME")
_SERIAL_KEYWORDS = ("SERIALNO", "SERNO", "SERIAL", "CAMSERNO", "DETSERNO")
_SETUP_KEYWORDS = ("GAIN", "OFFSET", "READMODE", "READOUTM", "XBINNING", "YBINNING", "IMAGETYP")
#: of the light-sensitive area the first counts
_ACTIVE_KEYWORDS, _OVERSCAN_KEYWORDS = ("TRIMSEC", "DATASEC"), ("BIASSEC",)
#: alike in images that are frames of one sensor: kind, exposure, setting, camera, place on the detector
_ALIKE = (
    *("EXTNAME", "BITPIX", "NAXIS", "NAXIS1", "NAXIS2", "BZERO", "BSCALE", "TILES"),
    *(*_TIME_KEYWORDS, *_SETUP_KEYWORDS, *_CAMERA_KEYWORDS, *_SERIAL_KEYWORDS),
    *_ACTIVE_KEYWORDS,
    *_OVERSCAN_KEYWORDS,
    *("DETSEC", "CCDSEC", "CCDNAME", "CCDCHIP", "CHIPID", "AMPNAME", "AMPSEC"),
)
_TEMPERATURE_KEYWORDS = ("CCD-TEMP", "DET-TEMP", "DETTEMP", "CCDTEMP", "SENSTEMP", "SET-TEMP")
#: of the samples, or of the place of an image in its file
_SAMPLE_KEYWORDS = (
    *("BUNIT", "BLANK", "DATAMIN", "DATAMAX", "CHECKSUM", "DATASUM"),
    *("EXTNAME", "EXTVER", "EXTLEVEL", "INHERIT"),
)
#: astropy's compressed images share a file handle and are not made for threads
_LOCK = threading.Lock()


class FitsReader(ContiguousReader):
    """The only image of a FITS file, 2-D or 3-D, or a 2-D one in each extension."""

    format_name = "fits"
    library: ClassVar[str] = "astropy"
    suffixes: ClassVar[tuple[str, ...]] = (".fits", ".fit", ".fts", ".fz")
    magic: ClassVar[tuple[bytes, ...]] = (b"SIMPLE  =",)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        require("astropy.io.fits", "fits", "FITS files")
        from astropy.io import fits

        with path.open("rb") as stream:
            check_unpacked(path, stream.read(8))
        options = {"memmap": False, "do_not_scale_image_data": True, "lazy_load_hdus": True}
        # truncation and sloppy headers are reported below
        with warnings.catch_warnings(action="ignore"), fits.open(path, **options) as hdus:
            self._numbers = _images(hdus, settings)
            hdu, several = hdus[self._numbers[0]], len(self._numbers) > 1
            header, primary = hdu.header, hdus[0].header
            sizes = [header[f"NAXIS{axis}"] for axis in range(header["NAXIS"], 0, -1)]
            sizes = [len(self._numbers), *sizes] if several else sizes
            compressed = isinstance(hdu, fits.CompImageHDU)
            stored, zero = _samples(header, compressed)
            self.set_stack(sizes, stored, None if zero else settings, "image")
            n, rows, columns = self.shape
            self.notes = _value_notes(header, n, several=several)
            if compressed:
                self.notes += _coding_notes(
                    path, self._numbers, stored.itemsize * math.prod(hdu.tile_shape), biased=bool(zero)
                )
                self.rows_per_read = min(rows, int(hdu.tile_shape[-2]))
            starts = [0 if compressed else int(hdus[each].fileinfo()["datLoc"]) for each in self._numbers]
            end = hdus[-1].fileinfo()["datLoc"] + hdus[-1].fileinfo()["datSpan"]
            self._read_facts(primary, header)
        if compressed:
            if end > self.size:
                raise InputError(f"truncated: {end} bytes needed, the file has {self.size}; copy it again")
            check_coded(self.shape, hdu.tile_shape, stored.itemsize, self.size)
            return
        offsets = np.array(starts, np.int64)
        if not several:
            offsets = even_offsets(n, rows * columns * stored.itemsize, self.size, start=starts[0])
        self.set_layout(Layout(offsets, rows, columns, stored, zero or self._offset))

    def _read_facts(self, *headers: Any) -> None:
        """Take each fact from the last header that has it."""
        last = [*reversed(headers)]
        units = [str(header[name]) for header in last for name in header if TIME_UNIT.fullmatch(name)][:1]

        def time_of(name: str) -> Duration | None:
            header = next((each for each in last if name in each), None)  # the image's own before the primary
            return header and duration_of(name, header[name], *units, comment=str(header.comments[name]))

        # with dead time, or without it
        whole = map(time_of, ("TELAPSE", "XPOSURE"))
        duration = agreed_duration(map(time_of, _TIME_KEYWORDS)) or first_of(whole)

        def area_of(names: Sequence[str]) -> Area | None:
            sections = (header[name] for name in names for header in last if name in header)
            found: Area | None = first_of(_area(section, *self.shape[1:]) for section in sections)
            return found

        self.active, self.overscan = area_of(_ACTIVE_KEYWORDS), area_of(_OVERSCAN_KEYWORDS)
        depths = (bits_of(header.get(name)) for header in last for name in ("BITDEPTH", "ADCBITS"))
        self.take_facts(_camera(last), duration, first_of(depths))

    def cards(self) -> tuple[Any, ...]:
        """See `FrameReader.cards`."""
        from astropy.io import fits

        with warnings.catch_warnings(action="ignore"):  # as above
            with fits.open(self.paths[0], memmap=False, lazy_load_hdus=True) as hdus:
                header = hdus[self._numbers[0]].header.copy(strip=True)
                if self._numbers[0]:
                    header.extend(hdus[0].header, unique=True)
            header = fits.Header.fromstring(header.tostring())  # what breaks the standard is mended
        for name in _SAMPLE_KEYWORDS:
            header.remove(name, ignore_missing=True)
        return tuple(header.cards)

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        from astropy.io import fits

        with _LOCK, fits.open(self.paths[0], memmap=False) as hdus:
            if len(self._numbers) == 1:
                for part, window in windows(buffer, self._full, t0, y0):
                    part[...] = hdus[self._numbers[0]].section[window]
            else:
                for frame, number in zip(buffer, self._numbers[t0:t1], strict=True):
                    frame[...] = hdus[number].section[y0:y1]


def _images(hdus: Any, settings: InputSettings) -> list[int]:
    """Return the number of the only image of the file, or those of extensions with a frame each."""
    from astropy.io import fits

    kind = fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU
    numbered = ((n, hdu) for n, hdu in enumerate(hdus) if isinstance(hdu, kind))
    images = [(n, hdu) for n, hdu in numbered if hdu.header.get("NAXIS", 0) >= 2]
    if not images:
        raise InputError("no image; omit it")
    if settings.dataset is not None:
        wanted = settings.dataset.strip()
        images = [(n, hdu) for n, hdu in images if wanted in (str(n), hdu.name)]
    kinds = [_kind(hdu) for _, hdu in images]
    differing = [name for name in _ALIKE if len({kind[name] for kind in kinds}) > 1]
    single = all(n and hdu.header["NAXIS"] == 2 for n, hdu in images)
    if not images or (len(images) > 1 and (differing or not single)):
        names = first_few((f"{n} ({hdu.name or 'unnamed'})" for n, hdu in images), 12) or "none"
        names += f", which differ in {', '.join(differing[:4])}" if differing else ""
        raise InputError(
            f"images in the file{' with this name' * (settings.dataset is not None)}: {names}; choose one by "
            "its number in input.dataset (--dataset), or write the frames as one cube"
        )
    return [n for n, _ in images]


def _kind(hdu: Any) -> dict[str, str]:
    """Return what frames of one sensor and exposure have alike, of the name of an image all but numbers."""
    values = {name: hdu.header.get(name) for name in _ALIKE}
    values |= {"EXTNAME": re.sub(r"[\W\d_]+", "", hdu.name), "TILES": getattr(hdu, "tile_shape", None)}
    return {name: f"{each:.3g}" if isinstance(each, float) else str(each) for name, each in values.items()}


def _value_notes(header: Any, frames: int, *, several: bool) -> tuple[str, ...]:
    """Say where pixels may be no samples, or planes no frames."""
    notes = []
    if "BLANK" in header:
        notes.append(f"BLANK = {header['BLANK']} marks pixels without a value; read as stored")
    if pattern := text_of(header.get("BAYERPAT")):
        notes.append(mosaic_note(pattern))
    if several:
        notes.append(
            f"its {frames} images are read as frames; if they are parts of a sensor, choose one by "
            "input.dataset (--dataset)"
        )
    elif frames == 3:
        notes.append("its 3 planes are read as frames; if they are colours, write one file per colour")
    return tuple(notes)


def _coding_notes(path: Path, numbers: Sequence[int], piece: int, *, biased: bool) -> tuple[str, ...]:
    """Say where compression lost information in images of tiles of ``piece`` bytes, ``biased`` by BZERO.

    Refuse biased samples in PLIO, of which the library does not undo the shift, and oversized tiles.
    """
    from astropy.io import fits

    notes = []
    with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
        for number in numbers:
            header = hdus[number].header
            coding = str(header.get("ZCMPTYPE", "")).strip()
            deflated = {"COMPRESSED_DATA"} if coding.startswith("GZIP") else set()
            for name in {*deflated, "GZIP_COMPRESSED_DATA"} & {*hdus[number].columns.names}:
                some = chosen_pieces(hdus[number].data[name], len)
                check_unpacked_size((tile.tobytes() for tile in some), piece, ["gzip"])
            options = {str(header[f"ZNAME{i}"]).strip(): header.get(f"ZVAL{i}") for i in _numbers(header)}
            if coding.startswith("PLIO") and biased:
                raise InputError(
                    "unsigned samples compressed by PLIO cannot be decoded reliably; unpack with funpack"
                )
            if coding.startswith("HCOMPRESS") and float(options.get("SCALE") or 0) != 0:
                notes.append(
                    f"lossy compression (HCOMPRESS, scale {options['SCALE']}); noise and histograms are "
                    "altered"
                )
    return tuple(dict.fromkeys(notes))


def _numbers(header: Any) -> Iterator[int]:
    """Yield the numbers of the options of a compression: ZNAME1, ZNAME2, ..."""
    return itertools.takewhile(lambda number: f"ZNAME{number}" in header, itertools.count(1))


def _camera(headers: Sequence[Any]) -> CameraFacts:
    """Return what headers say of the camera; the first that has a keyword counts."""
    hot, unit = _keyword(headers, _TEMPERATURE_KEYWORDS)
    taken, _ = _keyword(headers, ("DATE-OBS", "DATE-BEG"))
    clock, _ = _keyword(headers, ("TIME-OBS",))
    if isinstance(taken, str) and "T" not in taken and isinstance(clock, str):
        taken = f"{taken}T{clock}"
    stated = re.search(r"[\[(][KF][\])]|kelvin|fahrenheit", unit, re.IGNORECASE)
    return CameraFacts(
        text_of(_keyword(headers, _CAMERA_KEYWORDS)[0]),
        text_of(_keyword(headers, _SERIAL_KEYWORDS)[0]),
        celsius(hot, stated[0] if stated else "C"),
        seconds_of(taken),
        texts_of({name: _keyword(headers, (name,))[0] for name in _SETUP_KEYWORDS}, _SETUP_KEYWORDS),
    )


def _area(section: Any, rows: int, columns: int) -> Area | None:
    """Return rows and columns of ``[x1:x2,y1:y2]``, counted from 1, both ends included; None if unusable."""
    match = re.fullmatch(r"\s*\[(\d+):(\d+),(\d+):(\d+)\]\s*", str(section))
    if match is None:
        return None
    x1, x2, y1, y2 = map(int, match.groups())
    return (y1 - 1, y2, x1 - 1, x2) if 1 <= x1 <= x2 <= columns and 1 <= y1 <= y2 <= rows else None


def _keyword(headers: Sequence[Any], names: Sequence[str]) -> tuple[Any, str]:
    """Return the value of the first keyword that is there, and its comment."""
    for header in headers:
        for name in names:
            if name in header and header[name] not in ("", None):
                return header[name], str(header.comments[name])
    return None, ""


def _samples(header: Any, compressed: bool) -> tuple[np.dtype[Any], int]:
    """Return the stored type, and what BZERO adds to signed samples, 0 where nothing is."""
    bits = int(header["BITPIX"])
    zero, scale = header.get("BZERO", 0), header.get("BSCALE", 1)
    if bits < 0:
        return np.dtype(f">f{-bits // 8}"), 0
    stored = np.dtype("u1") if bits == 8 else np.dtype(f">i{bits // 8}")
    top = UNSIGNED_ZERO.get(bits, 0)
    plain = not compressed and not isinstance(zero, str) and zero == int(zero)
    if scale != 1 or not (zero in (0, top) or (plain and 0 < zero < top)):
        raise InputError(f"scaled data (BSCALE {scale}, BZERO {zero}), no raw DN; write raw integers")
    return stored, int(zero)


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as one cube (one frame: one image); see `frames.writing.write_frames`."""
    shape, dtype, integration_time, bit_depth = stack
    cards = camera_cards(CameraFacts(), integration_time)
    if bit_depth is not None:
        cards.append(("BITDEPTH", bit_depth, "bits of the ADC"))
    write_images(path, [FitsImage(blocks, shape if shape[0] > 1 else shape[1:], dtype, cards)])
