"""SPE files of Princeton Instruments: versions 2 (WinView) and 3 (LightField).

A header of 4100 bytes, the frames, and from version 3 on a footer in XML, which says what lies where: behind
each frame there may be numbers that the camera gave to it. Source: the maker's "SPE 3.0 File Format
Specification".
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import numpy as np

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import (
    CameraFacts,
    Stated,
    bits_of,
    celsius,
    duration_of,
    seconds_of,
    text_of,
)
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, OpenedFile, even_offsets
from pchem_pipeline.frames.formats.kinds import check_samples
from pchem_pipeline.frames.settings import InputSettings

_HEADER_BYTES = 4100
#: place of a number of the header, and its type
_FIELDS = {
    "seconds": (10, "<f"),
    "temperature": (36, "<f"),
    "columns": (42, "<H"),
    "samples": (108, "<h"),
    "rows": (656, "<H"),
    "footer": (678, "<Q"),
    "frames": (1446, "<i"),
    "regions": (1510, "<h"),
    "version": (1992, "<f"),
}
_SAMPLES = {0: "<f4", 1: "<i4", 2: "<i2", 3: "<u2", 6: "u1", 8: "<u4"}


class SpeReader(ContiguousReader):
    """SPE files with one region of interest."""

    format_name = "spe"
    suffixes: ClassVar[tuple[str, ...]] = (".spe",)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        with path.open("rb") as stream:
            head = stream.read(_HEADER_BYTES)
        field = {name: struct.unpack_from(kind, head, place)[0] for name, (place, kind) in _FIELDS.items()}
        if field["samples"] not in _SAMPLES:
            raise InputError(
                f"samples of type {field['samples']}; record whole numbers (16 or 32 bits), or correct the "
                "name if this is no SPE file"
            )
        stored = np.dtype(_SAMPLES[field["samples"]])
        n, rows, columns, regions = (field[name] for name in ("frames", "rows", "columns", "regions"))
        step, footer = None, None
        if field["version"] >= 3 and field["footer"]:
            footer = _footer(path, field["footer"], self.size)
            frame = next(footer.iterfind(".//{*}DataBlock[@type='Frame']"))
            parts = frame.findall(".//{*}DataBlock[@type='Region']")
            n, step, regions = int(frame.attrib["count"]), int(frame.attrib["stride"]), len(parts)
            rows, columns = (int(parts[0].attrib[name]) for name in ("height", "width"))
        if regions > 1:
            raise InputError(f"{regions} regions of interest; record one")
        if rows < 1 or columns < 1 or n < 0:
            raise InputError(f"damaged header ({n} frames, {rows} x {columns}); copy it again")
        offset = None if stored.kind == "f" else check_samples(stored, settings)
        frame_bytes = rows * columns * stored.itemsize
        offsets = even_offsets(n, frame_bytes, self.size, start=_HEADER_BYTES, step=step)
        self.set_layout(Layout(offsets, rows, columns, stored, offset))
        if footer is None:
            duration = duration_of("exp_sec", field["seconds"], "s")
            self.take_facts(CameraFacts(temperature=celsius(field["temperature"])), duration)
        else:
            self.take_facts(*_stated_facts(footer))
            self._read_stamps(footer)

    def _read_stamps(self, footer: Any) -> None:
        """Read the numbers behind the frames: when their exposure began, and the camera's count."""
        n, at = self.shape[0], 0
        places: dict[str, tuple[int, Any]] = {}
        for element in footer.iterfind(".//{*}MetaBlock/*"):
            places.setdefault(element.get("event") or element.tag.rpartition("}")[2], (at, element))
            at += int(element.get("bitDepth", 0)) // 8
        offsets = self._layout.offsets + self._layout.frame_bytes
        if not at or not n or int(offsets[-1]) + at > self.size:
            return
        with OpenedFile(self.paths[0], self.size) as file:
            data = [file.read_bytes(offset, at) for offset in offsets.tolist()]
        numbers = {
            name: np.array([struct.unpack_from("<q", each, place)[0] for each in data])
            for name, (place, element) in places.items()
            if element.get("type") == "Int64" and element.get("bitDepth") == "64"
        }
        self.frame_stamps = numbers.get("FrameTrackingNumber")
        begun = numbers.get("ExposureStarted")
        if begun is not None:
            element = places["ExposureStarted"][1]
            zero, rate = seconds_of(element.get("absoluteTime")), float(element.get("resolution", 0))
            if zero is not None and rate > 0:
                self.timestamps = zero + begun / rate


def _footer(path: Path, start: int, size: int) -> Any:
    """Return the root of the XML behind the frames."""
    if not _HEADER_BYTES <= start < size or size - start > 1 << 26:
        raise InputError("truncated before its footer, or a damaged header; copy the file again")
    with path.open("rb") as stream:
        stream.seek(start)
        text = stream.read()
    if b"<!DOCTYPE" in text:  # entities can unfold without an end
        raise InputError("its footer declares entities, which SPE files do not have; copy it again")
    return ElementTree.fromstring(text)


def _stated_facts(footer: Any) -> Stated:
    """Return what the footer says of the camera and its setting."""
    nothing = ElementTree.Element("none")
    camera, origin = (next(footer.iterfind(f".//{{*}}{name}"), nothing) for name in ("Camera", "Origin"))
    names = {"gain": "AnalogGain", "readout_mode": "Quality"}
    setup = {ours: footer.findtext(f".//{{*}}Adc//{{*}}{name}") for ours, name in names.items()}
    depth = footer.findtext(".//{*}Adc//{*}BitDepth") or ""
    return (
        CameraFacts(
            text_of(camera.get("model")),
            text_of(camera.get("serialNumber")),
            celsius(footer.findtext(".//{*}Temperature//{*}Reading")),
            seconds_of(origin.get("created")),
            {name: value for name, value in setup.items() if value},
        ),
        duration_of("ExposureTime", footer.findtext(".//{*}ExposureTime"), "ms"),
        bits_of(int(depth)) if depth.isdecimal() else None,
    )
