"""What the tags and metadata of a TIFF file say besides the pixels; works on tifffile's objects."""

from __future__ import annotations

import html
import json
import math
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import (
    CameraFacts,
    Duration,
    Stated,
    agreed_duration,
    bits_of,
    celsius,
    duration_of,
    facts_from_names,
    first_of,
    seconds_of,
    text_of,
)
from pchem_pipeline.frames.settings import Area

#: tags of a directory, as in tifffile
_MOST_TAGS = 4096
_MOST_PAGES = 100_000
#: colours of a mosaic by their numbers
_COLOURS = "RGBCMYW"


def check_chain(path: Path, size: int) -> None:
    """Walk from directory to directory: the library stops silently at one that is damaged, or never.

    Raises:
        ValueError: no TIFF file.
        InputError: a directory that is not within the file, or a circular chain.
    """
    with path.open("rb") as stream:
        head = stream.read(16)
        order: Literal["little", "big"] = "big" if head[:2] == b"MM" else "little"
        version = int.from_bytes(head[2:4], order)
        if len(head) < 8 or head[:2] not in (b"II", b"MM") or version not in (42, 43):
            raise ValueError("header")
        # bytes of the count of a directory, of a tag and of a pointer; where the header names the first one
        count_bytes, tag_bytes, pointer, first = (8, 20, 8, 8) if version == 43 else (2, 12, 4, 4)
        following = int.from_bytes(head[first : first + pointer], order)
        seen: set[int] = set()
        while following:
            if len(seen) > _MOST_PAGES:
                raise InputError(f"more than {_MOST_PAGES} pages; write several files, or an npy array")
            if following in seen:
                raise InputError(
                    f"damaged: after {len(seen)} pages the list of pages is circular; copy it again"
                )
            seen.add(following)
            stream.seek(following)
            tags = int.from_bytes(stream.read(count_bytes), order)
            stream.seek(following + count_bytes + min(tags, _MOST_TAGS) * tag_bytes)
            data = stream.read(pointer)
            if tags > _MOST_TAGS or len(data) < pointer:
                raise _broken_chain(len(seen) - 1, size)
            following = int.from_bytes(data, order)
        if not seen:
            raise _broken_chain(0, size)


def _broken_chain(pages: int, size: int) -> InputError:
    if not pages:
        return InputError("not a valid tiff file, or truncated (no pages); copy it again")
    return InputError(
        f"truncated: the file ({size} bytes) ends after {pages} page{'s' * (pages != 1)}; copy it again"
    )


def images_behind_one_page(file: Any) -> int:
    """Return the frames behind a single directory (ImageJ above 4 GB, MetaMorph, tifffile's truncated)."""
    if file.is_imagej and file.imagej_metadata:
        return max(1, int(file.imagej_metadata.get("images", 1)))
    tags = file.pages[0].tags
    if "UIC2tag" in tags:
        return max(1, int(tags["UIC2tag"].count))
    record = _shaped(file)
    return math.prod(record["shape"][:-2]) if record.get("truncated") else 1


def _shaped(file: Any) -> dict[str, Any]:
    """Return the JSON record in the description, from tifffile or our writer; else empty.

    Not ``shaped_metadata``: the library would look for series through all pages.
    """
    text = file.pages[0].description
    if not text.startswith("{") or '"shape"' not in text:
        return {}
    try:
        record = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _ome(file: Any) -> str:
    return (file.ome_metadata or "") if file.is_ome else ""


def stated_channels(file: Any) -> tuple[int, int]:
    """Return the channels, and the images of all of them, that ImageJ or OME metadata state; else (1, 1)."""
    if file.is_imagej and file.imagej_metadata:
        record = file.imagej_metadata
        return int(record.get("channels", 1)), int(record.get("images", 1))
    found = (re.search(rf'Size{axis}="(\d+)"', _ome(file)) for axis in "CZT")
    sizes = [int(match[1]) if match else 1 for match in found]
    return sizes[0], math.prod(sizes)


