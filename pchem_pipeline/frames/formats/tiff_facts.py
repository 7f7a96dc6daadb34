"""What the tags and metadata of a TIFF file say besides the pixels; works on tifffile's objects."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import InputError

__all__ = ["check_chain", "images_behind_one_page", "stated_bit_depth", "stated_channels", "stated_time"]

_EXPOSURE_TAG = 33434
_MICRO_MANAGER_TAG = 51123
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "\u00b5s": 1e-6, "us": 1e-6, "ns": 1e-9, "min": 60.0}


def check_chain(path: Path, file: Any, size: int) -> None:
    """Refuse a file whose chain of pages points behind its end: the library stops there silently."""
    last = file.pages[-1]
    offset_size = file.tiff.offsetsize
    count_size = file.tiff.tagnosize
    end = last.offset + count_size + file.tiff.tagsize * _tag_count(file, last)
    handle = file.filehandle
    handle.seek(end)
    data = handle.read(offset_size)
    following = int.from_bytes(data, "big" if file.byteorder == ">" else "little")
    if len(data) < offset_size or following >= size:
        raise InputError(
            f"{path}: truncated: only {len(file.pages)} pages are within the file's {size} bytes; copy it "
            "again"
        )


def _tag_count(file: Any, page: Any) -> int:
    handle = file.filehandle
    handle.seek(page.offset)
    data = handle.read(file.tiff.tagnosize)
    return int.from_bytes(data, "big" if file.byteorder == ">" else "little")


def images_behind_one_page(file: Any) -> int:
    """Return the frames behind a single directory (ImageJ above 4 GB, tifffile's truncated series)."""
    if file.is_imagej and file.imagej_metadata:
        return max(1, int(file.imagej_metadata.get("images", 1)))
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
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _ome(file: Any) -> str:
    return (file.ome_metadata or "") if file.is_ome else ""


def stated_channels(file: Any) -> int:
    """Return the number of channels that ImageJ or OME metadata state; 1 if they do not."""
    if file.is_imagej and file.imagej_metadata:
        return int(file.imagej_metadata.get("channels", 1))
    match = re.search(r'SizeC="(\d+)"', _ome(file))
    return int(match[1]) if match else 1


def stated_bit_depth(file: Any, page: Any) -> int | None:
    """Return the bits of a sample where the file says more than the size of its samples."""
    match = re.search(r'SignificantBits="(\d+)"', _ome(file))
    if match:
        return int(match[1])
    own = _shaped(file).get("bit_depth")
    if isinstance(own, int):
        return own
    bits = page.bitspersample
    return int(bits) if isinstance(bits, int) and bits not in (8, 16, 32) else None


def stated_time(file: Any, page: Any) -> float | None:
    """Return the exposure time in s from JSON, OME-XML, EXIF tag, or Micro-Manager; else None."""
    own = _shaped(file).get("integration_time")
    if isinstance(own, int | float):
        return _positive(float(own))
    match = re.search(r'<[^<>]*ExposureTime="([\d.eE+-]+)"[^<>]*>', _ome(file))
    if match:
        unit = re.search(r'ExposureTimeUnit="([^"]+)"', match[0])
        scale = _TIME_UNITS.get(unit[1] if unit else "s")
        return _positive(float(match[1]) * scale) if scale else None
    if _EXPOSURE_TAG in page.tags:
        value = page.tags[_EXPOSURE_TAG].value
        return _positive(value[0] / value[1]) if isinstance(value, tuple) and value[1] else None
    if _MICRO_MANAGER_TAG in page.tags:
        record = page.tags[_MICRO_MANAGER_TAG].value
        exposure = record.get("Exposure-ms") if isinstance(record, dict) else None
        return _positive(1e-3 * float(exposure)) if exposure is not None else None
    return None


def _positive(value: float) -> float | None:
    return value if math.isfinite(value) and value > 0 else None