def stated_facts(file: Any, page: Any) -> Stated:
    """Return what our own JSON, OME-XML, Micro-Manager or tags say of frames that are like a page."""
    head = file.pages[0]
    own_camera, own_duration, own_depth = facts_from_names(_shaped(file))
    record = _tag(head, "MicroManagerMetadata")
    record = record if isinstance(record, dict) else {}
    hot = next((value for name, value in record.items() if name.endswith("Temperature")), None)
    cameras = (
        own_camera,
        _ome_camera(_ome(file)),
        CameraFacts(
            text_of(record.get("Camera")), temperature=celsius(hot), taken=seconds_of(record.get("Time"))
        ),
        CameraFacts(_make_and_model(head), taken=seconds_of(_tag(head, "DateTime"))),
    )
    times = (
        own_duration,
        _ome_time(_ome(file)),
        _ratio(_tag(head, "ExposureTime")),
        _ratio(exif.get("ExposureTime")) if isinstance(exif := _tag(head, "ExifTag"), dict) else None,
        duration_of("Exposure-ms", record.get("Exposure-ms"), "ms"),
    )
    bits = page.bitspersample  # which say nothing where they are those of a whole type
    significant = re.search(r'SignificantBits="(\d+)"', _ome(file))
    stated = bits_of(int(significant[1])) if significant else None
    depths = (stated, own_depth, None if bits in (8, 16, 32) else bits_of(bits))
    names = [each.name for each in fields(CameraFacts)]
    camera = CameraFacts(*(first_of(getattr(each, name) for each in cameras) for name in names))
    return camera, agreed_duration(times), first_of(depths)


def mosaic(page: Any) -> str:
    """Return the colours of a mosaic from left to right and top to bottom; empty where there is none."""
    if getattr(page.photometric, "name", "") != "CFA":
        return ""
    pattern = bytes(_tag(page, "CFAPattern") or b"")[:36]
    return "".join(_COLOURS[each] for each in pattern if each < len(_COLOURS)) or "CFA"


def active_area(page: Any) -> Area | None:
    """Return the light-sensitive part of a DNG, see `FrameReader.active`; None where it says none."""
    rows, columns = page.shape[-2:]
    top, left, bottom, right = _tag(page, "ActiveArea") or (0, 0, 0, 0)
    inside = 0 <= top < bottom <= rows and 0 <= left < right <= columns
    return (top, bottom, left, right) if inside else None


def _ome_time(text: str) -> Duration | None:
    plane = re.search(r'<[^<>]*\sExposureTime="[^<>]*>', text)
    unit = _attribute(plane, "ExposureTimeUnit") or "s"  # as OME has it
    return duration_of("ExposureTime of OME", _attribute(plane, "ExposureTime"), unit)


def _ratio(value: Any) -> Duration | None:
    known = isinstance(value, tuple) and value[1]
    return duration_of("ExposureTime of EXIF", value[0] / value[1], "s") if known else None


def _ome_camera(text: str) -> CameraFacts:
    detector = re.search(r"<Detector [^<>]*>", text)
    surroundings = re.search(r"<ImagingEnvironment [^<>]*>", text)
    date = re.search(r"<AcquisitionDate>([^<>]*)<", text)
    hot = _attribute(surroundings, "Temperature")
    return CameraFacts(
        text_of(_attribute(detector, "Model")),
        text_of(_attribute(detector, "SerialNumber")),
        celsius(hot, _attribute(surroundings, "TemperatureUnit") or "C"),
        seconds_of(date[1].strip()) if date else None,
    )


def _attribute(element: re.Match[str] | None, name: str) -> str | None:
    found = re.search(rf'\s{name}="([^"]*)"', element[0]) if element else None
    return html.unescape(found[1]) if found else None


def _make_and_model(page: Any) -> str | None:
    make, model = text_of(_tag(page, "Make")), text_of(_tag(page, "Model"))
    if make and model and model.lower().startswith(make.lower()):
        return model
    return " ".join(part for part in (make, model) if part) or None


def _tag(page: Any, name: str) -> Any:
    return page.tags[name].value if name in page.tags else None
